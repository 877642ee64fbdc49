"""The empirical actuator model against closed-form solutions."""

import attrs
import numpy as np
import pytest
from scipy import stats

from quadvel_actuator import ActuatorModel, ActuatorParameters, DelayPair
from tests.helpers.robots import ALIENGO

Q = np.linspace(-0.4, 0.5, 12)
ZERO = np.zeros(12)
UNLIMITED = 1e6


def _parameters(input_delay=0.0, output_delay=0.0, noise=0.0, limit=UNLIMITED, delta_kp=0.0, delta_kd=0.0):
    return attrs.evolve(
        ActuatorParameters.of(ALIENGO),
        pairs=[DelayPair(input_delay, output_delay, noise)],
        torque_noise=noise,
        torque_limit=limit,
        delta_kp=delta_kp,
        delta_kd=delta_kd,
    )


def _held(signal, delay, dt):
    """Step means of the delayed `signal`, one value per step, constant before time 0."""
    fine = 1e-5
    per_step = round(dt / fine)
    time = (np.arange(len(signal) * per_step) + 0.5) * fine - delay
    samples = signal[np.maximum(np.floor(time / dt).astype(int), 0)]
    return samples.reshape(len(signal), per_step, *signal.shape[1:]).mean(axis=1)


@pytest.mark.parametrize("output_delay", [0.0, 0.001, 0.0013])
@pytest.mark.parametrize("input_delay", [0.0, 0.0001, 0.0069, 0.007, 0.0085])
@pytest.mark.parametrize("dt", [0.001, 0.0025])
def test_a_command_step_with_the_joint_still_arrives_after_both_delays(dt, input_delay, output_delay):
    model = ActuatorModel(_parameters(input_delay, output_delay), dt=dt)
    target = np.where(np.arange(30) < 5, 0.0, 0.3)
    torque = np.array([model.step(ZERO, ZERO, np.full(12, value), 30.0, 0.5) for value in target])
    expected = 30.0 * _held(_held(target, input_delay, dt), output_delay, dt)
    np.testing.assert_allclose(torque, np.broadcast_to(expected[:, None], torque.shape), atol=1e-9)


def test_the_state_is_delayed_by_the_output_alone():
    model = ActuatorModel(_parameters(0.007, 0.0015))
    rng = np.random.default_rng(1)
    q, dq = rng.normal(size=(2, 40, 12))
    torque = np.array([model.step(q[k], dq[k], ZERO, 30.0, 0.5) for k in range(40)])
    np.testing.assert_allclose(torque, _held(-30.0 * q - 0.5 * dq, 0.0015, 0.001), atol=1e-9)


def test_every_part_of_the_command_packet_travels_together():
    model = ActuatorModel(_parameters(0.0033))
    rng = np.random.default_rng(2)
    q_des, dq_des, tau_ff = rng.normal(size=(3, 60, 12))
    kp, kd = rng.uniform(0.0, 60.0, size=(60, 12)), rng.uniform(0.0, 2.0, size=(60, 12))
    torque = np.array([model.step(Q, Q + 1, q_des[k], kp[k], kd[k], dq_des[k], tau_ff[k]) for k in range(60)])
    expected = _held(kp * (q_des - Q) + kd * (dq_des - Q - 1) + tau_ff, 0.0033, 0.001)
    np.testing.assert_allclose(torque, expected, atol=1e-9)


def test_a_change_of_gains_after_long_rest_is_delayed_like_the_target():
    model = ActuatorModel(_parameters(0.0072))
    kp = np.where(np.arange(300) < 200, 30.0, 60.0)
    kd = np.where(np.arange(300) < 203, 0.5, 4.0)
    torque = np.array([model.step(Q, Q, Q + 0.1, kp[k], kd[k]) for k in range(300)])
    expected = _held(0.1 * kp[:, None] - kd[:, None] * Q, 0.0072, 0.001)
    np.testing.assert_allclose(torque, expected, atol=1e-9)


def test_gain_deviations_add_to_the_reference_gains():
    model = ActuatorModel(_parameters(delta_kp=-0.706, delta_kd=-0.021))
    torque = model.step(ZERO, ZERO + 2.0, Q, 30.0, 0.5, 1.0)
    np.testing.assert_allclose(torque, (30 - 0.706) * Q + (0.5 - 0.021) * (1.0 - 2.0), atol=1e-12)


def test_gain_deviations_may_differ_between_joints_and_scale_with_the_gains():
    deviation = tuple(-0.1 * i for i in range(12))
    model = ActuatorModel(_parameters(delta_kp=deviation))
    torque = model.step(ZERO, ZERO, Q, 60.0, 0.5)
    np.testing.assert_allclose(torque, 2 * (30 + np.array(deviation)) * Q, atol=1e-12)


def test_damping_without_stiffness_never_drives_the_joint():
    model = ActuatorModel(attrs.evolve(ActuatorParameters.of(ALIENGO), torque_noise=0.0))
    dq = np.linspace(-5, 5, 12)
    torque = model.step(Q, dq, ZERO, 0.0, 2.0)
    np.testing.assert_allclose(torque, -2.0 * (0.5 - 0.021) / 0.5 * dq, atol=1e-12)


def test_the_torque_noise_has_the_given_variance_and_is_white():
    model = ActuatorModel(_parameters(noise=0.066), (50, 12), seed=3)
    noise = np.array([model.step(np.zeros((50, 12)), 0.0, 0.0, 30.0, 0.5) for _ in range(200)]).ravel()
    low, high = stats.chi2.interval(0.999, noise.size)
    assert low < (noise**2).sum() / 0.066 < high
    correlation = (noise[600:] * noise[:-600]).mean() / 0.066  # the same joint, one step apart
    assert abs(correlation) < 4 / np.sqrt(noise.size)


def test_torque_stays_within_the_limit_of_each_joint_noise_included():
    model = ActuatorModel(_parameters(noise=4.0, limit=(35.278, 35.278, 44.4)))
    torque = np.array(
        [model.step(ZERO, ZERO, ZERO + sign * 3.0, 30.0, 0.5) for sign in (1, -1) for _ in range(100)]
    )
    limit = np.tile([35.278, 35.278, 44.4], 4)
    assert (np.abs(torque) <= limit).all()
    assert (np.abs(torque).max(axis=0) == limit).all()


def test_the_limit_acts_before_the_output_delay():
    model = ActuatorModel(_parameters(0.0, 0.0005, limit=10.0))
    model.step(ZERO, ZERO, ZERO, 30.0, 0.5)
    np.testing.assert_allclose(model.step(ZERO, ZERO, ZERO + 1.0, 30.0, 0.5), 5.0)


def test_the_first_step_after_a_reset_has_no_memory():
    model = ActuatorModel(_parameters(0.0075, 0.0015))
    for k in range(20):
        model.step(Q, Q, Q + k, 50.0, 1.0)
    model.reset()
    np.testing.assert_allclose(model.step(ZERO, Q, Q, 30.0, 0.5), 29.5 * Q, atol=1e-12)


def test_a_reset_of_some_environments_does_not_change_the_others():
    rng = np.random.default_rng(4)
    q, dq, q_des = rng.normal(size=(3, 80, 3, 12))
    kp = np.where(np.arange(80) < 30, 30.0, 40.0)[:, None] + np.zeros((1, 3))

    def run(reset_ids):
        model = ActuatorModel(_parameters(0.0075, 0.0015), (3, 12))
        torques = []
        for k in range(80):
            if k == 32 and reset_ids:
                model.reset(reset_ids)
            torques.append(model.step(q[k], dq[k], q_des[k], kp[k, :, None], 0.5))
        return np.array(torques)

    whole, some = run([]), run([1])
    np.testing.assert_array_equal(some[:, [0, 2]], whole[:, [0, 2]])
    fresh = ActuatorModel(_parameters(0.0075, 0.0015))
    alone = [fresh.step(q[k, 1], dq[k, 1], q_des[k, 1], 40.0, 0.5) for k in range(32, 80)]
    np.testing.assert_allclose(some[32:, 1], alone, atol=1e-12)


def test_environments_with_their_own_parameters_equal_single_runs():
    rng = np.random.default_rng(5)
    q, dq, q_des = rng.normal(size=(3, 50, 4, 12))
    own = {
        "input_delay": np.array([0.006, 0.007, 0.0068, 0.0])[:, None],
        "output_delay": np.array([0.0, 0.0005, 0.002, 0.001])[:, None],
        "kp_scale": np.array([1.0, 0.95, 0.9, 0.97])[:, None],
        "kd_scale": np.array([1.0, 0.9, 0.92, 0.96])[:, None],
    }

    def run(shape, pick):
        model = ActuatorModel(_parameters(), shape)
        for name, value in own.items():
            setattr(model, name, value[pick])
        return np.array([model.step(q[k][pick], dq[k][pick], q_des[k][pick], 30.0, 0.5) for k in range(50)])

    together = run((4, 12), slice(None))
    for i in range(4):
        np.testing.assert_array_equal(together[:, i], run((12,), i))


def test_sampling_stays_within_the_probable_set_and_fills_it():
    parameters = attrs.evolve(
        ActuatorParameters.of(ALIENGO),
        pairs=[*ActuatorParameters.of(ALIENGO).pairs, DelayPair(0.02, 0.02, 1.0)],
    )
    model = ActuatorModel(parameters, (2000, 12))
    model.sample(rng=np.random.default_rng(6))
    drawn = set(zip(model.input_delay[:, 0], model.output_delay[:, 0], strict=True))
    assert drawn == {(pair.input_delay_s, pair.output_delay_s) for pair in parameters.probable_pairs}
    for scale, deviation in ((model.kp_scale, -0.706 / 30), (model.kd_scale, -0.021 / 0.5)):
        assert (scale >= 1 + 2 * deviation).all()
        assert (scale <= 1).all()
        assert abs(scale[:, 0].mean() - (1 + deviation)) < abs(deviation) * 0.06
        assert (scale == scale[:, :1]).all()


def test_sampling_some_environments_does_not_change_the_others():
    model = ActuatorModel(ActuatorParameters.of(ALIENGO), (6, 12))
    model.sample([1, 4], np.random.default_rng(7))
    changed = (model.kp_scale != 1 - 0.706 / 30).any(axis=1)
    np.testing.assert_array_equal(changed, [False, True, False, False, True, False])


def test_the_same_seed_gives_the_same_torques_bit_for_bit():
    def run(seed):
        model = ActuatorModel(ActuatorParameters.of(ALIENGO), (5, 12), seed=seed)
        model.sample()
        return np.array([model.step(Q, Q, Q * k, 30.0, 0.5) for k in range(300)])

    np.testing.assert_array_equal(run(8), run(8))
    assert (run(8) != run(9)).any()


def test_a_delay_out_of_range_is_refused():
    model = ActuatorModel(_parameters())
    with pytest.raises(ValueError, match=r"delay: found .* expected 0 to 0\.05 s"):
        model.input_delay = 0.051
    with pytest.raises(ValueError, match="delay: found"):
        model.output_delay = -0.001


def test_parameters_for_another_number_of_joints_are_refused():
    with pytest.raises(ValueError, match="torque_limit: found 3 numbers, expected 1 or 2"):
        ActuatorModel(ActuatorParameters.of(ALIENGO), (2,))


def test_parameters_of_some_joints_are_not_taken_for_those_of_all():
    some = attrs.evolve(
        ActuatorParameters.of(ALIENGO),
        delta_kp=(1.0, 2.0, 3.0),
        joints=("FR_hip_joint", "FL_hip_joint", "RL_hip_joint"),
    )
    with pytest.raises(ValueError, match=r"joints: found 3 names \(FR_hip_joint, .*\), expected 12"):
        ActuatorModel(some)
    ActuatorModel(some, (3,))
