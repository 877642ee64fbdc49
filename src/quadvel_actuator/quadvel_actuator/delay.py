"""Fractional delay line for signals that are constant over each step of the model.

For a delay of (n + f) steps, 0 <= f < 1, the time average of the delayed signal over step k is
(1 - f) x[k - n] + f x[k - n - 1]. `model` and `running` delay commands and torques with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

MAX_DELAY_S = 0.05
"""Longest delay that a line holds, s."""

_ROUNDING_STEPS = 1e-9  # steps; a delay this close to a multiple of the step counts as one


class DelayLine:
    """Ring buffer of the last samples of a signal, read back with one delay per leading index.

    In each step, call `push()` once, fill the slot that it returns, then call `read()` any number
    of times. Leading axes are environments: a signal of shape (N, J) has N delays.

    Attributes:
        length: number of samples in the ring: the steps of `MAX_DELAY_S`, plus 2 for the fraction
            and for the newest sample.
        head: index of the newest sample. Setting it back undoes pushes.
    """

    def __init__(self, shape: tuple[int, ...], dt: float):
        """Create a line of zeros.

        Args:
            shape: (..., C), shape of one sample.
            dt: s, duration of a step.
        """
        self.length = int(np.ceil(MAX_DELAY_S / dt)) + 2
        self._dt = dt
        self._ring = np.zeros((self.length, *shape))
        self._rows = self._ring.reshape(-1, shape[-1])
        self._row = np.arange(self._rows.shape[0] // self.length)
        self.head = 0
        self.delay: ArrayLike = 0.0

    @property
    def delay(self) -> Array:
        """Delay in s, (..., 1), as a copy; assign anything that broadcasts to this shape."""
        return self._delay.copy()

    @delay.setter
    def delay(self, seconds: ArrayLike) -> None:
        """Set the delay and precompute the read positions.

        Args:
            seconds: s, broadcast to (..., 1).

        Raises:
            ValueError: a delay is negative or above `MAX_DELAY_S`.
        """
        lead = self._ring.shape[1:-1]
        delay = np.broadcast_to(np.asarray(seconds, dtype=float), (*lead, 1)).copy()
        if not np.all((delay >= 0.0) & (delay <= MAX_DELAY_S)):
            raise ValueError(f"delay: found {delay.min()} to {delay.max()} s, expected 0 to {MAX_DELAY_S} s")
        # delay / dt = n + f with an integer n and 0 <= f < 1
        steps = delay / self._dt
        whole = np.floor(steps + _ROUNDING_STEPS)
        fraction = np.maximum(steps - whole, 0.0)
        fraction[fraction < _ROUNDING_STEPS] = 0.0
        n = whole.astype(int)
        self._delay = delay
        # With one n for all indices a read is one slice of the ring; otherwise it gathers rows of
        # the flattened ring.
        self._common = int(n.flat[0]) if np.all(n == n.flat[0]) else None
        self._back = self._row - n.ravel() * self._row.size
        self._fraction = np.broadcast_to(fraction, self._ring.shape[1:]).copy() if fraction.any() else None

    def push(self) -> Array:
        """Begin a step.

        Returns:
            The slot (..., C) to write the sample of this step into, a view of the ring.
        """
        self.head = (self.head + 1) % self.length
        slot: Array = self._ring[self.head]
        return slot

    def fill_history(self, where: Any) -> None:
        """Overwrite the whole past with the newest sample.

        Args:
            where: index of the leading axes whose past is overwritten, or `...` for all.
        """
        self._ring[:, where] = self._ring[self.head][where]

    def read(self) -> Array:
        """Interpolate the delayed sample of this step.

        Returns:
            (..., C), a new array, in the unit of the samples.
        """
        # y[k] = (1 - f) x[k - n] + f x[k - n - 1] = x[k - n] + f (x[k - n - 1] - x[k - n])
        sample = self._sample_back(0)
        if self._fraction is not None:
            older = self._sample_back(1)
            older -= sample
            older *= self._fraction
            sample += older
        return sample

    def _sample_back(self, extra: int) -> Array:
        """Return the sample `extra` steps before the whole number n of delayed steps."""
        sample: Array
        if self._common is not None:
            sample = self._ring[self.head - self._common - extra].copy()
        else:
            rows = self._back + (self.head - extra) * self._row.size
            sample = self._rows.take(rows, axis=0, mode="wrap").reshape(self._ring.shape[1:])
        return sample
