"""One log, read at any time: its states between their rows, its commands as they were held, and its accelerations."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import interpolation
from .acceleration import HALF_WIDTHS_S, local_lines, local_slope, split_acceleration
from .logs.log import TIME_TOLERANCE_S, Log

Array = NDArray[np.float64]
Joints = slice | list[int]
ALL_JOINTS = slice(None)

_MAX_CACHED_SLOPES = 4
"""accelerations that a log keeps: two kinds at a few delays"""


class LogSignals:
    """One log; `steady` (s) as that of `Samples`. known: which of kp and kd count as logged, the others as 1.

    origin: when it began, s, or the log that it is a piece of.
    """

    def __init__(self, log: Log, steady: float, known: Collection[str]) -> None:
        self.log, self.origin = log, float(log.t[0]) if log.recording_start is None else log.recording_start
        self.t, self.t_cmd = as_double(log.t), as_double(log.t_cmd)
        self.states = {"q": as_double(log.q), "dq": as_double(log.dq)}
        if steady > 0.0:
            self.states = {
                k: local_lines(as_double(log.t), values, steady)[0] for k, values in self.states.items()
            }
        if log.temperature is not None:
            self.states["temperature"] = as_double(log.temperature)
        if log.voltage is not None:
            self.states["voltage"] = as_double(log.voltage)[:, None]
        shape = log.q_des.shape
        zero = np.zeros(shape)
        self.commands = {
            "q_des": as_double(log.q_des),
            "dq_des": zero if log.dq_des is None else as_double(log.dq_des),
            "tau_ff": zero if log.tau_ff is None else as_double(log.tau_ff),
        }
        self.gains = {
            name: as_double(getattr(log, name)) if name in known else np.broadcast_to(1.0, shape)
            for name in ("kp", "kd")
        }
        spacing = np.diff(log.t_cmd, append=log.t_cmd[-1] + 1e3)[:, None]
        self.sums = {
            name: np.concatenate([np.zeros((1, shape[1])), np.cumsum(values * spacing, axis=0)])
            for name, values in self.commands.items()
            if values.any()
        }
        self.signals: dict[str, Array] = {**self.states, **self.commands, **self.gains}
        self._slopes: dict[float, Array] = {}
        self._smooth: dict[tuple[Any, ...], tuple[Array, Array]] = {}

    def locate(self, at: Array) -> tuple[NDArray[np.intp], Array]:
        """Of times (N,): the state row before, and how far towards the next, 0 to 1."""
        return interpolation.locate(self.t, at)

    def state_at(
        self,
        name: str,
        at: Array,
        joints: Joints = ALL_JOINTS,
        found: tuple[NDArray[np.intp], Array] | None = None,
    ) -> Array:
        """A state signal, linear between rows; `found` is `between(at)` where that is known."""
        values = self.states[name]
        values = values if values.shape[1] == 1 else values[:, joints]
        return interpolation.interpolate(values, *(self.locate(at) if found is None else found))

    def acceleration_at(self, name: str, at: Array, delays: Array, joints: Joints = ALL_JOINTS) -> Array:
        """rad/s^2 where commands move the joints `delays` (J,) after they were sent; `name` says how smooth it is."""
        if name == "ddq":
            return interpolation.interpolate(self._slope_of_dq(name)[:, joints], *self.locate(at))
        key = (name, *delays.tolist())
        if key not in self._smooth:
            if len(self._smooth) >= _MAX_CACHED_SLOPES:
                self._smooth.pop(next(iter(self._smooth)))
            come = self._read_targets(self.t, delays, self._integral)
            self._smooth[key] = split_acceleration(
                name, self.t, as_double(self.log.dq), self._slope_of_dq(name), come
            )
        smooth, answer = self._smooth[key]
        jumps = self._read_targets(at, delays, lambda values, _, sent: values[self.command_rows(sent)])
        return interpolation.interpolate(smooth[:, joints], *self.locate(at)) + jumps @ answer[:, joints]

    def _slope_of_dq(self, name: str) -> Array:
        """rad/s^2 by rows, as smooth as `name` says, whatever commands do."""
        width = HALF_WIDTHS_S[name]
        if width not in self._slopes:
            self._slopes[width] = local_slope(self.t, as_double(self.log.dq), width)
        return self._slopes[width]

    def _read_targets(self, at: Array, delays: Array, read: Callable[[Array, Array, Array], Array]) -> Array:
        """What is read of q_des and its sums at the times at which what acts at `at` was sent, (N, J)."""
        found = np.zeros((len(at), len(delays)))
        if "q_des" in self.sums:
            for delay in np.unique(delays):
                joints = delays == delay
                values, sums = self.commands["q_des"][:, joints], self.sums["q_des"][:, joints]
                found[:, joints] = read(values, sums, at - delay)
        return found

    def state_shifted(self, name: str, at: Array, late: Array) -> Array:
        """A state signal (..., N, J) of every joint `late` (..., J) s before `at` (N,)."""
        return interpolation.interpolate_shifted(self.states[name], self.t, at, late)

    def command_rows(self, at: Array) -> NDArray[np.intp]:
        """The command row that counts at the times `at` (N,), s."""
        return interpolation.rows_at(self.t_cmd, at + TIME_TOLERANCE_S)

    def command_at(
        self,
        name: str,
        at: Array,
        window: float,
        joints: Joints = ALL_JOINTS,
        row: NDArray[np.intp] | None = None,
    ) -> Array:
        """A command signal: the mean over `at` to `at + window`; `row` is `command_rows(at)` where that is known."""
        values = self.commands[name][:, joints]
        if name not in self.sums:
            return np.zeros((len(at), values.shape[1]))
        if window == 0.0:
            return values[self.command_rows(at) if row is None else row]
        sums = self.sums[name][:, joints]
        late, early = (self._integral(values, sums, end) for end in (at + window, at))
        return (late - early) / window

    def _integral(self, values: Array, sums: Array, at: Array) -> Array:
        return interpolation.hold_integral(values, sums, self.t_cmd, at)


def as_double(values: NDArray[np.floating]) -> Array:
    return np.asarray(values, dtype=np.float64)
