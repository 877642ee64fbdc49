"""The Kalman filter on motions known in closed form, and its parts against independent computations."""

from collections.abc import Callable

import attrs
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadvel_description.kinematics import foot_jacobians, foot_positions, inverse_kinematics, rotation_matrix
from quadvel_description.quadruped import GRAVITY
from quadvel_description.state import RobotState
from quadvel_estimator.kalman import KalmanConfig, KalmanEstimator, _ground_force
from quadvel_estimator.odometry import leg_velocity
from tests.helpers.robots import ALIENGO

DT = 0.005
NOMINAL_FEET = foot_positions(ALIENGO, ALIENGO.nominal_q)
CONFIG = KalmanConfig(
    accelerometer=1.0,
    foot_position=0.003,
    foot_velocity=0.1,
    foot_walk=0.01,
    slip_gate=2.0,
    contact_force=15.0,
    contact_ramp=40.0,
    contact_source="foot_force",
)
State = Callable[..., RobotState]
Trot = Callable[[float, int], list[RobotState]]


def rolling_stance(speed: float, time: np.ndarray) -> np.ndarray:
    """Joint angles (n, 12) of a level trunk that moves at `speed` forward over feet that roll without slip.

    A foot's centre moves forward by the radius times the calf's turn; solved by iteration (a contraction).
    """
    q = np.tile(ALIENGO.nominal_q, (len(time), 1))
    feet = np.tile(NOMINAL_FEET, (len(time), 1, 1))
    for _ in range(10):
        turn = q[:, 1::3] + q[:, 2::3] - ALIENGO.nominal_q[1] - ALIENGO.nominal_q[2]
        feet[..., 0] = NOMINAL_FEET[:, 0] - speed * time[:, None] + ALIENGO.foot_radius * turn
        q = inverse_kinematics(ALIENGO, feet)
    return q


@pytest.fixture
def trot(standing: State) -> Trot:
    """trot(speed, samples): diagonal pairs take turns of 0.2 s; the pair in the air swings as the other's mirror."""

    def states(speed: float, samples: int) -> list[RobotState]:
        times = DT * np.arange(1, samples + 1)
        phase = times % 0.4
        stance = np.where(phase[:, None] < 0.2, [True, False, False, True], [False, True, True, False])

        def joints(ahead: float) -> np.ndarray:
            step = phase % 0.2 - 0.1 + ahead
            return np.where(
                np.repeat(stance, 3, 1), rolling_stance(speed, step), rolling_stance(speed, -step)
            )

        q, dq = joints(0.0), (joints(1e-6) - joints(-1e-6)) / 2e-6
        force = np.where(stance, 150.0, 0.0)
        return [standing(t, q=q[i], dq=dq[i], foot_force=force[i]) for i, t in enumerate(times)]

    return states


def stack(states: list[RobotState]) -> RobotState:
    """Several robots at one instant as a batch."""
    names = [field.name for field in attrs.fields(RobotState) if field.name not in ("time", "tick")]
    return attrs.evolve(states[0], **{name: np.stack([getattr(s, name) for s in states]) for name in names})


def run(estimator: KalmanEstimator, states: list[RobotState]) -> np.ndarray:
    """The velocities of a recording, (n, 3)."""
    return np.array([estimator.update(state)[0] for state in states])


@pytest.mark.parametrize("speed", [0.8, -0.5])
def test_a_trot_at_constant_velocity_is_recovered_exactly(trot: Trot, speed: float) -> None:
    velocity = run(KalmanEstimator(ALIENGO, CONFIG), trot(speed, 300))[200:]
    np.testing.assert_allclose(velocity, np.broadcast_to([speed, 0.0, 0.0], (100, 3)), atol=2e-3)


def test_the_velocity_is_told_in_the_body_frame(trot: Trot) -> None:
    heading = Rotation.from_euler("z", 2.0).as_quat(scalar_first=True)
    states = [attrs.evolve(state, quaternion=heading) for state in trot(0.8, 300)]
    np.testing.assert_allclose(run(KalmanEstimator(ALIENGO, CONFIG), states)[-1], [0.8, 0.0, 0.0], atol=2e-3)


def test_at_rest_noise_leaves_no_bias(standing: State) -> None:
    rng = np.random.default_rng(1)
    states = [
        standing(
            DT * i,
            q=ALIENGO.nominal_q + rng.normal(0.0, 0.002, 12),
            dq=rng.normal(0.0, 0.1, 12),
            linear_acceleration=np.array([0.0, 0.0, GRAVITY]) + rng.normal(0.0, 0.3, 3),
        )
        for i in range(800)
    ]
    velocity = run(KalmanEstimator(ALIENGO, CONFIG), states)[100:]
    np.testing.assert_allclose(velocity.mean(0), 0.0, atol=2e-3)
    assert velocity.std() < 0.02


def test_the_accelerometer_carries_it_through_a_flight(standing: State) -> None:
    airborne = np.zeros(4)
    estimator = KalmanEstimator(ALIENGO, CONFIG)
    run(estimator, [standing(DT * i) for i in range(100)])
    ballistic = [
        standing(
            0.5 + DT * i,
            foot_force=airborne,
            linear_acceleration=np.array([1.0, 0.0, 0.0]),
            q=ALIENGO.nominal_q,
        )
        for i in range(20)
    ]
    # the robot's free fall: the accelerometer reads 1 m/s^2 forward and no gravity
    np.testing.assert_allclose(run(estimator, ballistic)[-1], [0.1, 0.0, -0.1 * GRAVITY], atol=0.01)


def test_one_foot_that_slips_is_not_believed(standing: State) -> None:
    slide = 0.6  # m/s, the front right foot goes forward on the ground, the others stand

    def state(time: float) -> RobotState:
        feet = NOMINAL_FEET.copy()
        feet[0, 0] += slide * time
        q = inverse_kinematics(ALIENGO, feet)
        foot_rate = np.zeros((4, 3, 1))
        foot_rate[0, 0] = slide
        dq = np.linalg.solve(foot_jacobians(ALIENGO, q), foot_rate).reshape(12)
        return standing(time, q=q, dq=dq)

    estimator = KalmanEstimator(ALIENGO, CONFIG)
    run(estimator, [standing(DT * i) for i in range(-100, 0)])
    velocity = run(estimator, [state(DT * i) for i in range(40)])
    assert np.abs(velocity).max() < 0.03


def test_each_leg_tells_the_velocity_that_lets_its_contact_point_rest(standing: State) -> None:
    """Against finite differences of the material point of the foot that touches the ground."""
    rng = np.random.default_rng(2)
    q = ALIENGO.nominal_q + rng.uniform(-0.3, 0.3, 12)
    dq, omega = rng.normal(size=12), rng.normal(size=3)
    attitude = Rotation.from_euler("ZYX", [1.0, 0.3, -0.2])
    state = standing(0.0, q=q, dq=dq, angular_velocity=omega, quaternion=attitude.as_quat(scalar_first=True))
    velocity_by_leg = leg_velocity(ALIENGO, state, rotation_matrix(state.quaternion))

    def calf(q: np.ndarray, leg: int) -> Rotation:
        hip, thigh, knee = q[3 * leg : 3 * leg + 3]
        return Rotation.from_euler("XY", [hip, thigh + knee])

    for leg in range(4):
        fixed_in_calf = (attitude * calf(q, leg)).inv().apply([0.0, 0.0, -ALIENGO.foot_radius])

        def contact(h: float, leg: int = leg, fixed: np.ndarray = fixed_in_calf) -> np.ndarray:
            moved = q + h * dq
            turned = attitude * Rotation.from_rotvec(h * omega)
            return turned.apply(foot_positions(ALIENGO, moved)[leg] + calf(moved, leg).apply(fixed))

        slide = (contact(1e-6) - contact(-1e-6)) / 2e-6  # world frame, while the trunk's origin stays
        np.testing.assert_allclose(attitude.apply(velocity_by_leg[leg]), -slide, atol=1e-7)


def test_joint_torques_tell_the_weight_on_each_foot() -> None:
    rng = np.random.default_rng(3)
    q = ALIENGO.nominal_q + rng.uniform(-0.2, 0.2, 12)
    attitude = Rotation.from_euler("ZYX", [0.5, 0.2, 0.1])
    rotation = rotation_matrix(attitude.as_quat(scalar_first=True))
    share = np.array([0.4, 0.1, 0.2, 0.3]) * ALIENGO.mass * GRAVITY
    force = np.column_stack([rng.normal(0.0, 20.0, (4, 2)), share])  # on the feet, world frame
    power = 1e-6 * np.eye(12)  # virtual displacements of the joints do the work of the forces on the feet
    shifts = (
        foot_positions(ALIENGO, q + power) - foot_positions(ALIENGO, q - power)
    ) / 2e-6  # (12, 4, 3), trunk frame
    tau = -np.einsum("jfi,ki,fk->j", shifts, rotation, force)
    np.testing.assert_allclose(_ground_force(tau, rotation, foot_jacobians(ALIENGO, q)), share, rtol=0.02)


def test_standing_on_torques_alone_works_without_foot_sensors(standing: State) -> None:
    load = np.array([0.0, 0.0, ALIENGO.mass * GRAVITY / 4])
    tau = -np.einsum("fij,i->fj", foot_jacobians(ALIENGO, ALIENGO.nominal_q), load).reshape(12)
    config = attrs.evolve(CONFIG, contact_source="torque")
    estimator = KalmanEstimator(ALIENGO, config)
    states = [standing(DT * i, tau=tau, foot_force=np.zeros(4)) for i in range(100)]
    biased = [attrs.evolve(s, linear_acceleration=np.array([0.2, 0.0, GRAVITY])) for s in states]
    assert abs(run(estimator, biased)[-1, 0]) < 0.02


def test_a_batch_gives_the_same_as_one_by_one(trot: Trot) -> None:
    walks = [trot(speed, 60) for speed in (0.3, -0.6, 0.9)]
    alone = [run(KalmanEstimator(ALIENGO, CONFIG), walk) for walk in walks]
    estimator = KalmanEstimator(ALIENGO, CONFIG, shape=(3,))
    together = run(estimator, [stack(list(instant)) for instant in zip(*walks, strict=True)])
    np.testing.assert_allclose(together.swapaxes(0, 1), alone, atol=1e-10)


def test_reset_forgets_one_robot_of_a_batch_and_keeps_the_others(trot: Trot) -> None:
    estimator = KalmanEstimator(ALIENGO, CONFIG, shape=(2,))
    twice = [stack([state, state]) for state in trot(0.8, 101)]
    run(estimator, twice[:-2])
    _, settled = estimator.update(twice[-2])
    estimator.reset(np.array([1]))
    velocity, covariance = estimator.update(twice[-1])
    assert covariance[1, 0, 0] > 2.0 * covariance[0, 0, 0]
    np.testing.assert_allclose(covariance[0], settled[0], rtol=0.1)
    np.testing.assert_allclose(velocity[:, 0], 0.8, atol=0.02)


def test_a_series_ends_where_one_sample_after_the_other_ends(trot: Trot) -> None:
    walk, estimator = trot(0.8, 30), KalmanEstimator(ALIENGO, CONFIG)
    for part in (walk[:10], walk[10:11], walk[11:]):
        velocity, _ = estimator.update_series([state.time for state in part], stack(part))
    np.testing.assert_allclose(velocity, run(KalmanEstimator(ALIENGO, CONFIG), walk)[-1], atol=1e-9)


def test_the_covariance_is_symmetric_and_grows_without_contact(standing: State) -> None:
    estimator = KalmanEstimator(ALIENGO, CONFIG)
    run(estimator, [standing(DT * i) for i in range(100)])
    _, planted = estimator.update(standing(0.5))
    run(estimator, [standing(0.5 + DT * i, foot_force=np.zeros(4)) for i in range(1, 40)])
    _, flying = estimator.update(standing(0.7, foot_force=np.zeros(4)))
    np.testing.assert_array_equal(planted, planted.T)
    assert 0.0 < planted[0, 0] < 0.3 * flying[0, 0]


def test_time_that_runs_backwards_is_an_error(standing: State) -> None:
    estimator = KalmanEstimator(ALIENGO, CONFIG)
    estimator.update(standing(1.0))
    with pytest.raises(ValueError, match=r"state.time is 0.5, expected 1.0 or later"):
        estimator.update(standing(0.5))
    estimator.reset()
    estimator.update(standing(0.5))


def test_a_result_that_is_not_finite_is_an_error(standing: State) -> None:
    with pytest.raises(FloatingPointError):
        KalmanEstimator(ALIENGO, CONFIG).update(standing(0.0, dq=np.full(12, np.nan)))


def test_a_vector_within_the_bounds_makes_a_configuration_and_back() -> None:
    bounds = KalmanConfig.bounds()
    assert all(low < getattr(CONFIG, name) < high for name, (low, high) in bounds.items())
    vector = np.log([low for low, _ in bounds.values()])
    config = CONFIG.with_vector(vector)
    np.testing.assert_allclose(config.vector(), vector)
    assert config.accelerometer == pytest.approx(bounds["accelerometer"][0])
    assert config.contact_source == CONFIG.contact_source


def test_a_noise_of_zero_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"foot_position: found 0\.0, expected above 0"):
        KalmanConfig(foot_position=0.0)


def test_standing_height_of_the_closed_form_is_the_nominal_one() -> None:
    """The level ground that the trot above rolls on is where the nominal posture puts it."""
    assert ALIENGO.foot_radius - NOMINAL_FEET[0, 2] == pytest.approx(ALIENGO.nominal_height, abs=1e-4)
