"""The rewards of Table 2, a tick. Where the printed formula cannot be meant, the reading is listed in docs/decisions/0004."""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description import robot

from .env import HEAT, TICK, VelocityEnv
from .walking_rewards import hips_astray

FAST = 0.9  # share of the speed of a joint's drive, beyond which `overspeed` fines it


@attrs.frozen
class RewardWeights:
    """Coefficients of Table 2.

    `action_smoothness` is Section 4.4's, for the recipes without constraints. Five are our own: `tracking_width`, within
    which the tracking rewards tell errors apart (1 is Table 2's), `hips` against hips away from straight down, `overspeed`
    against joints that move nearly as fast as their drives can or faster, and, in stance, `stillness` against motion and
    `posture` against joints that are not where they are in the nominal posture.
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
    tracking_width: float = 1.0  # m/s, rad/s


class Table2:
    """The rewards of a batch of environments; remembers what needs a past."""

    def __init__(self, env: VelocityEnv, weights: RewardWeights) -> None:
        self.env, self.weights = env, weights
        n = env.config.n
        self._dq = np.zeros((n, 12))
        self._air_time = np.zeros((n, 4))
        self._actions = np.zeros((2, n, 12))

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        self._dq[ids], self._air_time[ids], self._actions[:, ids] = self.env.dq[ids], 0.0, 0.0

    def terms(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Each term of the state after a tick with `action` (n, 12), unweighted, (n,)."""
        env, c, width = self.env, self.env.command, self.weights.tracking_width
        v, w = env.velocity, env.angular_velocity
        walking = c[:, 3] < 0.5
        decay = np.maximum(1.0 - np.sum(c[:, :2] ** 2, axis=1), 0.0) * walking
        landed = env.contact & (self._air_time > 0.0)
        lift_time = np.minimum(self._air_time - 0.2, 0.5) * landed
        clearance = np.clip(env.clearance, 0.0, 0.05) * ~env.contact
        acceleration = (env.dq - self._dq) / TICK
        along = np.clip(v[:, :2] * np.sign(c[:, :2]), 0.0, np.abs(c[:, :2]))
        power = np.maximum(HEAT * env.torque**2 + env.torque * env.dq, 0.0)
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
            "hips": -hips_astray(env, c),
            "overspeed": -np.maximum(np.abs(env.dq) - FAST * robot.VELOCITY_LIMIT, 0.0).sum(axis=1),
            "posture": -np.abs(env.q - robot.NOMINAL_Q).sum(axis=1) * ~walking,
            "stillness": -(np.hypot(v[:, 0], v[:, 1]) + 0.05 * np.abs(env.dq).sum(axis=1)) * ~walking,
        }
        self._air_time = np.where(env.contact, 0.0, self._air_time + TICK)
        self._dq = env.dq
        self._actions = np.stack([action, self._actions[0]])
        return terms

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """The weighted sum, (n,)."""
        terms = self.terms(action)
        return np.sum([getattr(self.weights, name) * value for name, value in terms.items()], axis=0)
