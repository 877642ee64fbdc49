"""Search for effects, end to end: logs in, reports out."""

from functools import cache

import attrs
import pytest

from quadvel_actuator import Effect
from quadvel_sysid.identify import identify
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = NAMES[:2]
FRICTION = Effect("coulomb_friction", JOINTS, {"c": 0.5, "v_0": 0.05})
SPRING = Effect("parallel_spring", JOINTS, {"k": 3.0, "q0": 0.6})


def _log(*effects, seconds=3.0, seed=2):
    truth = parameters(effects, input_delay=0.009, output_delay=0.003)
    return record(attrs.evolve(truth, joints=JOINTS), 2, seconds, 500, seed=seed)


@cache
def _friction_report():
    """The log with friction, and its report; no test changes them."""
    log = _log(FRICTION, seed=3)
    return log, identify([log]).report


def _named(*effects, **options):
    report = identify([_log(*effects, **options)]).report
    return {one["name"]: one for one in report["effects"]}, report


def test_two_effects_that_mask_each_other_are_both_found():
    found, report = _named(FRICTION, SPRING)
    assert set(found) == {"coulomb_friction", "parallel_spring"}
    assert report["after"]["heldout_mse"] < 1.15 * 0.066


def test_a_lag_is_distinguished_from_the_delays_that_it_biases():
    found, report = _named(Effect("first_order_lag", JOINTS, {"T": 0.01}))
    assert set(found) == {"first_order_lag"}
    low, high = report["after"]["output_delay_ms_ci95"]
    assert low < 3.0 < high


def test_shared_values_are_reported_once_and_others_for_each_joint():
    (same,) = _friction_report()[1]["effects"]
    assert same["name"] == "coulomb_friction"
    assert isinstance(same["params"]["c"]["value"], float)
    other = [
        attrs.evolve(FRICTION, joints=JOINTS[k : k + 1], parameters={"c": c, "v_0": 0.05})
        for k, c in enumerate((0.4, 1.2))
    ]
    each, _ = _named(*other)
    assert each["coulomb_friction"]["params"]["c"]["value"] == pytest.approx([0.4, 1.2], rel=0.15)


def test_error_and_p_value_come_from_rows_that_select_nothing():
    """A change of the reported rows changes neither the effects nor the training error."""
    log, first = _friction_report()
    block = (log.t / 0.2).astype(int) % 5 == 4  # s, as in `preparation.split_rows`
    loud = log.tau.copy()
    loud[block] += 0.5 * (-1.0) ** (log.t[block, None] * 500.0).round()
    second = identify([attrs.evolve(log, tau=loud)]).report
    assert [one["name"] for one in second["effects"]] == [one["name"] for one in first["effects"]]
    assert second["after"]["train_mse"] == pytest.approx(first["after"]["train_mse"], rel=1e-9)
    assert second["after"]["heldout_mse"] > first["after"]["heldout_mse"] + 0.2
