"""One log, read at any time: its states between their rows, its commands as they were held, and its accelerations."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import interpolation
from .acceleration import HALF_WIDTHS, lines, slope, smooth_part
from .logs.log import ALMOST, Log

Array = NDArray[np.float64]
Joints = slice | list[int]
ALL = slice(None)

_KEPT_SLOPES = 4
"""accelerations that a log keeps: two kinds at a few delays"""


class LogSignals:
    """One log; `steady` (s) as that of `Samples`. known: which of kp and kd count as logged, the others as 1.

    origin: when it began, s, or the log that it is a piece of.
    """

    def __init__(self, log: Log, steady: float, known: Collection[str]) -> None:
        self.log, self.origin = log, float(log.t[0]) if log.began is None else log.began
        self.t, self.t_cmd = double(log.t), double(log.t_cmd)
        self.states = {"q": double(log.q), "dq": double(log.dq)}
        if steady > 0.0:
            self.states = {k: lines(double(log.t), values, steady)[0] for k, values in self.states.items()}
        if log.temperature is not None:
            self.states["temperature"] = double(log.temperature)
        if log.voltage is not None:
            self.states["voltage"] = double(log.voltage)[:, None]
        shape = log.q_des.shape
        zero = np.zeros(shape)
        self.commands = {
            "q_des": double(log.q_des),
            "dq_des": zero if log.dq_des is None else double(log.dq_des),
            "tau_ff": zero if log.tau_ff is None else double(log.tau_ff),
        }
        self.gains = {
            name: double(getattr(log, name)) if name in known else np.broadcast_to(1.0, shape)
            for name in ("kp", "kd")
        }
        spacing = np.diff(log.t_cmd, append=log.t_cmd[-1] + 1e3)[:, None]
        self.sums = {
            name: np.concatenate([np.zeros((1, shape[1])), np.cumsum(values * spacing, axis=0)])
            for name, values in self.commands.items()
            if values.any()
        }
        self.all: dict[str, Array] = {**self.states, **self.commands, **self.gains}
        self._slopes: dict[float, Array] = {}
        self._smooth: dict[tuple[Any, ...], tuple[Array, Array]] = {}

    def between(self, at: Array) -> tuple[NDArray[np.intp], Array]:
        """Of times (N,): the state row before, and how far towards the next, 0 to 1."""
        return interpolation.between(self.t, at)

    def state(
        self, name: str, at: Array, joints: Joints = ALL, found: tuple[NDArray[np.intp], Array] | None = None
    ) -> Array:
        """A state signal, linear between rows; `found` is `between(at)` where that is known."""
        values = self.states[name]
        values = values if values.shape[1] == 1 else values[:, joints]
        return interpolation.read(values, *(self.between(at) if found is None else found))

    def acceleration(self, name: str, at: Array, delays: Array, joints: Joints = ALL) -> Array:
        """rad/s^2 where commands move the joints `delays` (J,) after they were sent; `name` says how smooth it is."""
        if name == "ddq":
            return interpolation.read(self._slope_of_dq(name)[:, joints], *self.between(at))
        key = (name, *delays.tolist())
        if key not in self._smooth:
            if len(self._smooth) >= _KEPT_SLOPES:
                self._smooth.pop(next(iter(self._smooth)))
            come = self._acting(self.t, delays, self._integral)
            self._smooth[key] = smooth_part(name, self.t, double(self.log.dq), self._slope_of_dq(name), come)
        smooth, answer = self._smooth[key]
        jumps = self._acting(at, delays, lambda values, _, sent: values[self.in_force(sent)])
        return interpolation.read(smooth[:, joints], *self.between(at)) + jumps @ answer[:, joints]

    def _slope_of_dq(self, name: str) -> Array:
        """rad/s^2 by rows, as smooth as `name` says, whatever commands do."""
        width = HALF_WIDTHS[name]
        if width not in self._slopes:
            self._slopes[width] = slope(self.t, double(self.log.dq), width)
        return self._slopes[width]

    def _acting(self, at: Array, delays: Array, read: Callable[[Array, Array, Array], Array]) -> Array:
        """What is read of q_des and its sums at the times at which what acts at `at` was sent, (N, J)."""
        found = np.zeros((len(at), len(delays)))
        if "q_des" in self.sums:
            for delay in np.unique(delays):
                joints = delays == delay
                values, sums = self.commands["q_des"][:, joints], self.sums["q_des"][:, joints]
                found[:, joints] = read(values, sums, at - delay)
        return found

    def shifted(self, name: str, at: Array, late: Array) -> Array:
        """A state signal (..., N, J) of every joint `late` (..., J) s before `at` (N,)."""
        return interpolation.read_late(self.states[name], self.t, at, late)

    def in_force(self, at: Array) -> NDArray[np.intp]:
        """The command row that counts at the times `at` (N,), s."""
        return interpolation.rows_at(self.t_cmd, at + ALMOST)

    def command(
        self,
        name: str,
        at: Array,
        window: float,
        joints: Joints = ALL,
        row: NDArray[np.intp] | None = None,
    ) -> Array:
        """A command signal: the mean over `at` to `at + window`; `row` is `in_force(at)` where that is known."""
        values = self.commands[name][:, joints]
        if name not in self.sums:
            return np.zeros((len(at), values.shape[1]))
        if window == 0.0:
            return values[self.in_force(at) if row is None else row]
        sums = self.sums[name][:, joints]
        late, early = (self._integral(values, sums, end) for end in (at + window, at))
        return (late - early) / window

    def _integral(self, values: Array, sums: Array, at: Array) -> Array:
        return interpolation.integral(values, sums, self.t_cmd, at)


def double(values: NDArray[np.floating]) -> Array:
    return np.asarray(values, dtype=np.float64)
