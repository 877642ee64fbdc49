"""Cost of rollouts of a robot that follows a person. No ROS, no search.

`rollouts` predicts the motions and `dynamic_window` searches for the cheapest one.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.arrays import Array

from .clearance import Clearance, outline_distance
from .clusters import Scan
from .free_space import to_sensor
from .rollouts import TIMES_S, Limits, Rollouts

VELOCITY_FADE_S = 2.0
"""Time constant with which the predicted velocity of the followed person fades."""
PERSON_RADIUS_M = 0.25
HUBER_WIDTH_M = 0.3
"""Distance error up to which the cost is quadratic; beyond it is linear."""
ALIGNMENT_DISTANCE_M = 0.7
"""Distance to the place at the person's side below which the robot takes the person's heading."""
CHANGE_WEIGHTS = np.array([3.0, 10.0, 15.0])
"""Weights of squared changes of vx, vy (m/s), wz (rad/s) between steps."""
EFFORT_WEIGHTS = np.array([0.0, 2.0, 0.3])
"""Weights of squared vx, vy (m/s), wz (rad/s)."""
COLLISION_COST = 1000.0
"""Cost of a rollout that collides; it outweighs all other costs."""
CLOSENESS_WEIGHT = 100.0
"""Weight (1/m^2) of the squared violation of the margin to a person."""
FOLLOWED_MARGIN_M, PEDESTRIAN_MARGIN_M = 0.5, 0.7
"""Margin to the followed person, and to other people, whose motion is less certain."""
COLLISION_CLEARANCE_M = 0.05
"""Clearance below which a rollout counts as a collision."""


@attrs.frozen
class Situation:
    """Everything known at one instant, in the odometry frame.

    Attributes:
        pose: Pose of the robot, (3,): x, y in m, yaw in rad.
        velocity: Velocity of the robot in the body frame, (3,): vx, vy in m/s, wz in rad/s.
        command: Present command, as `velocity`.
        person: Followed person, (4,): x, y in m, vx, vy in m/s.
        others: Other people, (n, 4), as `person`.
        goal: Followed person, or a point on the path to it, (2,), m.
        remaining: Distance along the path from goal to person, m; 0 if the goal is the person.
        clearance: Distances to obstacles.
        scan: Newest scan.
        sensor: Pose of the scanner at the scan, (3,): x, y in m, yaw in rad.
        limits: Limits of the commands.
    """

    pose: Array
    velocity: Array
    command: Array
    person: Array
    others: Array
    goal: Array
    remaining: float
    clearance: Clearance
    scan: Scan
    sensor: Array
    limits: Limits

    @property
    def is_direct(self) -> bool:
        """Whether the goal is the person."""
        return self.remaining == 0.0


def predict_target(person: Array) -> Array:
    """Predict the position of the followed person at `TIMES_S`.

    The velocity fades, since the person may stop: p(t) = p + v T (1 - exp(-t / T)).

    Args:
        person: Position and velocity, (4,): x, y in m, vx, vy in m/s.

    Returns:
        Positions, (STEPS, 2), m.
    """
    walked = VELOCITY_FADE_S * (1.0 - np.exp(-TIMES_S / VELOCITY_FADE_S))
    return person[:2] + walked[:, None] * person[2:]


@attrs.frozen
class FollowCost:
    """Weights and geometry of the cost.

    Attributes:
        distance: Desired distance to the person, m.
        side: Desired side: 1 left of the person, -1 right, 0 behind.
        margin: Desired clearance to obstacles, m.
        length: Length of the robot's outline, m.
        width: Width of the robot's outline, m.
    """

    distance: float
    side: int
    margin: float
    length: float
    width: float

    def evaluate(self, situation: Situation, rollouts: Rollouts) -> Array:
        """Compute the cost of rollouts.

        Args:
            situation: Present situation.
            rollouts: K rollouts.

        Returns:
            Costs, (K,), dimensionless.
        """
        speed = np.hypot(rollouts.velocity[..., 0], rollouts.velocity[..., 1])
        return (
            self._following_cost(situation, rollouts)
            + self._obstacle_cost(situation.clearance.at_poses(rollouts.poses), speed)
            + self._people_cost(situation, rollouts, speed)
            + self._hidden_space_cost(situation, rollouts, speed)
            + self._effort_cost(situation, rollouts)
        )

    def tracking_errors(self, situation: Situation, poses: Array, person: Array) -> tuple[Array, Array]:
        """Compute the errors of distance and heading.

        Args:
            situation: Present situation.
            poses: Poses of the robot, (K, n, 3): x, y in m, yaw in rad.
            person: Positions of the followed person, (n, 2), m.

        Returns:
            Distance error, (K, n), m, positive if too far; heading error, (K, n), rad.
        """
        if not situation.is_direct:
            off = situation.goal - poses[..., :2]
            far = np.hypot(off[..., 0], off[..., 1]) + situation.remaining - self.distance
            return far, _wrap_angle(np.arctan2(off[..., 1], off[..., 0]) - poses[..., 2])
        if not self.side:
            off = person - poses[..., :2]
            far = np.hypot(off[..., 0], off[..., 1]) - self.distance
            return far, _wrap_angle(np.arctan2(off[..., 1], off[..., 0]) - poses[..., 2])
        heading = np.arctan2(situation.person[3], situation.person[2])
        off = person + self._side_offset(situation) - poses[..., :2]
        far = np.hypot(off[..., 0], off[..., 1])
        wanted = np.where(far < ALIGNMENT_DISTANCE_M, heading, np.arctan2(off[..., 1], off[..., 0]))
        return far, _wrap_angle(wanted - poses[..., 2])

    def _side_offset(self, situation: Situation) -> Array:
        """Return the vector from the person to the robot's place at its side, (2,), m."""
        heading = np.arctan2(situation.person[3], situation.person[2])
        return self.side * self.distance * np.array([-np.sin(heading), np.cos(heading)])

    def target_point(self, situation: Situation) -> Array:
        """Return the point to walk to: the goal, or the place at the person's side.

        Args:
            situation: Present situation.

        Returns:
            Point, (2,), m.
        """
        return situation.goal + self._side_offset(situation) if situation.is_direct else situation.goal

    def _following_cost(self, situation: Situation, rollouts: Rollouts) -> Array:
        """Return the cost of errors of distance (pseudo-Huber) and heading."""
        far, turn = self.tracking_errors(situation, rollouts.poses, predict_target(situation.person))
        # Pseudo-Huber loss: sqrt(e^2 + w^2) - w.
        return (
            10.0 * (np.sqrt(far**2 + HUBER_WIDTH_M**2) - HUBER_WIDTH_M) + 6.0 * (1.0 - np.cos(turn))
        ).mean(1)

    def _obstacle_cost(self, clearance: Array, speed: Array) -> Array:
        """Return the cost of obstacles: collision, too little clearance, speed near obstacles."""
        least = clearance.min(1)
        short = np.maximum(self.margin + 0.02 - least, 0.0)
        near = np.maximum(self.margin + 0.2 - clearance, 0.0)
        return (
            COLLISION_COST * (least < COLLISION_CLEARANCE_M)
            + 200.0 * short**2
            + (20.0 * near**2 + 1.5 * speed**2 * near).mean(1)
        )

    def person_gaps(self, situation: Situation, poses: Array) -> Array:
        """Compute the gap between the robot's outline and every person.

        Args:
            situation: Present situation.
            poses: Poses of the robot, (K, STEPS, 3).

        Returns:
            Gaps, (persons, K, STEPS), m; the followed person first.
        """
        half = (0.5 * self.length, 0.5 * self.width)
        others = situation.others[:, None, :2] + TIMES_S[:, None] * situation.others[:, None, 2:]
        every = [predict_target(situation.person), *others]
        return np.array([outline_distance(place, poses, half) - PERSON_RADIUS_M for place in every])

    def _people_cost(self, situation: Situation, rollouts: Rollouts, speed: Array) -> Array:
        """Return the cost of people: collision, too small a gap, speed near other people."""
        gaps = self.person_gaps(situation, rollouts.poses)
        least = gaps.min(2)  # (persons, K)
        kept = np.full((len(least), 1), PEDESTRIAN_MARGIN_M)
        kept[0] = FOLLOWED_MARGIN_M
        short = (kept - least).max(0).clip(min=0.0)
        near = np.maximum(1.0 - gaps[1:].min(0, initial=np.inf), 0.0)
        return (
            COLLISION_COST * (least.min(0) < COLLISION_CLEARANCE_M)
            + CLOSENESS_WEIGHT * short**2
            + (speed**2 * near).mean(1)
        )

    def _hidden_space_cost(self, situation: Situation, rollouts: Rollouts, speed: Array) -> Array:
        """Return the cost of speed in space that the scan does not show."""
        place = to_sensor(rollouts.poses[..., :2].reshape(-1, 2), situation.sensor)
        distance = np.hypot(*place.T)
        bearing = np.arctan2(place[:, 1], place[:, 0])
        hidden = (distance > self.length) & ~(situation.scan.range_at(bearing) > distance - 0.2)
        person = to_sensor(situation.person[None, :2], situation.sensor)[0]
        behind = np.abs(_wrap_angle(bearing - np.arctan2(person[1], person[0]))) < np.arctan2(
            2.0 * PERSON_RADIUS_M, np.hypot(*person)
        )
        hidden &= ~behind  # the path of the person is free
        return (2.0 * speed**2 * hidden.reshape(speed.shape)).mean(1)

    def _effort_cost(self, situation: Situation, rollouts: Rollouts) -> Array:
        """Return the cost of command changes, lateral and turning motion, and walking backward."""
        first = rollouts.commands[:, :1] - situation.command
        changes = np.concatenate([first, np.diff(rollouts.commands, axis=1)], axis=1)
        used = EFFORT_WEIGHTS * rollouts.commands**2
        back = np.minimum(rollouts.commands[..., 0], 0.0) ** 2
        return (CHANGE_WEIGHTS * changes**2 + used).sum(2).mean(1) + 2.0 * back.mean(1)


def _wrap_angle(angle: Array) -> Array:
    """Return angles wrapped to [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
