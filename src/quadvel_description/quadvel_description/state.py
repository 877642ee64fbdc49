"""Records that packages exchange: state of the robot and command to its joints. No ROS.

`quadvel_nodes.messages` converts them to and from ROS messages, and `quadvel_driver` from packets.
"""

from __future__ import annotations

import attrs
import numpy as np

MODE_DAMPING = 0  # the drive brakes with kd and ignores kp and tau
MODE_SERVO = 10

_zeros = attrs.Factory(lambda: np.zeros(12))


@attrs.define
class RobotState:
    """State of the robot at `time`. Joint order as in `quadruped.JOINT_NAMES`.

    Attributes:
        time: Time of the sample, s.
        tick: The same in ms as a counter; wraps at 2^32.
        q: Joint positions, (12,), rad.
        dq: Joint velocities, (12,), rad/s.
        tau: Joint torques that the drives estimate, (12,), N m.
        quaternion: Orientation, body to world, (4,), (w, x, y, z).
        angular_velocity: Gyroscope in the body frame, (3,), rad/s.
        linear_acceleration: Accelerometer in the body frame, (3,), m/s^2; +9.81 in z at rest.
        foot_force: Normal force at each foot, (4,), N.
    """

    time: float
    tick: int
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    linear_acceleration: np.ndarray
    foot_force: np.ndarray


@attrs.define
class JointCommand:
    """Joint command: torque = tau + kp (q - q_measured) + kd (dq - dq_measured).

    Attributes:
        q: Target positions, (12,), rad.
        dq: Target velocities, (12,), rad/s.
        tau: Feed-forward torques, (12,), N m.
        kp: Proportional gains, (12,), N m/rad.
        kd: Damping gains, (12,), N m s/rad.
        mode: MODE_SERVO, or MODE_DAMPING in which the drives ignore `kp` and `tau`.
        tick: Tick of the state that this command answers.
    """

    q: np.ndarray = _zeros
    dq: np.ndarray = _zeros
    tau: np.ndarray = _zeros
    kp: np.ndarray = _zeros
    kd: np.ndarray = _zeros
    mode: int = MODE_SERVO
    tick: int = 0

    @property
    def target(self) -> np.ndarray:
        """Equilibrium positions of the command without damping, q + tau / kp, (12,), rad."""
        return self.q + np.divide(self.tau, self.kp, out=np.zeros_like(self.q), where=self.kp > 0)

    def torque(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Compute the commanded torque at a joint state.

        Args:
            q: Joint positions, (12,), rad.
            dq: Joint velocities, (12,), rad/s.

        Returns:
            Torques, (12,), N m.
        """
        return self.tau + self.kp * (self.q - q) + self.kd * (self.dq - dq)

    @classmethod
    def damping(cls, kd: float = 5.0, tick: int = 0) -> JointCommand:
        """Create a command that brakes every joint.

        Args:
            kd: Damping gain, N m s/rad.
            tick: Tick of the state that this command answers.

        Returns:
            The command.
        """
        return cls(kd=np.full(12, kd), mode=MODE_DAMPING, tick=tick)
