"""Planner that follows a person: scans, odometry and tracks in, velocities out. No ROS.

`follow_costs` rates rollouts, `dynamic_window` searches for the best one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import field

from .clearance import Clearance
from .clusters import Scan
from .dynamic_window import DynamicWindow
from .follow_costs import PERSON_RADIUS_M, FollowCost, Situation, predict_target
from .obstacle_memory import ObstacleMemory
from .pose_history import PoseHistory
from .pursuit import pursue
from .rollouts import STEPS, TIMES_S, Axes, Limits, Rollouts, roll_out
from .trail import Trail

PERIOD_S = 0.05
"""Time between two steps."""
SIDES = {"behind": 0, "left": 1, "right": -1}
MAX_LATERAL_ACCELERATION = 3.0
"""Bound in m/s^2 of |wz| (|vx| + |vy|); above 1.3 m/s the shipped policy limits turns further."""
MAX_BACKWARD_SPEED = 0.4
"""m/s, if the scanner covers the space behind the robot."""
REAR_ANGLES_RAD = np.linspace(-0.5, 0.5, 7) + np.pi
"""Angles at which that space must be visible."""
MAX_JERK = np.array([10.0, 8.0, 16.0])
"""Jerk of the commands: m/s^3, m/s^3, rad/s^3."""
SURE_DEVIATION_M = 0.3
"""Standard deviation of the person's position up to which the robot walks at full speed."""
UNSURE_DEVIATION_M = 1.0
"""Standard deviation from which the robot walks at `MIN_SPEED_SHARE` of its speed."""
MIN_SPEED_SHARE = 0.4
STOP_DISTANCE_SHARE = 0.7
"""If the person stops, the robot must stop before this share of the desired distance."""
REACTION_TIME_S, BRAKING_DECELERATION = 0.4, 1.8
"""Delay of the reaction (tracker included), and deceleration in m/s^2."""
STAND_TOLERANCE = (0.25, 0.5)
"""Errors (m, rad) that a standing robot does not correct."""
ARRIVAL_TOLERANCE = (0.12, 0.2)
"""Errors (m, rad) with which a walking robot may stop."""
CROWDING_SHARE = 0.4
"""Share of the desired distance by which a standing robot may be too near."""
STANDING_SPEED = 0.25
"""Speed of a person in m/s below which it stands."""
SMALL_ERROR_M = 0.4
"""Distance error up to which a slow robot does not count as blocked."""
BLOCKED_AFTER_S = 0.6
"""Time without progress after which the robot is blocked."""
SAFETY_HORIZON_S = 0.8
"""Time in which a braking robot must not meet people."""
CRAWLING_SPEED = 0.1
"""Command (m/s, rad/s) below which a plan makes no progress."""
LOOK_DELAY_S = 1.0
"""Time between the loss of the person and looking around."""
LOOK_TURN_RATE = 1.0
"""Turn rate of looking around, rad/s."""
TURNING_CLEARANCE_M = 0.05
"""Clearance that turning on the spot requires."""


class State(Enum):
    """State of the planner; the values are published."""

    WAITING = "waiting"
    FOLLOWING = "following"
    BLOCKED = "blocked"
    LOST = "lost"
    LOOKING = "looking around"
    BLIND = "blind"


@attrs.frozen(kw_only=True)
class FollowConfig:
    """Parameters of the planner: distance, limits of the robot, mounting of the laser, timeouts.

    The description of each field gives its unit.

    Raises:
        ValueError: A number is not finite or not positive, or the side is unknown.
    """

    distance: float = field(1.5, "distance to the person, m", above=0.0)
    side: str = field("behind", "place of the robot: behind, left or right of the person", one_of=SIDES)
    clearance: float = field(0.3, "desired clearance between outline and obstacles, m", above=0.0)
    max_velocity: Axes = field((2.5, 0.6, 1.5), "largest commanded vx, vy, wz, m/s, rad/s", above=0.0)
    acceleration: Axes = field(
        (1.2, 0.8, 1.5), "largest change of a command away from zero, m/s^2, rad/s^2", above=0.0
    )
    deceleration: Axes = field(
        (2.5, 1.5, 3.0), "largest change of a command towards zero, m/s^2, rad/s^2", above=0.0
    )
    stop_deceleration: Axes = field(
        (5.0, 4.0, 8.0), "the same for an immediate stop, m/s^2, rad/s^2", above=0.0
    )
    length: float = field(0.65, "length of the robot's outline, legs included, m", above=0.0)
    width: float = field(0.35, "width of the robot's outline, m", above=0.0)
    laser_x: float = field(
        0.25, "position of the laser on the robot: forward, m; as in the shipped worlds", at_least=-np.inf
    )
    laser_y: float = field(0.0, "position of the laser on the robot: left, m", at_least=-np.inf)
    laser_yaw: float = field(0.0, "yaw of the laser on the robot, rad", at_least=-np.inf)
    scan_timeout: float = field(0.2, "silence of the scan after which the robot stops, s", above=0.0)
    odom_timeout: float = field(0.2, "silence of the odometry after which the robot stops, s", above=0.0)
    person_timeout: float = field(0.2, "silence of the tracker after which the person is lost, s", above=0.0)
    robot_timeout: float = field(
        0.5, "silence of the controller after which its last refusal expires, s", above=0.0
    )


@attrs.frozen
class Plan:
    """Result of a planner step.

    Attributes:
        velocity: Command, (3,): vx, vy in m/s, wz in rad/s, body frame.
        state: State of the planner.
        reason: Short text for people.
        path: Planned poses in the odometry frame, (n, 3): x, y in m, yaw in rad; empty if standing.
    """

    velocity: Array
    state: State
    reason: str
    path: Array


@attrs.frozen
class _Received:
    """Received data: arrival on the planner's clock and stamp on the senders' clock, s."""

    now: float
    stamp: float
    value: Any


class FollowPlanner:
    """Follows a person: pass inputs to the `on_...` methods and call `step` every `PERIOD_S`.

    Attributes:
        config: Parameters.
    """

    def __init__(self, config: FollowConfig | None = None) -> None:
        """Create a planner without inputs.

        Args:
            config: Parameters; None: the defaults.
        """
        self.config = config = config or FollowConfig()
        self._cost = FollowCost(
            config.distance, SIDES[config.side], config.clearance, config.length, config.width
        )
        self._search = DynamicWindow()
        self._limits = Limits(
            config.max_velocity,
            MAX_BACKWARD_SPEED,
            MAX_LATERAL_ACCELERATION,
            config.acceleration,
            config.deceleration,
        )
        self._mounting = np.array([config.laser_x, config.laser_y, config.laser_yaw])
        self._poses = PoseHistory(self._mounting.tolist())
        self._memory = ObstacleMemory()
        self._trail = Trail()
        self._waiting: deque[_Received] = deque(maxlen=5)  # scans that are newer than the odometry
        self._scan: _Received | None = None
        self._odometry: _Received | None = None
        self._person: _Received | None = None
        self._deviation = 0.0  # m, standard deviation of its position
        self._refusal: _Received | None = None
        self._others: _Received | None = None
        self._command = np.zeros(3)
        self._rate = np.zeros(3)  # of the command
        self._last_step = -np.inf
        self._last_progress = -np.inf  # s
        self._lost_since = np.inf  # s, since when the person is lost
        self._turned_angle: float | None = None  # rad, since looking around began

    def on_odometry(self, now: float, stamp: float, pose: Sequence[float], velocity: ArrayLike) -> None:
        """Receive odometry; a stamp that is not newer means a reset and clears scans and obstacles.

        Args:
            now: Present time, s.
            stamp: Time of the measurement, s.
            pose: Pose of the robot, (3,): x, y in m, yaw in rad.
            velocity: Velocity in the body frame, (3,): vx, vy in m/s, wz in rad/s.

        Raises:
            ValueError: A number is not finite.
        """
        motion = np.asarray(velocity, float)
        if not np.isfinite(motion).all():
            raise ValueError(f"velocity is {motion.tolist()}, expected finite numbers")
        if stamp <= self._poses.newest:
            self._scan = None
            self._waiting.clear()
            self._memory = ObstacleMemory()
        self._poses.add(stamp, pose)
        self._odometry = _Received(now, stamp, (np.array(pose, float), motion))
        while self._waiting and self._waiting[0].stamp <= stamp:
            self._use_scan(self._waiting.popleft())

    def on_scan(
        self, now: float, stamp: float, ranges: ArrayLike, angle_min: float, angle_increment: float
    ) -> None:
        """Receive a laser scan.

        Args:
            now: Present time, s.
            stamp: Time of the scan, s.
            ranges: Ranges, (rays,), m.
            angle_min: Angle of the first ray, rad.
            angle_increment: Angle between two rays, rad.

        Raises:
            ValueError: The scan is malformed.
        """
        heard = _Received(now, stamp, Scan.validated(ranges, angle_min, angle_increment))
        if stamp <= self._poses.newest:
            self._use_scan(heard)
        else:
            self._waiting.append(heard)

    def _use_scan(self, heard: _Received) -> None:
        """Add a scan to the obstacles; its pose is known."""
        pose = self._poses.sensor_at(heard.stamp)
        known = [
            _extrapolate(_parse_persons(h.value), heard.stamp - h.stamp)[:, :2]
            for h in (self._person, self._others)
            if h
        ]
        self._memory.add(heard.stamp, heard.value, pose, np.concatenate(known) if known else ())
        self._scan = _Received(heard.now, heard.stamp, (heard.value, pose))

    def on_person(self, now: float, stamp: float, person: ArrayLike, deviation: float) -> None:
        """Receive the person to follow.

        Args:
            now: Present time, s.
            stamp: Time of the estimate, s.
            person: Position and velocity in the odometry frame, (4,): x, y in m, vx, vy in m/s.
            deviation: Standard deviation of the position, m.

        Raises:
            ValueError: A number is not finite, or the deviation is negative.
        """
        found = _parse_persons(person)[0]
        if not deviation >= 0.0:
            raise ValueError(f"deviation is {deviation}, expected 0 m or more")
        self._person, self._deviation = _Received(now, stamp, found), deviation
        if deviation < SURE_DEVIATION_M:
            self._trail.add(found[:2])

    def on_robot(self, now: float, refusal: str) -> None:
        """Receive the state of the controller; by default the robot is assumed to walk.

        Args:
            now: Present time, s.
            refusal: Reason why the robot does not follow velocities; empty if it does.
        """
        self._refusal = _Received(now, now, refusal)

    def on_others(self, now: float, stamp: float, persons: ArrayLike) -> None:
        """Receive all people; the followed person may be among them.

        Args:
            now: Present time, s.
            stamp: Time of the estimates, s.
            persons: Positions and velocities in the odometry frame, (n, 4): x, y in m, vx, vy in
                m/s.

        Raises:
            ValueError: A number is not finite.
        """
        self._others = _Received(now, stamp, _parse_persons(persons))

    @property
    def obstacles(self) -> Array:
        """Obstacle points in the odometry frame, (n, 2), m."""
        return self._memory.points

    def step(self, now: float) -> Plan:
        """Compute the command.

        Args:
            now: Present time, s.

        Returns:
            Command, state and planned path.
        """
        elapsed = min(max(now - self._last_step, 0.0), 2.0 * PERIOD_S)
        self._last_step = now
        state, words = self._decide_state(now)
        if state is State.FOLLOWING:
            return self._follow(now, elapsed)
        self._search.reset()
        if state is State.LOOKING:
            return self._look_around(now, elapsed)
        return self._stop(state, words, elapsed)

    def _decide_state(self, now: float) -> tuple[State, str]:
        """Return state and reason from the inputs' ages; update since when the person is lost."""
        config = self.config
        for what, heard, timeout in (
            ("odometry", self._odometry, config.odom_timeout),
            ("scan", self._scan, config.scan_timeout),
        ):
            if heard is None or not 0.0 <= now - heard.now <= timeout:
                return State.BLIND, f"the {what} is silent" if heard else f"there was no {what} yet"
        refusal = self._refusal
        if refusal and refusal.value and 0.0 <= now - refusal.now <= config.robot_timeout:
            self._lost_since, self._turned_angle = np.inf, None
            return State.WAITING, f"the robot does not walk: {refusal.value}"
        if self._person is None:
            return State.WAITING, "no person selected"
        if 0.0 <= now - self._person.now <= config.person_timeout:
            self._lost_since, self._turned_angle = np.inf, None
            return State.FOLLOWING, ""
        if self._lost_since == np.inf:
            self._lost_since, self._last_progress = now, -np.inf
        if now - self._lost_since < LOOK_DELAY_S or (self._turned_angle or 0.0) >= 2.0 * np.pi:
            return State.LOST, "the person is lost"
        return State.LOOKING, "the person is lost; looking around"

    def _stop(self, state: State, words: str, elapsed: float) -> Plan:
        """Decelerate to zero with the stop deceleration."""
        step = elapsed * np.array(self.config.stop_deceleration)
        self._command = self._command - np.clip(self._command, -step, step)
        self._rate = np.zeros(3)
        return Plan(self._command.copy(), state, words, np.zeros((0, 3)))

    def _look_around(self, now: float, elapsed: float) -> Plan:
        """Turn around once, first toward the person's last position, if there is room."""
        pose, velocity = self._present_motion(now)
        corners = np.column_stack(
            [np.tile(pose[:2], (12, 1)), np.linspace(-np.pi, np.pi, 12, endpoint=False)]
        )
        if self._clearance_field(pose).at_poses(corners).min() < TURNING_CLEARANCE_M:
            return self._stop(State.LOST, "the person is lost, and there is no room to look around", elapsed)
        self._turned_angle = (self._turned_angle or 0.0) + abs(velocity[2]) * elapsed
        assert self._person is not None
        off = self._person.value[:2] - pose[:2]
        if self._command[2] == 0.0:
            side = np.sign(np.sin(np.arctan2(off[1], off[0]) - pose[2])) or 1.0
        else:
            side = np.sign(self._command[2])
        self._ramp_command(np.array([0.0, 0.0, side * LOOK_TURN_RATE]), elapsed, self._limits)
        return Plan(
            self._command.copy(), State.LOOKING, "the person is lost; looking around", np.zeros((0, 3))
        )

    def _follow(self, now: float, elapsed: float) -> Plan:
        """Search for a command that follows the person."""
        situation = self._situation(now)
        error, turn = self._errors(situation)
        if self._may_stand(situation, error, turn):
            self._last_progress = now
            self._search.reset()
            return self._slow_down(State.FOLLOWING, "stands with the person", elapsed)
        guesses = self._initial_guesses(situation)

        def cost(targets: Array) -> Array:
            return self._cost.evaluate(situation, self._roll_out(situation, targets))

        targets = self._search.search(cost, situation.limits, self._command, guesses, elapsed)
        found = self._roll_out(situation, targets[None])
        if (
            max(np.abs(targets[:6]).max(), np.abs(self._command).max()) > CRAWLING_SPEED
            or error < SMALL_ERROR_M
        ):
            self._last_progress = now
        if now - self._last_progress > BLOCKED_AFTER_S:
            return self._stop(State.BLOCKED, "something stands in the way", elapsed)
        if not self._is_safe(situation, targets, found.poses):
            return self._stop(State.FOLLOWING, "brakes: something is too near", elapsed)
        self._ramp_command(targets[0], elapsed, situation.limits)
        return Plan(self._command.copy(), State.FOLLOWING, "follows", found.poses[0])

    def _slow_down(self, state: State, words: str, elapsed: float) -> Plan:
        """Decelerate to zero within the usual limits."""
        self._ramp_command(np.zeros(3), elapsed, self._limits)
        return Plan(self._command.copy(), state, words, np.zeros((0, 3)))

    def _ramp_command(self, target: Array, elapsed: float, limits: Limits) -> None:
        """Move the command toward `target` with bounded acceleration and jerk."""
        if elapsed == 0.0:
            return
        wanted = (limits.ramp(self._command, target, elapsed) - self._command) / elapsed
        self._rate = self._rate + np.clip(wanted - self._rate, -MAX_JERK * elapsed, MAX_JERK * elapsed)
        before = self._command
        self._command = before + self._rate * elapsed
        past = (target - before) * (target - self._command) <= 0.0  # it would overshoot
        self._command = np.where(past, target, self._command)
        self._rate = np.where(past, 0.0, self._rate)

    def _present_motion(self, now: float) -> tuple[Array, Array]:
        """Return pose (3,) and velocity (3,) of the robot, extrapolated to `now`."""
        assert self._odometry is not None
        (pose, velocity), late = self._odometry.value, now - self._odometry.now
        c, s = np.cos(pose[2]), np.sin(pose[2])
        ahead = [c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1], velocity[2]]
        return pose + late * np.array(ahead), velocity

    def _clearance_field(self, pose: Array) -> Clearance:
        """Return the distances to obstacles around a pose."""
        return Clearance(self._memory.points, pose[:2], self.config.length, self.config.width)

    def _situation(self, now: float) -> Situation:
        """Return everything known at `now`."""
        assert self._scan is not None
        assert self._odometry is not None
        assert self._person is not None
        pose, velocity = self._present_motion(now)
        # Present time on the clock of the stamps, estimated from the odometry.
        stamp = self._odometry.stamp + now - self._odometry.now
        person = _extrapolate(self._person.value[None], stamp - self._person.stamp)[0]
        others = np.zeros((0, 4))
        if self._others is not None and now - self._others.now <= self.config.person_timeout:
            others = _extrapolate(self._others.value, stamp - self._others.stamp)
            others = others[np.hypot(*(others[:, :2] - person[:2]).T) > 2.0 * PERSON_RADIUS_M]
        scan, sensor = self._scan.value
        field = self._clearance_field(pose)
        goal, remaining = self._find_goal(field, pose, person)
        return Situation(
            pose=pose,
            velocity=velocity,
            command=self._command,
            person=person,
            others=others,
            goal=goal,
            remaining=remaining,
            clearance=field,
            scan=scan,
            sensor=sensor,
            limits=self._limits_now(scan, person[:2] - pose[:2]),
        )

    def _limits_now(self, scan: Scan, off: Array) -> Limits:
        """Return the present limits.

        Slower for a person with an uncertain position or, at `off` (2,) in m, nearby; backward only
        where the scan shows free space.
        """
        assert self._person is not None
        share = np.interp(self._deviation, (SURE_DEVIATION_M, UNSURE_DEVIATION_M), (1.0, MIN_SPEED_SHARE))
        vx, vy, wz = self.config.max_velocity
        vx = min(vx, _speed_to_stop(float(np.hypot(*off)) - STOP_DISTANCE_SHARE * self.config.distance))
        seen = scan.range_at(REAR_ANGLES_RAD - self._mounting[2])
        backward = MAX_BACKWARD_SPEED if (seen > self.config.length).all() else 0.0
        return attrs.evolve(self._limits, velocity=(share * vx, share * vy, wz), backward=backward)

    def _find_goal(self, field: Clearance, pose: Array, person: Array) -> tuple[Array, float]:
        """Return the goal (2,) and its distance from the person along the trail, m.

        The goal is the person if the straight line to it is free; else the newest point of its
        trail with a free line.
        """
        if self._is_free(field, pose, person[:2], self.config.distance):
            return person[:2], 0.0
        trail = self._trail.points
        left = np.hypot(*np.diff(np.vstack([trail, person[:2]]), axis=0).T)
        remaining = np.cumsum(left[::-1])[::-1]
        for place, far in zip(trail[::-1], remaining[::-1], strict=True):
            if self._is_free(field, pose, place, 0.0):
                return place, max(float(far), 1e-3)
        return person[:2], 0.0

    def _is_free(self, field: Clearance, pose: Array, place: Array, short: float) -> bool:
        """Return whether the straight line to `place`, up to `short` (m) before it, is free."""
        off = place - pose[:2]
        far = float(np.hypot(*off))
        along = np.arange(0.1, max(far - short, 0.0), 0.1)
        if not len(along):
            along = np.array([max(far - short, 0.0)])
        line = pose[:2] + along[:, None] * off / max(far, 1e-6)
        return bool((field.at_points(line) > 0.5 * self.config.width + 0.5 * self.config.clearance).all())

    def _errors(self, situation: Situation) -> tuple[float, float]:
        """Return the present errors of distance (m) and heading (rad)."""
        far, turn = self._cost.tracking_errors(
            situation, situation.pose[None, None], situation.person[None, :2]
        )
        return float(far[0, 0]), float(turn[0, 0])

    def _may_stand(self, situation: Situation, error: float, turn: float) -> bool:
        """Return whether the robot is within its tolerance, or too near, and the person stands."""
        if np.hypot(*situation.person[2:]) > STANDING_SPEED or not situation.is_direct:
            return False
        far, off = ARRIVAL_TOLERANCE if self._command.any() else STAND_TOLERANCE
        return (abs(error) < far or -CROWDING_SHARE * self.config.distance < error < 0.0) and abs(turn) < off

    def _initial_guesses(self, situation: Situation) -> Array:
        """Return candidates toward the goal that ignore obstacles, (n, STEPS, 3)."""
        person, pose = predict_target(situation.person), situation.pose
        start = np.broadcast_to(pose, (1, STEPS, 3))
        far = self._cost.tracking_errors(situation, start, person)[0][0]
        goal = self._cost.target_point(situation)
        return pursue(pose, goal, far, float(np.hypot(*situation.person[2:])), situation.limits)

    def _roll_out(self, situation: Situation, targets: Array) -> Rollouts:
        """Return the rollouts of targets."""
        return roll_out(targets, situation.pose, situation.velocity, situation.command, situation.limits)

    def _is_safe(self, situation: Situation, targets: Array, planned: Array) -> bool:
        """Return whether braking after this step, or following the plan, hits nothing."""
        braking = np.zeros((1, STEPS, 3))
        braking[0, 0] = targets[0]
        stopping = attrs.evolve(situation.limits, deceleration=self.config.stop_deceleration)
        poses = roll_out(braking, situation.pose, situation.velocity, situation.command, stopping).poses
        for way in (poses, planned):
            gaps = self._cost.person_gaps(situation, way)[..., TIMES_S < SAFETY_HORIZON_S]
            if min(situation.clearance.at_poses(way).min(), gaps.min()) > 0.0:
                return True
        return False


def _speed_to_stop(room: float) -> float:
    """Return the speed in m/s from which the robot can stop within `room` (m).

    With reaction time t_r and deceleration a: t_r v + v^2 / (2 a) = room.
    """
    return BRAKING_DECELERATION * (
        np.sqrt(REACTION_TIME_S**2 + 2.0 * max(room, 0.05) / BRAKING_DECELERATION) - REACTION_TIME_S
    )


def _parse_persons(persons: ArrayLike) -> Array:
    """Return people as a finite array (n, 4), or raise ValueError."""
    found = np.asarray(persons, float).reshape(-1, 4)
    if not np.isfinite(found).all():
        raise ValueError(f"persons are {found.tolist()}, expected finite numbers")
    return found


def _extrapolate(persons: Array, seconds: float) -> Array:
    """Return people (n, 4) after `seconds` at constant velocity."""
    return np.column_stack([persons[:, :2] + seconds * persons[:, 2:], persons[:, 2:]])
