"""Measures how well a stretch of walking followed its command.

The functions take plain arrays, so that grid and demo share them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

SETTLING_TIME_S = 2.0  # at the start of each stretch, not evaluated
DECIMALS = 6  # of numbers in JSON files


@attrs.frozen(eq=False)
class Segment:
    """A constant command and the mean true velocity under it.

    Attributes:
        command: Commanded vx, vy (m/s) and wz (rad/s), body frame, (3,).
        mean: Mean true vx, vy (m/s) and wz (rad/s), body frame, (3,).
    """

    command: Array
    mean: Array

    @property
    def error_xy(self) -> float:
        """Length of commanded minus mean velocity, m/s."""
        return float(np.hypot(*(self.command - self.mean)[:2]))

    @property
    def error_wz(self) -> float:
        """Absolute difference of commanded and mean yaw rate, rad/s."""
        return float(abs(self.command[2] - self.mean[2]))

    def to_json(self) -> dict[str, Any]:
        """Convert the segment to its entry in `summary.json`.

        Returns:
            Command, mean velocity and errors.
        """
        return {
            "command": rounded(self.command),
            "mean": rounded(self.mean),
            "error_xy": rounded(self.error_xy),
            "error_wz": rounded(self.error_wz),
        }


def measure_segment(
    time: ArrayLike, velocity: ArrayLike, command: ArrayLike, start: float, end: float
) -> Segment:
    """Average the velocity over start <= time < end.

    Args:
        time: Times (n,), s, evenly spaced.
        velocity: True vx, vy (m/s) and wz (rad/s), body frame, (n, 3).
        command: Command of the segment, (3,), in the units and frame of `velocity`.
        start: Start of the interval, s.
        end: End of the interval, s.

    Returns:
        The segment.

    Raises:
        ValueError: The interval holds no sample.
    """
    time, velocity = np.asarray(time, float), np.asarray(velocity, float)
    within = (start <= time) & (time < end)
    if not within.any():
        raise ValueError(f"no velocity was measured between {start:.2f} and {end:.2f} s")
    return Segment(np.asarray(command, float), velocity[within].mean(axis=0))


def tracking_errors(segments: Sequence[Segment]) -> dict[str, float]:
    """Return the largest and mean tracking errors of at least one segment.

    Args:
        segments: The segments.

    Returns:
        max_error_xy, mean_error_xy (m/s), max_error_wz, mean_error_wz (rad/s).
    """
    errors = {"xy": [s.error_xy for s in segments], "wz": [s.error_wz for s in segments]}
    found = {f"max_error_{axis}": rounded(max(some)) for axis, some in errors.items()}
    return found | {f"mean_error_{axis}": rounded(np.mean(some)) for axis, some in errors.items()}


def response_delay(commanded: Array, velocity: Array, period: float) -> float | None:
    """Return the delay of a velocity behind its command.

    The delay is the area between both curves, each divided by its final value. Final values are
    means over the second half, so that a steady-state error does not count as delay.

    Args:
        commanded: Commanded velocity of one axis, (n,), m/s or rad/s.
        velocity: Measured velocity of that axis, (n,), in the same unit.
        period: Sampling period, s.

    Returns:
        Delay, s; None if the velocity reaches less than half of the command.
    """
    # A first-order lag y' = (u - y) / T behind a step u has the area int (u - y) dt / u = T. The same
    # integral gives the delay of a pure dead time. u and y are divided by their final values.
    late = len(commanded) // 2
    wanted, reached = float(commanded[late:].mean()), float(velocity[late:].mean())
    if reached / wanted < 0.5:
        return None
    return float(period * np.sum(commanded / wanted - velocity / reached))


def rounded(value: ArrayLike) -> Any:
    """Round values for a JSON file.

    Args:
        value: A number or an array.

    Returns:
        A number or nested lists, rounded to DECIMALS; None for values that are not finite.
    """
    digits = np.round(np.asarray(value, float), DECIMALS)
    return np.where(np.isfinite(digits), digits.astype(object), np.array(None, object)).tolist()
