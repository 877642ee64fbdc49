"""Rows of several logs, with the signals that the drive acted on when it produced each row's torque.

A torque measured at t was requested at u = t - output delay, from the joint state at u and from
the command sent at u - input delay. States are interpolated between their rows. Commands are held
until the next one, so they are shifted exactly. A drive with a computation step returns the mean
over a step: `window` (s) is that step, 0 for the value at u. Rows are never resampled, so errors
are those of the measured samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, TypeVar

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

from ..logs.log import Log
from ..options import SEARCH_DEFAULTS, SearchOptions
from .differences import difference_variance
from .log_signals import ALL_JOINTS, Joints, LogSignals, as_double

Made = TypeVar("Made")

SETTLING_S = 0.03
"""s; rows this soon after a gap are not evaluated, since the commands before are not known."""

_CACHE_LIMITS = 2, 64
"""Sets of signals that are cached, at least and at most."""
_MAX_CACHED_VALUES = 400_000
"""Values of one signal in all cached sets together, about."""

_ROW_FIELDS = ("log_of_row", "t", "tau", "start", "dt", "evaluated", "row", "lead")
_JOINT_FIELDS = ("q", "dq", "q_des", "dq_des", "tau_ff", "kp", "kd", "temperature", "averaging")

_NOISE_SEED = 0
"""Seed of the noise that `Sources.with_more_noise` adds."""
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
        averaging: Share by which the interpolation between rows reduces the variance of encoder noise:
            0 on a row, 0.5 halfway between two.
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
    averaging: Array
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


def _stretches(log: Log) -> tuple[Bools, Array, Bools]:
    """For each row: whether a stretch begins, the spacing before, whether the past is known."""
    # The past of a row is known if SETTLING_S have passed since the last gap and since the first
    # command.
    start = log.after_gap
    start[0] = True
    steps = np.where(start, log.period, np.diff(log.t, prepend=log.t[0]))
    began = np.maximum.accumulate(np.where(start, log.t, -np.inf))
    known = (log.t - began >= SETTLING_S) & (log.t - SETTLING_S >= log.t_cmd[0])
    return np.asarray(start), np.asarray(steps, dtype=float), np.asarray(known)


@attrs.frozen(eq=False)
class Sources:
    """The signals of all logs that samples are read from.

    Attributes:
        series: Signals of each log.
        sent: (M, J) q_des of every command row of all logs, rad.
        first_packet: Number of command rows before each log, and of all of them.
        first_row: Number of state rows before each log, and of all of them.
        constant: Signals that are equal in every row of all logs, as that row.
    """

    series: tuple[LogSignals, ...]
    sent: Array
    first_packet: Indices
    first_row: Indices
    constant: Mapping[str, Array]

    @classmethod
    def of(cls, series: Sequence[LogSignals]) -> Sources:
        """Collect the signals of logs.

        Args:
            series: Signals of each log.

        Returns:
            The sources.
        """
        return cls(
            tuple(series),
            np.concatenate([one.commands["q_des"] for one in series]),
            np.cumsum([0, *(len(one.t_cmd) for one in series)]),
            np.cumsum([0, *(len(one.t) for one in series)]),
            _constant_signals([one.signals for one in series]),
        )

    @cached_property
    def encoder_noise(self) -> tuple[Array, Array]:
        """Variance of the white noise of q (J,), rad^2, and of dq (J,), rad^2/s^2, as logged."""
        every = np.ones((self.first_row[len(self.series)], self.sent.shape[1]), dtype=bool)
        start = np.concatenate([_stretches(one.log)[0] for one in self.series])
        q, dq = (
            difference_variance(
                np.concatenate([as_double(getattr(one.log, name)) for one in self.series]), every, start
            )
            for name in ("q", "dq")
        )
        return q, dq

    @property
    def interpolated_noise(self) -> tuple[Array, Array]:
        """Part of the variances of q (J,) and dq (J,) that interpolation between two rows can average."""
        # An average over n rows leaves noise of the variance 1 / n, of which the next row has the share
        # (n - 1) / n, too: 1 / n - (n - 1) / n^2 = 1 / n^2.
        share = 1.0 / self.series[0].smoothed_rows ** 2
        q, dq = self.encoder_noise
        return share * q, share * dq

    def with_more_noise(self) -> Sources:
        """Add white noise to q and dq, with the variance of the noise that they have.

        Returns:
            The sources of the same logs with twice the variance of encoder noise.
        """
        rng, deviations = np.random.default_rng(_NOISE_SEED), np.sqrt(self.encoder_noise)
        series = [
            one.with_encoder_errors(*(rng.normal(0.0, each, one.log.q.shape) for each in deviations))
            for one in self.series
        ]
        return attrs.evolve(
            self, series=tuple(series), constant=_constant_signals([one.signals for one in series])
        )

    def first(self, count: int) -> Sources:
        """Keep the first logs.

        Args:
            count: Number of logs.

        Returns:
            Their sources.
        """
        return attrs.evolve(self, series=self.series[:count], sent=self.sent[: self.first_packet[count]])


@attrs.frozen(eq=False, kw_only=True)
class Samples:
    """Rows of all logs one after the other: N rows of J joints, with their torque and signals.

    `Samples.of` makes them from logs; all other methods return samples of some of the rows. If kp
    or kd is not known in every log, it counts as 1, so that the fit yields the gain itself. The
    same holds for a kd that is 0 in all logs (`undamped`): its deviation is the drive's own
    damping, in units of 1 N m s/rad.

    Attributes:
        sources: Signals of all logs.
        commanded: Whether the commanded gains are known.
        undamped: Whether the commanded kd is 0 throughout.
        instants_per_row: Instants of a row, itself the last, for effects that are integrated
            between the rows.
        period: Median spacing of the rows, s.
        log_of_row: (N,) index of each row's log.
        t: (N,) times, s.
        tau: (N, J) measured torque, N m; 0 if not logged.
        start: (N,) whether a stretch begins at this row.
        dt: (N,) time since the row before, s.
        evaluated: (N, J) rows that a model has to explain.
        row: (N,) index of each row in all logs.
        lead: (N,) time by which an instant precedes its row, s.
    """

    sources: Sources
    commanded: bool
    undamped: bool
    instants_per_row: int
    period: float
    log_of_row: Indices
    t: Array
    tau: Array
    start: Bools
    dt: Array
    evaluated: Bools
    row: Indices
    lead: Array
    _signals: dict[tuple[Any, ...], Signals] = attrs.field(factory=dict, init=False, repr=False)
    _states: dict[tuple[Any, ...], dict[str, Array]] = attrs.field(factory=dict, init=False, repr=False)
    _selections: dict[bytes, Samples] = attrs.field(factory=dict, init=False, repr=False)

    @classmethod
    def of(
        cls, logs: Sequence[Log], steady: float = 0.0, options: SearchOptions = SEARCH_DEFAULTS
    ) -> Samples:
        """Concatenate the rows of logs.

        Args:
            logs: Logs with the same joints.
            steady: Half width of the lines that smooth q and dq, s; 0 for none.
            options: Options of the search.

        Returns:
            The samples of all rows.
        """
        undamped = all(log.kd is not None and not log.kd.any() for log in logs)
        known = {name for name in ("kp", "kd") if all(getattr(log, name) is not None for log in logs)}
        commanded = "kp" in known
        known -= {"kd"} if undamped else set()
        series = [LogSignals(log, steady, known, options.sharp_accelerations) for log in logs]
        starts, steps, settled = zip(*map(_stretches, logs), strict=True)
        t = np.concatenate([one.t for one in series])
        return cls(
            sources=Sources.of(series),
            commanded=commanded,
            undamped=undamped,
            instants_per_row=options.instants_per_row,
            period=float(np.median(np.concatenate([np.diff(log.t) for log in logs]))),
            log_of_row=np.repeat(np.arange(len(logs)), [len(log.t) for log in logs]),
            t=t,
            tau=np.concatenate([as_double(log.q * 0.0 if log.tau is None else log.tau) for log in logs]),
            start=np.concatenate(starts),
            dt=np.concatenate(steps),
            evaluated=np.concatenate([log.valid for log in logs]) & np.concatenate(settled)[:, None],
            row=np.arange(len(t)),
            lead=np.zeros(len(t)),
        )

    @property
    def logs(self) -> tuple[Log, ...]:
        """The logs, one after the other."""
        return tuple(one.log for one in self.sources.series)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.sources.series[0].log.joints

    @property
    def reference_gains(self) -> tuple[float, float]:
        """Gains that deviations are relative to: medians of kp (N m/rad) and kd (N m s/rad)."""
        kp, kd = (
            float(np.median(np.concatenate([one.gains[name].ravel() for one in self.sources.series])))
            for name in ("kp", "kd")
        )
        return max(kp, 1e-6), max(kd, 1e-6)

    def with_shifted_commands(self, logs: Sequence[int], shift: float) -> Samples:
        """Shift the command stamps of some logs.

        Args:
            logs: Numbers of the logs.
            shift: Time to add to their stamps, s.

        Returns:
            The same rows with shifted commands.
        """
        series = [
            one.with_shifted_commands(shift) if k in logs else one
            for k, one in enumerate(self.sources.series)
        ]
        return attrs.evolve(self, sources=Sources.of(series))

    def drop_heldout(self, rows: Bools) -> Samples:
        """Drop the logs at the end that hold none of the given rows.

        Args:
            rows: (N, J) rows that are needed.

        Returns:
            The remaining samples.
        """
        count = int(self.log_of_row[np.flatnonzero(rows.any(axis=1))[-1]]) + 1 if rows.any() else 1
        if count == len(self.sources.series):
            return self
        key = f"first {count} logs".encode()
        if key not in self._selections:
            part = self.take_rows(np.flatnonzero(self.log_of_row < count))
            self._selections[key] = attrs.evolve(part, sources=self.sources.first(count))
        return self._selections[key]

    def thinned(self, step: int) -> tuple[Samples, Indices]:
        """Keep one of every few rows; the signals between them stay known.

        Args:
            step: Spacing, rows.

        Returns:
            The samples, and the indices of their rows; these samples if all rows are kept.
        """
        if step == 1:
            return self, np.arange(len(self.t))
        rows = np.arange(step - 1, len(self.t), step)
        t, period = self.t[rows], step * self.period
        start = np.diff(np.cumsum(self.start)[rows], prepend=-1) > 0
        dt = np.where(start, period, np.diff(t, prepend=t[0] - period))
        return attrs.evolve(self.take_rows(rows), start=start, dt=dt, period=period), rows

    @cached_property
    def noisier(self) -> Samples:
        """The same rows with twice the variance of encoder noise in q and dq."""
        return attrs.evolve(self, sources=self.sources.with_more_noise())

    @cached_property
    def upsampled(self) -> Samples:
        """The samples with `instants_per_row` evenly spaced instants for each row."""
        count = self.instants_per_row
        part = self.take_rows(np.repeat(np.arange(len(self.t)), count))
        before = np.tile(np.arange(count)[::-1], len(self.t)) / count
        return attrs.evolve(
            part,
            lead=np.where(part.start, 0.0, before * part.dt),
            dt=part.dt / count,
            start=part.start & (np.arange(len(part.t)) % count == 0),
        )

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
        return attrs.evolve(self, **{name: getattr(self, name)[rows] for name in _ROW_FIELDS})

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
            self._signals,
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
        return self._cached(self._signals, key, lambda: attrs.evolve(self.at(0.0, 0.0, window), slope=slope))

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
        series, first_row = self.sources.series, self.sources.first_row
        edges = np.searchsorted(self.log_of_row, np.arange(len(series) + 1))
        for one, first, a, b in zip(series, first_row, edges[:-1], edges[1:], strict=False):
            yield one.t[self.row[a:b] - first] - self.lead[a:b] - output_delay

    def _shifted_state(self, output_delay: Array | float, name: str, late: Array) -> Array:
        """A state signal (..., N, J) of all rows, `late` s before the instants at this output delay.

        The shift follows straight lines between rows, as in a running model.
        """
        before = np.squeeze(late, -2) if np.ndim(late) > 1 else late
        before = np.broadcast_to(
            before + output_delay, np.broadcast_shapes(np.shape(before), self.tau.shape[1:])
        )
        return self._state_before(name, before) + self._bend_at(name, output_delay)

    def _bend_at(self, name: str, output_delay: Array | float) -> Array:
        """By how much a state signal (N, J) differs from straight lines at this output delay."""
        delays = np.broadcast_to(output_delay, self.tau.shape[1:])

        def make() -> dict[str, Array]:
            return {name: self._state_before(name, delays, True) - self._state_before(name, delays)}

        return self._cached(self._states, (name, *delays.tolist()), make)[name]

    def _state_before(self, name: str, late: Array, curved: bool = False) -> Array:
        """A state signal (..., N, J) of all rows, `late` (..., J) s before them."""
        parts = [
            one.state_shifted(name, at, late, curved)
            for one, at in zip(self.sources.series, self._request_times(0.0), strict=True)
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
        series, constant = self.sources.series, self.sources.constant
        parts: dict[str, list[Array]] = {}
        packets, ages = [], []
        if delays is None:
            delays = np.full(self.tau.shape[1], input_delay + output_delay - 0.5 * window)
        for one, at, first in zip(
            series, self._request_times(output_delay), self.sources.first_packet, strict=False
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
            sent=self.sources.sent,
            read_shifted=partial(self._shifted_state, output_delay),
            slope=partial(self._slope, output_delay, delays, chosen),
            **signals,
        )

    def _state(self, output_delay: float, joints: list[int] | None) -> dict[str, Array]:
        """The signals that depend on the output delay alone, by name."""

        def make() -> dict[str, Array]:
            parts: dict[str, list[Array]] = {}
            for one, at in zip(self.sources.series, self._request_times(output_delay), strict=False):
                found = one.locate(at)
                for name in one.states.keys() - self.sources.constant:
                    parts.setdefault(name, []).append(
                        one.state_at(name, at, ALL_JOINTS if joints is None else joints, found)
                    )
                parts.setdefault("t", []).append((at - one.origin)[:, None])
                # (1 - s) a + s b has the variance ((1 - s)^2 + s^2) var = (1 - 2 s (1 - s)) var.
                between = found[1]
                parts.setdefault("averaging", []).append((2.0 * between * (1.0 - between))[:, None])
            return {name: _collapse_constant(np.concatenate(part)) for name, part in parts.items()}

        key = (output_delay, *(joints or ()))
        return self._cached(self._states, key, make)

    def _slope(self, output_delay: float, delays: Array, joints: Joints, name: str) -> Array:
        """An acceleration (N, J) at this output delay; commands move the joints after `delays` (J,)."""
        parts = [
            one.acceleration_at(name, at, delays, joints)
            for one, at in zip(self.sources.series, self._request_times(output_delay), strict=False)
        ]
        return np.concatenate(parts)
