"""What an effect is worth: the mean squared torque error that it leaves to the paper's model, fitted as well as can be.

And which simpler laws explain it as well, so that a report that names one of them is right too. Linear regressions on
the plant's own noise-free series.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.identification.hidden.plant import Trace

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]

ROWS = 2500
INPUT_MAX, OUTPUT_MAX = 0.020, 0.006  # s, what the paper's search covers


@dataclass(frozen=True)
class Scene:
    """A run as the regressions see it: `held` (K, J) the targets as sent, on ticks; `rows` (N,) the ticks looked at."""

    held: Array
    trace: Trace
    rows: Ticks
    dt: float

    @staticmethod
    def of(held: Array, trace: Trace, dt: float, stride: int) -> Scene:
        """Rows are some of those that a log of one sample every `stride` ticks holds."""
        first = round((INPUT_MAX + OUTPUT_MAX) / dt / stride + 1) * stride
        logged = np.arange(first, len(held) - stride, stride)
        chosen = np.random.default_rng(0).permutation(len(logged))[:ROWS]
        return Scene(held, trace, logged[np.sort(chosen)], dt)

    @property
    def tau(self) -> Array:
        return self.trace.tau[self.rows]

    def pd_columns(self, input_ticks: int, output_ticks: int) -> Array:
        """Position error and speed as the delayed drive sees them, (N J, 2)."""
        seen = self.rows - output_ticks
        error = self.held[seen - input_ticks] - self.trace.q[seen]
        return np.stack([error.ravel(), -self.trace.dq[seen].ravel()], axis=1)


def _left(columns: Array, target: Array) -> tuple[float, Array]:
    """Mean square and residual of the least squares of `target` on `columns`."""
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
    normal = (columns / scale).T @ (columns / scale)
    solution = np.linalg.lstsq(
        normal + 1e-10 * len(columns) * np.eye(len(normal)), (columns / scale).T @ target, rcond=None
    )
    residual = target - columns / scale @ solution[0]
    return float(np.mean(residual**2)), residual


def best_model(scene: Scene, input_ticks: int, output_ticks: int) -> tuple[float, int, int]:
    """Least error of the paper's model and its delays (ticks), searched from the true delays on."""
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
    """Columns (N J, C) of simple laws, each with a coefficient of its own for each affected joint."""
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
    """(N, J) as (N J, len(joints)): one column for each joint, zero on the others."""
    blocks = np.zeros((*column.shape, len(joints)))
    for place, joint in enumerate(joints):
        blocks[:, joint, place] = column[:, joint]
    return blocks.reshape(-1, len(joints))


def equals(scene: Scene, base: Array, laws: dict[str, Array], allowed: float) -> list[str]:
    """The laws that, beside the paper's model, leave less than `allowed` of the torque unexplained."""
    target = scene.tau.ravel()
    return [
        name for name, law in laws.items() if _left(np.concatenate([base, law], axis=1), target)[0] < allowed
    ]


def beyond(scene: Scene, base: Array, laws: dict[str, Array]) -> float:
    """What the paper's model and all these laws together leave."""
    return _left(np.concatenate([base, *laws.values()], axis=1), scene.tau.ravel())[0]


def marginal(difference: Array, base: Array, others: list[Array]) -> float:
    """What is left of an effect's torque `difference` (N J,) when the model and the other effects are fitted to it."""
    return _left(np.concatenate([base, *(other[:, None] for other in others)], axis=1), difference)[0]
