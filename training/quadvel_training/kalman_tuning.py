"""Tuning of the Kalman filter's noise on the walks that the learned estimator learns from, so that the two can be compared."""

from __future__ import annotations

from collections.abc import Callable

import attrs
import numpy as np
from scipy.optimize import minimize

from quadvel_description.state import RobotState
from quadvel_estimator.kalman import KalmanConfig, KalmanEstimator
from quadvel_sim.terrain import Terrain

from .env import TICK, CommandRange
from .networks import Recurrent
from .randomisation import Randomisation
from .walks import Walks, both_grounds

SETTLE = 0.5  # s, at the start of a window, in which the filter finds its state; not judged
FIRST_STEP = np.log(1.5)  # of each parameter, in the search


@attrs.frozen
class TuningConfig:
    """One run; half of the `n` environments walk on flat ground, half on rough."""

    n: int = 64
    window: float = 2.0  # s; every one is filtered on its own, all at once
    windows: int = 8
    evaluations: int = 200
    seed: int = 4
    commands: CommandRange = CommandRange()
    randomisation: Randomisation = Randomisation()
    rough: Terrain = Terrain(kind="rough", blend=10.0)


@attrs.frozen
class Recording:
    """`robots` windows of T ticks at once, the first half on flat ground."""

    states: list[RobotState]  # T, each of (robots, ...)
    truth: np.ndarray  # (T, robots, 3) m/s, body frame
    judged: np.ndarray  # (T, robots) bool


def record(config: TuningConfig, actor: Recurrent) -> Recording:
    """Walks of `actor`, which knows the true velocity."""
    ticks = round(config.window / TICK)
    grounds = [
        [_window(walks, ticks) for _ in range(config.windows)]
        for walks in both_grounds(
            config.n, config.seed, config.commands, config.randomisation, config.rough, actor
        )
    ]
    parts = [window for ground in grounds for window in ground]
    names = [f.name for f in attrs.fields(RobotState) if f.name not in ("time", "tick")]
    states = [
        RobotState(
            time=k * TICK,
            tick=k,
            **{name: np.concatenate([getattr(part.states[k], name) for part in parts]) for name in names},
        )
        for k in range(ticks)
    ]
    truth = np.concatenate([part.truth for part in parts], axis=1)
    return Recording(states, truth, np.concatenate([part.judged for part in parts], axis=1))


def _window(walks: Walks, ticks: int) -> Recording:
    states, truth, alive = [], [], []
    for _ in range(ticks):
        states.append(walks.sense())
        truth.append(walks.truth.copy())
        alive.append(~walks.over)
        walks.advance(states[-1], walks.noisy_truth())
    walks.start_over(np.flatnonzero(walks.over))
    judged = np.array(alive)
    judged[: round(SETTLE / TICK)] = False
    return Recording(states, np.array(truth), judged)


def rmse(config: KalmanConfig, recording: Recording) -> np.ndarray:
    """Root mean square error (2, 3) on flat and on rough ground, m/s an axis."""
    robots = recording.truth.shape[1]
    estimator = KalmanEstimator(config, (robots,))
    square, count = np.zeros((robots, 3)), np.zeros((robots, 1))
    for state, truth, judged in zip(recording.states, recording.truth, recording.judged, strict=True):
        velocity, _ = estimator.update(state)
        square += np.square(velocity - truth) * judged[:, None]
        count += judged[:, None]
    grounds = (slice(0, robots // 2), slice(robots // 2, None))
    return np.array([np.sqrt(square[half].sum(axis=0) / count[half].sum()) for half in grounds])


def tune(
    recording: Recording, evaluations: int, progress: Callable[[np.ndarray], None] = lambda error: None
) -> KalmanConfig:
    """The configuration of the least mean of `rmse`, found from the present one by Nelder and Mead's search."""
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
