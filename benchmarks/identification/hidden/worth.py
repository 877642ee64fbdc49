"""Size of an effect: the mean squared torque error of the paper's model, fitted optimally.

Also finds simpler laws that explain the effect equally well, so that a report which names one of
them is right. Uses linear regressions on the noise-free series of the plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification.hidden.plant import Trace

Array = NDArray[np.float64]

Ticks = NDArray[np.int64]

ROWS = 2500
INPUT_MAX, OUTPUT_MAX = 0.020, 0.006  # s, what the paper's search covers


@dataclass(frozen=True)
class Scene:
    """Series for the regressions.

    Attributes:
        held: Targets as sent, at each tick, (K, J), rad.
        trace: Simulated series.
        rows: Ticks that are used, (N,).
        dt: Tick, s.
    """

    held: Array
    trace: Trace
    rows: Ticks
    dt: float

    @staticmethod
    def of(held: Array, trace: Trace, dt: float, stride: int) -> Scene:
        """Choose random rows of those that a log with one row every `stride` ticks contains."""
        first = round((INPUT_MAX + OUTPUT_MAX) / dt / stride + 1) * stride
        logged = np.arange(first, len(held) - stride, stride)
        chosen = np.random.default_rng(0).permutation(len(logged))[:ROWS]
        return Scene(held, trace, logged[np.sort(chosen)], dt)

    @property
    def tau(self) -> Array:
        """Torque of the rows, (N, J), N m."""
        return self.trace.tau[self.rows]

    def pd_columns(self, input_ticks: int, output_ticks: int) -> Array:
        """Regressors of the PD law: delayed position error and speed, (N J, 2)."""
        seen = self.rows - output_ticks
        error = self.held[seen - input_ticks] - self.trace.q[seen]
        return np.stack([error.ravel(), -self.trace.dq[seen].ravel()], axis=1)


def _left(columns: Array, target: Array) -> tuple[float, Array]:
    """Mean square and residual of the least-squares fit of `target` to `columns`."""
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
    normal = (columns / scale).T @ (columns / scale)
    solution = np.linalg.lstsq(
        normal + 1e-10 * len(columns) * np.eye(len(normal)), (columns / scale).T @ target, rcond=None
    )
    residual = target - columns / scale @ solution[0]
    return float(np.mean(residual**2)), residual


def best_model(scene: Scene, input_ticks: int, output_ticks: int) -> tuple[float, int, int]:
    """Fit the paper's model over its delays, starting from the true ones.

    Args:
        scene: Series.
        input_ticks: True input delay, ticks.
        output_ticks: True output delay, ticks.

    Returns:
        Least mean squared error, N^2 m^2, and its delays, ticks.
    """
    target = scene.tau.ravel()
    most_in, most_out = round(INPUT_MAX / scene.dt), round(OUTPUT_MAX / scene.dt)
    best = (np.inf, input_ticks, output_ticks)
    for step in (max(round(0.002 / scene.dt), 1), max(round(0.0005 / scene.dt), 1)):
        for _ in range(4):
            centre = best[1:]
            for i in (-2, -1, 0, 1, 2):
                for o in (-2, -1, 0, 1, 2):
                    at = (
                        min(max(centre[0] + i * step, 0), most_in),
                        min(max(centre[1] + o * step, 0), most_out),
                    )
                    best = min(best, (_left(scene.pd_columns(*at), target)[0], *at))
            if best[1:] == centre:
                break
    return best


def rivals(scene: Scene, joints: tuple[int, ...], base: Array) -> dict[str, Array]:
    """Compute regressors of simple laws, with one coefficient for each affected joint.

    Args:
        scene: Series.
        joints: Indices of the affected joints.
        base: Regressors of the paper's model, (N J, 2).

    Returns:
        Regressors by law, (N J, C) each.
    """
    rows, trace, dt = scene.rows, scene.trace, scene.dt
    asked = scene.tau - _left(base, scene.tau.ravel())[1].reshape(scene.tau.shape)
    q, dq, ddq = trace.q[rows], trace.dq[rows], trace.ddq[rows]
    old = trace.dq[rows - round(0.008 / dt)]
    time = (rows * dt)[:, None] * np.ones(q.shape[1])
    sign = np.tanh(dq / 0.05)
    laws = {
        "coulomb_friction": [sign],
        "viscous_friction": [dq],
        "stribeck_friction": [sign, sign * np.exp(-(dq**2)), sign * np.exp(-((dq / 0.4) ** 2))],
        "quadratic_drag": [dq * np.abs(dq)],
        "load_dependent_friction": [np.abs(asked) * sign],
        "velocity_filter": [dq - old],
        "armature": [ddq],
        "torque_offset": [np.ones_like(q)],
        "parallel_spring": [np.ones_like(q), q],
        "gain_asymmetry": [np.abs(asked)],
        "thermal_drift": [asked * time, asked],
    }
    used = list(joints)
    return {
        name: np.concatenate([_blocks(column, used) for column in columns], axis=1)
        for name, columns in laws.items()
    }


def _blocks(column: Array, joints: list[int]) -> Array:
    """Expand (N, J) to (N J, len(joints)): one column for each joint, zero on the others."""
    blocks = np.zeros((*column.shape, len(joints)))
    for place, joint in enumerate(joints):
        blocks[:, joint, place] = column[:, joint]
    return blocks.reshape(-1, len(joints))


def equals(scene: Scene, base: Array, laws: dict[str, Array], allowed: float) -> list[str]:
    """List the laws that together with the paper's model have an error below a bound.

    Args:
        scene: Series.
        base: Regressors of the paper's model, (N J, 2).
        laws: Regressors by law.
        allowed: Bound of the mean squared error, N^2 m^2.

    Returns:
        Names of laws.
    """
    target = scene.tau.ravel()
    return [
        name for name, law in laws.items() if _left(np.concatenate([base, law], axis=1), target)[0] < allowed
    ]


def beyond(scene: Scene, base: Array, laws: dict[str, Array]) -> float:
    """Return the error of the paper's model together with all simple laws, N^2 m^2.

    Args:
        scene: Series.
        base: Regressors of the paper's model, (N J, 2).
        laws: Regressors by law.

    Returns:
        Mean squared error, N^2 m^2.
    """
    return _left(np.concatenate([base, *laws.values()], axis=1), scene.tau.ravel())[0]


def marginal(difference: Array, base: Array, others: list[Array]) -> float:
    """Return the part of an effect's torque that the model and other effects do not explain.

    Args:
        difference: Torque of the effect, (N J,), N m.
        base: Regressors of the paper's model, (N J, 2).
        others: Torques of the other effects, (N J,), N m.

    Returns:
        Mean squared error, N^2 m^2.
    """
    return _left(np.concatenate([base, *(other[:, None] for other in others)], axis=1), difference)[0]
