"""Follows a person: from scans, odometry and tracks to velocities, with what the planner is doing and why.

Plain numbers and times; it knows no ROS. `follow_costs` says which ways are good, `dynamic_window` looks for the best of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .clearance import Clearance
from .clusters import Scan
from .dynamic_window import DynamicWindow
from .follow_costs import BODY, FollowCost, Situation, predict_target
from .obstacle_memory import ObstacleMemory
from .pose_history import PoseHistory
from .pursuit import pursue
from .rollouts import STEPS, TIMES, Axes, Limits, Rollouts, roll_out
from .trail import Trail

Array = NDArray[np.float64]

PERIOD = 0.05  # s, from one step to the next
SIDES = {"behind": 0, "left": 1, "right": -1}
CURVE = 3.0  # m/s^2, to which a turn at speed is held; above 1.3 m/s the shipped policy holds turns tighter itself
BACKWARD = 0.4  # m/s, where the scanner sees what is behind
BEHIND = np.linspace(-0.5, 0.5, 7) + np.pi  # rad, what has to be seen there
JERK = np.array([10.0, 8.0, 16.0])  # m/s^3, rad/s^3, of commands
SURE = (
    0.3  # m, standard deviation of a person's position up to which it is taken to be where it is said to be
)
UNSURE = 1.0  # m, from which the robot is as slow as it gets
SLOWEST = 0.4  # of its speed, where the person is unsure
NEAREST = 0.7  # of the distance, where the robot has to have stopped if the person stops at once
REACTS, BRAKES = (
    0.4,
    1.8,
)  # s, m/s^2, until it brakes for a person who stops, the tracker's delay included, and how
STAND_TOLERANCE = (0.25, 0.5)  # m, rad, errors of a standing robot that it leaves alone
ARRIVED = (0.12, 0.2)  # m, rad, those of a walking robot that may stand
CROWDED = 0.4  # of the distance, by which the robot may stand too near
STANDS = 0.25  # m/s, below which a person stands
NEARLY = 0.4  # m, of the distance that is too large, up to which nothing is in the way
TRIES = 0.6  # s, without a way, after which the robot says that it is blocked
SOON = 0.8  # s, in which nobody may be met, were the robot to brake
CRAWLING = 0.1  # m/s, rad/s, below which a plan leads nowhere
WAITS = 1.0  # s, from a track that was lost to the first look around
TURN = 1.0  # rad/s, of looking around
ROOM = 0.05  # m, round a robot that turns on the spot


class State(Enum):
    """What the planner is doing."""

    WAITING = "waiting"
    FOLLOWING = "following"
    BLOCKED = "blocked"
    LOST = "lost"
    LOOKING = "looking around"
    BLIND = "blind"


def _described(default: Any, description: str, positive: bool = True) -> Any:
    def check(_: object, field: Any, value: Any) -> None:
        numbers = np.ravel(value)
        if not (np.isfinite(numbers).all() and (not positive or (numbers > 0.0).all())):
            raise ValueError(
                f"{field.name} is {value}, expected finite numbers{' above 0' if positive else ''}"
            )

    return attrs.field(default=default, validator=check, metadata={"description": description})


@attrs.frozen(kw_only=True)
class FollowConfig:
    """What is wanted, what the robot can do, and where its scanner is."""

    distance: float = _described(1.5, "distance to the person, m")
    side: str = attrs.field(
        default="behind",
        validator=attrs.validators.in_(SIDES),
        metadata={"description": "where the robot goes: behind, left or right of the person"},
    )
    clearance: float = _described(0.3, "clearance from the robot's outline that it keeps where it can, m")
    max_velocity: Axes = _described((2.5, 0.6, 1.5), "largest vx, vy, wz commanded, m/s, rad/s")
    acceleration: Axes = _described(
        (1.2, 0.8, 1.5), "largest change of a command away from zero, m/s^2, rad/s^2"
    )
    deceleration: Axes = _described(
        (2.5, 1.5, 3.0), "largest change of a command towards zero, m/s^2, rad/s^2"
    )
    stop_deceleration: Axes = _described(
        (5.0, 4.0, 8.0), "the same where the robot has to stop at once, m/s^2, rad/s^2"
    )
    length: float = _described(0.65, "length of the robot's outline, legs included, m")
    width: float = _described(0.35, "its width, m")
    laser_x: float = _described(
        0.25, "where the laser is on the robot: forward, m; as in the shipped worlds", positive=False
    )
    laser_y: float = _described(0.0, "where the laser is on the robot: to the left, m", positive=False)
    laser_yaw: float = _described(0.0, "where the laser looks on the robot: to the left, rad", positive=False)
    scan_timeout: float = _described(0.2, "silence of the scan after which the robot stops, s")
    odom_timeout: float = _described(0.2, "silence of the odometry after which the robot stops, s")
    person_timeout: float = _described(0.2, "silence about the person after which it is lost, s")
    robot_timeout: float = _described(
        0.5, "silence of the controller after which what it last refused no longer counts, s"
    )


@attrs.frozen
class Plan:
    """velocity (3,): vx, vy (m/s), wz (rad/s) to command now; words: a sentence for people; way (n, 3): the poses, frame of the
    odometry, that it leads to, none where the robot stands.
    """

    velocity: Array
    state: State
    words: str
    way: Array


@attrs.frozen
class _Heard:
    """Something at `stamp`, on the clock of the stamps, that was heard at `now`, on the planner's clock, s."""

    now: float
    stamp: float
    value: Any


class FollowPlanner:
    """Take what arrives by `on_...`, then ask `step` at a rate of 1 / PERIOD."""

    def __init__(self, config: FollowConfig | None = None) -> None:
        self.config = config = config or FollowConfig()
        self._cost = FollowCost(
            config.distance, SIDES[config.side], config.clearance, config.length, config.width
        )
        self._search = DynamicWindow()
        self._limits = Limits(config.max_velocity, BACKWARD, CURVE, config.acceleration, config.deceleration)
        self._mounting = np.array([config.laser_x, config.laser_y, config.laser_yaw])
        self._poses = PoseHistory(self._mounting.tolist())
        self._memory = ObstacleMemory()
        self._trail = Trail()
        self._waiting: deque[_Heard] = deque(maxlen=5)  # scans that are newer than the odometry
        self._scan: _Heard | None = None
        self._odometry: _Heard | None = None
        self._person: _Heard | None = None
        self._deviation = 0.0  # m, of its position
        self._refusal: _Heard | None = None
        self._others: _Heard | None = None
        self._command = np.zeros(3)
        self._rate = np.zeros(3)  # of the command
        self._stepped = -np.inf
        self._leading = -np.inf  # s, when a way was found last
        self._lost = np.inf  # s, since when the person is lost
        self._turned: float | None = (
            None  # rad, of looking around; None before it, and once it is over: a whole turn
        )

    def on_odometry(self, now: float, stamp: float, pose: Sequence[float], velocity: ArrayLike) -> None:
        """pose: x, y (m), yaw (rad); velocity (3,): vx, vy (m/s), wz (rad/s), body frame. Raises ValueError if not finite."""
        motion = np.asarray(velocity, float)
        if not np.isfinite(motion).all():
            raise ValueError(f"velocity is {motion.tolist()}, expected finite numbers")
        if stamp <= self._poses.newest:
            self._scan = None
            self._waiting.clear()
            self._memory = ObstacleMemory()
        self._poses.add(stamp, pose)
        self._odometry = _Heard(now, stamp, (np.array(pose, float), motion))
        while self._waiting and self._waiting[0].stamp <= stamp:
            self._use(self._waiting.popleft())

    def on_scan(
        self, now: float, stamp: float, ranges: ArrayLike, angle_min: float, angle_increment: float
    ) -> None:
        """Ranges (rays,) in m. Raises ValueError for a scan that is none."""
        heard = _Heard(now, stamp, Scan.checked(ranges, angle_min, angle_increment))
        if stamp <= self._poses.newest:
            self._use(heard)
        else:
            self._waiting.append(heard)

    def _use(self, heard: _Heard) -> None:
        pose = self._poses.sensor_at(heard.stamp)
        known = [
            _moved(_persons(h.value), heard.stamp - h.stamp)[:, :2] for h in (self._person, self._others) if h
        ]
        self._memory.add(heard.stamp, heard.value, pose, np.concatenate(known) if known else ())
        self._scan = _Heard(heard.now, heard.stamp, (heard.value, pose))

    def on_person(self, now: float, stamp: float, person: ArrayLike, deviation: float) -> None:
        """The one to follow: x, y (m), vx, vy (m/s), frame of the odometry; standard deviation of its position, m.

        Raises ValueError if not finite.
        """
        found = _persons(person)[0]
        if not deviation >= 0.0:
            raise ValueError(f"deviation is {deviation}, expected 0 m or more")
        self._person, self._deviation = _Heard(now, stamp, found), deviation
        if deviation < SURE:
            self._trail.add(found[:2])

    def on_robot(self, now: float, refusal: str) -> None:
        """Why the robot follows no velocity, a sentence; empty where it does. Who never hears of it takes it to follow."""
        self._refusal = _Heard(now, now, refusal)

    def on_others(self, now: float, stamp: float, persons: ArrayLike) -> None:
        """Everybody else, (n, 4) as in `on_person`; the person to follow may be among them. Raises ValueError if not finite."""
        self._others = _Heard(now, stamp, _persons(persons))

    @property
    def obstacles(self) -> Array:
        """Where something stands, (n, 2) m, frame of the odometry."""
        return self._memory.points

    def step(self, now: float) -> Plan:
        """What to command at `now` (s)."""
        elapsed = min(max(now - self._stepped, 0.0), 2.0 * PERIOD)
        self._stepped = now
        state, words = self._judge(now)
        if state is State.FOLLOWING:
            return self._follow(now, elapsed)
        self._search.reset()
        if state is State.LOOKING:
            return self._look_around(now, elapsed)
        return self._stop(state, words, elapsed)

    def _judge(self, now: float) -> tuple[State, str]:
        """What can be done with what was heard; of a person that is lost `_lost` keeps since when."""
        config = self.config
        for what, heard, timeout in (
            ("odometry", self._odometry, config.odom_timeout),
            ("scan", self._scan, config.scan_timeout),
        ):
            if heard is None or not 0.0 <= now - heard.now <= timeout:
                return State.BLIND, f"the {what} is silent" if heard else f"there was no {what} yet"
        refusal = self._refusal
        if refusal and refusal.value and 0.0 <= now - refusal.now <= config.robot_timeout:
            self._lost, self._turned = np.inf, None
            return State.WAITING, f"the robot does not walk: {refusal.value}"
        if self._person is None:
            return State.WAITING, "nobody is meant"
        if 0.0 <= now - self._person.now <= config.person_timeout:
            self._lost, self._turned = np.inf, None
            return State.FOLLOWING, ""
        if self._lost == np.inf:
            self._lost, self._leading = now, -np.inf
        if now - self._lost < WAITS or (self._turned or 0.0) >= 2.0 * np.pi:
            return State.LOST, "the person is lost"
        return State.LOOKING, "the person is lost; looks around"

    def _stop(self, state: State, words: str, elapsed: float) -> Plan:
        step = elapsed * np.array(self.config.stop_deceleration)
        self._command = self._command - np.clip(self._command, -step, step)
        self._rate = np.zeros(3)
        return Plan(self._command.copy(), state, words, np.zeros((0, 3)))

    def _look_around(self, now: float, elapsed: float) -> Plan:
        """Once around, to the side where the person was, if there is room to turn."""
        pose, velocity = self._now(now)
        corners = np.column_stack(
            [np.tile(pose[:2], (12, 1)), np.linspace(-np.pi, np.pi, 12, endpoint=False)]
        )
        if self._field(pose).of(corners).min() < ROOM:
            return self._stop(State.LOST, "the person is lost, and there is no room to look around", elapsed)
        self._turned = (self._turned or 0.0) + abs(velocity[2]) * elapsed
        assert self._person is not None
        off = self._person.value[:2] - pose[:2]
        if self._command[2] == 0.0:
            side = np.sign(np.sin(np.arctan2(off[1], off[0]) - pose[2])) or 1.0
        else:
            side = np.sign(self._command[2])
        self._advance(np.array([0.0, 0.0, side * TURN]), elapsed, self._limits)
        return Plan(self._command.copy(), State.LOOKING, "the person is lost; looks around", np.zeros((0, 3)))

    def _follow(self, now: float, elapsed: float) -> Plan:
        situation = self._situation(now)
        error, turn = self._errors(situation)
        if self._may_stand(situation, error, turn):
            self._leading = now
            self._search.reset()
            return self._ease(State.FOLLOWING, "stands with the person", elapsed)
        guesses = self._guesses(situation)

        def cost(targets: Array) -> Array:
            return self._cost.of(situation, self._rolled(situation, targets))

        targets = self._search.search(cost, situation.limits, self._command, guesses, elapsed)
        found = self._rolled(situation, targets[None])
        if max(np.abs(targets[:6]).max(), np.abs(self._command).max()) > CRAWLING or error < NEARLY:
            self._leading = now
        if now - self._leading > TRIES:
            return self._stop(State.BLOCKED, "something stands in the way", elapsed)
        if not self._is_safe(situation, targets, found.poses):
            return self._stop(State.FOLLOWING, "brakes: something is too near", elapsed)
        self._advance(targets[0], elapsed, situation.limits)
        return Plan(self._command.copy(), State.FOLLOWING, "follows", found.poses[0])

    def _ease(self, state: State, words: str, elapsed: float) -> Plan:
        self._advance(np.zeros(3), elapsed, self._limits)
        return Plan(self._command.copy(), state, words, np.zeros((0, 3)))

    def _advance(self, target: Array, elapsed: float, limits: Limits) -> None:
        """The command on towards `target`, with a bounded jerk."""
        if elapsed == 0.0:
            return
        wanted = (limits.ramped(self._command, target, elapsed) - self._command) / elapsed
        self._rate = self._rate + np.clip(wanted - self._rate, -JERK * elapsed, JERK * elapsed)
        before = self._command
        self._command = before + self._rate * elapsed
        past = (target - before) * (target - self._command) <= 0.0  # it would overshoot
        self._command = np.where(past, target, self._command)
        self._rate = np.where(past, 0.0, self._rate)

    def _now(self, now: float) -> tuple[Array, Array]:
        """Pose and velocity (3,) of the robot, moved on to `now`."""
        assert self._odometry is not None
        (pose, velocity), late = self._odometry.value, now - self._odometry.now
        c, s = np.cos(pose[2]), np.sin(pose[2])
        ahead = [c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1], velocity[2]]
        return pose + late * np.array(ahead), velocity

    def _field(self, pose: Array) -> Clearance:
        return Clearance(self._memory.points, pose[:2], self.config.length, self.config.width)

    def _situation(self, now: float) -> Situation:
        assert self._scan is not None
        assert self._odometry is not None
        assert self._person is not None
        pose, velocity = self._now(now)
        # The stamps' clock, as far as the odometry tells.
        stamp = self._odometry.stamp + now - self._odometry.now
        person = _moved(self._person.value[None], stamp - self._person.stamp)[0]
        others = np.zeros((0, 4))
        if self._others is not None and now - self._others.now <= self.config.person_timeout:
            others = _moved(self._others.value, stamp - self._others.stamp)
            others = others[np.hypot(*(others[:, :2] - person[:2]).T) > 2.0 * BODY]
        scan, sensor = self._scan.value
        field = self._field(pose)
        goal, rest = self._goal(field, pose, person)
        return Situation(
            pose=pose,
            velocity=velocity,
            command=self._command,
            person=person,
            others=others,
            goal=goal,
            rest=rest,
            clearance=field,
            scan=scan,
            sensor=sensor,
            limits=self._limits_now(scan, person[:2] - pose[:2]),
        )

    def _limits_now(self, scan: Scan, off: Array) -> Limits:
        """Slower for a person who is unsure or, at `off` (2,) m, near; backwards only where the scan shows what is there."""
        assert self._person is not None
        share = np.interp(self._deviation, (SURE, UNSURE), (1.0, SLOWEST))
        vx, vy, wz = self.config.max_velocity
        vx = min(vx, _speed_to_stop(float(np.hypot(*off)) - NEAREST * self.config.distance))
        seen = scan.at(BEHIND - self._mounting[2])
        backward = BACKWARD if (seen > self.config.length).all() else 0.0
        return attrs.evolve(self._limits, velocity=(share * vx, share * vy, wz), backward=backward)

    def _goal(self, field: Clearance, pose: Array, person: Array) -> tuple[Array, float]:
        """The person where the way to it is free; else the newest place on its trail with a free way, and how far on it is."""
        if self._is_free(field, pose, person[:2], self.config.distance):
            return person[:2], 0.0
        trail = self._trail.points
        left = np.hypot(*np.diff(np.vstack([trail, person[:2]]), axis=0).T)
        rest = np.cumsum(left[::-1])[::-1]
        for place, far in zip(trail[::-1], rest[::-1], strict=True):
            if self._is_free(field, pose, place, 0.0):
                return place, max(float(far), 1e-3)
        return person[:2], 0.0

    def _is_free(self, field: Clearance, pose: Array, place: Array, short: float) -> bool:
        """Whether the robot could go straight to `place`, `short` of it."""
        off = place - pose[:2]
        far = float(np.hypot(*off))
        along = np.arange(0.1, max(far - short, 0.0), 0.1)
        if not len(along):
            along = np.array([max(far - short, 0.0)])
        line = pose[:2] + along[:, None] * off / max(far, 1e-6)
        return bool((field.of_disc(line) > 0.5 * self.config.width + 0.5 * self.config.clearance).all())

    def _errors(self, situation: Situation) -> tuple[float, float]:
        far, turn = self._cost.errors(situation, situation.pose[None, None], situation.person[None, :2])
        return float(far[0, 0]), float(turn[0, 0])

    def _may_stand(self, situation: Situation, error: float, turn: float) -> bool:
        """Whether the robot is where it should be, or nearer, with a person who stands."""
        if np.hypot(*situation.person[2:]) > STANDS or not situation.direct:
            return False
        far, off = ARRIVED if self._command.any() else STAND_TOLERANCE
        return (abs(error) < far or -CROWDED * self.config.distance < error < 0.0) and abs(turn) < off

    def _guesses(self, situation: Situation) -> Array:
        """Towards the goal, as if nothing stood about, (n, STEPS, 3)."""
        person, pose = predict_target(situation.person), situation.pose
        start = np.broadcast_to(pose, (1, STEPS, 3))
        far = self._cost.errors(situation, start, person)[0][0]
        goal = self._cost.place(situation)
        return pursue(pose, goal, far, float(np.hypot(*situation.person[2:])), situation.limits)

    def _rolled(self, situation: Situation, targets: Array) -> Rollouts:
        return roll_out(targets, situation.pose, situation.velocity, situation.command, situation.limits)

    def _is_safe(self, situation: Situation, targets: Array, planned: Array) -> bool:
        """Whether the robot hits nothing if it brakes after this step, or else if it goes on as planned."""
        braking = np.zeros((1, STEPS, 3))
        braking[0, 0] = targets[0]
        stopping = attrs.evolve(situation.limits, deceleration=self.config.stop_deceleration)
        poses = roll_out(braking, situation.pose, situation.velocity, situation.command, stopping).poses
        for way in (poses, planned):
            gaps = self._cost.gaps(situation, way)[..., TIMES < SOON]
            if min(situation.clearance.of(way).min(), gaps.min()) > 0.0:
                return True
        return False


def _speed_to_stop(room: float) -> float:
    """m/s, from which the robot still stops within `room` (m): REACTS v + v^2 / (2 BRAKES) = room."""
    return BRAKES * (np.sqrt(REACTS**2 + 2.0 * max(room, 0.05) / BRAKES) - REACTS)


def _persons(persons: ArrayLike) -> Array:
    """(n, 4)."""
    found = np.asarray(persons, float).reshape(-1, 4)
    if not np.isfinite(found).all():
        raise ValueError(f"persons are {found.tolist()}, expected finite numbers")
    return found


def _moved(persons: Array, seconds: float) -> Array:
    """Persons (n, 4) after as long."""
    return np.column_stack([persons[:, :2] + seconds * persons[:, 2:], persons[:, 2:]])
