"""The record of a measured joint log, independent of the file format it was read from.

`Log` validates what every computation needs: matching shapes, finite numbers, increasing times.
`read_log.read_log` makes a `Log` from a path, and `check_log.check_log` checks it against the robot.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from quadvel_description.arrays import Bools, Floats, Indices
from quadvel_description.robot import Robot

TIME_TOLERANCE_S = 1e-9
"""s; a command sent at most this long after an instant is in force at it (round-off of summed
times).
"""

GAP_FACTOR = 3.5
"""A spacing of more than this many median spacings is a gap: memories, slopes and replays restart
there.
"""

MIN_ROWS = 10
"""Fewest rows of a log."""


class LogError(ValueError):
    """A log that cannot be used; the message is one sentence that names the file and the field."""


def joint_name(name: str) -> str:
    """Append `_joint` to a name that does not end with it.

    Args:
        name: Name of a joint, with or without the suffix.

    Returns:
        The name with the suffix.
    """
    return name if name.endswith("_joint") else f"{name}_joint"


@attrs.frozen(eq=False)
class Log:
    """A measured log of J joints in SI units: N state rows, M command rows, each with own times.

    A state row holds the values measured at its time. A command is in force from its time until
    the next one (zero-order hold). Construction raises `LogError` unless times increase strictly,
    all numbers are finite and all shapes match. Arrays are in double precision, or in single
    precision if the file holds more than `readers.raw.MAX_DOUBLE_VALUES` values: cast before solving
    linear systems with them.

    Attributes:
        name: Path of the file.
        joints: (J,) names, each ends with `_joint`.
        t: (N,) times of the state rows, s.
        q: (N, J) measured joint angles, rad.
        dq: (N, J) joint speeds, rad/s.
        t_cmd: (M,) times of the command rows, s.
        q_des: (M, J) commanded joint angles, rad.
        valid: (N, J) rows and joints that a model has to explain.
        tau: (N, J) measured joint torques, N m; None if not logged.
        temperature: (N, J) drive temperatures, degrees Celsius, or None.
        voltage: (N,) supply voltage, V, or None.
        dq_des: (M, J) commanded joint speeds, rad/s, or None.
        tau_ff: (M, J) feed-forward torques, N m, or None.
        kp: (M, J) commanded position gains, N m/rad, or None.
        kd: (M, J) commanded speed gains, N m s/rad, or None.
        recording_start: Start time of the whole recording, s, if this log is an excerpt of it;
            else None.
        remarks: Assumptions of the reader, one sentence each.
        warnings: Defects that the reader found, one sentence each.
        derived: Fields that the file did not hold, such as a `dq` computed from `q`.
        robot: The robot; None if it is unknown.
    """

    name: str
    joints: tuple[str, ...]
    t: Floats
    q: Floats
    dq: Floats
    t_cmd: Floats
    q_des: Floats
    valid: Bools
    tau: Floats | None = None
    temperature: Floats | None = None
    voltage: Floats | None = None
    dq_des: Floats | None = None
    tau_ff: Floats | None = None
    kp: Floats | None = None
    kd: Floats | None = None
    recording_start: float | None = None
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    derived: tuple[str, ...] = ()
    robot: Robot | None = None

    def __attrs_post_init__(self) -> None:
        for name in self.joints:
            if self.joints.count(name) > 1:
                raise LogError(f"{self.name}: joint_names: '{name}' stands there twice")
        self._check_time("t", self.t)
        self._check_time("t_cmd", self.t_cmd)
        joints = len(self.joints)
        states, commands = (len(self.t), joints), (len(self.t_cmd), joints)
        for field in ("q", "dq", "tau", "temperature", "valid"):
            self._check_values(field, getattr(self, field), states)
        self._check_values("voltage", self.voltage, states[:1])
        for field in ("q_des", "dq_des", "tau_ff", "kp", "kd"):
            self._check_values(field, getattr(self, field), commands)

    @property
    def duration(self) -> float:
        """Time from the first state row to the last, s."""
        return float(self.t[-1] - self.t[0])

    @property
    def period(self) -> float:
        """Median spacing of the state rows, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def has_own_command_stamps(self) -> bool:
        """Whether commands have other stamps than states."""
        return len(self.t) != len(self.t_cmd) or bool((self.t != self.t_cmd).any())

    @property
    def after_gap(self) -> Bools:
        """State rows (N,) that follow a gap."""
        after: Bools = np.diff(self.t, prepend=self.t[0]) > GAP_FACTOR * self.period
        return after

    def command_rows(self, at: Floats) -> Indices:
        """Return the command rows in force at given times.

        Args:
            at: Times of any shape, s.

        Returns:
            Row indices of the same shape; 0 before the first command.
        """
        return np.maximum(np.searchsorted(self.t_cmd, np.asarray(at) + TIME_TOLERANCE_S, side="right") - 1, 0)

    def joints_where(self, hit: Bools) -> tuple[str, ...]:
        """Return the names of the joints that a mask marks.

        Args:
            hit: (J,) mask.

        Returns:
            The names, in the order of the log.
        """
        return tuple(name for name, one in zip(self.joints, hit, strict=True) if one)

    def without_feed_forward(self) -> Log:
        """Subtract the feed-forward torque from the measured torque.

        What remains is the response to measured angles and speeds: tau - tau_ff - kd dq_des, with
        the command in force at each state row.

        Returns:
            The log without `tau_ff` and `dq_des`; the same log if it holds no torque or no
            feed-forward.
        """
        speed = None if self.kd is None or self.dq_des is None else self.kd * self.dq_des
        asked = [torque for torque in (self.tau_ff, speed) if torque is not None]
        if self.tau is None or not asked:
            return self
        tau = self.tau - np.sum(asked, axis=0)[self.command_rows(self.t)]
        return attrs.evolve(self, tau=tau, tau_ff=None, dq_des=self.dq_des if speed is None else None)

    def holds_other_gains(self, gains: tuple[float, float] | None) -> bool:
        """Return whether `with_gains` would not use given gains, because the log has others.

        Args:
            gains: kp (N m/rad) and kd (N m s/rad), or None.

        Returns:
            True if the log has a gain that differs from the given one.
        """
        pairs = zip((self.kp, self.kd), gains or (), strict=False)
        return any(own is not None and bool(np.any(own != gain)) for own, gain in pairs)

    def with_gains(self, gains: tuple[float, float] | None) -> Log:
        """Fill in the commanded gains that the log does not hold.

        Args:
            gains: kp (N m/rad) and kd (N m s/rad), or None to change nothing.

        Returns:
            The log with gains; those that were logged stay.

        Raises:
            ValueError: A gain is negative or not finite.
        """
        if gains is None:
            return self
        if not np.isfinite(gains).all() or min(gains) < 0.0:
            raise ValueError(f"--gains: found {gains[0]:g} {gains[1]:g}, expected two gains of 0 or more")
        kp, kd = (np.broadcast_to(gain, self.q_des.shape) for gain in gains)
        return attrs.evolve(
            self, kp=kp if self.kp is None else self.kp, kd=kd if self.kd is None else self.kd
        )

    def select_rows(self, keep: Bools) -> Log:
        """Keep some of the state rows and all command rows.

        Args:
            keep: (N,) state rows to keep.

        Returns:
            The log with these state rows.
        """
        fields = ("t", "q", "dq", "valid", "tau", "temperature", "voltage")
        selected = {name: getattr(self, name)[keep] for name in fields if getattr(self, name) is not None}
        return attrs.evolve(self, **selected)

    def select_joints(self, joints: Sequence[str]) -> Log:
        """Keep some of the joints, in the given order.

        Args:
            joints: Names, with or without `_joint`.

        Returns:
            The log with these joints.

        Raises:
            LogError: The log does not hold one of the joints.
        """
        names = tuple(joint_name(name) for name in joints)
        for name in names:
            if name not in self.joints:
                raise LogError(f"{self.name}: joint_names: no '{name}', found {', '.join(self.joints)}")
        if names == self.joints:
            return self
        columns = [self.joints.index(name) for name in names]
        selected = {
            field.name: getattr(self, field.name)[:, columns]
            for field in attrs.fields(Log)
            if np.ndim(getattr(self, field.name)) == 2
        }
        return attrs.evolve(self, joints=names, **selected)

    def _check_time(self, field: str, time: Floats) -> None:
        if time.ndim != 1 or len(time) < MIN_ROWS:
            raise LogError(f"{self.name}: {field}: found shape {time.shape}, expected ({MIN_ROWS} or more,)")
        self._check_finite(field, time)
        steps = np.diff(time)
        backward = np.flatnonzero(steps <= 0.0)
        if backward.size:
            row = int(backward[0]) + 1
            raise LogError(
                f"{self.name}: {field}: the time does not rise from row {row - 1} to row {row} "
                f"({time[row - 1]:.6f} to {time[row]:.6f} s; {backward.size} of {steps.size} steps), "
                "expected rows in the order of time"
            )

    def _check_values(self, field: str, values: Floats | Bools | None, shape: tuple[int, ...]) -> None:
        if values is None:
            return
        if values.shape != shape:
            raise LogError(f"{self.name}: {field}: found shape {values.shape}, expected {shape}")
        self._check_finite(field, values)

    def _check_finite(self, field: str, values: Floats | Bools) -> None:
        finite = np.isfinite(values)
        if finite.all():
            return
        missing = np.argwhere(~finite)
        row = int(missing[0][0])
        joint = f"/{self.joints[missing[0][1]]}" if missing.shape[1] == 2 else ""
        raise LogError(
            f"{self.name}: {field}{joint}: {len(missing)} of {finite.size} values are not finite, "
            f"the first in row {row}, expected numbers (leave out rows without a measurement)"
        )
