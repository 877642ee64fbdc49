"""Rows of several logs, with the signals that the drive acted on when it produced each row's torque.

A torque measured at t was requested at u = t - output delay, from the joint state at u and from
the command sent at u - input delay. States are interpolated between their rows. Commands are held
until the next one, so they are shifted exactly. A drive with a computation step returns the mean
over a step: `window` (s) is that step, 0 for the value at u. Rows are never resampled, so errors
are those of the measured samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import cached_property, partial
from typing import Any, TypeVar

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

from ..logs.log import Log
from .log_signals import ALL_JOINTS, Joints, LogSignals, as_double

Made = TypeVar("Made")

SETTLING_S = 0.03
"""s; rows this soon after a gap are not evaluated, since the commands before are not known."""

_CACHE_LIMITS = 2, 64
"""Sets of signals that are cached, at least and at most."""
_MAX_CACHED_VALUES = 400_000
"""Values of one signal in all cached sets together, about."""

_ROW_FIELDS = ("log_of_row", "t", "tau", "start", "dt", "evaluated", "row", "lead")

INSTANTS_PER_ROW = 2
"""Instants of a row, itself the last, for effects that are integrated between the rows."""
_JOINT_FIELDS = ("q", "dq", "q_des", "dq_des", "tau_ff", "kp", "kd", "temperature")

_GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)
"""The fractional parts of its multiples fill the unit interval evenly and without a period."""


@attrs.frozen(eq=False)
class Signals:
    """What the drive acted on at the instants u of N rows, each (N, J) or (N, 1); units of the log.

    Attributes:
        t: (N, 1) time since the recording began, s.
        dt: (N, 1) time since the row before, s.
        start: (N, 1) whether a stretch begins at this row.
        q: Angle, rad.
        dq: Speed, rad/s.
        q_des: Commanded angle, rad.
        dq_des: Commanded speed, rad/s.
        tau_ff: Feed-forward torque, N m.
        kp: Position gain, N m/rad, or 1 if not known.
        kd: Speed gain, N m s/rad, or 1 if not known.
        temperature: Temperature, degrees Celsius, or None.
        voltage: (N, 1) supply voltage, V, or None.
        packet: (N, 1) index of the command row in force, counted over all logs.
        age: (N, 1) time since that command acts, s; at least `dt` if commands are means over a
            step.
        row: (N, 1) index of the row, counted over all logs.
        sent: (M, J) q_des of every command row of all logs, rad.
        read_shifted: Function of a signal's name and a delay (s) that reads the signal at another
            time.
        slope: Function of an acceleration's name that computes it.
    """

    t: Array
    dt: Array
    start: Bools
    q: Array
    dq: Array
    q_des: Array
    dq_des: Array
    tau_ff: Array
    kp: Array
    kd: Array
    temperature: Array | None
    voltage: Array | None
    packet: Indices
    age: Array
    row: Indices
    sent: Array
    read_shifted: Callable[[str, Array], Array]
    slope: Callable[[str], Array]

    @cached_property
    def ddq(self) -> Array:
        """Acceleration, rad/s^2, over a few rows."""
        return self.slope("ddq")

    @cached_property
    def ddq_sharp(self) -> Array:
        """Acceleration, rad/s^2, over a few rows, not blurred where a command arrives."""
        return self.slope("ddq_sharp")

    @cached_property
    def ddq_smooth(self) -> Array:
        """Acceleration, rad/s^2, over more rows, not blurred where a command arrives."""
        return self.slope("ddq_smooth")

    @cached_property
    def stiffness_torque(self) -> Array:
        """Torque of the position error, kp (q_des - q), N m."""
        return self.kp * (self.q_des - self.q)

    @cached_property
    def damping_torque(self) -> Array:
        """Torque of the speed error, kd (dq_des - dq), N m."""
        return self.kd * (self.dq_des - self.dq)

    def shifted(self, name: str, late: Array) -> Array:
        """Read a state signal at another time.

        Args:
            name: Name of the signal.
            late: Delay, s, (J,) or (B, 1, J); negative for later times.

        Returns:
            (N, J) or (B, N, J) values.
        """
        return self.read_shifted(name, late)


def scattered_rows(count: int, every: int) -> Indices:
    """Select one of every few rows at irregular places.

    At regular places, commands of an even sender would have the same age in each selected row.

    Args:
        count: Number of rows.
        every: Mean spacing, rows.

    Returns:
        Row indices, increasing.
    """
    first = np.arange(0, count, every)
    rows: Indices = first + (every * np.modf(_GOLDEN_RATIO * np.arange(len(first)))[0]).astype(np.intp)
    return rows[rows < count]


def _collapse_constant(values: Array) -> Array:
    """A view of one row if all rows of `values` (N, J) are equal, to save memory; else `values`."""
    some = values[:: max(1, len(values) // 10)]  # a quick test that nearly always decides
    same = (some == values[0]).all() and (values == values[0]).all()
    return np.broadcast_to(values[0].copy(), values.shape) if same else values


def _constant_signals(logs: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """The signals that are equal in every row of all `logs`, as that row."""
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
    """Rows of all logs one after the other: N rows of J joints, with their torque and signals.

    If kp or kd is not known in every log, it counts as 1, so that the fit yields the gain itself.
    The same holds for a kd that is 0 in all logs (`undamped`): its deviation is the drive's own
    damping, in units of 1 N m s/rad.

    Attributes:
        logs: Signals of each log.
        joints: Names of the joints.
        commanded: Whether the commanded gains are known.
        undamped: Whether the commanded kd is 0 throughout.
        log_of_row: (N,) index of each row's log.
        t: (N,) times, s.
        period: Median spacing of the rows, s.
        tau: (N, J) measured torque, N m; 0 if not logged.
        start: (N,) whether a stretch begins at this row.
        dt: (N,) time since the row before, s.
        evaluated: (N, J) rows that a model has to explain.
        sent: (M, J) q_des of every command row, rad.
        row: (N,) index of each row in all logs.
        lead: (N,) time by which an instant precedes its row, s.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        steady: float = 0.0,
    ) -> None:
        """Concatenate the rows of logs.

        Args:
            logs: Logs with the same joints.
            steady: Half width of the lines that smooth q and dq, s; 0 for none.
        """
        self.undamped = all(log.kd is not None and not log.kd.any() for log in logs)
        known = {name for name in ("kp", "kd") if all(getattr(log, name) is not None for log in logs)}
        self.commanded = "kp" in known
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
        self.evaluated: Bools = np.concatenate([log.valid for log in logs]) & np.concatenate(settled)[:, None]
        self.sent = np.concatenate([one.commands["q_des"] for one in self.logs])
        self.row = np.arange(len(self.t))
        self.lead = np.zeros(len(self.t))
        self._upsampled: Samples | None = None
        self._selections: dict[bytes, Samples] = {}
        self._first_packet = np.cumsum([0, *(len(log.t_cmd) for log in logs)])
        self._first_row = np.cumsum([0, *lengths])
        self._constant = _constant_signals([one.signals for one in self.logs])
        self._cache: dict[tuple[Any, ...], Signals] = {}
        self._states: dict[tuple[Any, ...], dict[str, Array]] = {}

    def _stretches(self, log: Log) -> tuple[Bools, Array, Bools]:
        """For each row: whether a stretch begins, the spacing before, whether the past is known."""
        # The past of a row is known if SETTLING_S have passed since the last gap and since the first
        # command.
        start = log.after_gap
        start[0] = True
        steps = np.where(start, log.period, np.diff(log.t, prepend=log.t[0]))
        began = np.maximum.accumulate(np.where(start, log.t, -np.inf))
        known = (log.t - began >= SETTLING_S) & (log.t - SETTLING_S >= log.t_cmd[0])
        return np.asarray(start), np.asarray(steps, dtype=float), np.asarray(known)

    def drop_heldout(self, rows: Bools) -> Samples:
        """Drop the logs at the end that hold none of the given rows.

        Args:
            rows: (N, J) rows that are needed.

        Returns:
            The remaining samples.
        """
        count = int(self.log_of_row[np.flatnonzero(rows.any(axis=1))[-1]]) + 1 if rows.any() else 1
        if count == len(self.logs):
            return self
        part = self.take_rows(np.flatnonzero(self.log_of_row < count))
        part.logs, part.sent = self.logs[:count], self.sent[: self._first_packet[count]]
        return part

    def thinned(self, step: int) -> tuple[Samples, Indices]:
        """Keep one of every few rows; the signals between them stay known.

        Args:
            step: Spacing, rows.

        Returns:
            The samples, and the indices of their rows.
        """
        rows = np.arange(step - 1, len(self.t), step)
        part = self.take_rows(rows)
        stretch = np.cumsum(self.start)[rows]
        part.start = np.diff(stretch, prepend=-1) > 0
        part.period = step * self.period
        part.dt = np.where(part.start, part.period, np.diff(part.t, prepend=part.t[0] - part.period))
        return part, rows

    @property
    def upsampled(self) -> Samples:
        """The samples with `INSTANTS_PER_ROW` evenly spaced instants for each row."""
        if self._upsampled is None:
            part = self.take_rows(np.repeat(np.arange(len(self.t)), INSTANTS_PER_ROW))
            before = np.tile(np.arange(INSTANTS_PER_ROW)[::-1], len(self.t)) / INSTANTS_PER_ROW
            part.lead = np.where(part.start, 0.0, before * part.dt)
            part.dt = part.dt / INSTANTS_PER_ROW
            part.start = part.start & (np.arange(len(part.t)) % INSTANTS_PER_ROW == 0)
            self._upsampled = part
        return self._upsampled

    def select_rows(self, rows: Bools) -> Samples:
        """Keep the rows that a mask marks; the result is cached, since fits reuse the same masks.

        Args:
            rows: (N,) mask.

        Returns:
            The samples of these rows.
        """
        key = rows.tobytes()
        if key not in self._selections:
            self._selections[key] = self.take_rows(np.flatnonzero(rows))
        return self._selections[key]

    def take_rows(self, rows: Indices) -> Samples:
        """Keep rows by their indices, with their `dt` and `start`.

        Args:
            rows: Row indices.

        Returns:
            The samples of these rows.
        """
        part = copy(self)
        for name in _ROW_FIELDS:
            setattr(part, name, getattr(self, name)[rows])
        part._cache, part._states, part._upsampled, part._selections = {}, {}, None, {}
        return part

    def at(self, input_delay: Array | float, output_delay: Array | float, window: float) -> Signals:
        """Compute the signals at given delays.

        Args:
            input_delay: Delay from a command to the drive, s, one or one for each joint (J,).
            output_delay: Delay from the drive to the measured torque, s, one or (J,).
            window: Step of the drive, s, or 0.

        Returns:
            The signals of all rows.
        """
        delays = np.broadcast_arrays(np.atleast_1d(input_delay), np.atleast_1d(output_delay))
        inputs, outputs = np.round(delays, 7).tolist()
        pairs = list(zip(inputs, outputs, strict=True))
        shared = len(set(pairs)) == 1
        key = (window, pairs[0]) if shared else (window, *pairs)
        return self._cached(
            self._cache,
            key,
            lambda: self._make_signals(*pairs[0], window) if shared else self._mix_delays(pairs, window),
        )

    def at_joint(self, input_delay: Array, output_delay: Array, window: float) -> Signals:
        """Compute the undelayed signals, for effects that act on the joint itself.

        Args:
            input_delay: (J,) delay from a command to the drive, s.
            output_delay: (J,) delay from the drive to the torque, s.
            window: Step of the drive, s, or 0.

        Returns:
            The signals of all rows; only accelerations use the delays, as commands move a joint
            after them.
        """
        delays = np.broadcast_to(input_delay + output_delay, self.tau.shape[1:])
        slope = partial(self._slope, 0.0, delays - 0.5 * window, ALL_JOINTS)
        key = ("joint", window, *np.round(delays, 7).tolist())
        return self._cached(self._cache, key, lambda: attrs.evolve(self.at(0.0, 0.0, window), slope=slope))

    def _cached(
        self, cache: dict[tuple[Any, ...], Made], key: tuple[Any, ...], make: Callable[[], Made]
    ) -> Made:
        """Return the cached value of `key`, or compute and cache it."""
        if key not in cache:
            made = make()
            if len(cache) >= max(
                _CACHE_LIMITS[0], min(_CACHE_LIMITS[1], _MAX_CACHED_VALUES // self.tau.size)
            ):
                cache.pop(next(iter(cache)))
            cache[key] = made
        return cache[key]

    def _mix_delays(self, pairs: Sequence[tuple[float, float]], window: float) -> Signals:
        """Signals with each joint at its own delays; times and command rows are the first joint's."""
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

        return attrs.evolve(first, **columns, read_shifted=partial(self._shifted_state, late), slope=slope)

    def _request_times(self, output_delay: float) -> Iterator[Array]:
        """Yield for each log the instants at which the torque of its rows was requested."""
        edges = np.searchsorted(self.log_of_row, np.arange(len(self.logs) + 1))
        for one, first, a, b in zip(self.logs, self._first_row, edges[:-1], edges[1:], strict=False):
            yield one.t[self.row[a:b] - first] - self.lead[a:b] - output_delay

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
        """Signals of some joints at one pair of delays; `delays` (J,) are those of accelerations."""
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
            read_shifted=partial(self._shifted_state, output_delay),
            slope=partial(self._slope, output_delay, delays, chosen),
            **signals,
        )

    def _state(self, output_delay: float, joints: list[int] | None) -> dict[str, Array]:
        """The signals that depend on the output delay alone, by name."""

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
        """An acceleration (N, J) at this output delay; commands move the joints after `delays` (J,)."""
        parts = [
            one.acceleration_at(name, at, delays, joints)
            for one, at in zip(self.logs, self._request_times(output_delay), strict=False)
        ]
        return np.concatenate(parts)
