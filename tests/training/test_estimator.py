"""Training of the estimators: walks and their modes, the network, tuning of the Kalman filter."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_description.kinematics import rotation_matrix  # noqa: E402
from quadvel_description.quadruped import GRAVITY  # noqa: E402
from quadvel_description.state import JointCommand, RobotState  # noqa: E402
from quadvel_estimator import features  # noqa: E402
from quadvel_estimator.kalman import KalmanConfig  # noqa: E402
from quadvel_estimator.learned import LearnedEstimator  # noqa: E402
from quadvel_estimator.odometry import leg_velocity  # noqa: E402
from quadvel_policy.config import SupervisorConfig  # noqa: E402
from quadvel_policy.modes import ModeInput, Posture  # noqa: E402
from quadvel_training import kalman_tuning, walks  # noqa: E402
from quadvel_training.env import TICK_S, CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.estimator import EstimatorConfig, EstimatorRun, VelocityNetwork  # noqa: E402
from quadvel_training.networks import Recurrent  # noqa: E402
from quadvel_training.randomisation import Randomisation  # noqa: E402
from quadvel_training.walks import Mode, Modes, Walks  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

STILL = CommandRange(stance=1.0)


@pytest.fixture(scope="module")
def actor():
    torch.manual_seed(0)
    return Recurrent(48, 12)  # nearly zero: it stands


def only(monkeypatch, mode):
    """Every walk begins in `mode`."""
    monkeypatch.setattr(walks, "FIRST_MODE_SHARES", np.eye(len(Mode))[mode])


def test_postures_are_those_of_the_controller(monkeypatch):
    """Targets and their speeds, tick by tick, while a robot stands up from any joint positions."""
    only(monkeypatch, Mode.DAMPING)
    rng = np.random.default_rng(0)
    modes = Modes(ALIENGO, 1, rng)
    modes.begin(np.array([0]))
    q = ALIENGO.lie_q + rng.normal(0, 0.1, 12)
    while modes.mode[0] == Mode.DAMPING:
        modes.set_targets(np.zeros((1, 12)), ALIENGO.kp, ALIENGO.kd)
        modes.advance(q[None])
    c = SupervisorConfig()
    fold = Posture(ALIENGO, [(c.fold_time, ALIENGO.lie_q)], c.stand_kp, c.stand_kd)
    state = RobotState(
        0.0, 0, q, np.zeros(12), np.zeros(12), np.array([1.0, 0, 0, 0]), *np.zeros((2, 3)), np.zeros(4)
    )
    fold.enter(ModeInput(0.0, state, None, np.zeros(4), JointCommand.damping(c.damping_kd)))
    for k in range(round(c.fold_time / TICK_S)):
        wanted = fold.tick(ModeInput(k * TICK_S, state, None, np.zeros(4), JointCommand.damping(1.0)))
        speed = modes.set_targets(np.zeros((1, 12)), ALIENGO.kp, ALIENGO.kd)
        np.testing.assert_allclose(modes.target[0], wanted.q, atol=1e-9)
        np.testing.assert_allclose(speed[0], wanted.dq, atol=1e-9)
        assert (modes.kp == c.stand_kp).all()
        assert (modes.kd == c.stand_kd).all()
        modes.advance(q[None])
    assert modes.mode[0] == Mode.RISE


def test_what_the_policy_asks_for_fades_in(monkeypatch):
    only(monkeypatch, Mode.STANCE)
    modes = Modes(ALIENGO, 1, np.random.default_rng(0))
    modes.begin(np.array([0]))
    c = SupervisorConfig()
    monkeypatch.setattr(walks, "LOWER_SHARE", 0.0)
    asked, q = np.full((1, 12), 0.3), np.zeros((1, 12))
    torque = []
    while modes.mode[0] == Mode.STANCE or modes.elapsed[0] < c.blend_time + 0.02:
        modes.set_targets(asked, ALIENGO.kp, ALIENGO.kd)
        torque.append((modes.kp * (modes.target - q))[0, 0])
        modes.advance(q)
    assert torque[-1] == pytest.approx(ALIENGO.kp * 0.3)
    step = c.stand_kp * abs(ALIENGO.nominal_q[0]) + ALIENGO.kp * 0.3
    assert np.abs(np.diff(torque)).max() == pytest.approx(step * TICK_S / c.blend_time, rel=0.01)


def test_robots_that_lie_stand_up(monkeypatch, actor):
    only(monkeypatch, Mode.DAMPING)
    monkeypatch.setattr(walks, "MAX_MODE_S", walks.MIN_MODE_S)  # stance after 0.2 + 0.8 + 1.2 s
    env = VelocityEnv(
        EnvConfig(robot=ALIENGO, n=3, threads=1, seed=1, randomisation=Randomisation.none(), commands=STILL)
    )
    walking = Walks(env, actor)
    assert env.height.max() < ALIENGO.lie_height + 0.1
    assert (walking.previous_action == 0.0).all()
    for _ in range(round(2.5 / TICK_S)):
        walking.advance(walking.sense(), walking.truth)
    assert not walking.over.any()
    assert env.height == pytest.approx(ALIENGO.nominal_height, abs=0.03)  # the gains give way
    assert np.abs(env.velocity).max() < 0.05


def test_readings_are_the_truth_but_for_noise_and_bias(monkeypatch, actor):
    only(monkeypatch, Mode.STANCE)
    env = VelocityEnv(
        EnvConfig(robot=ALIENGO, n=400, seed=1, randomisation=Randomisation.none(), commands=STILL)
    )
    walking = Walks(env, actor)
    sensed = walking.sense()
    scale = np.sqrt(
        np.mean(np.square([walks.NOISE_SCALE[0] + d for d in np.linspace(0, np.ptp(walks.NOISE_SCALE), 99)]))
    )
    assert np.std(sensed.q - env.q) == pytest.approx(walks.NOISE[0] * scale, rel=0.1)
    bias = np.hypot(walks.BIAS_ANGULAR_VELOCITY, walks.NOISE[24] * scale)
    assert np.std(sensed.angular_velocity - env.angular_velocity) == pytest.approx(bias, rel=0.1)
    np.testing.assert_allclose(np.linalg.norm(sensed.quaternion, axis=1), 1.0)
    assert np.abs(np.sum(sensed.quaternion * env.quaternion, axis=1)).min() > 0.999


KEEP = 4


def believing(which: int) -> VelocityNetwork:
    """A network without corrections whose only share is that of a leg, 0 to 3, or of inertia, 4."""
    torch.manual_seed(0)
    network = VelocityNetwork(features.default_layout(ALIENGO))
    last = network.body[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
        last.bias[6 + which] = 50.0
    return network


def seen(sensed: RobotState, ticks: int) -> torch.Tensor:
    """The network's input (T, 1, 69) of a constant state."""
    x = features.build(ALIENGO, sensed, np.zeros(12), features.default_layout(ALIENGO))
    return torch.from_numpy(np.tile(x, (ticks, 1, 1)))


def moving(**changes) -> RobotState:
    still = RobotState(
        time=0.0,
        tick=0,
        q=ALIENGO.nominal_q,
        dq=np.linspace(-4.0, 3.0, 12),
        tau=np.zeros(12),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
        linear_acceleration=np.array([0.0, 0.0, GRAVITY]),
        foot_force=np.zeros(4),
    )
    return attrs.evolve(still, **changes)


def test_the_network_can_believe_one_leg():
    network, state = believing(2), moving()
    with torch.no_grad():
        output, _ = network(seen(state, 2), network.initial_state(1))
    np.testing.assert_allclose(
        output[1, 0, :3].numpy(),
        leg_velocity(ALIENGO, state, rotation_matrix(state.quaternion))[2],
        atol=1e-5,
    )


def test_the_network_can_go_on_by_inertia_alone():
    """A body that spins at constant world velocity and falls: body frame velocity in closed form."""
    network = believing(KEEP)
    rate, ticks = 2.0, 100
    spinning = moving(angular_velocity=np.array([0.0, 0.0, rate]), linear_acceleration=np.zeros(3))
    state = network.initial_state(1)
    state[0][0, 0, -3:] = torch.tensor([1.0, 0.5, 0.0])
    with torch.no_grad():
        output, _ = network(seen(spinning, ticks), state)
    turned = (1.0 + 0.5j) * np.exp(-1j * rate * ticks * TICK_S)
    expected = [turned.real, turned.imag, -GRAVITY * ticks * TICK_S]
    np.testing.assert_allclose(output[-1, 0, :3].numpy(), expected, rtol=0.02)


def test_a_trained_network_runs_as_a_file(tmp_path, actor):
    run = EstimatorRun(EstimatorConfig(n=8, length=4, mini_batches=2), actor)
    run.step(0.9)
    run.export(tmp_path / "estimator.onnx", {"stage": "test"})
    estimator = LearnedEstimator(ALIENGO, tmp_path / "estimator.onnx")
    sensed = run.walks[0].walks.sense()
    action = run.walks[0].walks.previous_action
    state = run.network.initial_state(4)
    for _ in range(3):
        with torch.no_grad():
            output, state = run.network(
                torch.from_numpy(
                    features.build(ALIENGO, sensed, action, features.default_layout(ALIENGO))[None]
                ),
                state,
            )
        arrays = {k: v[0] for k, v in attrs.asdict(sensed).items() if isinstance(v, np.ndarray)}
        velocity, covariance = estimator.update(attrs.evolve(sensed, **arrays), action[0])
        np.testing.assert_allclose(velocity, output[0, 0, :3].numpy(), atol=1e-5)
        np.testing.assert_allclose(np.diag(covariance), np.exp(output[0, 0, 3:].numpy()), rtol=1e-4)


def test_tuning_does_not_make_the_filter_worse(actor):
    config = kalman_tuning.TuningConfig(n=4, window=0.75, windows=1)
    recording = kalman_tuning.record(config, actor)
    assert recording.truth.shape == (150, 4, 3)
    assert not recording.is_scored[:100].any()
    tuned = kalman_tuning.tune(recording, evaluations=10)
    before, after = (kalman_tuning.rmse(c, recording).mean() for c in (KalmanConfig(), tuned))
    assert after <= before
