"""Basis regressors of named signals: steps give the same as series; entries of files; bounds."""

from types import SimpleNamespace

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters, Effect
from quadvel_actuator.effects.basis_regressors import BasisRegressor
from quadvel_actuator.effects.regressor_entries import load_regressor
from quadvel_actuator.effects.shapes import Curve, Filter, Lag, Resonance, Wave
from tests.helpers.robots import ALIENGO
from tests.quadvel_sysid.simulated_joints import NAMES, parameters

JOINTS = NAMES[:3]
DT = 0.001
SHAPES = {
    "curve": Curve([-0.4, -0.3, -0.5], [0.4, 0.5, 0.3], 6),
    "wave": Wave([9.0, 12.0, 15.0], 2),
    "filter": Filter((0.001, 0.002, 0.004, 0.009, 0.02)),
    "lag": Lag(0.03),
    "resonance": Resonance(18.0, 0.05),
}


def _regressor(shape, signal="q", times="", bound=50.0, seed=0, at="drive"):
    weights = np.random.default_rng(seed).normal(size=(shape.count, 3))
    weights[:, 1] = 0.0
    bounds = np.array([bound, 0.0, bound])
    return BasisRegressor(signal, times, shape, np.array([True, False, True]), weights, bounds, at)


def _views(n=60):
    rng = np.random.default_rng(1)
    walk = {name: np.cumsum(rng.normal(0.0, 0.05, (n, 3)), axis=0) for name in ("q", "dq", "ddq", "q_des")}
    return [
        SimpleNamespace(t=np.array([k * DT]), **{name: x[k] for name, x in walk.items()}) for k in range(n)
    ]


@pytest.mark.parametrize("kind", SHAPES)
def test_steps_give_what_the_columns_of_a_series_give(kind):
    shape, u = SHAPES[kind], np.cumsum(np.random.default_rng(2).normal(0.0, 0.05, (80, 3)), axis=0)
    weights = np.random.default_rng(3).normal(size=(shape.count, 3))
    start = np.isin(np.arange(80), (0, 47))  # two stretches
    series = np.einsum("nkj,kj->nj", shape.columns(u, start, DT), weights)
    stepped = []
    for k in range(80):
        if start[k]:
            memory = shape.rest(u[k], DT)
        torque, memory = shape.advance(u[k], DT, weights, memory)
        stepped.append(torque)
    np.testing.assert_allclose(stepped, series, atol=1e-9)


def test_a_curve_is_a_spline_that_stays_at_its_ends():
    curve = Curve([0.0], [1.0], 5)
    weights = np.linspace(-1.0, 2.0, curve.count)[:, None]  # of a straight line
    x = np.array([-3.0, 0.0, 0.37, 1.0, 9.0])
    value = [curve.advance(np.array([one]), DT, weights, ())[0][0] for one in x]
    slope = 3.0 / (curve.count - 1) * 5
    np.testing.assert_allclose(value, -1.0 + 3.0 / 7.0 + slope * np.clip(x, 0.0, 1.0), atol=1e-12)


def test_a_resonance_rings_as_in_its_equation():
    shape, t = Resonance(18.0, 0.05), np.arange(400) * DT
    pole = 2 * np.pi * 18.0 * complex(-0.05, np.sqrt(1 - 0.05**2))
    u = np.where(np.arange(400) < 1, 0.0, 1.0)[:, None]
    columns = shape.columns(u, np.arange(400) == 0, DT)
    expected = abs(pole) / -pole * (1.0 - np.exp(pole * (t[1:] - 0.5 * DT)))
    np.testing.assert_allclose(columns[1:, 1, 0] + 1j * columns[1:, 2, 0], expected, atol=0.01)


def test_a_lag_follows_a_step_as_an_exponential():
    u = np.where(np.arange(200) < 1, 0.0, 1.0)[:, None]
    columns = Lag(0.03).columns(u, np.arange(200) == 0, DT)
    expected = 1.0 - np.exp(-(np.arange(1, 200) - 0.5) * DT / 0.03)
    np.testing.assert_allclose(columns[1:, 1, 0], expected, atol=0.001)


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize(("signal", "times"), [("q", ""), ("FL_hip_joint/tau", "direction"), ("t", "tau")])
def test_a_regressor_survives_its_entry_unchanged(kind, signal, times):
    names = (*JOINTS[:2], "FL_hip_joint")
    shape = SHAPES[kind] if signal == "q" else SHAPES[kind].for_columns(np.array([0]))
    regressor = _regressor(shape, signal, times)
    again = load_regressor(regressor.to_entry(names), names)
    tau = np.array([1.0, -2.0, 3.0])
    memories = [one.rest(_views()[0], tau, names, DT) for one in (regressor, again)]
    for view in _views():
        for k, one in enumerate((regressor, again)):
            torque, memories[k] = one.advance(view, tau, names, DT, memories[k])
            if k == 0:
                expected = torque
        np.testing.assert_allclose(torque, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"kind": "spline"}, "kind: found 'spline', expected one of curve"),
        ({"signal": "q_dot"}, "signal: found 'q_dot'"),
        ({"signal": "XX_joint/q"}, "signal: found 'XX_joint'"),
        ({"times": "q"}, "times: found 'q'"),
        ({"at": "gear"}, "at: found 'gear', expected one of drive, joint"),
        ({"joints": ["XX_joint"]}, r"joints: found \['XX_joint'\]"),
        ({"weights": [[1.0]]}, "weights, bound: found shapes"),
        ({"low": [0.0, float("nan")]}, "low: found"),
        ({"low": [0.0]}, "low: found 1 numbers, expected 2"),
        ({"width": 1.0}, "curve: .*width"),
    ],
)
def test_a_wrong_entry_is_refused_by_name(changes, said):
    with pytest.raises(ValueError, match=said):
        load_regressor(_regressor(SHAPES["curve"]).to_entry(JOINTS) | changes, JOINTS)


def _model(shape=(3,), bound=50.0, kind="filter", at="drive"):
    entries = [_regressor(SHAPES[kind], bound=bound, at=at).to_entry(JOINTS)]
    effect = Effect("learned_residual", (JOINTS[0], JOINTS[2]), {"terms": entries})
    truth = attrs.evolve(parameters((effect,), noise=0.0), joints=JOINTS)
    return ActuatorModel(truth, shape, DT)


@pytest.mark.parametrize(("at", "late"), [("drive", 1), ("joint", 0)])
def test_a_model_adds_its_regressors_after_its_parameters_went_through_a_file(tmp_path, at, late):
    """Regressors in the drive pass the output delay, one step here; regressors at the joint do not."""
    model = _model(at=at)
    model.parameters.save(tmp_path / "actuator.yaml")
    assert ActuatorParameters.load(ALIENGO, tmp_path / "actuator.yaml", some_joints=True) == model.parameters
    plain = ActuatorModel(attrs.evolve(model.parameters, effects=()), (3,), DT)
    regressor, memory, added = _regressor(SHAPES["filter"]), None, []
    for view in _views():
        memory = regressor.rest(view, view.q, JOINTS, DT) if memory is None else memory
        torque, memory = regressor.advance(view, view.q, JOINTS, DT, memory)
        added.append(torque)
    difference = [
        model.step(v.q, v.dq, v.q_des, 30.0, 0.5) - plain.step(v.q, v.dq, v.q_des, 30.0, 0.5)
        for v in _views()
    ]
    np.testing.assert_allclose(difference[late:], added[: len(added) - late], atol=1e-9)


def test_an_entry_that_names_no_place_is_of_the_drive():
    entry = _regressor(SHAPES["curve"]).to_entry(JOINTS)
    del entry["at"]
    assert load_regressor(entry, JOINTS).at == "drive"


def test_no_regressor_gives_more_than_its_bound():
    models = [_model(bound=0.2), _model(bound=1e-9)]
    torques = np.array([[m.step(v.q, v.dq, v.q_des, 30.0, 0.5) for v in _views()] for m in models])
    assert 0.19 < np.max(np.abs(torques[0] - torques[1])) <= 0.2 + 1e-9


@pytest.mark.parametrize("kind", ["filter", "lag", "resonance"])
def test_environments_of_a_batch_have_memories_of_their_own_and_peeks_leave_none(kind):
    single, batch = _model(kind=kind), _model((2, 3), kind=kind)
    views = _views()
    for k, v in enumerate(views):
        if k == 20:
            batch.reset(np.array([1]))
            fresh = _model(kind=kind)
        two = [np.tile(x, (2, 1)) for x in (v.q, v.dq, v.q_des)]
        batch.peek(*(one + 0.3 for one in two), 30.0, 0.5)
        torque = batch.step(*two, 30.0, 0.5)
        np.testing.assert_allclose(torque[0], single.step(v.q, v.dq, v.q_des, 30.0, 0.5), atol=1e-9)
        if k >= 20:
            np.testing.assert_allclose(torque[1], fresh.step(v.q, v.dq, v.q_des, 30.0, 0.5), atol=1e-9)
