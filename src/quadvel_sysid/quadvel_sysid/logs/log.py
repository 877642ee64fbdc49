"""A measured log of joints, whatever file it came from; `read_log` makes one of a path.

Here stands what a log has to be before anything can be computed from it: shapes that fit, finite numbers, times
that rise. What a well-formed log says about the robot is for `checks.py`; the formats are in `recordings.py`
(MCAP, rosbag2, ROS 1) and `tables.py` (all others, read by `files.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

ALMOST = 1e-9
"""s: a command counts that is sent no later than this after an instant, which is a sum of rounded numbers."""

GAP = 3.5
"""Times the usual spacing, beyond which rows are no neighbours: memories, slopes and replays begin anew there."""

LEAST_ROWS = 10
"""Fewer samples say nothing about a joint."""


class LogError(ValueError):
    """What is wrong with a log: one sentence that names the file and the field."""


def joint_name(name: str) -> str:
    """The name with `_joint` at its end."""
    return name if name.endswith("_joint") else f"{name}_joint"


@attrs.frozen(eq=False)
class Log:
    """J joints, state rows (N,) and command rows (M,) on time bases of their own; SI units.

    A row holds what was at its time; a command counts from its time until the next. Times rise strictly and all
    numbers are finite: building a Log that breaks this raises LogError. Floats are double precision, single in
    a log of more than `raw.LONG` values: cast before solving with them.
    """

    name: str  # the file
    joints: tuple[str, ...]  # (J,), each ends in _joint
    t: Array  # (N,) s
    q: Array  # (N, J) rad
    dq: Array  # (N, J) rad/s
    t_cmd: Array  # (M,) s
    q_des: Array  # (M, J) rad
    valid: Bools  # (N, J), false: not to be explained
    tau: Array | None = None  # (N, J) N m
    temperature: Array | None = None  # (N, J) degrees Celsius
    voltage: Array | None = None  # (N,) V
    dq_des: Array | None = None  # (M, J) rad/s
    tau_ff: Array | None = None  # (M, J) N m
    kp: Array | None = None  # (M, J) N m/rad
    kd: Array | None = None  # (M, J) N m s/rad
    began: float | None = None  # s, of a piece: when the whole log began
    remarks: tuple[str, ...] = ()  # what the reader had to assume
    warnings: tuple[str, ...] = ()  # what it found that is to be read with care
    made: tuple[str, ...] = ()  # fields that the file did not hold, such as a dq that is made from q

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
        """From the first state to the last, s."""
        return float(self.t[-1] - self.t[0])

    @property
    def period(self) -> float:
        """The median spacing of the states, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def after_gap(self) -> Bools:
        """Which rows (N,) follow a gap."""
        after: Bools = np.diff(self.t, prepend=self.t[0]) > GAP * self.period
        return after

    def command_rows(self, at: Array) -> NDArray[np.intp]:
        """The command row that counts at the times `at`, s, the first one before there is any; shape of `at`."""
        return np.maximum(np.searchsorted(self.t_cmd, np.asarray(at) + ALMOST, side="right") - 1, 0)

    def without_feed_forward(self) -> Log:
        """The log with the torque alone that answers angles and speeds: less what `tau_ff` and `dq_des` in force ask for."""
        speed = None if self.kd is None or self.dq_des is None else self.kd * self.dq_des
        asked = [torque for torque in (self.tau_ff, speed) if torque is not None]
        if self.tau is None or not asked:
            return self
        tau = self.tau - np.sum(asked, axis=0)[self.command_rows(self.t)]
        return attrs.evolve(self, tau=tau, tau_ff=None, dq_des=self.dq_des if speed is None else None)

    def with_gains(self, gains: tuple[float, float] | None) -> Log:
        """The log with these commanded gains, kp and kd, where it holds none. Raises ValueError."""
        if gains is None:
            return self
        if not np.isfinite(gains).all() or min(gains) < 0.0:
            raise ValueError(f"--gains: found {gains[0]:g} {gains[1]:g}, expected two gains of 0 or more")
        kp, kd = (np.broadcast_to(gain, self.q_des.shape) for gain in gains)
        return attrs.evolve(
            self, kp=kp if self.kp is None else self.kp, kd=kd if self.kd is None else self.kd
        )

    def of_rows(self, keep: Bools) -> Log:
        """The log with the state rows that `keep` (N,) names; the commands stay."""
        fields = ("t", "q", "dq", "valid", "tau", "temperature", "voltage")
        taken = {name: getattr(self, name)[keep] for name in fields if getattr(self, name) is not None}
        return attrs.evolve(self, **taken)

    def select(self, joints: Sequence[str]) -> Log:
        """The log with these joints only, in this order. Raises LogError for one that it does not hold."""
        names = tuple(joint_name(name) for name in joints)
        for name in names:
            if name not in self.joints:
                raise LogError(f"{self.name}: joint_names: no '{name}', found {', '.join(self.joints)}")
        if names == self.joints:
            return self
        columns = [self.joints.index(name) for name in names]
        taken = {
            field.name: getattr(self, field.name)[:, columns]
            for field in attrs.fields(Log)
            if np.ndim(getattr(self, field.name)) == 2
        }
        return attrs.evolve(self, joints=names, **taken)

    def _check_time(self, field: str, time: Array) -> None:
        if time.ndim != 1 or len(time) < LEAST_ROWS:
            raise LogError(
                f"{self.name}: {field}: found shape {time.shape}, expected ({LEAST_ROWS} or more,)"
            )
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

    def _check_values(self, field: str, values: Array | Bools | None, shape: tuple[int, ...]) -> None:
        if values is None:
            return
        if values.shape != shape:
            raise LogError(f"{self.name}: {field}: found shape {values.shape}, expected {shape}")
        self._check_finite(field, values)

    def _check_finite(self, field: str, values: Array | Bools) -> None:
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
