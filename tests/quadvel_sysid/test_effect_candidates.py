"""Candidates of effects: one for each effect, defaults for those of other packages."""

from importlib.metadata import EntryPoint
from pathlib import Path

import attrs
import pytest

import quadvel_actuator
from quadvel_actuator import Effect, effects
from quadvel_actuator.effects import AddedEffect, Parameter
from quadvel_sysid.identify import identify
from quadvel_sysid.model.effect_candidate import EffectCandidate
from quadvel_sysid.search.effect_candidates import registry
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = NAMES[:2]


class MagneticDrag(AddedEffect):
    """An effect of another package: drag that is largest at a speed."""

    name = "magnetic_drag"
    parameters = (Parameter("a", "N m", 0.0, 20.0, 0.5), Parameter("v", "rad/s", 0.1, 20.0, 1.0))

    def torque(self, x, s, p):
        return -2.0 * p["a"] * p["v"] * s.dq / (s.dq**2 + p["v"] ** 2)


class MagneticDragCandidate(EffectCandidate):
    """Its candidate, which another package may add."""

    linear = ("a",)
    depends_on_commands = False


@pytest.fixture
def install(monkeypatch):
    """Install entry points, as (group, name, class)."""

    def install_entries(*entries):
        points = [
            EntryPoint(name, f"{kind.__module__}:{kind.__name__}", group) for group, name, kind in entries
        ]
        loads = {f"{kind.__module__}:{kind.__name__}": kind for _, _, kind in entries}
        monkeypatch.setattr(EntryPoint, "load", lambda self: loads[self.value])
        for module in (effects, registry):
            monkeypatch.setattr(
                module, "entry_points", lambda group: [one for one in points if one.group == group]
            )
        forget()

    def forget():
        effects.registry.cache_clear()
        registry.candidate_classes.cache_clear()

    yield install_entries
    forget()


def test_every_effect_of_the_actuator_has_a_candidate_of_its_own():
    assert EffectCandidate not in registry.candidate_classes().values()
    assert list(registry.candidate_classes()) == list(effects.registry())


def test_linear_parameters_are_parameters():
    for name, candidate in registry.candidate_classes().items():
        if name not in ("cross_coupling", "command_hold"):  # their forms depend on the log
            form = candidate(effects.registry()[name]())
            assert set(form.linear) <= set(form.names), name


def test_an_effect_of_another_package_is_found_without_a_candidate_of_its_own(install):
    install((effects.GROUP, "drag", MagneticDrag))
    drag = Effect(MagneticDrag.name, JOINTS, {"a": 1.5, "v": 0.8})
    truth = attrs.evolve(parameters([drag], noise=0.01), joints=JOINTS)
    report = identify([record(truth, 2, 3.0, 500, seed=2)]).report
    (found,) = report["effects"]
    assert found["name"] == MagneticDrag.name
    assert found["params"]["a"]["value"] == pytest.approx(1.5, rel=0.1)
    assert found["params"]["v"]["value"] == pytest.approx(0.8, rel=0.15)


def test_an_effect_of_another_package_may_name_its_candidate(install):
    install((effects.GROUP, "drag", MagneticDrag), (registry.GROUP, MagneticDrag.name, MagneticDragCandidate))
    others = effects.registry().keys() - {MagneticDrag.name}
    drive, joint = registry.effect_candidates(None, others)
    assert type(drive) is type(joint) is MagneticDragCandidate
    assert (drive.at, joint.at) == ("drive", "joint")


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("magnetic_drag", MagneticDrag, "expected an EffectCandidate"),
        ("unknown", MagneticDragCandidate, "expected an effect of another package"),
        ("armature", MagneticDragCandidate, "expected an effect of another package"),
    ],
)
def test_a_wrong_entry_point_of_a_candidate_is_refused_by_name(install, name, kind, message):
    install((effects.GROUP, "drag", MagneticDrag), (registry.GROUP, name, kind))
    with pytest.raises(ValueError, match=f"entry point {name} of {registry.GROUP}: .*{message}"):
        registry.candidate_classes()


def test_the_actuator_does_not_mention_the_identification():
    for path in Path(quadvel_actuator.__file__).parent.rglob("*.py"):
        assert "sysid" not in path.read_text(), path
