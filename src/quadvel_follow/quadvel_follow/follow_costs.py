"""What a robot that follows a person would rather do: what each of many rollouts costs. No ROS, no search."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from .clearance import Clearance, outline_distance
from .clusters import Scan
from .looking import to_sensor
from .rollouts import TIMES, Limits, Rollouts

Array = NDArray[np.float64]

FADES = 2.0  # s, in which the velocity of the person who is followed is taken to fade, as it may stop; others walk on
BODY = 0.25  # m, from the middle of a person to its outside
SOFT = 0.3  # m, up to which an error of the distance counts by its square, and then by itself
TURNS = 0.7  # m, from its place beside the person, up to which the robot turns as the person does
CHANGES = np.array([3.0, 10.0, 15.0])  # cost of the squared change of vx, vy, wz from one step to the next
USE = np.array([0.0, 2.0, 0.3])  # of their squares
COLLISION = 1000.0
CLOSE = 100.0  # 1/m^2, cost of the least distance to a person, as far as it is below what is kept
KEPT, BERTH = 0.5, 0.7  # m, of the person who is followed, and of others, of whom one knows less
GUARD = 0.05  # m, below which a clearance counts as a collision


@attrs.frozen
class Situation:
    """All that is known at one instant, in the frame of the odometry.

    pose (3,): x, y (m), yaw (rad); velocity, command (3,): vx, vy (m/s), wz (rad/s), body frame; person (4,): x, y, vx, vy;
    others (n, 4); goal (2,): m, the person or a place on the way to it; rest: m, from the goal to the person, 0 where the
    goal is the person; sensor (3,): the scanner's pose at the scan.
    """

    pose: Array
    velocity: Array
    command: Array
    person: Array
    others: Array
    goal: Array
    rest: float
    clearance: Clearance
    scan: Scan
    sensor: Array
    limits: Limits

    @property
    def direct(self) -> bool:
        """Whether the goal is the person itself."""
        return self.rest == 0.0


def predict_target(person: Array) -> Array:
    """Where the person (4,) who is followed will be at `TIMES`, (STEPS, 2)."""
    walked = FADES * (1.0 - np.exp(-TIMES / FADES))
    return person[:2] + walked[:, None] * person[2:]


@attrs.frozen
class FollowCost:
    """distance: m, from the person; side: 1 to its left, -1 to its right, 0 behind; margin: m, clearance that is kept;
    length, width: m, of the robot.
    """

    distance: float
    side: int
    margin: float
    length: float
    width: float

    def of(self, situation: Situation, rollouts: Rollouts) -> Array:
        """(K,), without unit."""
        speed = np.hypot(rollouts.velocity[..., 0], rollouts.velocity[..., 1])
        return (
            self._following(situation, rollouts)
            + self._obstacles(situation.clearance.of(rollouts.poses), speed)
            + self._persons(situation, rollouts, speed)
            + self._unseen(situation, rollouts, speed)
            + self._effort(situation, rollouts)
        )

    def errors(self, situation: Situation, poses: Array, person: Array) -> tuple[Array, Array]:
        """Of the distance, m, too far above 0, and of the heading, rad, for poses (K, n, 3) and the person at (n, 2), m."""
        if not situation.direct:
            off = situation.goal - poses[..., :2]
            far = np.hypot(off[..., 0], off[..., 1]) + situation.rest - self.distance
            return far, _wrapped(np.arctan2(off[..., 1], off[..., 0]) - poses[..., 2])
        if not self.side:
            off = person - poses[..., :2]
            far = np.hypot(off[..., 0], off[..., 1]) - self.distance
            return far, _wrapped(np.arctan2(off[..., 1], off[..., 0]) - poses[..., 2])
        heading = np.arctan2(situation.person[3], situation.person[2])
        off = person + self._beside(situation) - poses[..., :2]
        far = np.hypot(off[..., 0], off[..., 1])
        wanted = np.where(far < TURNS, heading, np.arctan2(off[..., 1], off[..., 0]))
        return far, _wrapped(wanted - poses[..., 2])

    def _beside(self, situation: Situation) -> Array:
        """From the person to the place beside it, (2,) m."""
        heading = np.arctan2(situation.person[3], situation.person[2])
        return self.side * self.distance * np.array([-np.sin(heading), np.cos(heading)])

    def place(self, situation: Situation) -> Array:
        """Where to walk now, (2,) m: the goal, or the place beside the person."""
        return situation.goal + self._beside(situation) if situation.direct else situation.goal

    def _following(self, situation: Situation, rollouts: Rollouts) -> Array:
        far, turn = self.errors(situation, rollouts.poses, predict_target(situation.person))
        return (10.0 * (np.sqrt(far**2 + SOFT**2) - SOFT) + 6.0 * (1.0 - np.cos(turn))).mean(1)

    def _obstacles(self, clearance: Array, speed: Array) -> Array:
        least = clearance.min(1)
        short = np.maximum(self.margin + 0.02 - least, 0.0)
        near = np.maximum(self.margin + 0.2 - clearance, 0.0)
        return (
            COLLISION * (least < GUARD) + 200.0 * short**2 + (20.0 * near**2 + 1.5 * speed**2 * near).mean(1)
        )

    def gaps(self, situation: Situation, poses: Array) -> Array:
        """Between the outline at poses (K, STEPS, 3) and everybody, who is followed first, (persons, K, STEPS) in m."""
        half = (0.5 * self.length, 0.5 * self.width)
        others = situation.others[:, None, :2] + TIMES[:, None] * situation.others[:, None, 2:]
        every = [predict_target(situation.person), *others]
        return np.array([outline_distance(place, poses, half) - BODY for place in every])

    def _persons(self, situation: Situation, rollouts: Rollouts, speed: Array) -> Array:
        """Nobody is met; past others, of whom one does not know where they go, the robot is slow."""
        gaps = self.gaps(situation, rollouts.poses)
        least = gaps.min(2)  # (persons, K)
        kept = np.full((len(least), 1), BERTH)
        kept[0] = KEPT
        short = (kept - least).max(0).clip(min=0.0)
        near = np.maximum(1.0 - gaps[1:].min(0, initial=np.inf), 0.0)
        return COLLISION * (least.min(0) < GUARD) + CLOSE * short**2 + (speed**2 * near).mean(1)

    def _unseen(self, situation: Situation, rollouts: Rollouts, speed: Array) -> Array:
        """Fast into what the scan does not show."""
        place = to_sensor(rollouts.poses[..., :2].reshape(-1, 2), situation.sensor)
        distance = np.hypot(*place.T)
        bearing = np.arctan2(place[:, 1], place[:, 0])
        hidden = (distance > self.length) & ~(situation.scan.at(bearing) > distance - 0.2)
        person = to_sensor(situation.person[None, :2], situation.sensor)[0]
        behind = np.abs(_wrapped(bearing - np.arctan2(person[1], person[0]))) < np.arctan2(
            2.0 * BODY, np.hypot(*person)
        )
        hidden &= ~behind  # where the person walks, nothing else is
        return (2.0 * speed**2 * hidden.reshape(speed.shape)).mean(1)

    def _effort(self, situation: Situation, rollouts: Rollouts) -> Array:
        first = rollouts.commands[:, :1] - situation.command
        changes = np.concatenate([first, np.diff(rollouts.commands, axis=1)], axis=1)
        used = USE * rollouts.commands**2
        back = np.minimum(rollouts.commands[..., 0], 0.0) ** 2
        return (CHANGES * changes**2 + used).sum(2).mean(1) + 2.0 * back.mean(1)


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
