"""Tuning of the Kalman filter's noise on the walks that the learned estimator learns from.

`quadvel_estimator.kalman` has the filter, and `walks` the data.
"""

from __future__ import annotations

from collections.abc import Callable

import attrs
import numpy as np
from scipy.optimize import minimize

from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_description.state import RobotState
from quadvel_estimator.kalman import KalmanConfig, KalmanEstimator
from quadvel_sim.terrain import Terrain

from .env import TICK_S, CommandRange
from .networks import Recurrent
from .randomisation import Randomisation
from .walks import Walks, walks_on_both_grounds

SETTLE_S = 0.5  # at the start of a window, for the filter to settle; not scored
FIRST_STEP = np.log(1.5)  # of the search, in log units


@attrs.frozen
class TuningConfig:
    """Configuration of the tuning; half of the robots walk on flat ground, half on rough.

    Attributes:
        robot: name of a shipped robot, or path of a robot.yaml.
        n: number of robots, on both grounds together.
        window: s, length of a window; each one is filtered separately.
        windows: number of windows per robot.
        evaluations: evaluations of the search.
        seed: seed of all draws.
        commands: range of commands.
        randomisation: what varies.
        rough: the rough ground.
    """

    robot: str = DEFAULT_ROBOT
    n: int = 64
    window: float = 2.0
    windows: int = 8
    evaluations: int = 200
    seed: int = 4
    commands: CommandRange = CommandRange()
    randomisation: Randomisation = Randomisation()
    rough: Terrain = Terrain(kind="rough", blend=10.0)


@attrs.frozen
class WalkRecording:
    """R windows of T ticks, the first half of them on flat ground.

    Attributes:
        robot: the robot.
        states: T readings, each of arrays (R, ...).
        truth: (T, R, 3), m/s, true velocity in the body frame.
        is_scored: (T, R) bool, ticks that count: the robot has neither fallen nor timed out in this window,
            and the filter has settled.
    """

    robot: Robot
    states: list[RobotState]
    truth: np.ndarray
    is_scored: np.ndarray


def record(config: TuningConfig, actor: Recurrent) -> WalkRecording:
    """Record walks of a policy that gets the true velocity with the noise of its training.

    Args:
        config: configuration.
        actor: policy.

    Returns:
        The recording.
    """
    robot, ticks = load_robot(config.robot), round(config.window / TICK_S)
    grounds = [
        [_window(walks, ticks) for _ in range(config.windows)]
        for walks in walks_on_both_grounds(
            robot,
            config.n,
            config.seed,
            config.commands,
            config.randomisation,
            config.rough,
            actor,
        )
    ]
    parts = [window for ground in grounds for window in ground]
    names = [f.name for f in attrs.fields(RobotState) if f.name not in ("time", "tick")]
    states = [
        RobotState(
            time=k * TICK_S,
            tick=k,
            **{name: np.concatenate([getattr(part.states[k], name) for part in parts]) for name in names},
        )
        for k in range(ticks)
    ]
    truth = np.concatenate([part.truth for part in parts], axis=1)
    return WalkRecording(robot, states, truth, np.concatenate([part.is_scored for part in parts], axis=1))


def _window(walks: Walks, ticks: int) -> WalkRecording:
    """Record one window of each robot."""
    states, truth, alive = [], [], []
    for _ in range(ticks):
        states.append(walks.sense())
        truth.append(walks.truth.copy())
        alive.append(~walks.over)
        walks.advance(states[-1], walks.noisy_truth())
    walks.start_over(np.flatnonzero(walks.over))
    judged = np.array(alive)
    judged[: round(SETTLE_S / TICK_S)] = False
    return WalkRecording(walks.env.robot, states, np.array(truth), judged)


def rmse(config: KalmanConfig, recording: WalkRecording) -> np.ndarray:
    """RMS error of a Kalman filter.

    Args:
        config: noise of the filter.
        recording: recorded walks.

    Returns:
        (2, 3), m/s per axis, on flat and on rough ground.
    """
    robots = recording.truth.shape[1]
    estimator = KalmanEstimator(recording.robot, config, (robots,))
    square, count = np.zeros((robots, 3)), np.zeros((robots, 1))
    for state, truth, judged in zip(recording.states, recording.truth, recording.is_scored, strict=True):
        velocity, _ = estimator.update(state)
        square += np.square(velocity - truth) * judged[:, None]
        count += judged[:, None]
    grounds = (slice(0, robots // 2), slice(robots // 2, None))
    return np.array([np.sqrt(square[half].sum(axis=0) / count[half].sum()) for half in grounds])


def tune(
    recording: WalkRecording, evaluations: int, progress: Callable[[np.ndarray], None] = lambda error: None
) -> KalmanConfig:
    """Minimise the mean of `rmse` from the defaults of `KalmanConfig` by Nelder and Mead's search.

    Args:
        recording: recorded walks.
        evaluations: number of evaluations.
        progress: called with the errors of each evaluation.

    Returns:
        The best configuration.
    """
    start = KalmanConfig()

    def cost(vector: np.ndarray) -> float:
        error = rmse(start.with_vector(vector), recording)
        progress(error)
        return float(error.mean())

    bounds = np.log(list(KalmanConfig.bounds().values()))
    first = start.vector()
    # away from the nearer bound
    simplex = np.vstack([first, first + np.diag(np.where(first < bounds.mean(axis=1), 1, -1) * FIRST_STEP)])
    options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-5}
    found = minimize(cost, first, method="Nelder-Mead", bounds=bounds, options=options)
    return start.with_vector(found.x)
