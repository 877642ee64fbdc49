"""Everything that a recording holds about a run, on one time base. It knows no file formats.

`reading` reads the files. `signals` computes quantities from it that several causes use.
"""

from __future__ import annotations

from functools import cached_property

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices
from quadvel_description.robot import Robot
from quadvel_eval.recording import Series

SAME_INSTANT_S = 1e-6
"""Stamps that differ by less are equal."""


@attrs.frozen(eq=False)
class Commands:
    """Joint commands of a run: m rows, J joints. A command holds until the next one.

    Attributes:
        time: When each was sent, (m,), s.
        answers: Row of the state that each answers, (m,).
        q: Target angles, (m, J), rad.
        dq: Target speeds, (m, J), rad/s.
        tau: Feed-forward torques, (m, J), N m.
        kp: Stiffness, (m, J), N m/rad.
        kd: Damping, (m, J), N m s/rad.
        servo: Whether the drives track a position, (m,).
    """

    time: Array
    answers: Indices
    q: Array
    dq: Array
    tau: Array
    kp: Array
    kd: Array
    servo: Bools

    @property
    def target(self) -> Array:
        """Equilibrium angles without damping, q + tau / kp, (m, J), rad."""
        return self.q + np.divide(self.tau, self.kp, out=np.zeros_like(self.q), where=self.kp > 0.0)


@attrs.frozen(eq=False)
class Imu:
    """Inertial measurements at the states of a run.

    Attributes:
        quaternion: Orientation, body to world, (n, 4), w, x, y, z.
        angular_velocity: Body frame, (n, 3), rad/s.
        linear_acceleration: Body frame, (n, 3), m/s^2, gravity included.
    """

    quaternion: Array
    angular_velocity: Array
    linear_acceleration: Array


@attrs.frozen(eq=False)
class Modes:
    """Mode of the controller over time.

    Attributes:
        time: (k,), s.
        name: Name of the mode, (k,).
        fault: Name of the fault that stopped the robot, (k,); empty without one.
    """

    time: Array
    name: tuple[str, ...]
    fault: tuple[str, ...]

    def begins(self, mode: str) -> list[float]:
        """Return the times at which a mode was reported first, or again after another one, s.

        Args:
            mode: Name of the mode.

        Returns:
            The times.
        """
        pairs = zip(("", *self.name), self.name, strict=False)
        return [float(t) for t, (last, now) in zip(self.time, pairs, strict=True) if now == mode != last]

    @property
    def stopped_by(self) -> str:
        """Fault that keeps the robot stopped at the end of the run, empty without one.

        A fault that damps the joints replaces the one that made the robot stand.
        """
        return self.fault[-1]

    @property
    def recovered_from(self) -> tuple[str, ...]:
        """Faults that stopped the robot and were reset before the end of the run."""
        pairs = zip(self.fault, self.fault[1:], strict=False)
        return tuple(fault for fault, following in pairs if fault and not following)


@attrs.frozen(eq=False)
class Run:
    """A recorded run: n states of J joints and what else was recorded. Times are s since the first state.

    Attributes:
        name: Path of the recording.
        robot: The robot.
        joints: Names of the joints, (J,).
        time: Times of the states, (n,), s.
        q: Angles, (n, J), rad.
        dq: Speeds, (n, J), rad/s.
        tau: Torques that the drives report, (n, J), N m; None if not recorded.
        imu: Inertial measurements; None if not recorded.
        commands: The joint commands.
        estimate: Estimated velocity of the trunk, body frame, (k, 3), m/s; None if not recorded.
        velocity_command: vx, vy (m/s), wz (rad/s) and 1 to stand, (k, 4), before the limits of the policy.
        effective_command: The same after these limits, as the controller reports it.
        trim: What the controller adds to vx, vy (m/s) and wz (rad/s) of a constant command, (k, 3); None if not
            recorded.
        modes: Modes of the controller; None if not recorded.
        temperature: Temperatures of the motors, (k, J), deg C; None if not recorded.
        is_own: Whether the robot is the one of `quadvel_description`, so that its kinematics are known.
        remarks: Assumptions of the reader, one sentence each.
    """

    name: str
    robot: Robot
    joints: tuple[str, ...]
    time: Array
    q: Array
    dq: Array
    tau: Array | None
    imu: Imu | None
    commands: Commands
    estimate: Series | None = None
    velocity_command: Series | None = None
    effective_command: Series | None = None
    trim: Series | None = None
    modes: Modes | None = None
    temperature: Series | None = None
    is_own: bool = False
    remarks: tuple[str, ...] = ()

    @cached_property
    def period(self) -> float:
        """Median spacing of the states, s."""
        return float(np.median(np.diff(self.time)))

    @property
    def duration(self) -> float:
        """Time from the first state to the last, s."""
        return float(self.time[-1] - self.time[0])

    def command_rows(self, delay: float) -> Indices:
        """Return the command that acts at each state, for drives that receive commands late.

        Args:
            delay: Time from the sending of a command until it acts, s.

        Returns:
            Rows of the commands, (n,); -1 before the first acts.
        """
        return np.searchsorted(self.commands.time, self.time - delay + SAME_INSTANT_S, side="right") - 1

    @cached_property
    def walking(self) -> Bools:
        """States in which the policy drives, (n,)."""
        return self._in_modes("walk")

    @cached_property
    def on_feet(self) -> Bools:
        """States in which the robot walks or stands, (n,)."""
        return self._in_modes("walk", "stance")

    def _in_modes(self, *names: str) -> Bools:
        """States in one of these modes; without modes, those of servo commands."""
        if self.modes is None:
            rows = self.command_rows(0.0)
            return np.where(rows >= 0, self.commands.servo[np.maximum(rows, 0)], False)
        is_walk = np.array([name in names for name in self.modes.name])
        rows = np.searchsorted(self.modes.time, self.time + SAME_INSTANT_S, side="right") - 1
        return np.where(rows >= 0, is_walk[np.maximum(rows, 0)], False)
