"""Actuators of a batch of robots whose drives are not all of one kind.

A policy that is tuned on a corrected actuator model forgets the model it knew, unless some of the
robots keep it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadvel_actuator.model import ActuatorModel, Values
from quadvel_actuator.parameters import ActuatorParameters

from .randomisation import Randomisation, sample_actuators


class ActuatorGroups:
    """Equal groups of neighbouring robots, each with actuators of its own kind."""

    def __init__(self, kinds: Sequence[ActuatorParameters], robots: int, dt: float, seed: int) -> None:
        """Create the actuators.

        Args:
            kinds: parameters of each group, at least one.
            robots: number of robots, at least one for each group.
            dt: s, duration of a step.
            seed: seed of the noise.
        """
        ends = np.linspace(0, robots, len(kinds) + 1).round().astype(int).tolist()
        self._groups = [
            (slice(first, end), ActuatorModel(kind, (end - first, 12), dt, seed=seed + k))
            for k, (kind, first, end) in enumerate(zip(kinds, ends[:-1], ends[1:], strict=True))
        ]
        self._torque = np.zeros((robots, 12))

    def sample(self, ids: np.ndarray, ranges: Randomisation, rng: np.random.Generator) -> None:
        """Draw the actuators of some robots, and reset them.

        Args:
            ids: indices of the robots.
            ranges: ranges to draw from, as in `sample_actuators`.
            rng: source of randomness.
        """
        for rows, model in self._groups:
            if len(own := _within(rows, ids)):
                sample_actuators(model, own, ranges, rng)

    def reset(self, ids: np.ndarray) -> None:
        """Clear the past of some robots' actuators.

        Args:
            ids: indices of the robots.
        """
        for rows, model in self._groups:
            if len(own := _within(rows, ids)):
                model.reset(own)

    def step(
        self,
        q: np.ndarray,
        dq: np.ndarray,
        q_des: np.ndarray,
        kp: Values,
        kd: Values,
        dq_des: Values = 0.0,
        tau_ff: Values = 0.0,
    ) -> np.ndarray:
        """Advance by one step; the arguments are those of `ActuatorModel.step`.

        Args:
            q: rad, (n, 12), joint positions.
            dq: rad/s, (n, 12), joint velocities.
            q_des: rad, (n, 12), position targets.
            kp: N m/rad, proportional gain, a number or (n, 12).
            kd: N m s/rad, derivative gain, a number or (n, 12).
            dq_des: rad/s, velocity targets, a number or (n, 12).
            tau_ff: N m, feedforward torques, a number or (n, 12).

        Returns:
            Torques, (n, 12), N m; the next call overwrites them.
        """
        for rows, model in self._groups:
            gains_and_more = (_rows(value, rows) for value in (kp, kd, dq_des, tau_ff))
            self._torque[rows] = model.step(q[rows], dq[rows], q_des[rows], *gains_and_more)
        return self._torque


def _rows(value: Values, rows: slice) -> Values:
    """Rows of an array (n, 12); a number stays."""
    return np.asarray(value)[rows] if np.ndim(value) == 2 else value


def _within(rows: slice, ids: np.ndarray) -> np.ndarray:
    """Indices within a group of those robots that belong to it."""
    return ids[(ids >= rows.start) & (ids < rows.stop)] - rows.start
