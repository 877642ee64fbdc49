"""Signals of one log at any time: interpolated states, held commands, and accelerations.

`dataset` holds the logs, `interpolation` has the compiled loops, and `signals` joins several logs.
Units: s, rad, rad/s, N m.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import copy
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array, Bools, Indices

from ..logs.log import TIME_TOLERANCE_S, Log
from . import interpolation
from .acceleration import HALF_WIDTHS_S, local_lines, local_slope, split_acceleration

Joints = slice | list[int]
ALL_JOINTS = slice(None)
"""Selects all joints."""

_MAX_CACHED_SLOPES = 4
"""Accelerations that are cached for a log: two kinds at a few delays."""


class LogSignals:
    """Signals of one log in double precision, at any time.

    Attributes:
        log: The log, N state rows and M command rows of J joints.
        origin: Start time of the recording, s.
        t: (N,) times of the states, s.
        t_cmd: (M,) times of the commands, s.
        states: State signals by name, (N, J) or (N, 1).
        commands: Command signals by name, (M, J).
        gains: kp and kd, (M, J); 1 if they are not known.
        sums: Integral (M + 1, J) of each command signal that is not 0.
        smoothed_rows: Number of rows over which q and dq are averaged; 1 without smoothing.
        left_out_speed_errors: Errors (J,) of lines and of parabolas at rows that are left out, from
            `interpolation.left_out_errors`; those of the log also where errors are added to it.
        signals: All of these signals by name.
    """

    def __init__(self, log: Log, smoothing: float, known: Collection[str], sharp: bool) -> None:
        """Prepare the signals.

        Args:
            log: The log.
            smoothing: Half width of the window of the lines fitted to q and dq, s; 0 for none.
                Accelerations use the raw dq. `preparation` selects it.
            known: Which of kp and kd are used as logged.
            sharp: Whether accelerations are kept sharp where a command arrives.
        """
        self.log, self.origin = log, float(log.t[0]) if log.recording_start is None else log.recording_start
        self.t, self.t_cmd = as_double(log.t), as_double(log.t_cmd)
        self.states = {"q": as_double(log.q), "dq": as_double(log.dq)}
        self._smoothing = smoothing
        self.smoothed_rows = 2 * round(smoothing / log.period) + 1
        self.states = {name: self._smoothed(values) for name, values in self.states.items()}
        self.left_out_speed_errors = interpolation.left_out_errors(self.t, *self.states.values())
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
        # Integral of each held command up to its row. The last command lasts for 1000 s.
        spacing = np.diff(log.t_cmd, append=log.t_cmd[-1] + 1e3)[:, None]
        self.sums = {
            name: np.concatenate([np.zeros((1, shape[1])), np.cumsum(values * spacing, axis=0)])
            for name, values in self.commands.items()
            if values.any()
        }
        self.signals: dict[str, Array] = {**self.states, **self.commands, **self.gains}
        self._sharp = sharp
        self._bends: dict[str, Array] = {}
        self._slopes: dict[float, Array] = {}
        self._smooth: dict[tuple[Any, ...], tuple[Array, Array]] = {}

    def _smoothed(self, values: Array) -> Array:
        """Fit lines to the values (N, J) of the rows around each row; return their values there."""
        return local_lines(self.t, values, self._smoothing)[0] if self._smoothing > 0.0 else values

    def with_encoder_errors(self, q: Array, dq: Array) -> LogSignals:
        """Add errors to the measured states.

        Args:
            q: (N, J) error of q, rad.
            dq: (N, J) error of dq, rad/s.

        Returns:
            The signals as a log with these errors would have them.
        """
        other = copy(self)
        other.log = attrs.evolve(self.log, q=self.log.q + q, dq=self.log.dq + dq)
        errors = {"q": self._smoothed(q), "dq": self._smoothed(dq)}  # lines are linear in the values
        other.states = self.states | {name: self.states[name] + error for name, error in errors.items()}
        other.signals = {**self.signals, **other.states}
        other._bends, other._slopes, other._smooth = {}, {}, {}
        return other

    def with_shifted_commands(self, shift: float) -> LogSignals:
        """Shift the times of the commands.

        Args:
            shift: Time to add to them, s.

        Returns:
            The signals of the log with later (positive) or earlier commands.
        """
        other = copy(self)
        other.log = attrs.evolve(self.log, t_cmd=self.log.t_cmd + shift)
        other.t_cmd = as_double(other.log.t_cmd)
        other._smooth = {}
        return other

    def locate(self, at: Array) -> tuple[Indices, Array]:
        """Find the interval of state rows that holds each time.

        Args:
            at: (N,) times, s.

        Returns:
            (N,) first row of the interval, and (N,) position in it, from 0 to 1.
        """
        return interpolation.locate(self.t, at)

    def state_at(
        self,
        name: str,
        at: Array,
        joints: Joints = ALL_JOINTS,
        found: tuple[Indices, Array] | None = None,
    ) -> Array:
        """Interpolate a state signal.

        Args:
            name: Name of the signal.
            at: (N,) times, s.
            joints: Columns to read.
            found: `locate(at)`, if already computed.

        Returns:
            (N, J) or (N, 1) values.
        """
        values, bends = self.states[name], self._bend(name)
        values = values if values.shape[1] == 1 else values[:, joints]
        bends = None if bends is None else bends[:, joints]
        return interpolation.interpolate(values, *(self.locate(at) if found is None else found), bends)

    def _bend(self, name: str) -> Array | None:
        """How far a state signal bends between rows: q and dq tell it of each other."""
        if not self._bends:
            q, dq = self.states["q"], self.states["dq"]
            self._bends["q"] = interpolation.bend(self.t, dq)
            self._bends["dq"] = np.where(self.curved, interpolation.speed_bend(self.t, q, dq), 0.0)
        return self._bends.get(name)

    @property
    def curved(self) -> Bools:
        """Joints (J,) whose dq is read by parabolas between rows."""
        straight, curved = self.left_out_speed_errors
        found: Bools = curved < interpolation.MAX_CURVED_ERROR * straight
        return found

    def acceleration_at(self, name: str, at: Array, delays: Array, joints: Joints = ALL_JOINTS) -> Array:
        """Compute the acceleration of the joints.

        Args:
            name: `ddq`, `ddq_sharp` or `ddq_smooth`; selects the half width of the slope, and for
                the latter two whether steps at commands are kept sharp.
            at: (N,) times, s.
            delays: (J,) delay from a command to the motion of its joint, s.
            joints: Columns to read.

        Returns:
            (N, J) acceleration, rad/s^2.
        """
        if name == "ddq" or not self._sharp:
            return interpolation.interpolate(self._slope_of_dq(name)[:, joints], *self.locate(at))
        key = (name, *delays.tolist())
        if key not in self._smooth:
            if len(self._smooth) >= _MAX_CACHED_SLOPES:
                self._smooth.pop(next(iter(self._smooth)))
            target_integral = self._read_targets(self.t, delays, self._integral)
            states = as_double(self.log.q), as_double(self.log.dq)
            self._smooth[key] = split_acceleration(
                name, self.t, states, self._slope_of_dq(name), target_integral
            )
        # ddq = smooth + B q_des, with the command as it acts at `at`.
        smooth, response = self._smooth[key]
        targets = self._read_targets(at, delays, lambda values, _, sent: values[self.command_rows(sent)])
        return interpolation.interpolate(smooth[:, joints], *self.locate(at)) + targets @ response[:, joints]

    def _slope_of_dq(self, name: str) -> Array:
        """Slope of dq at each row, rad/s^2, as smooth as `name` says."""
        width = HALF_WIDTHS_S[name]
        if width not in self._slopes:
            self._slopes[width] = local_slope(self.t, as_double(self.log.dq), width)
        return self._slopes[width]

    def _read_targets(self, at: Array, delays: Array, read: Callable[[Array, Array, Array], Array]) -> Array:
        """Apply `read` to q_des and its integral at the time `at` minus the delay of each joint, (N, J)."""
        found = np.zeros((len(at), len(delays)))
        if "q_des" in self.sums:
            for delay in np.unique(delays):
                joints = delays == delay
                values, sums = self.commands["q_des"][:, joints], self.sums["q_des"][:, joints]
                found[:, joints] = read(values, sums, at - delay)
        return found

    def state_shifted(self, name: str, at: Array, late: Array, curved: bool = False) -> Array:
        """Interpolate a state signal at delays that differ between joints.

        Args:
            name: Name of the signal.
            at: (N,) times, s.
            late: (..., J) delays, s; values are those at `at` minus these.
            curved: Whether it bends between rows, as in `state_at`; straight lines if not.

        Returns:
            (..., N, J) values.
        """
        bends = self._bend(name) if curved else None
        return interpolation.interpolate_shifted(self.states[name], self.t, at, late, bends)

    def command_rows(self, at: Array) -> Indices:
        """Find the command rows in force.

        Args:
            at: (N,) times, s.

        Returns:
            (N,) row indices; 0 before the first command.
        """
        return interpolation.rows_at(self.t_cmd, at + TIME_TOLERANCE_S)

    def command_at(
        self,
        name: str,
        at: Array,
        window: float,
        joints: Joints = ALL_JOINTS,
        row: Indices | None = None,
    ) -> Array:
        """Read a command signal, or its mean over a step of the drive.

        Args:
            name: Name of the signal.
            at: (N,) times, s.
            window: Step of the drive, s: the mean over `at` to `at` + `window`; 0 for the value
                at `at`.
            joints: Columns to read.
            row: `command_rows(at)`, if already computed.

        Returns:
            (N, J) values.
        """
        values = self.commands[name][:, joints]
        if name not in self.sums:
            return np.zeros((len(at), values.shape[1]))
        if window == 0.0:
            return values[self.command_rows(at) if row is None else row]
        # Mean of the held command over the step: (I(at + window) - I(at)) / window.
        sums = self.sums[name][:, joints]
        end, start = (self._integral(values, sums, time) for time in (at + window, at))
        return (end - start) / window

    def _integral(self, values: Array, sums: Array, at: Array) -> Array:
        """Integral of a command signal from the first command to `at`."""
        return interpolation.hold_integral(values, sums, self.t_cmd, at)


def as_double(values: NDArray[np.floating]) -> Array:
    """Convert an array to double precision.

    Args:
        values: The array.

    Returns:
        The array, without a copy if possible.
    """
    return np.asarray(values, dtype=np.float64)
