"""Effects outside the registry: the signal is named, and the learned term removes the error."""

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_sysid.identify import identify
from tests.helpers.robots import ALIENGO
from tests.quadvel_sysid import odd_joints
from tests.quadvel_sysid.simulated_joints import parameters, record

VARIANCE = 0.066  # of the torque noise of these logs


MARKS = {
    "creep": (
        pytest.mark.xfail(reason="decision 49: creep is reported as a curve over q_des"),
        pytest.mark.long,
    ),
    "drag_in_part_of_the_range": pytest.mark.long,
    "stiffness_with_error": pytest.mark.long,
    "gain_over_angle": pytest.mark.long,
    "friction_with_a_neighbours_load": pytest.mark.long,
    "friction_that_wears_in": pytest.mark.long,
    "resonance": pytest.mark.long,
    "rubbing": pytest.mark.long,
    "hum": pytest.mark.long,
    "ripple_on_a_neighbour": pytest.mark.long,
}


@pytest.mark.parametrize("name", [pytest.param(one, marks=MARKS.get(one, ())) for one in odd_joints.ODD])
def test_the_signal_behind_an_odd_effect_is_named_and_most_of_its_error_goes(name):
    report = identify([odd_joints.log(name, "mixed", 0, 4.0)]).report
    odd = odd_joints.ODD[name]
    assert set(odd.signals) & set(report["unexplained"]["depends_on"])
    before, after = (report[word]["heldout_mse"] for word in ("before", "after"))
    assert before - after > 0.8 * (before - VARIANCE)
    assert set(report["unexplained"]["joints"]) >= {odd_joints.NAMES[j] for j in odd.joints}


def test_rare_unpredictable_blows_are_not_ignored_as_noise():
    log = record(parameters(joints=2), 2, 4.0, 500, seed=4)
    tau = log.tau.copy()
    tau[[700, 1701], 1] += [8.0, -8.0]  # three such rows would count as sensor faults
    report = identify([attrs.evolve(log, tau=tau)]).report
    assert report["effects"] == []
    assert report["unexplained"]["verdict"] == "structured"
    assert report["unexplained"]["depends_on"] == []
    assert report["unexplained"]["joints"] == [log.joints[1]]
    assert "uncorrelated with every logged signal" in report["decision"]


def test_the_corrected_model_run_step_by_step_gives_what_the_report_claims(tmp_path):
    fitted, kept = (odd_joints.log("rubbing", "mixed", seed, 2.0, 1000) for seed in (0, 1))
    found = identify([fitted], [kept])
    report = found.report
    assert [one["name"] for one in report["effects"]] == ["learned_residual"]
    assert report["effects"][0]["inputs"] == report["unexplained"]["depends_on"] == ["q", "dq"]
    found.parameters.save(tmp_path / "actuator.yaml")
    loaded = ActuatorParameters.load(ALIENGO, tmp_path / "actuator.yaml", some_joints=True)
    model = ActuatorModel(attrs.evolve(loaded, torque_noise=0.0), (len(kept.joints),))
    rows = zip(kept.q, kept.dq, kept.q_des, strict=True)
    torque = np.array([model.step(q, dq, q_des, 30.0, 0.5) for q, dq, q_des in rows])
    error = np.mean((kept.tau - torque)[40:] ** 2)
    assert error == pytest.approx(report["after"]["heldout_mse"], rel=0.05)
    assert error < 0.5 * report["before"]["heldout_mse"]
