"""The rewards of the teacher: following commands, in xy and yaw alike, with a quiet trunk and feet that step in diagonal pairs.

No clock and no reference motion: the policy finds when each foot steps. Diagonal pairs that move together are paid from the
start. What would fine a robot's first clumsy steps (sway, roll rate, fast joints, stance off the hip, and the larger weights
at low speed) is scaled by `lifting`, which grows from 0 to 1 as the robots' feet leave the ground.
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
FAST = 0.8  # share of a drive's speed from which on `overspeed` fines its joint
PAIRED = (
    0.3  # share of the time with one diagonal pair alone in the air, from which on `diagonal` is paid in full
)
LIFTING = (
    0.15,
    0.35,
)  # share of the time in the air of walking robots' feet: where `lifting` leaves 0, and where it is 1
DIAGONALS = ((0, 3), (1, 2))  # feet in the order of robot.LEGS: FR with RL, FL with RR


def lifting(airborne: float) -> float:
    """Weight, 0 to 1, of the terms that wait until feet lift.

    Args:
        airborne: share of the time that the feet of walking robots spend in the air, mean of all feet.
    """
    low, high = LIFTING
    return float(np.clip((airborne - low) / (high - low), 0.0, 1.0))


def alike(contact: np.ndarray, pairs: tuple[tuple[int, int], ...] = DIAGONALS) -> np.ndarray:
    """Share of the pairs of feet of which both are on the ground or both in the air.

    Args:
        contact: (n, 4) bool, feet in the order of robot.LEGS.
        pairs: which feet belong together, by index.

    Returns:
        (n,), from 0 to 1.
    """
    return np.asarray(np.mean([contact[:, one] == contact[:, other] for one, other in pairs], axis=0))


def one_diagonal_in_the_air(contact: np.ndarray) -> np.ndarray:
    """Which robots have both feet of one diagonal in the air and both of the other on the ground, (n,) bool.

    contact: (n, 4) bool, feet in the order of robot.LEGS.
    """
    (a, b), (c, d) = DIAGONALS
    one, other = contact[:, a], contact[:, c]
    return np.asarray((one == contact[:, b]) & (other == contact[:, d]) & (one != other))


def sizes(error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of velocity errors (n, 3) those in xy (n,), m/s, and in yaw (n,), rad/s."""
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def pace_of(command: np.ndarray) -> np.ndarray:
    """How fast commands (n, 4) make the feet move, (n,), m/s; 1 rad/s of turning counts as 0.3 m/s."""
    return np.asarray(np.hypot(command[:, 0], command[:, 1]) + 0.3 * np.abs(command[:, 2]))


def hips_astray(env: VelocityEnv, command: np.ndarray) -> np.ndarray:
    """By how much the four hips are away from straight down (n,), rad; moving sideways, where they have to swing, it counts less.

    Feet close to the middle cost the least energy, and a robot on them tips over the soonest.
    """
    astray = np.abs(env.q[:, ::3]).sum(axis=1)
    return np.asarray(astray / (1.0 + 2.0 * np.abs(command[:, 1])))


class Past(Protocol):
    """What `privileged.Past` keeps."""

    stride: np.ndarray
    lasting: np.ndarray
    air: np.ndarray
    down: np.ndarray
    paired: np.ndarray
    off_hip: np.ndarray


@attrs.frozen
class WalkingWeights:
    """Weights of the terms of a SAMPLE; all fines are positive here."""

    linear: float = 1.2  # exp(-e^2 / (0.25 m^2/s^2 (1 + |c| / 2))) of the velocity error e
    linear_narrow: float = (
        0.5  # exp(-e^2 / 0.09 m^2/s^2): wide enough for a slow step's own swing of the velocity
    )
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
    diagonal: float = 0.6  # pay for diagonal pairs alike in contact, once a robot has one of them in the air again and again
    off_hip: float = (
        4.0  # fine, 1/m, at lift-off: distance of the middle of a foot's stance from the hip, ahead or behind
    )
    sway: float = 10.0  # fine: sideways velocity off its mean over a stride, squared,
    roll: float = 0.1  # and roll rate squared
    overspeed: float = 0.1  # fine, s/rad, of joint speeds beyond FAST of their drives' limit
    slow: float = 5.0  # by how much `power` and `swing` weigh more at rest; falls to 1 at 1 m/s
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
        self.lifting = 0.0  # of all robots, as the function `lifting` has it

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
        on_feet = self._feet(command, past, air) | self._gait(command, past)
        terms |= {name: value * walking for name, value in on_feet.items()}
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
            + w.linear_narrow * np.exp(-xy / 0.09),
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
            "power": -w.power * self._slowness(command) * env.power / (1 + 0.5 * speed),
            "acceleration": -w.acceleration * np.sum(acceleration**2, axis=1),
            "smoothness": -w.rate * np.sum((now - before) ** 2, axis=1)
            - w.bend * np.sum((now - 2 * before + earlier) ** 2, axis=1),
            "hips": -w.hips * hips_astray(env, command),
            "alive": np.full(len(now), w.alive),
        }

    def _feet(self, command: np.ndarray, past: Past, air: np.ndarray) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        pace = pace_of(command)
        suited = 0.25 - 0.03 * np.minimum(pace, 3.0)  # s in the air
        touchdown = env.contact & (air > 0.0)
        speed = np.hypot(env.foot_velocity[..., 0], env.foot_velocity[..., 1])
        missing = np.maximum(LIFT - env.clearance, 0.0) * np.minimum(speed, 2.0) * ~env.contact
        swing = (np.clip(air - suited[:, None], -0.25, 0.1) * touchdown).sum(axis=1)
        return {
            "swing": w.swing * self._slowness(command) * swing,
            "dragging": -w.dragging * (past.down > LONG_DOWN).sum(axis=1),
            "slip": -w.slip * (np.minimum(speed, 3.0) * env.contact).sum(axis=1),
            "stumble": -w.stumble * missing.sum(axis=1),
        }

    def _slowness(self, command: np.ndarray) -> np.ndarray:
        """Factor (n,) of the terms that ask for slow steps: 1, and up to `slow` at rest once feet lift."""
        decay = np.maximum(1.0 - pace_of(command) ** 2, 0.0)
        return np.asarray(1.0 + self.lifting * (self.weights.slow - 1.0) * decay)

    def _gait(self, command: np.ndarray, past: Past) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        sideways = command[:, 1] - env.velocity[:, 1] - past.stride[:, 1]
        beyond = np.maximum(env.fastest - FAST * robot.VELOCITY_LIMIT, 0.0)
        fines = {
            "off_hip": w.off_hip * np.abs(past.off_hip).sum(axis=1),
            "sway": w.sway * np.minimum(sideways**2, 0.1),
            "roll": w.roll * np.minimum(env.angular_velocity[:, 0] ** 2, 10.0),
            "overspeed": w.overspeed * np.minimum(beyond, 5.0).sum(axis=1),
        }
        paid = w.diagonal * np.minimum(past.paired / PAIRED, 1.0) * alike(env.contact)
        return {"diagonal": paid} | {name: -self.lifting * value for name, value in fines.items()}

    def _stance(self) -> dict[str, np.ndarray]:
        env, w = self.env, self.weights
        return {
            "posture": -w.posture * np.abs(env.q - robot.NOMINAL_Q).sum(axis=1),
            "step": -w.step * (~env.contact).sum(axis=1),
            "fidget": -w.fidget * np.minimum(np.sum(env.dq**2, axis=1), 200.0),
        }
