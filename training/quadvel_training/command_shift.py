"""Commands for the teacher beyond those of its student, so that the student has no steady error.

The teacher removes its steady errors by integrals over seconds. The student, whose sequences last for
a second, learns them in part: without this shift it was 0.1 m/s slow at 1.5 m/s. So the teacher is
asked for a shifted command. The shift grows by the student's own mean error at each command, as
in integral control, until there is none. It is a smooth function of the command:

    shift(c) = W phi(c),   W <- W + gain argmin_V (sum_i w_i |e_i - V phi(c_i)|^2 + ridge |V|^2)

where e_i is the command minus the velocity of a robot that the student drives, without exploration:
a robot that explores is slower. phi are piecewise linear functions of vx, vy and yaw rate and the
products of vx, vy and yaw rate up to the third degree. Errors are bounded, so that few robots that
slip or carry much do not shift all others; so is the shift, and an error that would take it past its
bound does not count. All processes of a run share the shift. Weights w_i fall with the command: at the
fastest ones robots fall before they are steady. The mirrored command gets the mirrored shift.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import torch

from . import process_group
from .env import TICK_S

SCALES = np.array([2.0, 1.0, 3.0])  # m/s, m/s, rad/s: commands of usual size, so that features are about 1
MAX_ERROR = np.array([0.1, 0.1, 0.2])  # m/s, m/s, rad/s: larger ones count as this
MAX_SHIFT = np.array([0.3, 0.3, 0.6])  # m/s, m/s, rad/s
MIRROR = np.array([1.0, -1.0, -1.0])  # of vx, vy and yaw rate, left for right
KNOTS = (
    np.array([-4.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0]),
    np.array([-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0]),
    np.array([-6.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 6.0]),
)  # m/s, m/s, rad/s: between them the shift of a command along one axis is linear
PRODUCTS = [
    axes
    for degree in (2, 3)
    for axes in combinations_with_replacement(range(3), degree)
    if len(set(axes)) > 1
]
FEATURES = sum(len(knots) - 1 for knots in KNOTS) + len(PRODUCTS)
GAIN = 0.3  # share of the mean error by which the shift grows; the student needs millions of samples to follow it
SHORTEST_STEADY_S = 0.5  # of a sequence in which a robot is steady, for its mean error to count
RIDGE = 5.0  # robots that walk at the usual commands with no error


class CommandShift:
    """Shift of the commands that a teacher follows, learned from the errors of its student.

    Attributes:
        every: calls of `add` from one change of the shift to the next.
    """

    def __init__(self, every: int) -> None:
        """Create a shift of zero.

        Args:
            every: calls of `add` from one change of the shift to the next.
        """
        self.every = every
        self._weights = np.zeros((FEATURES, 3))
        self._start_over()

    def _start_over(self) -> None:
        """Forget the errors since the last change."""
        self._calls = 0
        self._squares, self._products = np.zeros((FEATURES, FEATURES)), np.zeros((FEATURES, 3))

    def of(self, command: np.ndarray) -> np.ndarray:
        """Evaluate the shift.

        Args:
            command: (n, 4), vx, vy (m/s), yaw rate (rad/s), 1 for stance.

        Returns:
            (n, 4), what to add; 0 in stance and in the last column.
        """
        shift = np.clip(_features(command) @ self._weights, -MAX_SHIFT, MAX_SHIFT)
        shift[command[:, 3] > 0.5] = 0.0
        return np.concatenate([shift, np.zeros((len(shift), 1))], axis=1).astype(command.dtype)

    def add(self, command: np.ndarray, error: np.ndarray) -> None:
        """Add steady errors of the student; every `every` calls they change the shift.

        Args:
            command: (n, 4), commands of walking robots.
            error: (n, 3), command minus velocity in vx, vy (m/s) and yaw rate (rad/s).
        """
        weight = 1.0 / (1.0 + np.sum((command[:, :3] / SCALES) ** 2, axis=1, keepdims=True))
        shift = _features(command) @ self._weights
        bounded = np.clip(shift + np.clip(error, -MAX_ERROR, MAX_ERROR), -MAX_SHIFT, MAX_SHIFT) - shift
        for sign in (np.ones(3), MIRROR):
            phi = _features(command[:, :3] * sign)
            self._squares += phi.T @ (weight * phi)
            self._products += phi.T @ (weight * bounded * sign)
        self._calls += 1
        if self._calls == self.every:  # in all processes at the same time
            squares, products = (
                process_group.size() * process_group.mean(torch.from_numpy(sums)).numpy()
                for sums in (self._squares, self._products)
            )
            self._weights += GAIN * np.linalg.solve(squares + RIDGE * np.eye(FEATURES), products)
            self._start_over()

    def state(self) -> dict[str, Any]:
        """Return what a resumed run needs.

        Returns:
            Plain values, for `restore`.
        """
        return {"weights": self._weights.tolist()}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the shift; errors since its last change are forgotten.

        Args:
            state: what `state` returned.
        """
        self._weights = np.array(state["weights"])
        self._start_over()


class Drift:
    """Mean velocity errors of robots while they are steady at their present command.

    Attributes:
        seconds: (n,), time for which each was steady.
        integral: (n, 3), of its errors over that time, m, m, rad.
    """

    def __init__(self, n: int) -> None:
        """Begin.

        Args:
            n: number of robots.
        """
        self.seconds, self.integral = np.zeros(n), np.zeros((n, 3))

    def advance(self, error: np.ndarray, steady: np.ndarray, changed: np.ndarray) -> None:
        """Count a tick.

        Args:
            error: (n, 3), command minus velocity, m/s, m/s, rad/s.
            steady: (n,) bool, whether the tick counts.
            changed: (n,) bool, whether the command has changed, so that the robot begins again.
        """
        self.seconds += TICK_S * steady
        self.integral += TICK_S * steady[:, None] * error
        self.seconds[changed], self.integral[changed] = 0.0, 0.0

    @property
    def is_known(self) -> np.ndarray:
        """Whether each robot was steady for long enough, (n,) bool."""
        return np.asarray(self.seconds > SHORTEST_STEADY_S)

    def mean(self, robots: np.ndarray) -> np.ndarray:
        """Mean errors of some robots.

        Args:
            robots: (n,) bool, robots whose drift is known.

        Returns:
            (k, 3), m/s, m/s, rad/s.
        """
        return np.asarray(self.integral[robots] / self.seconds[robots, None])


def _features(command: np.ndarray) -> np.ndarray:
    """Features (n, FEATURES) of commands (n, 3 or more): 0 for a command of 0."""
    scaled = command[:, :3] / SCALES
    hats = [
        np.interp(command[:, axis], knots, (knots == knot).astype(float))
        for axis, knots in enumerate(KNOTS)
        for knot in knots[knots != 0.0]
    ]
    return np.stack([*hats, *(scaled[:, list(axes)].prod(axis=1) for axes in PRODUCTS)], axis=1)
