"""When the states of a board held, told from its counter and from when they arrived.

The counter is even but counts in a unit that is not known: headers of the SDK for the AlienGo say microseconds up to 3.3
and milliseconds in 3.8.4. Arrival is on our clock, but late by what network and machine took. Together they tell both.
"""

from __future__ import annotations

from collections import deque

import attrs

UNITS = (1e-3, 1e-6)  # s a count
LOOK = 0.1  # s of states that the unit is told from
FACTOR = 10.0  # by which a board, or this machine, may be slower or faster than its unit says
WINDOW = 32  # states, the least delayed of which tells where the board's time is on ours
JUMP = 0.01  # s, later than any network is: the board itself stood still, as a simulated one does with its machine
RESTART = 0.1  # s without a newer state, after which one from before means that the board began to count anew
STEP = 1e-6  # s, the least between the instants of two states
_WRAP = 2**32


@attrs.frozen
class Instant:
    """When a state held: `time` on the clock of the arrivals, s; `tick` of the board, ms, wraps at 2^32."""

    time: float
    tick: int


class BoardClock:
    """Follows the counter of one board. Counted since the start: `repeated`, `late` and `restarts`.

    unit: s a count, None until it is known. rate: counts per second where they fit no unit, else None.
    """

    def __init__(self) -> None:
        self.repeated = self.late = self.restarts = 0
        self.unit: float | None = None
        self.rate: float | None = None
        self._count: int | None = None  # without wrapping
        self._first = 0, 0.0  # count and arrival from where the unit is told
        self._advanced = 0.0  # when the newest state arrived, s
        self._offsets: deque[float] = deque(maxlen=WINDOW)  # of arrivals from the board's time, s
        self._last = float("-inf")
        self._states = 0  # since the unit was found or the board began anew

    def follow(self, counter: int, arrival: float) -> Instant | None:
        """The instant of the state with this counter; None where it is not newer than the last, or the unit is not known yet.

        arrival: s, on any clock that does not go back.
        """
        if self._count is None:
            self._begin(counter, arrival)
            return None
        step = (counter - self._count + _WRAP // 2) % _WRAP - _WRAP // 2
        if step <= 0:
            self._not_newer(step, counter, arrival)
            return None
        self._count += step
        self._advanced = arrival
        if self.unit is None:
            self._find_unit(arrival)
            return None
        instant = self._instant(self.unit, arrival)
        self._states += 1
        return instant if self._states > WINDOW else None  # the first ones came later than is known yet

    def _begin(self, counter: int, arrival: float) -> None:
        """Follow from here."""
        self._count, self._first, self._advanced = counter, (counter, arrival), arrival
        self._offsets.clear()
        self._states = 0

    def _not_newer(self, step: int, counter: int, arrival: float) -> None:
        if step == 0:
            self.repeated += 1
        elif arrival - self._advanced > RESTART:
            self.restarts += 1
            self._begin(counter, arrival)
        else:
            self.late += 1

    def _find_unit(self, arrival: float) -> None:
        """Tell the unit from how fast the counter runs; where it fits none, look at the next stretch."""
        first_count, first_arrival = self._first
        assert self._count is not None
        if arrival - first_arrival < LOOK:
            return
        rate = (self._count - first_count) / (arrival - first_arrival)
        self.unit = next((unit for unit in UNITS if 1.0 / FACTOR < rate * unit < FACTOR), None)
        self.rate = None if self.unit else rate
        self._first = self._count, arrival

    def _instant(self, unit: float, arrival: float) -> Instant:
        assert self._count is not None
        time = unit * self._count
        offset = arrival - time
        if self._offsets and offset - min(self._offsets) > JUMP:
            self._offsets.clear()
        self._offsets.append(offset)
        self._last = max(time + min(self._offsets), self._last + STEP)
        return Instant(self._last, self._count * round(unit * 1e6) // 1000 % _WRAP)
