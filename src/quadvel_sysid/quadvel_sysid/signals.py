"""Logs as one set of rows, and their signals at the instant at which the drive asked for the torque of each row.

A torque that is measured at `t` was asked for at `u = t - output delay`, on the joint state of that instant and the
command that was sent an input delay earlier. The state is interpolated between its rows; the command, which is held
until the next one, is shifted exactly. A drive that computes in steps gives the mean over a step: `window` (s) is
that step, 0 for the instant itself. Rows are never resampled, so errors are those of the measured samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import cached_property, partial
from typing import Any, TypeVar

import attrs
import numpy as np
from numpy.typing import NDArray

from .log_signals import ALL_JOINTS, Joints, LogSignals, as_double
from .logs.log import Log

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Made = TypeVar("Made")

SETTLING_S = 0.03
"""Rows so soon (s) after a gap are not judged: what was commanded before is not known."""

_CACHE_LIMITS = 2, 64
"""sets of signals that are kept, at least and at most;"""
_MAX_CACHED_VALUES = 400_000
"""as many as have about so many values in each of their signals together"""

_ROW_FIELDS = ("log_of_row", "t", "tau", "start", "dt", "judged", "row", "early")

INSTANTS_PER_ROW = 2
"""Instants of a row, itself the last, for what has to be followed between the rows"""
_JOINT_FIELDS = ("q", "dq", "q_des", "dq_des", "tau_ff", "kp", "kd", "temperature")

_GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)
"""Its multiples' fractions fill the unit interval evenly, in no period."""


@attrs.frozen(eq=False)
class Signals:
    """What the drive saw at the instants `u`, (N, J) or (N, 1); the units of the log."""

    t: Array  # (N, 1) s since the log began
    dt: Array  # (N, 1) s since the row before
    start: Bools  # (N, 1), does a stretch begin here
    q: Array
    dq: Array
    q_des: Array
    dq_des: Array
    tau_ff: Array
    kp: Array
    kd: Array
    temperature: Array | None
    voltage: Array | None  # (N, 1)
    packet: NDArray[np.intp]  # (N, 1), the command row in force, counted over all logs
    age: Array  # (N, 1) s since that command acts, at least `dt` where commands are means over a drive's step
    row: NDArray[np.intp]  # (N, 1), which row of all logs this is
    sent: Array  # (M, J), q_des of every command row of all logs
    elsewhere: Callable[[str, Array], Array]
    slope: Callable[[str], Array]

    @cached_property
    def ddq(self) -> Array:
        """rad/s^2, over a few rows."""
        return self.slope("ddq")

    @cached_property
    def ddq_sharp(self) -> Array:
        """rad/s^2, over a few rows, and not smeared where a command comes in."""
        return self.slope("ddq_sharp")

    @cached_property
    def ddq_smooth(self) -> Array:
        """rad/s^2, over more rows, and not smeared where a command comes in."""
        return self.slope("ddq_smooth")

    @cached_property
    def stiffness_torque(self) -> Array:
        """kp times the error of position, N m."""
        return self.kp * (self.q_des - self.q)

    @cached_property
    def damping_torque(self) -> Array:
        """kd times the error of velocity, N m."""
        return self.kd * (self.dq_des - self.dq)

    def shifted(self, name: str, late: Array) -> Array:
        """A signal of the joints' state `late` s earlier (negative: later); `late` (J,) or (B, 1, J)."""
        return self.elsewhere(name, late)


def scattered_rows(count: int, every: int) -> NDArray[np.intp]:
    """One row of `every` of so many, at changing places: even steps and an even sender's commands would meet alike each time."""
    first = np.arange(0, count, every)
    rows: NDArray[np.intp] = first + (every * np.modf(_GOLDEN_RATIO * np.arange(len(first)))[0]).astype(
        np.intp
    )
    return rows[rows < count]


def _collapse_constant(values: Array) -> Array:
    """`values` (N, J), as a view of one row where all are the same: long logs have many such signals."""
    some = values[:: max(1, len(values) // 10)]  # these tell nearly always, and quickly
    same = (some == values[0]).all() and (values == values[0]).all()
    return np.broadcast_to(values[0].copy(), values.shape) if same else values


def _constant_signals(logs: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """The signals, of those of all `logs`, that are the same in every row, as that row."""
    rows = {name: values[0] for name, values in logs[0].items()}
    return {
        name: row.copy()
        for name, row in rows.items()
        if all(
            name in one and _collapse_constant(one[name]).strides[0] == 0 and (one[name][0] == row).all()
            for one in logs
        )
    }


class Samples:
    """The rows of all `logs`, one after the other: measured torque, who judges what, and the signals behind it.

    Where not every log holds its gains these count as 1, so that what is fitted is the gain itself; so does a kd that is 0 in
    all of them (`undamped`), whose deviation is the drive's own damping, in units of 1 N m s/rad. q and dq are lines through
    the rows at most `steady` s off. `judged` (N, J) are the rows that a model has to explain.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        steady: float = 0.0,
    ) -> None:
        self.undamped = all(log.kd is not None and not log.kd.any() for log in logs)
        known = {name for name in ("kp", "kd") if all(getattr(log, name) is not None for log in logs)}
        self.commanded = "kp" in known
        """are the gains that were commanded known?"""
        known -= {"kd"} if self.undamped else set()
        self.logs = [LogSignals(log, steady, known) for log in logs]
        self.joints = logs[0].joints
        lengths = [len(log.t) for log in logs]
        self.log_of_row = np.repeat(np.arange(len(logs)), lengths)
        self.t = np.concatenate([as_double(log.t) for log in logs])
        self.period = float(np.median(np.concatenate([np.diff(log.t) for log in logs])))
        self.tau = np.concatenate([as_double(log.q * 0.0 if log.tau is None else log.tau) for log in logs])
        starts, steps, settled = zip(*(self._stretches(log) for log in logs), strict=True)
        self.start: Bools = np.concatenate(starts)
        self.dt = np.concatenate(steps)
        self.judged: Bools = np.concatenate([log.valid for log in logs]) & np.concatenate(settled)[:, None]
        self.sent = np.concatenate([one.commands["q_des"] for one in self.logs])
        self.row = np.arange(len(self.t))
        self.early = np.zeros(len(self.t))  # s, how much before the row of the log
        self._finer: Samples | None = None
        self._held: dict[bytes, Samples] = {}
        self._first_packet = np.cumsum([0, *(len(log.t_cmd) for log in logs)])
        self._first_row = np.cumsum([0, *lengths])
        self._constant = _constant_signals([one.signals for one in self.logs])
        self._cache: dict[tuple[Any, ...], Signals] = {}
        self._states: dict[tuple[Any, ...], dict[str, Array]] = {}

    def _stretches(self, log: Log) -> tuple[Bools, Array, Bools]:
        """Of each row: does a stretch begin there, the spacing to the row before, is the past known."""
        start = log.after_gap
        start[0] = True
        steps = np.where(start, log.period, np.diff(log.t, prepend=log.t[0]))
        began = np.maximum.accumulate(np.where(start, log.t, -np.inf))
        known = (log.t - began >= SETTLING_S) & (log.t - SETTLING_S >= log.t_cmd[0])
        return np.asarray(start), np.asarray(steps, dtype=float), np.asarray(known)

    def drop_heldout(self, rows: Bools) -> Samples:
        """These samples without the logs at the end that hold none of `rows` (N, J)."""
        count = int(self.log_of_row[np.flatnonzero(rows.any(axis=1))[-1]]) + 1 if rows.any() else 1
        if count == len(self.logs):
            return self
        part = self.taken(np.flatnonzero(self.log_of_row < count))
        part.logs, part.sent = self.logs[:count], self.sent[: self._first_packet[count]]
        return part

    def thinned(self, step: int) -> tuple[Samples, NDArray[np.intp]]:
        """One row of `step`, and which these are; what happens to the signals between them is known as before."""
        rows = np.arange(step - 1, len(self.t), step)
        part = self.taken(rows)
        stretch = np.cumsum(self.start)[rows]
        part.start = np.diff(stretch, prepend=-1) > 0
        part.period = step * self.period
        part.dt = np.where(part.start, part.period, np.diff(part.t, prepend=part.t[0] - part.period))
        return part, rows

    @property
    def upsampled(self) -> Samples:
        """These rows, each with BETWEEN - 1 instants before it, evenly over the time since the row before."""
        if self._finer is None:
            part = self.taken(np.repeat(np.arange(len(self.t)), INSTANTS_PER_ROW))
            before = np.tile(np.arange(INSTANTS_PER_ROW)[::-1], len(self.t)) / INSTANTS_PER_ROW
            part.early = np.where(part.start, 0.0, before * part.dt)
            part.dt = part.dt / INSTANTS_PER_ROW
            part.start = part.start & (np.arange(len(part.t)) % INSTANTS_PER_ROW == 0)
            self._finer = part
        return self._finer

    def select_rows(self, rows: Bools) -> Samples:
        """The rows (N,) that are true, alone; made but once, as fits come by again and again."""
        key = rows.tobytes()
        if key not in self._held:
            self._held[key] = self.taken(np.flatnonzero(rows))
        return self._held[key]

    def taken(self, rows: NDArray[np.intp]) -> Samples:
        """These rows alone; `dt` and `start` are those they had."""
        part = copy(self)
        for name in _ROW_FIELDS:
            setattr(part, name, getattr(self, name)[rows])
        part._cache, part._states, part._finer, part._held = {}, {}, None, {}
        return part

    def at(self, input_delay: Array | float, output_delay: Array | float, window: float) -> Signals:
        """The signals (N, J) with delays (s) of all joints, or of each, (J,)."""
        delays = np.broadcast_arrays(np.atleast_1d(input_delay), np.atleast_1d(output_delay))
        early, late = np.round(delays, 7).tolist()
        pairs = list(zip(early, late, strict=True))
        shared = len(set(pairs)) == 1
        key = (window, pairs[0]) if shared else (window, *pairs)
        return self._cached(
            self._cache,
            key,
            lambda: self._make_signals(*pairs[0], window) if shared else self._mix_delays(pairs, window),
        )

    def at_joint(self, input_delay: Array, output_delay: Array, window: float) -> Signals:
        """The signals (N, J) of now, for what acts on the joint itself; commands move it with delays (s) of each, (J,)."""
        delays = np.broadcast_to(input_delay + output_delay, self.tau.shape[1:])
        slope = partial(self._slope, 0.0, delays - 0.5 * window, ALL_JOINTS)
        key = ("joint", window, *np.round(delays, 7).tolist())
        return self._cached(self._cache, key, lambda: attrs.evolve(self.at(0.0, 0.0, window), slope=slope))

    def _cached(
        self, cache: dict[tuple[Any, ...], Made], key: tuple[Any, ...], make: Callable[[], Made]
    ) -> Made:
        """What `make` gives, made but once while few others are asked for."""
        if key not in cache:
            made = make()
            if len(cache) >= max(
                _CACHE_LIMITS[0], min(_CACHE_LIMITS[1], _MAX_CACHED_VALUES // self.tau.size)
            ):
                cache.pop(next(iter(cache)))
            cache[key] = made
        return cache[key]

    def _mix_delays(self, pairs: Sequence[tuple[float, float]], window: float) -> Signals:
        """Each joint's columns at its own delays; times and packets are those of the first one."""
        every = {pair: [j for j, one in enumerate(pairs) if one == pair] for pair in dict.fromkeys(pairs)}
        delays = np.array(pairs).sum(axis=1) - 0.5 * window
        made = {pair: self._make_signals(*pair, window, joints, delays) for pair, joints in every.items()}
        first = made[pairs[0]]
        columns: dict[str, Any] = {}
        for name in _JOINT_FIELDS:
            if getattr(first, name) is not None:
                columns[name] = np.empty(self.tau.shape)
                for pair, joints in every.items():
                    columns[name][:, joints] = getattr(made[pair], name)
                columns[name] = _collapse_constant(columns[name])
        late = np.array([pair[1] for pair in pairs])

        def slope(name: str) -> Array:
            values = np.empty(self.tau.shape)
            for pair, joints in every.items():
                values[:, joints] = getattr(made[pair], name)
            return values

        return attrs.evolve(first, **columns, elsewhere=partial(self._shifted_state, late), slope=slope)

    def _request_times(self, output_delay: float) -> Iterator[Array]:
        """Of each log the instants at which the torque of these rows was asked for."""
        edges = np.searchsorted(self.log_of_row, np.arange(len(self.logs) + 1))
        for one, first, a, b in zip(self.logs, self._first_row, edges[:-1], edges[1:], strict=False):
            yield one.t[self.row[a:b] - first] - self.early[a:b] - output_delay

    def _shifted_state(self, output_delay: Array | float, name: str, late: Array) -> Array:
        """A state signal (..., N, J) of all rows, `late` s before the instants at this output delay."""
        before = np.squeeze(late, -2) if np.ndim(late) > 1 else late
        before = np.broadcast_to(
            before + output_delay, np.broadcast_shapes(np.shape(before), self.tau.shape[1:])
        )
        parts = [
            one.state_shifted(name, at, before)
            for one, at in zip(self.logs, self._request_times(0.0), strict=True)
        ]
        return np.concatenate(parts, axis=-2)

    def _make_signals(
        self,
        input_delay: float,
        output_delay: float,
        window: float,
        joints: list[int] | None = None,
        delays: Array | None = None,
    ) -> Signals:
        """The signals of `joints`, or of all, at one pair of delays; `delays` (J,) after which commands move the joints."""
        chosen = ALL_JOINTS if joints is None else joints
        constant = self._constant
        parts: dict[str, list[Array]] = {}
        packets, ages = [], []
        if delays is None:
            delays = np.full(self.tau.shape[1], input_delay + output_delay - 0.5 * window)
        for one, at, first in zip(
            self.logs, self._request_times(output_delay), self._first_packet, strict=False
        ):
            sent = at - input_delay
            row = one.command_rows(sent)
            for name in one.commands.keys() - constant:
                parts.setdefault(name, []).append(one.command_at(name, sent, window, chosen, row))
            for name in one.gains.keys() - constant:
                parts.setdefault(name, []).append(one.gains[name][:, chosen][row])
            packets.append((row + first)[:, None])
            ages.append((sent - one.t_cmd[row] + (1.0 if window else 0.0))[:, None])
        signals = {name: _collapse_constant(np.concatenate(part)) for name, part in parts.items()}
        signals |= self._state(output_delay, joints)
        for name, value in constant.items():
            value = value if value.size == 1 else value[chosen]
            signals[name] = np.broadcast_to(value, (len(self.t), value.size))
        for name in ("temperature", "voltage"):
            if name not in signals or len(signals[name]) < len(self.t):
                signals[name] = None  # type: ignore[assignment]  # not in every log
        return Signals(
            dt=self.dt[:, None],
            start=self.start[:, None],
            packet=np.concatenate(packets),
            age=np.maximum(np.concatenate(ages), 0.0),
            row=self.row[:, None],
            sent=self.sent,
            elsewhere=partial(self._shifted_state, output_delay),
            slope=partial(self._slope, output_delay, delays, chosen),
            **signals,
        )

    def _state(self, output_delay: float, joints: list[int] | None) -> dict[str, Array]:
        """The part of the signals that goes with the output delay alone, by name."""

        def make() -> dict[str, Array]:
            parts: dict[str, list[Array]] = {}
            for one, at in zip(self.logs, self._request_times(output_delay), strict=False):
                found = one.locate(at)
                for name in one.states.keys() - self._constant:
                    parts.setdefault(name, []).append(
                        one.state_at(name, at, ALL_JOINTS if joints is None else joints, found)
                    )
                parts.setdefault("t", []).append((at - one.origin)[:, None])
            return {name: _collapse_constant(np.concatenate(part)) for name, part in parts.items()}

        key = (output_delay, *(joints or ()))
        return self._cached(self._states, key, make)

    def _slope(self, output_delay: float, delays: Array, joints: Joints, name: str) -> Array:
        """One of the accelerations (N, J) at this output delay, where commands move the joints after `delays` (J,)."""
        parts = [
            one.acceleration_at(name, at, delays, joints)
            for one, at in zip(self.logs, self._request_times(output_delay), strict=False)
        ]
        return np.concatenate(parts)
