"""Every effect of the registry: it runs in the model, and steps give the same as a series."""

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters, Effect
from quadvel_actuator.effects import MemoryEffect, Stage, registry
from quadvel_actuator.effects.numerics import evaluate_distinct
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.logs.log import Log
from quadvel_sysid.model.applied_effect import AppliedEffect
from quadvel_sysid.model.jacobian import DELAY_STEP_S, Unknowns, jacobian, pack, with_slots
from quadvel_sysid.model.torque_model import Model
from quadvel_sysid.search.effect_candidates.registry import candidate_classes
from tests.helpers.robots import ALIENGO
from tests.quadvel_sysid.simulated_joints import NAMES, parameters

JOINTS = NAMES[:3]
TRUTH = {
    "coulomb_friction": {"c": 0.3, "v_0": 0.1},
    "viscous_friction": {"b": 0.1},
    "stribeck_friction": {"c": 0.2, "c_s": 0.5, "v_s": 0.4, "v_0": 0.05},
    "quadratic_drag": {"c": 0.05},
    "load_dependent_friction": {"mu": 0.1, "v_0": 0.1},
    "torque_saturation": {"limit": 3.0},
    "torque_speed_limit": {"stall": 6.0, "no_load": 6.5},
    "slew_limit": {"rate": 40.0},
    "first_order_lag": {"T": 0.005},
    "velocity_filter": {"T": 0.008},
    "armature": {"J": 0.005},
    "timestamp_skew": {"late": 0.0025},
    "torque_offset": {"offset": 0.4},
    "parallel_spring": {"k": 2.0, "q0": 0.1},
    "cogging": {"a": 0.3, "n": 30.0, "phi": 1.0},
    "deadband": {"width": 0.02, "edge": "hard"},
    "backlash": {"gap": 0.01, "on": "error"},
    "hysteresis": {"F": 0.4, "reach": 0.05, "beta": 0.5},
    "gain_asymmetry": {"a": 0.1},
    "thermal_drift": {"rate": -0.05, "tau_t": 10.0, "of": "time"},
    "supply_sag": {"sag": 0.002, "T": 0.01, "of": "power", "what": "gain"},
    "cross_coupling": {"a": 0.2, "offset": -0.1, "source": ["FL_hip_joint/q"] * 3},
    "command_hold": {"share": 0.1},
}
LATE = {"armature"}  # a running model takes the acceleration from the past alone
UNLIKE = {"command_hold"}  # random


def _motion(steps=800, dt=0.001):
    """Smooth motion and commands (N, 4 joints) at 1 kHz, of three joints and a neighbour."""
    t = np.arange(steps) * dt
    phase = np.array([0.3, 1.1, 2.3, 4.0])
    q = 0.3 * np.sin(2 * np.pi * 2.0 * t[:, None] + phase) + 0.1
    dq = np.gradient(q, dt, axis=0)
    q_des = q + 0.15 * np.sin(2 * np.pi * 3.0 * t[:, None] + 2 * phase)
    return t, q, dq, q_des


@pytest.mark.parametrize("name", sorted(set(registry()) - UNLIKE))
def test_an_effect_gives_the_same_torque_step_by_step_and_over_a_series(name):
    t, q, dq, q_des = _motion()
    joints = (*JOINTS, NAMES[3])
    effect = Effect(name, JOINTS, TRUTH[name])
    truth = attrs.evolve(
        parameters([effect], delta_kp=0.0, delta_kd=0.0, input_delay=0.0, output_delay=0.0, noise=0.0),
        joints=joints,
    )
    model = ActuatorModel(truth, (4,))
    steps = np.array([model.step(q[k], dq[k], q_des[k], 30.0, 0.5) for k in range(len(t))])

    log = Log("steps", joints, t, q, dq, t, q_des, np.ones(q.shape, bool), tau=steps,
              kp=np.full(q.shape, 30.0), kd=np.full(q.shape, 0.5))  # fmt: skip
    settings = {k: v for k, v in TRUTH[name].items() if isinstance(v, (str, list)) or k == "full"}
    if name == "cross_coupling":
        settings["source"] = [*settings["source"], settings["source"][0]]
    form = registry()[name].from_settings(settings, joints)
    values = np.array([np.full(4, TRUTH[name][parameter]) for parameter in form.names])
    active = np.array([True, True, True, False])
    zero = np.zeros(4, dtype=int)
    series = Model(
        Samples.of([log]), 0.001, np.ones((2, 4)), zero, np.zeros((2, 4)), zero,
        (AppliedEffect(_candidate(form), active, values, np.arange(4)),),
    ).predict()  # fmt: skip
    skip, tolerance = (5, 0.15) if name in LATE else (0, 2e-3 if name == "thermal_drift" else 1e-8)
    np.testing.assert_allclose(steps[skip:], series[skip:], atol=tolerance)
    plain = 30.0 * (q_des - q) - 0.5 * dq
    assert np.abs(steps[:, :3] - plain[:, :3]).max() > 0.05, "the effect does something"
    np.testing.assert_allclose(steps[:, 3], plain[:, 3], atol=1e-9)


@pytest.mark.parametrize("name", ["slew_limit", "velocity_filter", "backlash", "hysteresis"])
def test_an_effect_of_another_package_needs_its_step_alone_to_be_run_over_a_series(name):
    """For any stretches and guesses; `series` of an effect is only a faster way."""
    t, q, dq, q_des = _motion(200)
    samples = Samples.of([Log("steps", NAMES[:4], t, q, dq, t, q_des, np.ones(q.shape, bool), tau=q)])
    s = samples.at(0.0, 0.0, 0.0)
    s = attrs.evolve(s, start=s.start | (np.arange(200) % 70 == 0)[:, None])
    settings = {"on": "error"} if name == "backlash" else {}
    form = registry()[name].from_settings(settings, NAMES[:4])
    guesses = np.array([0.7, 1.0, 1.6])[:, None, None]
    p = {parameter: TRUTH[name][parameter] * guesses + np.zeros(4) for parameter in form.names}
    x = (s.q_des - s.q, s.dq_des - s.dq) if form.stage == Stage.ERRORS else s.stiffness_torque
    own, simple = form.series(x, s, p), MemoryEffect.series(form, x, s, p)
    for one, other in zip(own, simple, strict=True) if isinstance(x, tuple) else [(own, simple)]:
        np.testing.assert_allclose(*np.broadcast_arrays(one, other), atol=1e-12)


def test_a_coupling_to_a_torque_does_not_carry_the_noise_of_its_measurement_over():
    t, q, dq, q_des = _motion(300)
    form = registry()["cross_coupling"].from_settings({"source": [f"{NAMES[1]}/tau"] * 4}, NAMES[:4])
    every, zero = np.ones(4, dtype=bool), np.zeros(4, dtype=int)
    coupled = AppliedEffect(_candidate(form), every, np.full((1, 4), 0.2), np.arange(4))
    torques = []
    for noise in (0.0, 1.0):
        tau = noise * np.random.default_rng(0).standard_normal(q.shape)
        log = Log("coupled", NAMES[:4], t, q, dq, t, q_des, np.ones(q.shape, bool), tau=tau)
        gains = np.ones((2, 4)), zero
        torques.append(Model(Samples.of([log]), 0.0, *gains, np.zeros((2, 4)), zero, (coupled,)).predict())
    np.testing.assert_array_equal(*torques)


def test_a_coupling_has_an_offset_where_it_is_of_an_angle_and_nowhere_else():
    """Otherwise it would explain a constant offset that no neighbour causes."""
    sources = [f"{NAMES[1]}/q", f"{NAMES[0]}/dq", f"{NAMES[0]}/tau", f"{NAMES[0]}/dq"]
    form = registry()["cross_coupling"].from_settings({"source": sources}, NAMES[:4])
    t, q, dq, q_des = _motion(300)
    s = Samples.of([Log("still", NAMES[:4], t, q, dq, t, q_des, np.ones(q.shape, bool), tau=q)]).at(0, 0, 0)
    torque = form.torque(s.stiffness_torque, s, {"a": np.zeros(4), "offset": np.ones(4)})
    np.testing.assert_array_equal(torque, np.tile([1.0, 0.0, 0.0, 0.0], (len(q), 1)))
    values = np.ones((2, 4))
    np.testing.assert_array_equal(_on(form, values, 0, 1).values, [np.ones(4), [1, 0, 0, 0]])


def test_a_coupling_that_is_of_no_angle_on_its_joints_is_the_same_in_a_file():
    """The file names the sources of these joints only."""
    sources = [f"{NAMES[1]}/q", f"{NAMES[0]}/dq", f"{NAMES[0]}/tau", f"{NAMES[0]}/dq"]
    form = registry()["cross_coupling"].from_settings({"source": sources}, NAMES[:4])
    kept = _on(form, np.ones((2, 4)), 1, 2)
    filed = registry()["cross_coupling"].from_settings({"source": sources[1:3]}, NAMES[:4])
    assert kept.candidate.names == filed.names
    assert _on(kept.candidate.effect, kept.values, 0, 1, 2).candidate.names == form.names


def _candidate(form):
    return candidate_classes()[form.name](form)


def _on(form, values, *joints):
    """The effect that remains on these joints after a fit."""
    active = np.isin(np.arange(4), joints)
    return AppliedEffect(_candidate(form), active, values, np.arange(4)).canonical()


@pytest.mark.parametrize("at", ["drive", "joint"])
@pytest.mark.parametrize("source", ["q", "tau"])
@pytest.mark.parametrize("name", [name for name, effect in registry().items() if effect.stage == Stage.ADDED])
def test_slopes_of_a_fit_are_those_of_the_torque(name, source, at):
    """Whether or not the effect depends on the drive's torque or on delays."""
    t, q, dq, q_des = _motion(300)
    forms = {"cross_coupling": {"source": [f"{NAMES[1]}/{source}"] * 4}, "armature": {"of": "ddq_sharp"}}
    form = registry()[name].from_settings({"at": at, **forms.get(name, {})}, NAMES[:4])
    values = np.array([np.full(4, TRUTH[name].get(one, 0.0)) for one in form.names])
    every, zero = np.ones(4, dtype=bool), np.zeros(4, dtype=int)
    samples = Samples.of([Log("steps", NAMES[:4], t, q, dq, t, q_des, np.ones(q.shape, bool), tau=q)])
    model = Model(
        samples, 0.0, np.ones((2, 4)), zero, np.repeat([[0.004], [0.002]], 4, axis=1), zero,
        (AppliedEffect(_candidate(form), every, values, np.arange(4)),),
    )  # fmt: skip
    unknowns = Unknowns.of(model)
    torque, slopes = jacobian(model, unknowns)
    np.testing.assert_array_equal(torque, model.predict())
    for k, step in enumerate(unknowns.step[:-2]):
        moved = pack(model)
        moved[k] += step
        slope = (with_slots(model, moved).predict() - torque) / step
        np.testing.assert_allclose(slopes[:, k].T, slope, atol=1e-9 * max(np.abs(slope).max(), 1.0))
    for k, late in enumerate(np.eye(2)[:, :, None] * DELAY_STEP_S):
        after, before = (model.with_delays(model.delays + by).predict() for by in (late, -late))
        slope = (after - before) / (2.0 * DELAY_STEP_S)
        np.testing.assert_allclose(slopes[:, k - 2].T, slope, atol=1e-9 * max(np.abs(slope).max(), 1.0))


def test_what_is_equal_in_a_batch_is_computed_once():
    given = []

    def wave(n, phi):
        given.append(n.shape)
        return np.sin(n * q + phi)

    q, n, phi = np.linspace(0.0, 1.0, 6).reshape(3, 2), np.full((4, 1, 2), 5.0), np.full((4, 1, 2), 0.3)
    n[2] += 0.1
    np.testing.assert_array_equal(evaluate_distinct(wave, n, phi), np.sin(n * q + phi))
    np.testing.assert_array_equal(evaluate_distinct(wave, n, phi[0, 0]), np.sin(n * q + 0.3))
    np.testing.assert_array_equal(evaluate_distinct(wave, n[0, 0], phi[0, 0]), np.sin(5.0 * q + 0.3))
    assert given == [(2, 1, 2), (2, 1, 2), (2,)]


@pytest.mark.parametrize("name", ["coulomb_friction", "hysteresis", "load_dependent_friction"])
def test_a_torque_added_at_the_joint_does_not_wait_for_the_output_delay(name):
    t, q, dq, q_des = (x[..., :3] if np.ndim(x) > 1 else x for x in _motion())
    effect = Effect(name, JOINTS, TRUTH[name] | {"at": "joint"})
    gains = {"delta_kp": 0.0, "delta_kd": 0.0, "input_delay": 0.0}
    truth = attrs.evolve(parameters([effect], **gains, output_delay=0.004, noise=0.0), joints=JOINTS)
    model = ActuatorModel(truth, (3,))
    steps = np.array([model.step(q[k], dq[k], q_des[k], 30.0, 0.5) for k in range(len(t))])

    plain = 30.0 * (q_des - q) - 0.5 * dq
    late = np.concatenate([np.repeat(plain[:1], 4, axis=0), plain[:-4]])
    form = registry()[name](at="joint")
    samples = Samples.of([Log("steps", JOINTS, t, q, dq, t, q_des, np.ones(q.shape, bool), tau=steps)])
    p = {parameter: np.full(3, TRUTH[name][parameter]) for parameter in form.names}
    now = samples.at(0.0, 0.0, 0.0)
    np.testing.assert_allclose(steps[5:], (late + form.series(late, now, p))[5:], atol=1e-9)


def test_every_effect_has_a_truth_to_be_tested_with():
    assert set(TRUTH) == set(registry())


def test_an_environment_that_is_reset_forgets_its_memory_and_others_do_not():
    effects = [Effect(name, JOINTS, TRUTH[name]) for name in ("hysteresis", "first_order_lag", "backlash")]
    truth = attrs.evolve(parameters(effects, noise=0.0), joints=JOINTS)
    _, q, dq, q_des = (x[..., :3] if np.ndim(x) > 1 else x for x in _motion(120))
    whole, some = (ActuatorModel(truth, (2, 3)) for _ in range(2))
    for k in range(100):
        if k == 60:
            some.reset([0])
        both = [model.step(np.tile(q[k], (2, 1)), dq[k], q_des[k], 30.0, 0.5) for model in (whole, some)]
    np.testing.assert_array_equal(both[0][1], both[1][1])
    assert np.abs(both[0][0] - both[1][0]).max() > 1e-4


def test_peeking_does_not_change_the_memory_of_effects():
    effects = [Effect(name, JOINTS, TRUTH[name]) for name in ("hysteresis", "slew_limit", "timestamp_skew")]
    truth = attrs.evolve(parameters(effects, noise=0.0), joints=JOINTS)
    _, q, dq, q_des = (x[..., :3] if np.ndim(x) > 1 else x for x in _motion(60))
    peeking, plain = (ActuatorModel(truth, (3,)) for _ in range(2))
    for k in range(60):
        peeking.peek(q[k] + 0.3, dq[k] - 1.0, q_des[k], 30.0, 0.5)
        ours = peeking.step(q[k], dq[k], q_des[k], 30.0, 0.5)
        np.testing.assert_array_equal(ours, plain.step(q[k], dq[k], q_des[k], 30.0, 0.5))


def test_commands_are_lost_with_the_given_probability():
    effect = Effect("command_hold", JOINTS, {"share": 0.2})
    truth = attrs.evolve(
        parameters([effect], delta_kp=0.0, delta_kd=0.0, input_delay=0.0, output_delay=0.0, noise=0.0),
        joints=JOINTS,
    )
    model = ActuatorModel(truth, (3,), seed=3)
    still = np.zeros(3)
    torque = np.array([model.step(still, still, still + k, 0.01, 0.0) for k in range(4000)])
    kept = np.isclose(torque[:, 0], 0.01 * np.arange(4000))
    assert abs(1.0 - kept.mean() - 0.2) < 0.03


def test_effects_survive_the_file(tmp_path):
    effects = [Effect(name, JOINTS, value) for name, value in TRUTH.items()]
    truth = attrs.evolve(parameters(effects), joints=NAMES[:4])
    truth.save(tmp_path / "actuator.yaml")
    loaded = ActuatorParameters.load(ALIENGO, tmp_path / "actuator.yaml", some_joints=True)
    assert [effect.parameters for effect in loaded.effects] == list(TRUTH.values())
    ActuatorModel(loaded, (4,))


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (Effect("magic", JOINTS, {}), "effects: found magic, expected one of"),
        (Effect("armature", ["wheel"], {"J": 0.1}), "effects/armature/joints: found wheel, expected one of"),
        (Effect("armature", JOINTS, {}), "effects/armature/parameters: J is missing"),
        (Effect("armature", JOINTS, {"J": [0.1, 0.2]}), "found 2 numbers, expected 1 or 3"),
        (
            Effect("coulomb_friction", JOINTS, {"c": 0.3, "v_0": 0.1, "c_2": 0.1}),
            "effects/coulomb_friction/parameters/c_2: unknown, expected one of c, v_0, at, turn",
        ),
        (
            Effect("coulomb_friction", JOINTS, {"c": 0.3, "v_0": 0.1, "turn": "slow"}),
            "effects/coulomb_friction/parameters/turn: found 'slow', expected one of tanh, arctan",
        ),
        (
            Effect("thermal_drift", JOINTS, {"of": "temperature", "rate": 0.1, "cold": "ice"}),
            "effects/thermal_drift/parameters/cold: found 'ice', expected a number",
        ),
        (
            Effect("gain_asymmetry", JOINTS, {"a": 0.1, "at": "joint"}),
            "effects/gain_asymmetry/parameters/at: unknown, expected one of a",
        ),
    ],
)
def test_an_effect_that_cannot_run_is_refused_by_name(effect, message):
    with pytest.raises(ValueError, match=message):
        ActuatorModel(attrs.evolve(parameters([effect]), joints=JOINTS), (3,))


@pytest.mark.parametrize("name", sorted(set(registry()) - {"command_hold"}))
def test_a_sampled_environment_runs_as_a_model_of_the_parameters_that_were_drawn(name):
    """Environments of a batch, one not sampled; each parameter is within its interval, equal for all joints."""
    _, q, dq, q_des = _motion(60, 0.0025)
    numbers = {k: v for k, v in TRUTH[name].items() if isinstance(v, float)}
    intervals = {k: sorted((0.5 * v, 1.5 * v)) for k, v in numbers.items() if k != "full"}
    plain = parameters(delta_kp=0.0, delta_kd=0.0, noise=0.0)
    effect = Effect(name, JOINTS, TRUTH[name], {}, intervals)
    batch = ActuatorModel(attrs.evolve(plain, effects=(effect,)), (3, 12), dt=0.0025)
    batch.sample(np.array([0, 2]), np.random.default_rng(1))
    batch.reset(np.array([0, 2]))
    drawn = batch._effects._all[0].values
    single = []
    for env in range(3):
        values = {k: float(drawn[k][env, 0]) for k in intervals}
        assert all(low <= values[k] <= high for k, (low, high) in intervals.items())
        assert (values == {k: numbers[k] for k in intervals}) == (env == 1)
        mine = attrs.evolve(effect, parameters=effect.parameters | values)
        single.append(ActuatorModel(attrs.evolve(plain, effects=(mine,)), (12,), dt=0.0025))
    for k in range(60):
        step = [np.tile(x[k, :4], 3) for x in (q, dq, q_des)]
        torque = batch.step(*(np.tile(x, (3, 1)) for x in step), 30.0, 0.5)
        expected = [one.step(*step, 30.0, 0.5) for one in single]
        np.testing.assert_allclose(torque, expected, atol=1e-9)


def test_intervals_of_single_joints_are_drawn_joint_by_joint():
    effect = Effect("coulomb_friction", JOINTS, {"c": 0.3, "v_0": 0.1}, {}, {"c": [[0.2, 0.4]] * 3})
    batch = ActuatorModel(parameters([effect]), (50, 12))
    batch.sample()
    c = batch._effects._all[0].values["c"][:, [NAMES.index(name) for name in JOINTS]]
    assert np.abs(np.corrcoef(c.T) - np.eye(3)).max() < 0.4
    assert 0.2 <= c.min() < 0.21
    assert 0.39 < c.max() <= 0.4


def test_an_interval_the_wrong_way_round_is_refused_by_name():
    effect = Effect("coulomb_friction", JOINTS, {"c": 0.3, "v_0": 0.1}, {}, {"c": [0.4, 0.2]})
    with pytest.raises(ValueError, match=r"coulomb_friction/intervals/c: found \[0.4, 0.2\]"):
        ActuatorModel(parameters([effect]))


def test_a_setting_that_is_a_number_counts():
    """A running model assumes 25 degrees Celsius; a drive colder than `cold` is stronger."""
    effect = {"of": "temperature", "rate": -0.01}
    torques = []
    for cold in ({}, {"cold": 40.0}):
        drift = Effect("thermal_drift", JOINTS, effect | cold)
        model = ActuatorModel(
            attrs.evolve(parameters([drift], input_delay=0.0, output_delay=0.0, noise=0.0), joints=JOINTS),
            (3,),
        )
        torques.append(model.step(np.zeros(3), np.zeros(3), np.full(3, 0.1), 30.0, 0.5))
    np.testing.assert_allclose(torques[1], 1.15 * torques[0])
