"""Rewards of the teacher: track commands in xy and yaw with a quiet trunk and a trot.

A clock plans when each foot is on the ground (`gait_clock`). Where feet land and how joints move is
left to the policy.
"""

from __future__ import annotations

import attrs
import numpy as np

from .env import VelocityEnv
from .gait_clock import foot_pace
from .past import Past

SAMPLE_S = 0.02  # how long the teacher holds an action
MIN_REWARD, MAX_REWARD = -6.0, 4.0  # bounds of a sample's sum of terms, without falls
TARGET_HEIGHT_M = 0.36  # of the trunk; of a robot of the reference size, as the next one (`similarity`)
SWING_CLEARANCE_M = 0.06  # wanted clearance in swing
OVERSPEED_SHARE = 0.8  # of a joint's speed limit; `overspeed` penalises more,
MAX_BEYOND = 8.0  # rad/s, up to this excess


def error_magnitudes(error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Magnitudes of velocity errors.

    Args:
        error: (n, 3), vx, vy in m/s, yaw rate in rad/s.

    Returns:
        In xy (n,), m/s, and in yaw (n,), rad/s.
    """
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def hip_deviation(env: VelocityEnv, command: np.ndarray) -> np.ndarray:
    """Deviation of the hips from straight down, less with sideways commands.

    Feet close to the middle cost the least energy, but the robot tips over easily.

    Args:
        env: environments.
        command: (n, 4).

    Returns:
        (n,), rad, sum of the four hips.
    """
    astray = np.abs(env.q[:, ::3]).sum(axis=1)
    # sum |q_hip| / (1 + 2 |vy|)
    return np.asarray(astray / (1.0 + 2.0 * np.abs(command[:, 1])))


@attrs.frozen
class WalkingWeights:
    """Weights of the rewards of one teacher sample; penalties have positive weights here.

    e is the velocity error, c the command.

    Attributes:
        linear: exp(-e^2 / (0.25 m^2/s^2 (1 + |c| / 2))), xy.
        linear_narrow: exp(-e^2 / 0.09 m^2/s^2), xy: as wide as the velocity swings within a slow
            step.
        angular: exp(-e^2 / (0.25 rad^2/s^2 (1 + |c| / 4))), yaw.
        angular_narrow: exp(-e^2 / 0.04 rad^2/s^2), yaw.
        stride_linear: penalty, s/m, of the error low-passed over 0.35 s (`STRIDE_S`), xy.
        stride_angular: penalty, s/rad, of the error over a stride, yaw.
        lasting_linear: penalty, s/m, of the error low-passed over 1.5 s (`LASTING_S`), xy.
        lasting_angular: penalty, s/rad, of the lasting error, yaw.
        steady: exp(-(e / 0.06)^2) of the lasting error, xy and yaw.
        bounce: penalty, s^2/m^2, of the trunk's speed along its own z axis, squared.
        rocking: penalty, s^2/rad^2, of roll and pitch rate squared.
        tilt: penalty, 1/rad^2, of roll and pitch relative to the ground, squared.
        height: penalty, 1/m^2, of the height error squared.
        power: penalty, 1/W; at speed |c| divided by 1 + |c| / 2.
        acceleration: penalty, s^4/rad^2, of joint accelerations squared.
        rate: penalty of the change of the action squared.
        bend: penalty of the second difference of the action squared.
        schedule: reward for feet on the ground or in the air as planned, 1 for all four.
        lift: reward for the clearance of feet in their planned swing, up to `SWING_CLEARANCE_M` in
            the middle of it, 1 for all four.
        slip: penalty, s/m, of the speed of feet in contact.
        off_hip: penalty, 1/m, at lift-off: distance of the middle of a foot's stance from the hip.
        sway: penalty, s^2/m^2, of the sideways velocity relative to its mean over a stride,
            squared.
        roll: penalty, s^2/rad^2, of the roll rate squared.
        overspeed: penalty, s/rad, of joint speeds beyond `OVERSPEED_SHARE` of their limit.
        slow: factor of `power` at rest; falls to 1 at 1 m/s.
        hips: penalty, 1/rad, of `hip_deviation`.
        posture: penalty in stance, 1/rad, of joints away from the nominal posture.
        step: penalty in stance for each foot in the air.
        fidget: penalty in stance, s^2/rad^2, of joint speeds squared.
        constant: added to each sample. It brings the sum near 0: the return that is lost by a fall
            is then small, and so is the noise that falls by pushes bring into all gradients.
        fall: penalty of a fall.
        scale: factor of the sum.
    """

    linear: float = 1.2
    linear_narrow: float = 0.5
    angular: float = 0.6
    angular_narrow: float = 0.25
    stride_linear: float = 1.0
    stride_angular: float = 0.5
    lasting_linear: float = 1.0
    lasting_angular: float = 0.5
    steady: float = 0.3
    bounce: float = 0.6
    rocking: float = 0.03
    tilt: float = 2.0
    height: float = 30.0
    power: float = 6e-4
    acceleration: float = 2e-7
    rate: float = 0.012
    bend: float = 0.008
    schedule: float = 1.5
    lift: float = 1.5
    slip: float = 0.06
    off_hip: float = 4.0
    sway: float = 10.0
    roll: float = 0.1
    overspeed: float = 1.0
    slow: float = 5.0
    hips: float = 1.0
    posture: float = 0.2
    step: float = 0.1
    fidget: float = 1e-3
    constant: float = -1.2
    fall: float = 10.0
    scale: float = 0.5


class WalkingRewards:
    """Rewards of a batch of robots, with the joint speeds of the sample before.

    Attributes:
        env: environments.
        weights: weights.
    """

    def __init__(self, env: VelocityEnv, weights: WalkingWeights) -> None:
        """Create the rewards without a past.

        Args:
            env: environments.
            weights: weights.
        """
        self.env, self.weights = env, weights
        self._dq = env.dq.copy()

    def reset(self, ids: np.ndarray) -> None:
        """Clear the past of some environments.

        Args:
            ids: their indices.
        """
        self._dq[ids] = self.env.dq[ids]

    def total(self, terms: dict[str, np.ndarray], fell: np.ndarray) -> np.ndarray:
        """Sum rewards, bounded, and subtract the penalty of a fall.

        Args:
            terms: weighted rewards, (n,) each.
            fell: (n,) bool.

        Returns:
            (n,).
        """
        w = self.weights
        # R = scale (clip(sum of terms, MIN_REWARD, MAX_REWARD) - fall [fell])
        bounded = np.clip(np.sum(list(terms.values()), axis=0), MIN_REWARD, MAX_REWARD)
        return np.asarray(w.scale * (bounded - w.fall * fell))

    def terms(self, command: np.ndarray, past: Past, actions: np.ndarray) -> dict[str, np.ndarray]:
        """Evaluate all weighted rewards after a sample; call it once per sample.

        Args:
            command: (n, 4), command in force: vx, vy (m/s), yaw rate (rad/s), 1 to stand.
            past: low-passed errors and foot timing of the robots.
            actions: (3, n, 12), of this sample and the two before.

        Returns:
            Weighted rewards by name, (n,) each.
        """
        walking = past.clock.walking
        terms = self._tracking(command, past) | self._body(command, actions)
        on_feet = self._feet(command, past) | self._gait(command, past)
        terms |= {name: value * walking for name, value in on_feet.items()}
        terms |= {name: value * ~walking for name, value in self._stance().items()}
        return terms

    def _tracking(self, command: np.ndarray, past: Past) -> dict[str, np.ndarray]:
        """Rewards of tracking; formulas in `WalkingWeights`."""
        env, w = self.env, self.weights
        xy = np.sum((command[:, :2] - env.velocity[:, :2]) ** 2, axis=1)
        wz = (command[:, 2] - env.angular_velocity[:, 2]) ** 2
        speed, turn = np.hypot(command[:, 0], command[:, 1]), np.abs(command[:, 2])
        stride_xy, stride_wz = error_magnitudes(past.stride)
        lasting_xy, lasting_wz = error_magnitudes(past.lasting)
        return {
            "linear": w.linear * np.exp(-xy / (0.25 * (1 + 0.5 * speed)))
            + w.linear_narrow * np.exp(-xy / 0.09),
            "angular": w.angular * np.exp(-wz / (0.25 * (1 + 0.25 * turn)))
            + w.angular_narrow * np.exp(-wz / 0.04),
            "stride": -w.stride_linear * stride_xy - w.stride_angular * stride_wz,
            "lasting": -w.lasting_linear * lasting_xy - w.lasting_angular * lasting_wz,
            "steady": w.steady * (np.exp(-((lasting_xy / 0.06) ** 2)) + np.exp(-((lasting_wz / 0.06) ** 2))),
        }

    def _body(self, command: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
        """Rewards of trunk motion and smoothness."""
        env, w = self.env, self.weights
        acceleration = (env.dq - self._dq) / env.config.period
        self._dq = env.dq.copy()
        speed = np.hypot(command[:, 0], command[:, 1])
        now, before, earlier = actions
        return {
            "bounce": -w.bounce * env.velocity[:, 2] ** 2
            - w.rocking * np.sum(env.angular_velocity[:, :2] ** 2, axis=1),
            "tilt": -w.tilt * np.sum((env.roll_pitch - env.ground_lean) ** 2, axis=1),
            "height": -w.height * np.minimum((env.height - TARGET_HEIGHT_M * env.size.length) ** 2, 0.02),
            "power": -w.power * self._slowness(command) * env.power / (1 + 0.5 * speed),
            "acceleration": -w.acceleration * np.sum(acceleration**2, axis=1),
            "smoothness": -w.rate * np.sum((now - before) ** 2, axis=1)
            - w.bend * np.sum((now - 2 * before + earlier) ** 2, axis=1),
            "hips": -w.hips * hip_deviation(env, command),
            "constant": np.full(len(now), w.constant),
        }

    def _feet(self, command: np.ndarray, past: Past) -> dict[str, np.ndarray]:
        """Rewards of swing and stance of the feet."""
        env, w = self.env, self.weights
        speed = np.hypot(env.foot_velocity[..., 0], env.foot_velocity[..., 1])
        # swing share s: below 0 in the planned stance; wanted clearance: top sin(pi s)
        share, top = past.clock.swing_share(), SWING_CLEARANCE_M * env.size.length
        wanted = top * np.sin(np.pi * np.maximum(share, 0.0))
        lifted = np.clip(np.minimum(env.clearance, wanted), 0.0, None) / top
        return {
            "schedule": w.schedule * (env.contact == (share < 0.0)).mean(axis=1),
            "lift": w.lift * lifted.mean(axis=1),
            "slip": -w.slip * (np.minimum(speed, 3.0) * env.contact).sum(axis=1),
        }

    def _slowness(self, command: np.ndarray) -> np.ndarray:
        """Factor (n,) of the penalty of power: `slow` at rest, 1 from 1 m/s on."""
        decay = np.maximum(1.0 - foot_pace(self.env.size.as_reference(command[:, :3])) ** 2, 0.0)
        # 1 + (slow - 1) max(1 - pace^2, 0)
        return np.asarray(1.0 + (self.weights.slow - 1.0) * decay)

    def _gait(self, command: np.ndarray, past: Past) -> dict[str, np.ndarray]:
        """Rewards of the kind of gait."""
        env, w = self.env, self.weights
        sideways = command[:, 1] - env.velocity[:, 1] - past.stride[:, 1]
        beyond = np.maximum(env.fastest - OVERSPEED_SHARE * env.robot.velocity_limit, 0.0)
        return {
            "off_hip": -w.off_hip * np.abs(past.off_hip).sum(axis=1),
            "sway": -w.sway * np.minimum(sideways**2, 0.1),
            "roll": -w.roll * np.minimum(env.angular_velocity[:, 0] ** 2, 10.0),
            "overspeed": -w.overspeed * np.minimum(beyond, MAX_BEYOND).sum(axis=1),
        }

    def _stance(self) -> dict[str, np.ndarray]:
        """Rewards of standing still."""
        env, w = self.env, self.weights
        return {
            "posture": -w.posture * np.abs(env.q - env.robot.nominal_q).sum(axis=1),
            "step": -w.step * (~env.contact).sum(axis=1),
            "fidget": -w.fidget * np.minimum(np.sum(env.dq**2, axis=1), 200.0),
        }
