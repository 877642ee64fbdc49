"""Modes of the controller: damping, motion to a posture, and walking with the policy.

A mode has `enter` and `tick`. The supervisor decides which mode runs and what is unsafe.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Protocol

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array
from quadvel_description.kinematics import foot_positions, inverse_kinematics, rotate_inverse
from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand, RobotState

from .imported.metadata import ImportedMetadata
from .observation import JOINTS, PolicyMetadata
from .velocity_trim import VelocityTrim

LEAN_FILTER_S = 1.0
"""Time constant of the lean; a shorter one amplifies the sway of a standing robot (decision 50)."""
MAX_LEAN_RAD = 0.35
UP = np.array([0.0, 0.0, 1.0])


class Policy(Protocol):
    """Interface of a policy; `PolicyFile` and `ImportedPolicy` implement it."""

    @property
    def metadata(self) -> PolicyMetadata | ImportedMetadata:
        """Gains, rate, observer of the network's input, and action map."""

    def reset(self) -> None:
        """Reset the recurrent state."""

    def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run one step.

        Args:
            observation: The network input, (n,), as the observer of the metadata makes it.

        Returns:
            The raw action, (12,).
        """


@attrs.frozen
class ModeInput:
    """Input of a mode at one tick.

    Attributes:
        elapsed: Time since the mode was entered, s.
        state: The measured state.
        velocity: Velocity of the trunk, body frame, (3,), m/s; None without a fresh estimate.
        command: vx, vy (m/s), wz (rad/s), stance (0 or 1), within limits, (4,).
        previous: Joint command of the previous tick.
        filtered: Velocity of the supervisor's Kalman filter, body frame, (3,), m/s, some states old (`BATCH`);
            None without one.
    """

    elapsed: float
    state: RobotState
    velocity: Array | None
    command: Array
    previous: JointCommand
    filtered: Array | None = None


class Mode(Protocol):
    """Interface of a mode."""

    def enter(self, inputs: ModeInput) -> None:
        """Initialise the mode.

        Args:
            inputs: The first input.
        """

    def tick(self, inputs: ModeInput) -> JointCommand:
        """Compute the joint command of one tick.

        Args:
            inputs: The input.

        Returns:
            The joint command.
        """


def blend(a: JointCommand, b: JointCommand, share: float) -> JointCommand:
    """Interpolate two joint commands so that the torque is interpolated at any joint state.

        tau = (1 - s) tau_a + s tau_b  for  tau = kp (q_des - q) + kd (dq_des - dq) + tau_ff

    so kp = (1 - s) kp_a + s kp_b and q_des = ((1 - s) kp_a q_a + s kp_b q_b) / kp; kd and dq_des
    alike.

    Args:
        a: Command at share 0.
        b: Command at share 1.
        share: s, 0 to 1.

    Returns:
        The joint command.
    """
    kp_a, kp_b, kd_a, kd_b = (1 - share) * a.kp, share * b.kp, (1 - share) * a.kd, share * b.kd
    kp, kd = kp_a + kp_b, kd_a + kd_b
    return JointCommand(
        q=np.divide(kp_a * a.q + kp_b * b.q, kp, out=b.q.copy(), where=kp > 0),
        dq=np.divide(kd_a * a.dq + kd_b * b.dq, kd, out=b.dq.copy(), where=kd > 0),
        tau=(1 - share) * a.tau + share * b.tau,
        kp=kp,
        kd=kd,
    )


class Damping:
    """Damps all joints."""

    def __init__(self, kd: float) -> None:
        """Create the mode.

        Args:
            kd: Damping gain, N m s/rad.
        """
        self._kd = kd

    def enter(self, inputs: ModeInput) -> None:
        """Do nothing.

        Args:
            inputs: Not used.
        """

    def tick(self, inputs: ModeInput) -> JointCommand:
        """Return the damping command.

        Args:
            inputs: Not used.

        Returns:
            The joint command.
        """
        return JointCommand.damping(self._kd)


def vertical_offset(state: RobotState) -> Array:
    """Compute the offset of the vertical from the trunk's own z axis, 1 m below the trunk's origin.

    Args:
        state: The measured state.

    Returns:
        Offset forward and to the left in the trunk frame, (2,), m, limited to an angle of
        MAX_LEAN_RAD.
    """
    forward, left, up = -rotate_inverse(state.quaternion, UP)
    difference = np.array([forward, left]) / max(-up, math.cos(MAX_LEAN_RAD))
    return difference * min(1.0, math.tan(MAX_LEAN_RAD) / max(math.hypot(*difference), 1e-9))


class Posture:
    """Moves smoothly through postures and holds the last one, with the feet below the trunk on slopes.

    The feet are shifted uphill or downhill by the tilt of the trunk, which is low-pass filtered
    with LEAN_FILTER_S and limited to MAX_LEAN_RAD. The path starts at the targets for which the
    gains give the torque of the previous command, so the torque does not jump; afterwards its rate
    is at most kp times the speed of the path.
    """

    def __init__(self, robot: Robot, path: Sequence[tuple[float, Array]], kp: float, kd: float) -> None:
        """Create the mode.

        Args:
            robot: The robot.
            path: Duration (s) and joint angles (12,) rad of each posture, on level ground.
            kp: Stiffness of each joint, N m/rad.
            kd: Damping of each joint, N m s/rad.
        """
        self._robot = robot
        self._times = np.cumsum([0.0, *(seconds for seconds, _ in path)])
        self._postures = np.array([np.zeros(JOINTS), *(q for _, q in path)])
        self._feet = foot_positions(robot, self._postures[1:])
        # Difference to the inverse kinematics, not zero if a knee bends the other way.
        self._offset = self._postures[1:] - inverse_kinematics(robot, self._feet)
        self._kp, self._kd = np.full(JOINTS, kp), np.full(JOINTS, kd)
        self._lean, self._lean_updated_at = np.zeros(2), 0.0

    def final_posture(self, state: RobotState) -> Array:
        """Compute the last posture for the present tilt of the trunk.

        Args:
            state: The measured state.

        Returns:
            Joint angles, (12,), rad.
        """
        goal: Array = self._lean_postures(vertical_offset(state))[-1]
        return goal

    def is_finished(self, elapsed: float) -> bool:
        """Return whether the path has ended.

        Args:
            elapsed: Time since the mode was entered, s.

        Returns:
            True at the end of the path.
        """
        return bool(elapsed >= self._times[-1])

    def enter(self, inputs: ModeInput) -> None:
        """Set the start of the path from the measured joints and the previous command.

            q_0 = q + (kp_prev (q_des,prev - q) + tau_ff,prev) / kp

        Args:
            inputs: The first input.
        """
        measured, requested = inputs.state.q, inputs.previous
        self._postures[0] = measured + (requested.kp * (requested.q - measured) + requested.tau) / self._kp
        self._lean, self._lean_updated_at = vertical_offset(inputs.state), inputs.elapsed

    def tick(self, inputs: ModeInput) -> JointCommand:
        """Return the posture on the path at this time.

        The tilt is low-pass filtered: lean' = lean + (1 - exp(-dt / LEAN_FILTER_S)) (offset -
        lean).

        Args:
            inputs: The input.

        Returns:
            The joint command.
        """
        share = 1.0 - math.exp(-max(inputs.elapsed - self._lean_updated_at, 0.0) / LEAN_FILTER_S)
        self._lean, self._lean_updated_at = (
            self._lean + share * (vertical_offset(inputs.state) - self._lean),
            inputs.elapsed,
        )
        self._postures[1:] = self._lean_postures(self._lean)
        q, dq = self._interpolate(inputs.elapsed)
        return JointCommand(q=q, dq=dq, kp=self._kp, kd=self._kd)

    def _lean_postures(self, lean: Array) -> Array:
        """Return the postures of the path, (n, 12), rad, for an offset of the vertical (`vertical_offset`)."""
        feet = self._feet.copy()
        feet[..., :2] -= feet[..., 2:].mean(axis=1, keepdims=True) * lean
        leaning: Array = inverse_kinematics(self._robot, feet) + self._offset
        return leaning

    def _interpolate(self, elapsed: float) -> tuple[Array, Array]:
        """Interpolate the path with quintic polynomials: q (rad) and dq (rad/s), at rest at each posture.

        q(s) = q_a + (10 s^3 - 15 s^4 + 6 s^5) (q_b - q_a),   dq = 30 s^2 (1 - s)^2 (q_b - q_a) / T
        """
        if self.is_finished(elapsed):
            return self._postures[-1].copy(), np.zeros(JOINTS)
        leg = int(np.searchsorted(self._times, elapsed, side="right"))
        seconds = self._times[leg] - self._times[leg - 1]
        s = (elapsed - self._times[leg - 1]) / seconds
        difference = self._postures[leg] - self._postures[leg - 1]
        progress = s**3 * (10 - 15 * s + 6 * s**2)
        speed = 30 * s**2 * (1 - s) ** 2 / seconds
        return self._postures[leg - 1] + progress * difference, speed * difference


class Walk:
    """Runs the policy; its torques fade in over `blend_time` after the entry.

    A policy with a lower rate than the control loop runs at some ticks; its targets are held at the
    others. Constant commands are trimmed (`velocity_trim`), but not those of an imported policy, with
    which the trim was not measured.

    Attributes:
        inference_seconds: Duration of the last network step, s; NaN before the first.
    """

    def __init__(self, policy: Policy, blend_time: float, max_trim: float = 0.0) -> None:
        """Create the mode.

        Args:
            policy: The policy.
            blend_time: Duration of the fade-in, s.
            max_trim: Largest trim of each axis of the velocity command, m/s and rad/s.
        """
        self._policy = policy
        self._blend_time = blend_time
        meta = policy.metadata
        self._trim = VelocityTrim(meta.limits, max_trim if isinstance(meta, PolicyMetadata) else 0.0)
        self._observer, self._action = meta.observer, meta.action
        self._ticks_per_step = meta.ticks_per_step
        self._kp, self._kd = np.array(meta.kp), np.array(meta.kd)
        self._fade_from = JointCommand.damping()
        self.inference_seconds = float("nan")
        self.reset()

    @property
    def trim(self) -> tuple[float, float, float]:
        """What is added to the commanded vx, vy (m/s) and wz (rad/s) now."""
        return self._trim.trim

    def reset(self) -> None:
        """Reset the policy's recurrent state, past observations and previous action, and the trim."""
        self._policy.reset()
        self._trim.reset()
        self._observer.reset()
        self._previous_action = np.zeros(JOINTS, np.float32)
        self._held_ticks = self._ticks_per_step  # the next tick runs the network

    def enter(self, inputs: ModeInput) -> None:
        """Reset the policy and keep the previous command for the fade-in.

        Args:
            inputs: The first input.
        """
        self.reset()
        self._fade_from = inputs.previous

    def tick(self, inputs: ModeInput) -> JointCommand:
        """Run one step of the policy, if one is due.

        Args:
            inputs: The input, with a velocity.

        Returns:
            The joint command.

        Raises:
            FloatingPointError: The output of the policy is not finite.
        """
        assert inputs.velocity is not None  # the supervisor does not walk without one
        state, velocity = inputs.state, inputs.velocity
        measured = velocity if inputs.filtered is None else inputs.filtered
        command = self._trim.apply(inputs.command, measured, float(state.angular_velocity[2]))
        if self._held_ticks == self._ticks_per_step:
            observation = self._observer.observe(state, velocity, command, self._previous_action)
            start = time.perf_counter()
            self._previous_action = self._policy.step(observation)
            self.inference_seconds = time.perf_counter() - start
            self._held_ticks = 0
        self._held_ticks += 1
        requested = JointCommand(q=self._action.targets(self._previous_action), kp=self._kp, kd=self._kd)
        if inputs.elapsed < self._blend_time:
            return blend(self._fade_from, requested, inputs.elapsed / self._blend_time)
        return requested
