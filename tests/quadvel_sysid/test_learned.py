"""Effects that the registry does not hold: the right signal is named, most of the error goes, and the model runs so."""

from functools import cache

import attrs
import numpy as np
import odd_joints
import pytest
from simulated_joints import NAMES, parameters, record

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_sysid.engine import learned as learned_module
from quadvel_sysid.engine.delays import fit_with_delays
from quadvel_sysid.engine.eam import fit_eam
from quadvel_sysid.engine.features import Scene
from quadvel_sysid.engine.floor import noise_floor
from quadvel_sysid.engine.identify import identify
from quadvel_sysid.engine.judging import Judge
from quadvel_sysid.engine.learned import learn, longest
from quadvel_sysid.engine.model import Model
from quadvel_sysid.engine.picks import Trial
from quadvel_sysid.engine.signals import Samples
from quadvel_sysid.engine.simplest import Alone

VARIANCE = 0.066  # of the torque noise of these logs


def looked_at(log):
    """The plain EAM on a log, who judges, and the noise floor."""
    samples = Samples([log])
    first = (np.floor(samples.t / 0.2).astype(int) % 3 != 2)[:, None]
    judge = Judge.of(samples, samples.judged & first, samples.judged & ~first)
    eam = fit_eam(samples, judge.fit)
    one = np.zeros(len(log.joints), dtype=np.intp)
    plain = Model(
        samples, eam.window, eam.gains, np.array([one, one]), eam.input_delay, eam.output_delay, one
    )
    model = fit_with_delays(plain, judge.fit, 2)
    return model, judge, noise_floor(samples, judge.fit | judge.judge, samples.tau - model.predict())


@cache
def _learned(name):
    model, judge, noise = looked_at(odd_joints.log(name, "mixed", 0, 4.0))
    learned = learn(model, judge, noise)
    assert learned is not None
    left = model.samples.tau - learned.model.predict() - learned.torque
    error = float(np.sum(np.where(judge.judge, left, 0.0) ** 2) / judge.judge.sum())
    return learned, model.mse(judge.judge), error, judge


@pytest.mark.parametrize("name", odd_joints.ODD)
def test_the_signal_behind_an_odd_effect_is_named_and_most_of_its_error_goes(name):
    learned, before, after, _ = _learned(name)
    odd = odd_joints.ODD[name]
    heaviest = learned.terms[int(np.argmax(learned.gains))]
    assert set(odd.signals) & set(heaviest.inputs)
    assert before - after > 0.85 * (before - VARIANCE)
    assert np.flatnonzero(heaviest.active).tolist() == list(odd.joints)
    assert len(learned.terms) <= 3


@pytest.mark.parametrize("name", odd_joints.ODD)
def test_delays_that_are_moved_to_their_longest_say_the_same_together_with_the_terms(name):
    learned, _, _, judge = _learned(name)
    tau = learned.model.samples.tau
    fitted, late = (
        np.where(judge.fit, tau - model.predict() - learned.torque, 0.0)
        for model in (learned.model, longest(learned.model, learned, judge.fit))
    )
    assert np.sum(late**2) <= np.sum(fitted**2) * (1.0 + 1e-6)


def _drag(factor):
    """A torque -dq times `factor` of the speeds, of the joints in their order."""
    return lambda k, q, dq, tau: tau - dq * factor(dq)


def _log(distort, seconds=4.0):
    truth = attrs.evolve(parameters(), joints=NAMES[:3])
    return record(truth, 3, seconds, 500, "mixed", 7, distort=distort)


def test_each_joint_has_the_neighbour_of_its_own():
    """Drag that the speed of the next joint makes: three signals at once, none of them alone."""
    model, judge, noise = looked_at(_log(_drag(lambda dq: 0.3 * np.tanh(np.roll(dq, -1) / 2.0))))
    learned = learn(model, judge, noise)
    pairs = {term.inputs: np.flatnonzero(term.active).tolist() for term in learned.terms}
    assert pairs == {(f"{NAMES[(j + 1) % 3]}/dq", "dq"): [j] for j in range(3)}
    left = model.samples.tau - learned.model.predict() - learned.torque
    before, after = model.mse(judge.judge), np.mean(left[judge.judge] ** 2)
    assert before - after > 0.9 * (before - VARIANCE)


def test_gains_that_a_strong_effect_has_bent_are_left_for_those_commanded():
    """Six times the damping of the drive, one way only: with gains as they were fitted it looks like anything else."""
    model, judge, noise = looked_at(_log(_drag(lambda dq: 3.0 * (dq > 0.0))))
    assert not model.believable
    learned = Alone(model, judge, noise).learned
    assert learned.model.believable
    heaviest = learned.terms[int(np.argmax(learned.gains))]
    assert heaviest.inputs == ("dq",)
    assert heaviest.active.all()


def test_nothing_is_learned_where_nothing_is():
    truth = attrs.evolve(parameters(), joints=odd_joints.NAMES[: odd_joints.JOINTS])
    model, judge, noise = looked_at(record(truth, odd_joints.JOINTS, 3.0, 500, "mixed", 5))
    assert learn(model, judge, noise) is None


def test_a_joint_that_rests_while_the_model_is_fitted_makes_up_no_terms():
    """What gains and delays do to it was not seen, so that its own free ones could be anything on the rows that judge."""
    model, judge, noise = looked_at(record(attrs.evolve(parameters(), joints=NAMES[:2]), 2, motion="mixed"))
    fit = judge.fit.copy()
    fit[:, 0] &= np.abs(model.samples.logs[0].states["dq"][:, 0]) < 0.05
    resting = attrs.evolve(judge, fit=fit)
    scene = Scene(model, resting)
    bare = Trial([], scene).bare[judge.judge[:, 0], 0]
    assert np.mean(bare**2) < 1.3 * np.mean(scene.residual[judge.judge[:, 0], 0] ** 2)
    assert learn(model, resting, noise) is None


def test_terms_that_predict_worse_once_they_are_bounded_are_not_told(monkeypatch):
    """Large ones that cancel each other on the fitted rows meet their bounds at different instants of others."""
    as_terms, tried = learned_module._as_terms, []

    def broken(state):
        tried.append(len(state.picks))
        found = as_terms(state)
        return attrs.evolve(found, torque=50.0 * found.torque) if len(state.picks) > 1 else found

    monkeypatch.setattr(learned_module, "_as_terms", broken)
    model, judge, noise = looked_at(odd_joints.log("friction_with_a_neighbours_load", "mixed", 0, 4.0))
    monkeypatch.setattr(learned_module, "_narrowed", lambda state, noise: state.plus(state.picks))
    learned = learn(model, judge, noise)
    assert tried == [2, 1]
    left = model.samples.tau - learned.model.predict() - learned.torque
    assert np.mean(left[judge.judge] ** 2) < model.mse(judge.judge)


def test_the_corrected_model_run_step_by_step_gives_what_the_report_claims(tmp_path):
    fitted, kept = (odd_joints.log("rubbing", "mixed", seed, 2.0, 1000) for seed in (0, 1))
    found = identify([fitted], [kept])
    report = found.report
    assert [one["name"] for one in report["effects"]] == ["learned_residual"]
    assert report["effects"][0]["inputs"] == report["unexplained"]["depends_on"] == ["q", "dq"]
    found.parameters.save(tmp_path / "actuator.yaml")
    loaded = ActuatorParameters.load(tmp_path / "actuator.yaml")
    model = ActuatorModel(attrs.evolve(loaded, torque_noise=0.0), (len(kept.joints),))
    rows = zip(kept.q, kept.dq, kept.q_des, strict=True)
    torque = np.array([model.step(q, dq, q_des, 30.0, 0.5) for q, dq, q_des in rows])
    error = np.mean((kept.tau - torque)[40:] ** 2)
    assert error == pytest.approx(report["after"]["heldout_mse"], rel=0.05)
    assert error < 0.5 * report["before"]["heldout_mse"]
