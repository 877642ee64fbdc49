"""Time of the board's states, estimated from the board's counter and the arrival times.

The counter is regular, but its unit is unknown: headers of the SDK for the AlienGo say microseconds
up to version 3.3 and milliseconds in 3.8.4. Arrival times are on the local clock, but include the
delays of network and machine. Both together give the unit and the time of each state.
"""

from __future__ import annotations

from collections import deque

import attrs

COUNTER_UNITS_S = (1e-3, 1e-6)  # possible units of the counter
UNIT_WINDOW_S = 0.1  # length of the record from which the unit is identified
MAX_RATE_RATIO = 10.0  # largest ratio of counter rate and nominal rate, either way
OFFSET_WINDOW = 32  # states; the one with the least delay gives the offset of the clocks
MAX_DELAY_JUMP_S = 0.01  # an arrival so much later than the fastest one means that a simulated board paused
RESTART_TIMEOUT_S = 0.1  # after so long without a newer state, an older counter means a restart
MIN_TIME_STEP_S = 1e-6  # least time between two states
_COUNTER_MODULUS = 2**32


@attrs.frozen
class BoardTime:
    """Time of a state.

    Attributes:
        time: Time on the clock of the arrivals, s.
        tick: Time of the board, ms, modulo 2^32.
    """

    time: float
    tick: int


class BoardClock:
    """Tracks the counter of one board.

    Attributes:
        repeated: Number of states with the counter of the state before.
        late: Number of states that arrived after a newer one.
        restarts: Number of restarts of the counter.
        unit: Unit of the counter, s; None until it is known.
        rate: Rate of the counter, counts/s, if it matches no known unit; else None.
    """

    def __init__(self) -> None:
        self.repeated = self.late = self.restarts = 0
        self.unit: float | None = None
        self.rate: float | None = None
        self._count: int | None = None  # of the newest state, unwrapped
        self._unit_reference = 0, 0.0  # count and arrival (s) at the begin of UNIT_WINDOW_S
        self._newest_arrival = 0.0  # s
        self._offsets: deque[float] = deque(maxlen=OFFSET_WINDOW)  # arrival minus board time, s
        self._last = float("-inf")
        self._states = 0  # since the unit is known, or since the board restarted

    def update(self, counter: int, arrival: float) -> BoardTime | None:
        """Process the counter of a received state.

        Args:
            counter: Counter of the board, modulo 2^32.
            arrival: Arrival time, s, on a monotonic clock.

        Returns:
            The time of the state; None if the state is not newer than the last one, or while the
            unit and the offset of the clocks are unknown.
        """
        if self._count is None:
            self._start_at(counter, arrival)
            return None
        step = (counter - self._count + _COUNTER_MODULUS // 2) % _COUNTER_MODULUS - _COUNTER_MODULUS // 2
        if step <= 0:
            self._count_stale(step, counter, arrival)
            return None
        self._count += step
        self._newest_arrival = arrival
        if self.unit is None:
            self._find_unit(arrival)
            return None
        instant = self._board_time(self.unit, arrival)
        self._states += 1
        return instant if self._states > OFFSET_WINDOW else None  # until the offset is known

    def _start_at(self, counter: int, arrival: float) -> None:
        """Start tracking at this state."""
        self._count, self._unit_reference, self._newest_arrival = counter, (counter, arrival), arrival
        self._offsets.clear()
        self._states = 0

    def _count_stale(self, step: int, counter: int, arrival: float) -> None:
        """Count a state that is repeated or late, or restart at it."""
        if step == 0:
            self.repeated += 1
        elif arrival - self._newest_arrival > RESTART_TIMEOUT_S:
            self.restarts += 1
            self._start_at(counter, arrival)
        else:
            self.late += 1

    def _find_unit(self, arrival: float) -> None:
        """Identify the unit from the rate of the counter; if none matches, start another window."""
        first_count, first_arrival = self._unit_reference
        assert self._count is not None
        if arrival - first_arrival < UNIT_WINDOW_S:
            return
        rate = (self._count - first_count) / (arrival - first_arrival)
        self.unit = next(
            (unit for unit in COUNTER_UNITS_S if 1.0 / MAX_RATE_RATIO < rate * unit < MAX_RATE_RATIO), None
        )
        self.rate = None if self.unit else rate
        self._unit_reference = self._count, arrival

    def _board_time(self, unit: float, arrival: float) -> BoardTime:
        """Convert the counter to local time: t = unit * count + min(arrival - unit * count) over OFFSET_WINDOW."""
        assert self._count is not None
        time = unit * self._count
        offset = arrival - time
        if self._offsets and offset - min(self._offsets) > MAX_DELAY_JUMP_S:
            self._offsets.clear()
        self._offsets.append(offset)
        self._last = max(time + min(self._offsets), self._last + MIN_TIME_STEP_S)
        return BoardTime(self._last, self._count * round(unit * 1e6) // 1000 % _COUNTER_MODULUS)
