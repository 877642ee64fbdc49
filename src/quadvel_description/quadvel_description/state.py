"""Plain records that cross package borders: what the robot reports and what its joints are asked for. No ROS."""

from __future__ import annotations

import attrs
import numpy as np

MODE_DAMPING = 0  # the drive brakes with kd and ignores kp and tau
MODE_SERVO = 10

_zeros = attrs.Factory(lambda: np.zeros(12))


@attrs.define
class RobotState:
    """One sample of the robot; every quantity held at `time`. Joint order as in `robot.JOINT_NAMES`."""

    time: float  # s
    tick: int  # ms, wraps at 2^32
    q: np.ndarray  # (12,) rad
    dq: np.ndarray  # (12,) rad/s
    tau: np.ndarray  # (12,) N m, the drives' own estimate
    quaternion: np.ndarray  # (4,) w, x, y, z, body to world
    angular_velocity: np.ndarray  # (3,) rad/s, body frame
    linear_acceleration: np.ndarray  # (3,) m/s^2, body frame, +9.81 in z at rest
    foot_force: np.ndarray  # (4,) N


@attrs.define
class JointCommand:
    """What the drives are asked for: torque = tau + kp (q - q_measured) + kd (dq - dq_measured)."""

    q: np.ndarray = _zeros  # (12,) rad
    dq: np.ndarray = _zeros  # (12,) rad/s
    tau: np.ndarray = _zeros  # (12,) N m
    kp: np.ndarray = _zeros  # (12,) N m/rad
    kd: np.ndarray = _zeros  # (12,) N m s/rad
    mode: int = MODE_SERVO
    tick: int = 0  # tick of the state that this answers

    @property
    def target(self) -> np.ndarray:
        """The angles (12,) rad at which the drives would push as little as without a target: q + tau / kp."""
        return self.q + np.divide(self.tau, self.kp, out=np.zeros_like(self.q), where=self.kp > 0)

    def torque(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """The torque (12,) N m that is asked for where the joints are: q (12,) rad, dq (12,) rad/s."""
        return self.tau + self.kp * (self.q - q) + self.kd * (self.dq - dq)

    @classmethod
    def damping(cls, kd: float = 5.0, tick: int = 0) -> JointCommand:
        """Brake every joint."""
        return cls(kd=np.full(12, kd), mode=MODE_DAMPING, tick=tick)
