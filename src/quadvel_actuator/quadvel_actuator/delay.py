"""A fractional delay of a signal that is constant over each step.

With a delay of (n + f) steps, 0 <= f < 1, the time average of the delayed signal over step k is
(1 - f) x[k - n] + f x[k - n - 1].
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_DELAY_S = 0.05  # s

_ROUND_OFF = 1e-9  # steps; a delay that is a multiple of the step but for rounding is one


class DelayLine:
    """A ring of the last samples of a signal of `shape` (..., C), read back with one delay per leading index.

    Each step takes one `push()`, whose slot the caller fills, and then any number of `read()`. `head` is the
    place of the newest sample; setting it back takes pushes back.
    """

    def __init__(self, shape: tuple[int, ...], dt: float):
        self.length = int(np.ceil(MAX_DELAY_S / dt)) + 2
        self._dt = dt
        self._ring = np.zeros((self.length, *shape))
        self._rows = self._ring.reshape(-1, shape[-1])
        self._row = np.arange(self._rows.shape[0] // self.length)
        self.head = 0
        self.delay: ArrayLike = 0.0

    @property
    def delay(self) -> NDArray[np.float64]:
        """The delay (s), (..., 1); set it with anything that broadcasts to this shape."""
        return self._delay.copy()

    @delay.setter
    def delay(self, seconds: ArrayLike) -> None:
        lead = self._ring.shape[1:-1]
        delay = np.broadcast_to(np.asarray(seconds, dtype=float), (*lead, 1)).copy()
        if not np.all((delay >= 0.0) & (delay <= MAX_DELAY_S)):
            raise ValueError(f"delay: found {delay.min()} to {delay.max()} s, expected 0 to {MAX_DELAY_S} s")
        steps = delay / self._dt
        whole = np.floor(steps + _ROUND_OFF)
        fraction = np.maximum(steps - whole, 0.0)
        fraction[fraction < _ROUND_OFF] = 0.0
        n = whole.astype(int)
        self._delay = delay
        self._common = int(n.flat[0]) if np.all(n == n.flat[0]) else None
        self._back = self._row - n.ravel() * self._row.size
        self._fraction = np.broadcast_to(fraction, self._ring.shape[1:]).copy() if fraction.any() else None

    def push(self) -> NDArray[np.float64]:
        """Begin a step: the slot (..., C) to write its sample into."""
        self.head = (self.head + 1) % self.length
        slot: NDArray[np.float64] = self._ring[self.head]
        return slot

    def hold(self, where: Any) -> None:
        """Make the newest sample the whole past of the leading indices `where`."""
        self._ring[:, where] = self._ring[self.head][where]

    def read(self) -> NDArray[np.float64]:
        """The delayed sample (..., C) of this step, a new array."""
        sample = self._back_by(0)
        if self._fraction is not None:
            older = self._back_by(1)
            older -= sample
            older *= self._fraction
            sample += older
        return sample

    def _back_by(self, extra: int) -> NDArray[np.float64]:
        sample: NDArray[np.float64]
        if self._common is not None:
            sample = self._ring[self.head - self._common - extra].copy()
        else:
            rows = self._back + (self.head - extra) * self._row.size
            sample = self._rows.take(rows, axis=0, mode="wrap").reshape(self._ring.shape[1:])
        return sample
