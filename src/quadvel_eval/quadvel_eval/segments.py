"""How well a stretch of walking followed its command: means and errors, for the grid and for the demo alike.

Plain arrays; where they come from is the caller's matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SETTLE = 2.0  # s at the start of each stretch that belong to the change of command and are not evaluated
DIGITS = 6  # of numbers in files


@attrs.frozen(eq=False)
class Segment:
    """A constant command and the mean true velocity under it: vx, vy (m/s), wz (rad/s), body frame, (3,)."""

    command: Array
    mean: Array

    @property
    def error_xy(self) -> float:
        """Length of commanded minus mean velocity, m/s."""
        return float(np.hypot(*(self.command - self.mean)[:2]))

    @property
    def error_wz(self) -> float:
        """Absolute commanded minus mean yaw rate, rad/s."""
        return float(abs(self.command[2] - self.mean[2]))

    def to_json(self) -> dict[str, Any]:
        """The entry of `summary.json`."""
        return {
            "command": rounded(self.command),
            "mean": rounded(self.mean),
            "error_xy": rounded(self.error_xy),
            "error_wz": rounded(self.error_wz),
        }


def measure(time: ArrayLike, velocity: ArrayLike, command: ArrayLike, start: float, end: float) -> Segment:
    """The segment with the samples of `start` <= time < `end`.

    time (n,): s, evenly spaced. velocity (n, 3): vx, vy, wz, true, body frame. ValueError where none falls
    into the stretch.
    """
    time, velocity = np.asarray(time, float), np.asarray(velocity, float)
    within = (start <= time) & (time < end)
    if not within.any():
        raise ValueError(f"no velocity was measured between {start:.2f} and {end:.2f} s")
    return Segment(np.asarray(command, float), velocity[within].mean(axis=0))


def tracking_errors(segments: Sequence[Segment]) -> dict[str, float]:
    """Largest and mean errors of at least one segment: xy in m/s, wz in rad/s."""
    errors = {"xy": [s.error_xy for s in segments], "wz": [s.error_wz for s in segments]}
    found = {f"max_error_{axis}": rounded(max(some)) for axis, some in errors.items()}
    return found | {f"mean_error_{axis}": rounded(np.mean(some)) for axis, some in errors.items()}


def response_delay(asked: Array, velocity: Array, period: float) -> float | None:
    """By how much a velocity (n,) comes after what was asked for (n,), s: the area between both, each as a share of its end.

    Ends are means over the second half of the stretch, so that a steady error is no delay. Samples are `period` (s) apart.
    None where the velocity does not get half as far as it should: that is no delay either.
    """
    late = len(asked) // 2
    wanted, reached = float(asked[late:].mean()), float(velocity[late:].mean())
    if reached / wanted < 0.5:
        return None
    return float(period * np.sum(asked / wanted - velocity / reached))


def rounded(value: ArrayLike) -> Any:
    """`value` as JSON keeps it: a number or nested lists of numbers, with as many digits as make sense; None for NaN."""
    digits = np.round(np.asarray(value, float), DIGITS)
    return np.where(np.isfinite(digits), digits.astype(object), np.array(None, object)).tolist()
