"""Rewards of Table 2, per tick.

Where the printed formula must be a misprint, docs/decisions/0004 gives the reading used here.
"""

from __future__ import annotations

import attrs
import numpy as np

from .env import HEAT_LOSS_W_PER_N2M2, TICK_S, VelocityEnv
from .walking_rewards import hip_deviation

OVERSPEED_SHARE = 0.9  # of a joint's speed limit; `overspeed` penalises more


@attrs.frozen
class RewardWeights:
    """Coefficients of Table 2, and of rewards that are not in it.

    Attributes:
        linear_tracking: exp(-e^2 / width^2) of the velocity error in xy.
        angular_tracking: exp(-e^2 / width^2) of the yaw rate error.
        orientation: penalty of |roll| + |pitch|, 1/rad.
        torso_stability: penalty, s/rad and s/m, of roll and pitch rate and of vertical speed.
        joint_velocity: penalty, s^2/rad^2, of squared joint velocities.
        joint_acceleration: penalty, s^4/rad^2, of squared joint accelerations.
        slippage: penalty, s^2/m^2, of the squared horizontal speed of feet in contact.
        energy: penalty of the power of the joints, 1/W.
        velocity_compensation: reward, s/m, for speed along the command, up to the commanded speed.
        alive: constant.
        foot_lift_time: reward at touchdown for time in the air beyond 0.2 s, at low speed.
        foot_clearance: reward for clearance of feet in the air up to 0.05 m, at low speed.
        action_smoothness: penalty of the second difference of the action (Section 4.4), for the
            recipes without constraints.
        hips: penalty of hips away from straight down (not in Table 2).
        overspeed: penalty of joint speeds beyond `OVERSPEED_SHARE` of their limit (not in Table 2).
        stillness: penalty of motion in stance (not in Table 2).
        posture: penalty in stance of joints away from the nominal posture (not in Table 2).
        tracking_width: m/s and rad/s, width of the tracking rewards; 1 in Table 2.
    """

    linear_tracking: float = 0.5
    angular_tracking: float = 0.2
    orientation: float = 0.1
    torso_stability: float = 0.1
    joint_velocity: float = 1.0e-4
    joint_acceleration: float = 1.5e-8
    slippage: float = 0.1
    energy: float = 3e-4
    velocity_compensation: float = 0.3
    alive: float = 0.8
    foot_lift_time: float = 1.0
    foot_clearance: float = 3.0
    action_smoothness: float = 0.0
    hips: float = 0.0
    overspeed: float = 0.0
    stillness: float = 0.0
    posture: float = 0.0
    tracking_width: float = 1.0


class Table2:
    """Rewards of a batch of environments, with the memory that some of them need."""

    def __init__(self, env: VelocityEnv, weights: RewardWeights) -> None:
        """Create the rewards without a past.

        Args:
            env: environments.
            weights: coefficients.
        """
        self.env, self.weights = env, weights
        n = env.config.n
        self._dq = np.zeros((n, 12))
        self._air_time = np.zeros((n, 4))
        self._actions = np.zeros((2, n, 12))

    def reset(self, ids: np.ndarray) -> None:
        """Clear the past of some environments.

        Args:
            ids: their indices.
        """
        self._dq[ids], self._air_time[ids], self._actions[:, ids] = self.env.dq[ids], 0.0, 0.0

    def terms(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Evaluate all rewards of the present state, without their weights.

        Call it once after each tick.

        Args:
            action: (n, 12), action of the tick, in the network's unit.

        Returns:
            Rewards by name, (n,) each; penalties are negative.
        """
        env, c, width = self.env, self.env.command, self.weights.tracking_width
        v, w = env.velocity, env.angular_velocity
        # v, w: velocity (m/s) and angular velocity (rad/s) in the body frame; c: command (vx, vy,
        # wz, stance)
        #     decay = max(1 - |c_xy|^2, 0) while walking
        #     lift time = sum over touchdowns of min(t_air - 0.2, 0.5)
        #     power = max(k_r tau^2 + tau dq, 0)
        #     bend = a[t] - 2 a[t-1] + a[t-2]
        walking = c[:, 3] < 0.5
        decay = np.maximum(1.0 - np.sum(c[:, :2] ** 2, axis=1), 0.0) * walking
        landed = env.contact & (self._air_time > 0.0)
        lift_time = np.minimum(self._air_time - 0.2, 0.5) * landed
        clearance = np.clip(env.clearance, 0.0, 0.05) * ~env.contact
        acceleration = (env.dq - self._dq) / TICK_S
        along = np.clip(v[:, :2] * np.sign(c[:, :2]), 0.0, np.abs(c[:, :2]))
        power = np.maximum(HEAT_LOSS_W_PER_N2M2 * env.torque**2 + env.torque * env.dq, 0.0)
        bend = action - 2 * self._actions[0] + self._actions[1]
        terms = {
            "linear_tracking": np.exp(-np.sum((c[:, :2] - v[:, :2]) ** 2, axis=1) / width**2),
            "angular_tracking": np.exp(-((c[:, 2] - w[:, 2]) ** 2) / width**2),
            "orientation": -np.abs(env.roll_pitch).sum(axis=1),
            "torso_stability": -np.hypot(w[:, 0], w[:, 1]) - np.abs(v[:, 2]),
            "joint_velocity": -np.sum(env.dq**2, axis=1),
            "joint_acceleration": -np.sum(acceleration**2, axis=1),
            "slippage": -np.sum(np.sum(env.foot_velocity[..., :2] ** 2, axis=-1) * env.contact, axis=1),
            "energy": -power.sum(axis=1),
            "velocity_compensation": np.hypot(along[:, 0], along[:, 1]),
            "alive": np.ones(len(c)),
            "foot_lift_time": lift_time.sum(axis=1) * decay,
            "foot_clearance": clearance.sum(axis=1) * decay,
            "action_smoothness": -np.abs(bend).sum(axis=1),
            "hips": -hip_deviation(env, c),
            "overspeed": -np.maximum(np.abs(env.dq) - OVERSPEED_SHARE * env.robot.velocity_limit, 0.0).sum(
                axis=1
            ),
            "posture": -np.abs(env.q - env.robot.nominal_q).sum(axis=1) * ~walking,
            "stillness": -(np.hypot(v[:, 0], v[:, 1]) + 0.05 * np.abs(env.dq).sum(axis=1)) * ~walking,
        }
        self._air_time = np.where(env.contact, 0.0, self._air_time + TICK_S)
        self._dq = env.dq
        self._actions = np.stack([action, self._actions[0]])
        return terms

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """Sum the weighted rewards of the present state; call it once after each tick.

        Args:
            action: (n, 12), action of the tick, in the network's unit.

        Returns:
            (n,).
        """
        terms = self.terms(action)
        return np.sum([getattr(self.weights, name) * value for name, value in terms.items()], axis=0)
