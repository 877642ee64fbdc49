"""What laws are looked at with: few rows, other delays, and intervals that say what a log cannot tell."""

import attrs
import numpy as np
import pytest
from simulated_joints import NAMES, parameters, record

from quadvel_actuator import Effect
from quadvel_actuator.effects import JOINT, registry
from quadvel_actuator.effects.commands import CommandHold
from quadvel_sysid.engine import backlog, candidates, ranking
from quadvel_sysid.engine.candidates import About, judged, propose, simplified, started
from quadvel_sysid.engine.company import Company, Said
from quadvel_sysid.engine.delays import fit_with_delays
from quadvel_sysid.engine.diagnosis import diagnose
from quadvel_sysid.engine.features import Scene, library
from quadvel_sysid.engine.few import Few
from quadvel_sysid.engine.intervals import intervals
from quadvel_sysid.engine.judging import Judge
from quadvel_sysid.engine.model import Applied, Model, Slots, jacobian
from quadvel_sysid.engine.screening import Started
from quadvel_sysid.engine.signals import Samples, scattered

JOINTS = NAMES[:2]
ONE = np.zeros(2, dtype=np.intp)
FRICTION = Effect("coulomb_friction", JOINTS, {"c": 0.5, "v_0": 0.05})


def _log(*effects, seconds=3.0, seed=2):
    truth = parameters(effects, input_delay=0.009, output_delay=0.003)
    return record(attrs.evolve(truth, joints=JOINTS), 2, seconds, 500, seed=seed)


def about(log, input_delay, output_delay):
    samples = Samples([log])
    even = np.floor(samples.t / 0.2).astype(int) % 2 == 0
    judge = Judge.of(samples, samples.judged & even[:, None], samples.judged & ~even[:, None])
    joints = len(log.joints)
    one = np.zeros(joints, dtype=np.intp)
    delays = np.repeat([[input_delay], [output_delay]], joints, axis=1)
    model = Model(samples, 0.001, np.ones((2, joints)), np.array([one, one]), *delays, one)
    few = Few(model.samples, judge, np.zeros((len(samples.t), joints)))
    return About(model, judge, np.full(joints, 0.066), few)


def company(looked):
    return Company(looked.judge, looked.noise, looked.few)


def test_signals_of_few_rows_are_those_of_all():
    samples = Samples([_log(), _log(seed=3)])
    few, rows = samples.thinned(7)
    assert len(few.t) == len(rows) < len(samples.t) / 6
    for name in ("t", "q", "q_des", "ddq", "packet"):
        whole = getattr(samples.at(0.004, 0.001, 0.001), name)
        np.testing.assert_array_equal(getattr(few.at(0.004, 0.001, 0.001), name), whole[rows])


@pytest.mark.parametrize("every", [2, 5, 10])
def test_few_rows_lie_at_all_places_between_two_commands(every):
    """Commands at 200 Hz, rows at 500 or 1000 Hz: even steps would show few of the places, and hide a wrong delay."""
    rows = scattered(4000, every)
    assert len(rows) == pytest.approx(4000 / every, abs=1)
    assert np.diff(rows).min() > 0
    counts = np.bincount(rows % 10)
    assert counts.min() > 0.8 * len(rows) / 10
    assert counts.max() < 1.2 * len(rows) / 10


def test_stretches_lie_where_most_is_left_and_all_over_the_log():
    samples = Samples([_log(seconds=16.0)])
    left = np.zeros(len(samples.t))
    burst = (samples.t > 5.1) & (samples.t < 5.3)
    left[burst] = 1.0
    _, rows, counted = samples.stretches(2000, left)
    assert set(np.flatnonzero(burst)) <= set(rows[counted])
    assert samples.t[rows].min() < 0.1
    assert samples.t[rows].max() > 15.9
    assert len(rows) <= 2000


@pytest.mark.parametrize("wrong", ["FR_thigh_joint/dq", "FR_thigh_joint/q"])
def test_a_coupling_takes_the_neighbour_that_shows_once_the_other_effects_are_known(wrong):
    """Before they were, it took the wrong one."""
    joints, right = NAMES[:3], [f"{name}/dq" for name in (NAMES[2], NAMES[0], NAMES[1])]
    friction = Effect("coulomb_friction", joints, {"c": 0.5, "v_0": 0.05})
    coupling = Effect("cross_coupling", joints, {"a": -0.15, "source": right})
    truth = parameters((friction, coupling), input_delay=0.009, output_delay=0.003)
    looked = about(record(attrs.evolve(truth, joints=joints), 3, 3.0, 500), 0.009, 0.003)
    rubs = started(looked, registry()["coulomb_friction"]())
    beside = attrs.evolve(looked.model, applied=rubs.model.applied)
    at_first = registry()["cross_coupling"].configured({"source": [wrong, right[1], right[2]]}, joints)
    every = np.ones(3, dtype=bool)
    groups = np.arange(3)
    bent = beside.plus(Applied(at_first, every, np.full((len(at_first.names), 3), 0.01), groups))
    found = company(looked).taken(looked, judged(looked, at_first, bent))
    assert found.applied[1].law.settings["source"] == right


def test_an_effect_that_is_worth_nothing_once_all_is_fitted_is_not_reported(monkeypatch):
    looked, seen = about(_log(FRICTION), 0.009, 0.003), []

    def faded(company, model):
        seen.extend(one.law.name for one in model.applied)
        less = tuple(attrs.evolve(one, values=1e-6 * one.values) for one in model.applied)
        return attrs.evolve(model, applied=less)

    monkeypatch.setattr(Company, "deepened", faded)
    found = diagnose(looked.model, looked.judge, looked.noise, lambda _: None, lambda *_: None, 1)
    assert seen == ["coulomb_friction"]
    assert found.findings == ()


def test_a_feature_has_columns_for_every_joint_that_asks_for_them():
    looked = about(_log(seconds=1.0), 0.009, 0.003)
    scene = Scene(looked.model, looked.judge)
    feature = next(library(scene, scene.residual))
    columns = scene.columns(feature)
    for joints in ([True, False], [True, True]):
        taken = scene.taken(feature, np.array(joints))
        for j in np.flatnonzero(joints):
            np.testing.assert_array_equal(taken[j], columns[:, :, j])


def test_each_joint_reads_the_signals_at_its_own_delays():
    samples = Samples([_log()])
    mixed = samples.at(np.array([0.004, 0.009]), np.array([0.001, 0.003]), 0.001)
    for joint, pair in enumerate(((0.004, 0.001), (0.009, 0.003))):
        for name in ("q", "dq", "q_des", "kp"):
            own = getattr(samples.at(*pair, 0.001), name)[:, joint]
            np.testing.assert_array_equal(getattr(mixed, name)[:, joint], own)


def test_slopes_of_two_laws_on_the_errors_are_those_that_either_has_when_the_other_stays():
    """Both act on the velocity alone: one leaves a batch of speeds to the other, and the positions as they were."""
    model = about(_log(), input_delay=0.009, output_delay=0.003).model
    late = {"velocity_filter": (0.004, 0.005), "timestamp_skew": (0.002, 0.003)}
    for name, values in late.items():
        model = model.plus(
            Applied(registry()[name](), np.ones(2, dtype=bool), np.array([values]), np.arange(2))
        )
    slots = Slots.of(model)
    predicted, slopes = jacobian(model, slots)
    np.testing.assert_allclose(predicted, model.predict(), atol=1e-12)
    for k, (one, step) in enumerate(zip(model.applied, slots.step[2:], strict=True)):
        moved = model.replacing(k, attrs.evolve(one, values=one.values + step))
        expected = (moved.predict() - model.predict()) / step
        np.testing.assert_allclose(slopes[:, 2 + k], expected.T, atol=1e-6 * np.abs(expected).max())


def test_friction_is_found_from_delays_that_it_has_bent():
    looked = about(_log(FRICTION), input_delay=0.007, output_delay=0.0055)
    found = propose(looked, started(looked, registry()["coulomb_friction"]()))
    last = found.model.applied[-1]
    np.testing.assert_allclose(last.values[0], 0.5, atol=0.04)
    np.testing.assert_allclose(found.model.input_delay, 0.009, atol=0.0006)
    np.testing.assert_allclose(found.model.output_delay, 0.003, atol=0.0006)


def test_a_spring_is_found_from_delays_that_are_far_off():
    looked = about(_log(Effect("parallel_spring", JOINTS, {"k": 3.0, "q0": -0.4})), 0.001, 0.0055)
    found = propose(looked, started(looked, registry()["parallel_spring"]()))
    model = looked.fit_anew(found.model)
    np.testing.assert_allclose(model.applied[-1].values[0], 3.0, atol=0.3)
    np.testing.assert_allclose(model.input_delay + model.output_delay, 0.012, atol=0.0004)


def test_a_bound_that_does_not_fall_with_speed_is_found_from_one_that_could():
    looked = about(_log(Effect("torque_saturation", JOINTS, {"limit": 1.0})), 0.009, 0.003)
    wider = propose(looked, started(looked, registry()["torque_speed_limit"]()))
    found = simplified(looked, wider)
    assert found.name == "torque_saturation"
    assert found.gain > 0.99 * wider.gain
    np.testing.assert_allclose(found.model.applied[-1].values[0], 1.0, atol=0.05)
    assert simplified(looked, found) is None


@pytest.mark.parametrize("volts", [False, True])
def test_a_supply_that_does_not_sag_leaves_a_constant_bound(volts):
    law = registry()["supply_sag"].configured({"what": "bound"} | ({} if volts else {"of": "power"}), JOINTS)
    less, start = law.simpler({"sag": np.zeros(2), "T": np.full(2, 0.01), "limit": np.array([4.0, 7.0])})
    assert less.name == "torque_saturation"
    assert start["limit"].tolist() == [4.0, 7.0]
    assert registry()["supply_sag"].configured({"what": "gain"}, JOINTS).simpler({"sag": np.zeros(2)}) is None


def test_a_constant_that_passed_for_a_weak_spring_far_away_is_called_one_in_the_end():
    offset = Effect("torque_offset", JOINTS, {"offset": 0.25})
    looked = about(_log(FRICTION, offset), 0.009, 0.003)
    spring = np.array([[-0.01, -0.01], [-25.0, -25.0]])
    friction = registry()["coulomb_friction"](at=JOINT)
    both = (
        Applied(registry()["parallel_spring"](at=JOINT), np.ones(2, dtype=bool), spring, np.arange(2)),
        Applied(friction, np.ones(2, dtype=bool), np.array([[0.5, 0.5], [0.05, 0.05]]), np.arange(2)),
    )
    model = attrs.evolve(looked.model, applied=both)
    found, said = company(looked).simplest(model, [Said(("cogging",)), Said()])
    assert [one.law.name for one in found.applied] == ["torque_offset", "coulomb_friction"]
    assert [one.ties for one in said] == [("parallel_spring", "cogging"), ()]
    np.testing.assert_allclose(found.applied[0].values[0], 0.25, atol=0.03)


def test_of_a_law_that_looks_like_a_delay_one_form_at_a_place_is_fitted_if_it_promises_little(monkeypatch):
    looked = about(_log(FRICTION), 0.009, 0.003)
    fitted = []
    monkeypatch.setattr(ranking, "propose", lambda about, one: fitted.append(one.law) or propose(about, one))
    ranking.ranked(looked, lambda text: None, "")
    places = [law.at for law in fitted if law.name == "armature"]
    assert len(registry()["armature"].variants(looked)) > 2
    assert sorted(places) == sorted(set(places))
    assert places


SPRING = Effect("parallel_spring", JOINTS, {"k": 1.5, "q0": -0.2})
OFFSET = Effect("torque_offset", JOINTS, {"offset": 0.25})


@pytest.mark.parametrize(("truth", "named"), [(SPRING, "parallel_spring"), (OFFSET, "torque_offset")])
def test_a_law_gives_way_to_a_rival_that_says_more_beside_what_came_later(truth, named):
    looked = about(_log(FRICTION, truth), 0.009, 0.003)
    offset = Applied(
        registry()["torque_offset"](), np.ones(2, dtype=bool), np.full((1, 2), 0.25), np.arange(2)
    )
    friction = registry()["coulomb_friction"](at=JOINT)
    later = Applied(friction, np.ones(2, dtype=bool), np.array([[0.5, 0.5], [0.05, 0.05]]), np.arange(2))
    model = fit_with_delays(looked.model.plus(offset).plus(later), looked.judge.fit)
    found, said = company(looked).exchanged(model, [Said(("cogging",), ("parallel_spring", "cogging"))])
    assert [one.law.name for one in found.applied] == [named, "coulomb_friction"]
    assert ("parallel_spring" in said[0].rivals) == (truth is OFFSET)


def test_a_law_that_takes_nothing_off_the_error_is_not_tried():
    looked = about(_log(), input_delay=0.009, output_delay=0.003)
    assert started(looked, registry()["coulomb_friction"]()) is None


def test_one_guess_of_a_slew_limit_bounds_nothing():
    """For the joints that have none: what any bound would spoil there must not count against the law."""
    looked = about(_log(), 0.009, 0.003)
    law = registry()["slew_limit"]()
    widest = law.starts(looked.seen, looked.torque, looked.fitted)[-1]
    np.testing.assert_allclose(law.series(looked.torque, looked.seen, widest), looked.torque, atol=1e-6)


def test_a_law_that_reads_the_torque_keeps_no_other_from_being_fitted(monkeypatch):
    looked = about(_log(Effect("first_order_lag", JOINTS, {"T": 0.01})), 0.009, 0.003)
    odds = np.full((*looked.samples.tau.shape, 3), [0.9, 0.1, 0.0])
    monkeypatch.setattr(About, "lost_commands", lambda about, most: [(odds, odds[0, 0])])
    few = {name: registry()[name] for name in ("first_order_lag", "command_hold")}
    monkeypatch.setattr(ranking, "registry", lambda: few)

    def loud(about, law):
        found = started(about, law)
        if law.name != "command_hold":
            return found
        lost = Applied(law, np.ones(2, dtype=bool), np.full((1, 2), 0.1), np.arange(2))
        return Started(law, looked.model.plus(lost), 1e9)

    monkeypatch.setattr(ranking, "started", loud)
    found, _ = ranking.ranked(looked, lambda text: None, "")
    assert found[0].name == "first_order_lag"


@pytest.mark.parametrize("turn", ["tanh", "arctan"])
def test_an_interval_of_friction_holds_what_other_smooth_signs_say(turn):
    """Two hundredths of a radian a second are too few to show how the sign turns."""
    looked = about(_log(Effect("coulomb_friction", JOINTS, {"c": 0.3, "v_0": 0.02})), 0.009, 0.003)
    law = registry()["coulomb_friction"](at=JOINT, turn=turn)
    found = propose(looked, started(looked, law))
    other = propose(looked, started(looked, attrs.evolve(law, turn="arctan")))
    half = intervals(found.model, looked.judge).effects[0]
    apart = np.abs(found.model.applied[0].values - other.model.applied[0].values)
    assert (half[0] > apart[0]).all()


def test_a_drive_in_steps_and_one_without_are_both_fitted_before_they_are_compared(monkeypatch):
    """Each has valleys of its own along the delays."""
    looked = about(_log(FRICTION), 0.009, 0.003)
    found = started(looked, registry()["coulomb_friction"](at=JOINT))
    seen = []
    monkeypatch.setattr(
        candidates, "fit_with_delays", lambda model, rows, n: seen.append(model.window) or model
    )
    looked.fit_anew(found.model)
    assert min(seen.count(0.0), seen.count(0.001)) >= 2


def test_an_effect_comes_to_a_joint_that_shows_it_later():
    looked = about(_log(FRICTION), 0.009, 0.003)
    friction = registry()["coulomb_friction"](at=JOINT)
    first = Applied(friction, np.array([True, False]), np.array([[0.5, 0.0], [0.05, 0.05]]), np.arange(2))
    spring = registry()["torque_offset"]()
    last = Applied(spring, np.ones(2, dtype=bool), np.zeros((1, 2)), np.arange(2))
    model = company(looked).widened(looked.model.plus(first).plus(last))
    assert model.applied[0].active.all()
    np.testing.assert_allclose(model.applied[0].values[0], 0.5, atol=0.04)


def test_an_effect_leaves_a_joint_that_needs_it_no_more():
    """With one joint's position stamped 9 ms off, delays half as wrong seem to be off on the other, too."""
    log = _log()
    q = log.q.copy()
    q[:, 0] = np.interp(log.t - 0.009, log.t, q[:, 0])
    looked = about(attrs.evolve(log, q=q), 0.009, 0.003)
    skew = registry()["timestamp_skew"]("q")
    both = Applied(skew, np.ones(2, dtype=bool), np.array([[-0.006, 0.003]]), np.arange(2))
    delays = np.full(2, 0.012), np.full(2, 0.0)
    bent = looked.model.plus(both).with_delays(*delays)
    model = company(looked).narrowed(bent)
    assert model.applied[0].active.tolist() == [True, False]
    np.testing.assert_allclose(model.applied[0].values[0, 0], -0.009, atol=5e-4)


@pytest.mark.parametrize(("shake", "kept"), [(0.0, ["torque_offset"]), (1.0, [])])
def test_an_effect_stays_where_little_is_left_beside_it(shake, kept):
    """0.16 N m on a joint, 40 % of the noise: less than a tenth of what a shake leaves that no effect says."""
    log = _log(seconds=6.0)
    tau = log.tau + shake * np.sin(2.0 * np.pi * 9.7 * log.t)[:, None] + np.array([0.16, 0.0])
    looked = about(attrs.evolve(log, tau=tau), 0.009, 0.003)
    offset = Applied(
        registry()["torque_offset"](), np.array([True, False]), np.array([[0.16, 0.0]]), np.arange(2)
    )
    model, _ = company(looked).pruned(looked.model.plus(offset), [Said()])
    assert [one.law.name for one in model.applied] == kept


def test_a_supply_that_sags_is_one_for_all_joints():
    """Friction beside it, on one joint alone, must not pass for another sag there."""
    sag = Effect("supply_sag", JOINTS, {"of": "power", "what": "gain", "sag": 0.02, "T": 0.01})
    looked = about(_log(sag, attrs.evolve(FRICTION, joints=JOINTS[:1])), 0.009, 0.003)
    law = next(one for one in registry()["supply_sag"].variants(looked) if one.what == "gain")
    late = propose(looked, started(looked, law)).model.applied[-1].values
    np.testing.assert_array_equal(late[:, 0], late[:, 1])


def test_a_drift_of_a_few_per_cent_is_looked_at():
    """Of one joint, on gains that are shared: a guess several times too large takes nothing off the error."""
    drift = Effect("thermal_drift", JOINTS[:1], {"rate": -0.011, "tau_t": 3.0})
    looked = about(_log(drift, seconds=8.0), 0.009, 0.003)
    first = started(looked, registry()["thermal_drift"]("time"))
    assert first is not None
    found = propose(looked, first).model.applied[-1]
    at_the_end = found.values[0, 0] * found.values[1, 0] * np.expm1(-8.0 / found.values[1, 0])
    np.testing.assert_allclose(at_the_end, 0.011 * 3.0 * -np.expm1(-8.0 / 3.0), atol=0.012)


def test_a_drift_with_temperature_counts_from_the_coolest_drive():
    """Drives that start at 32 degrees have the gains that were found for them; those that stay so are not affected."""
    log = _log()
    warm = 32.0 + np.stack([12.0 * log.t / log.t[-1], np.zeros_like(log.t)], axis=1)
    looked = about(attrs.evolve(log, temperature=warm), 0.009, 0.003)
    of_temperature = registry()["thermal_drift"].variants(looked)[1]
    moved = of_temperature.torque(
        np.ones((1, 2)), attrs.evolve(looked.seen, temperature=warm), {"rate": np.full(2, -0.02)}
    )
    np.testing.assert_allclose(moved[:, 1], 1.0, atol=1e-3)
    assert moved[-1, 0] == pytest.approx(0.76, abs=1e-3)


@pytest.mark.parametrize(("kp", "held"), [(30.0, False), (60.0, True)])
def test_gains_that_are_held_are_left_free_where_they_stay_near_the_commanded_ones(kp, held):
    log = _log()
    looked = about(attrs.evolve(log, kp=np.full_like(log.kp, kp)), 0.009, 0.003)
    model = company(looked).released(attrs.evolve(looked.model, gains_held=True))
    assert model.gains_held == held
    np.testing.assert_allclose(model.gains[0], 1.0 if held else 29.294 / 30.0, atol=0.02)


def test_a_law_is_looked_at_with_the_laws_of_the_model_left_free():
    """Friction that is there with the half of its torque: only freed does it come to the other half."""
    looked = about(_log(FRICTION), 0.009, 0.003)
    friction = registry()["coulomb_friction"](at=JOINT)
    half = Applied(friction, np.ones(2, dtype=bool), np.array([[0.25, 0.25], [0.05, 0.05]]), np.arange(2))
    ground = About(looked.model.plus(half), looked.judge, looked.noise, looked.few).ground
    spring = registry()["torque_offset"]()
    bare = ground.bare(spring)
    assert (bare / ground.few.of(ground.model, spring)[1].sum(axis=0) < 1.15 * 0.066).all()


def test_lost_commands_are_found_alike_in_one_piece_and_in_several(monkeypatch):
    """Of 3000 rows with a command every fifth, three are lost, at the edges of pieces."""
    behind = np.zeros(3000, dtype=int)
    for first in (595, 1400, 2400):
        behind[first : first + 5] = 1
    rng = np.random.default_rng(0)
    costs = 5.0 * (behind[:, None, None] != np.arange(3)) + rng.exponential(0.3, (3000, 1, 3))
    new = (np.arange(3000) % 5 == 0).astype(int)
    several, moves = backlog._odds(costs, new, backlog.Chances())
    np.testing.assert_array_equal(several[:, 0].argmax(axis=1), behind)
    assert backlog.Chances.of(moves).lost == pytest.approx(3 / 600, rel=0.05)
    monkeypatch.setattr(backlog, "_PIECE", 3000)
    np.testing.assert_allclose(several, backlog._odds(costs, new, backlog.Chances())[0], atol=1e-9)


def _losing(share, joints=JOINTS):
    """A log that loses that share of its commands, which come at 200 Hz."""
    truth = parameters([Effect("command_hold", joints, {"share": share})], noise=0.01)
    log = record(attrs.evolve(truth, joints=joints), len(joints), 3.0, 500, seed=2)
    sent = slice(None, None, 5)  # what changes at 200 Hz
    return attrs.evolve(log, **{name: getattr(log, name)[sent] for name in ("t_cmd", "q_des", "kp", "kd")})


def test_half_of_the_commands_lost_are_told_beside_a_delay_that_held_them():
    """At random, so that the drive is k commands behind for a half to the power k + 1 of the time."""
    joints = NAMES[:6]
    late = 0.0075 + 0.005  # s, the delay, and what the commands are late on average
    looked = about(_losing(0.5, joints), late, 0.001)
    looked.noise = np.full(len(joints), 0.01)
    ((_, usual),) = looked.lost_commands(6)
    # within three standard errors of 600 tosses
    np.testing.assert_allclose(usual[:4], 0.5 ** np.arange(1, 5), atol=0.06)


def test_lost_commands_are_told_without_a_look_at_the_torque_that_they_are_judged_by():
    log = _losing(0.1)
    looked = about(log, 0.0075, 0.001)
    looked.noise = np.full(2, 0.01)
    ((odds, usual),) = looked.lost_commands(6)
    other = log.tau.copy()
    other[looked.judge.judge[:, 0], 0] += 2.0
    changed = backlog.backlog(
        about(attrs.evolve(log, tau=other), 0.0075, 0.001).model, looked.noise, 6, looked.judge.judge
    )
    same = backlog.backlog(looked.model, looked.noise, 6, looked.judge.judge)
    judged = looked.judge.judge[:, 0]
    np.testing.assert_allclose(changed[judged, 0], same[judged, 0], atol=1e-12)
    assert np.abs(changed[judged, 1] - same[judged, 1]).max() > 0.5
    law = CommandHold(odds, usual)
    assert 0.05 < law.observed()["samples_hit"] < 0.2
    assert np.ptp(law.foretold().odds, axis=(0, 1)).max() == 0.0


def test_the_share_of_lost_commands_has_the_width_of_as_many_tosses():
    looked = about(_log(), 0.009, 0.003)
    law = CommandHold()
    share = np.full((1, 2), 0.1)
    model = looked.model.plus(Applied(law, np.ones(2, dtype=bool), share, ONE))
    half = intervals(model, looked.judge).effects[0]
    commands = len(np.unique(looked.signals.packet))
    np.testing.assert_allclose(half[0], 2 * np.sqrt(0.09 / commands), rtol=0.15)


def test_guesses_of_a_hard_deadband_leave_few_errors_between_them():
    """Each error between two guesses is a jump of the torque that a slope along the width does not see."""
    samples = Samples([_log(seconds=1.0)])
    s = samples.at(0.009, 0.003, 0.0)
    starts = registry()["deadband"](edge="hard").starts(s, samples.tau, samples.tau)
    widths = np.array([one["width"] for one in starts])
    share = (np.abs(s.q_des - s.q) < widths[:, None]).mean(axis=1)
    assert np.diff(share, axis=0).max() < 0.05
    assert (share[-1] > 0.95).all()


def test_the_signals_of_a_part_are_those_of_its_rows_whatever_logs_its_stretches_reach_over():
    logs = [record(parameters(), joints=2, seconds=1.5, seed=k) for k in range(4)]
    whole = Samples(logs)
    every = whole.at(0.004, 0.001, 0.0)
    weight = np.zeros(len(whole.t))
    weight[1300:1800], weight[1800:2050] = 2.0, 1.0  # two stretches that reach over the end of the first log
    part, rows, counts = whole.stretches(3000, weight)
    assert len(rows) == len(counts) == len(part.t) < len(whole.t)
    assert counts[np.isin(rows, np.flatnonzero(weight))].any()
    np.testing.assert_array_equal(part.at(0.004, 0.001, 0.0).q, every.q[rows])
