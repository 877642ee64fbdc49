"""What the teacher is paid for: following commands, in xy and yaw alike, with a body that is carried quietly and feet that step.

Nothing here knows a gait: which foot goes when is the policy's to find.
"""

from __future__ import annotations

from typing import Protocol

import attrs
import numpy as np

from quadvel_description import robot

from .env import VelocityEnv

SAMPLE = 0.02  # s, for which the teacher holds an action, and which the weights are for
LOWEST, HIGHEST = -6.0, 4.0  # of a sample's sum of terms, a fall apart: nothing may drown all else
CARRIED = 0.36  # m, wanted height of the trunk
LIFT = 0.06  # m, clearance wanted in swing
LONG_DOWN = 0.4  # s: a foot that is down for longer while walking is being dragged along


def sizes(error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of velocity errors (n, 3) those in xy (n,), m/s, and in yaw (n,), rad/s."""
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def hips_astray(env: VelocityEnv, command: np.ndarray) -> np.ndarray:
    """By how much the four hips are away from straight down (n,), rad; moving sideways, where they have to swing, it counts less.

    Trotting on feet close to the middle costs the least, and tips over the soonest.
    """
    astray = np.abs(env.q[:, ::3]).sum(axis=1)
    return np.asarray(astray / (1.0 + 2.0 * np.abs(command[:, 1])))


class Past(Protocol):
    """What `privileged.Past` keeps."""

    stride: np.ndarray
    lasting: np.ndarray
    air: np.ndarray
    down: np.ndarray


@attrs.frozen
class WalkingWeights:
    """Weights of the terms of a SAMPLE; all fines are positive here."""

    linear: float = 1.2  # exp(-e^2 / (0.25 m^2/s^2 (1 + |c| / 2))) of the velocity error e
    linear_narrow: float = 0.5  # exp(-e^2 / 0.04)
    angular: float = 0.6  # exp(-e^2 / (0.25 rad^2/s^2 (1 + |c| / 4)))
    angular_narrow: float = 0.25  # exp(-e^2 / 0.04)
    stride_linear: float = 1.0  # fine, s/m, of the error over a stride,
    stride_angular: float = 0.5  # s/rad, the same of yaw
    lasting_linear: float = 1.0  # fine, s/m, of the error that lasts,
    lasting_angular: float = 0.5  # s/rad, the same of yaw,
    steady: float = 0.3  # and exp(-(e / 0.06)^2) of it, xy and yaw
    bounce: float = 0.6  # fine: vertical speed squared
    rocking: float = 0.03  # fine: roll and pitch rate squared
    tilt: float = 2.0  # fine: roll and pitch against the ground, squared
    height: float = 30.0  # fine: height off what is wanted, squared
    power: float = 6e-4  # fine, 1/W; at speed |c| divided by 1 + |c| / 2
    acceleration: float = 2e-7  # fine: joint accelerations squared
    rate: float = 0.012  # fine: change of the action squared
    bend: float = 0.008  # fine: second difference of the action squared
    swing: float = 1.2  # at touchdown: seconds in the air beyond what suits the speed, within -0.25 and 0.1
    dragging: float = 0.4  # fine for each foot that stays down
    slip: float = 0.06  # fine, s/m, of each foot on the ground
    stumble: float = 3.0  # fine, s/m^2: clearance missing in swing times the foot's speed
    hips: float = 1.0  # fine, 1/rad, of hips away from straight down
    posture: float = 0.2  # fine in stance, 1/rad, off the nominal posture
    step: float = 0.1  # fine in stance for each foot in the air
    fidget: float = 1e-3  # fine in stance: joint speeds squared
    alive: float = 0.3
    fall: float = 4.0  # fine, once
    scale: float = 0.5  # of the sum


class WalkingRewards:
    """The terms of a batch of robots; remembers the joint speeds of the sample before."""

    def __init__(self, env: VelocityEnv, weights: WalkingWeights) -> None:
        self.env, self.weights = env, weights
        self._dq = env.dq.copy()

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        self._dq[ids] = self.env.dq[ids]

    def total(self, terms: dict[str, np.ndarray], fell: np.ndarray) -> np.ndarray:
        """The reward (n,) of these terms, bounded, and of a fall (n,)."""
        w = self.weights
        bounded = np.clip(np.sum(list(terms.values()), axis=0), LOWEST, HIGHEST)
        return np.asarray(w.scale * (bounded - w.fall * fell))

    def terms(
        self, command: np.ndarray, past: Past, air: np.ndarray, actions: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Each term (n,), weighted, after a sample under `command` (n, 4).

        air (n, 4): s in the air before it; actions (3, n, 12): of this sample and the two before.
        """
        walking = command[:, 3] < 0.5
        terms = self._tracking(command, past) | self._body(command, actions)
        terms |= {name: value * walking for name, value in self._feet(command, past, air).items()}
        terms |= {name: value * ~walking for name, value in self._stance().items()}
        return terms

    def _tracking(self, command: np.ndarray, past: Past) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        xy = np.sum((command[:, :2] - env.velocity[:, :2]) ** 2, axis=1)
        wz = (command[:, 2] - env.angular_velocity[:, 2]) ** 2
        speed, turn = np.hypot(command[:, 0], command[:, 1]), np.abs(command[:, 2])
        stride_xy, stride_wz = sizes(past.stride)
        lasting_xy, lasting_wz = sizes(past.lasting)
        return {
            "linear": w.linear * np.exp(-xy / (0.25 * (1 + 0.5 * speed)))
            + w.linear_narrow * np.exp(-xy / 0.04),
            "angular": w.angular * np.exp(-wz / (0.25 * (1 + 0.25 * turn)))
            + w.angular_narrow * np.exp(-wz / 0.04),
            "stride": -w.stride_linear * stride_xy - w.stride_angular * stride_wz,
            "lasting": -w.lasting_linear * lasting_xy - w.lasting_angular * lasting_wz,
            "steady": w.steady * (np.exp(-((lasting_xy / 0.06) ** 2)) + np.exp(-((lasting_wz / 0.06) ** 2))),
        }

    def _body(self, command: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        down_forward, down_left = env.ground_slope.T
        lean = np.arctan(np.stack([-down_left, down_forward], axis=1))
        acceleration = (env.dq - self._dq) / env.config.period
        self._dq = env.dq.copy()
        speed = np.hypot(command[:, 0], command[:, 1])
        now, before, earlier = actions
        return {
            "bounce": -w.bounce * env.velocity[:, 2] ** 2
            - w.rocking * np.sum(env.angular_velocity[:, :2] ** 2, axis=1),
            "tilt": -w.tilt * np.sum((env.roll_pitch - lean) ** 2, axis=1),
            "height": -w.height * np.minimum((env.height - CARRIED) ** 2, 0.02),
            "power": -w.power * env.power / (1 + 0.5 * speed),
            "acceleration": -w.acceleration * np.sum(acceleration**2, axis=1),
            "smoothness": -w.rate * np.sum((now - before) ** 2, axis=1)
            - w.bend * np.sum((now - 2 * before + earlier) ** 2, axis=1),
            "hips": -w.hips * hips_astray(env, command),
            "alive": np.full(len(now), w.alive),
        }

    def _feet(self, command: np.ndarray, past: Past, air: np.ndarray) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        pace = np.hypot(command[:, 0], command[:, 1]) + 0.3 * np.abs(command[:, 2])
        suited = 0.30 - 0.04 * np.minimum(pace, 3.0)  # s in the air
        touchdown = env.contact & (air > 0.0)
        speed = np.hypot(env.foot_velocity[..., 0], env.foot_velocity[..., 1])
        missing = np.maximum(LIFT - env.clearance, 0.0) * np.minimum(speed, 2.0) * ~env.contact
        return {
            "swing": w.swing * (np.clip(air - suited[:, None], -0.25, 0.1) * touchdown).sum(axis=1),
            "dragging": -w.dragging * (past.down > LONG_DOWN).sum(axis=1),
            "slip": -w.slip * (np.minimum(speed, 3.0) * env.contact).sum(axis=1),
            "stumble": -w.stumble * missing.sum(axis=1),
        }

    def _stance(self) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        return {
            "posture": -w.posture * np.abs(env.q - robot.NOMINAL_Q).sum(axis=1),
            "step": -w.step * (~env.contact).sum(axis=1),
            "fidget": -w.fidget * np.minimum(np.sum(env.dq**2, axis=1), 200.0),
        }
