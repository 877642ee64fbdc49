"""A scene as it runs: persons, a robot of delay, lag and bounded acceleration, and between them laser, tracker, planner, mux."""

from __future__ import annotations

from collections import deque
from time import process_time
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_follow.clearance import outline_distance
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, State
from quadvel_follow.leg_detector import LegDetector
from quadvel_policy.command_mux import CommandMux, MuxConfig, MuxInput
from quadvel_sim.laser import Scan
from quadvel_sim.walker import leg_circles

from ..people.laser import FloorPlan, Laser
from .follower import Follower
from .scenes import FollowScene

Array = NDArray[np.float64]

STEP = 0.01  # s
DELAY = 0.06  # s, from a command to the first motion
LAG = 0.15  # s, of the velocity behind it
ACCELERATION = np.array([2.6, 2.0, 6.0])  # m/s^2, rad/s^2, that the robot reaches
FOLLOW = MuxInput("follow", 50, 0.15)
MOUNTING = np.array([0.3, 0.0, 0.0])  # m, rad, of the laser on the robot
CONFIG = FollowConfig(laser_x=float(MOUNTING[0]))
LASER = Laser(rays=541, angle_min=-0.75 * np.pi, angle_increment=np.deg2rad(0.5), range_max=12.0)
GROUND = 0.15  # share of the scans in which some rays hit the ground
BAND = 0.5  # m, round the set distance
SETTLED = 6.0  # s, after which the distance counts: then the person sets out
POLITE = 0.3  # m, before the robot's outline, where a person waits
WIDE = 0.02  # m, between the points of a wall


@attrs.define
class Robot:
    """pose (3,): x, y (m), yaw (rad); velocity (3,): vx, vy (m/s), wz (rad/s), body frame."""

    pose: Array
    velocity: Array = attrs.field(factory=lambda: np.zeros(3))
    _commands: deque[Array] = attrs.field(factory=deque, init=False)

    def step(self, command: Array) -> None:
        """STEP on, under a command of `DELAY` ago."""
        self._commands.append(command)
        if len(self._commands) > DELAY / STEP:
            late = self._commands.popleft()
            change = (late - self.velocity) / LAG
            self.velocity = self.velocity + STEP * np.clip(change, -ACCELERATION, ACCELERATION)
        (vx, vy, wz), c, s = self.velocity, np.cos(self.pose[2]), np.sin(self.pose[2])
        self.pose = self.pose + STEP * np.array([c * vx - s * vy, s * vx + c * vy, wz])

    @property
    def sensor(self) -> Array:
        """The laser's pose (3,)."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        x, y, yaw = MOUNTING
        return self.pose + np.array([c * x - s * y, s * x + c * y, yaw])


@attrs.frozen
class Instant:
    """What is kept of each period. clearance, gap: m, from the outline to what stands, and to persons."""

    time: float
    pose: Array
    velocity: Array
    command: Array
    person: Array
    state: State
    words: str
    clearance: float
    gap: float
    milliseconds: float


class Stage:
    """`run` is a generator of instants; `mute`, what is not heard while it is set: "scan", "person" or "planner"."""

    def __init__(
        self,
        scene: FollowScene,
        seed: int,
        detector: LegDetector,
        config: FollowConfig = CONFIG,
    ) -> None:
        self._scene, self._rng = scene, np.random.default_rng(seed)
        self.config = config
        self._follower = Follower(self.config, detector)
        self._mux = CommandMux([FOLLOW], MuxConfig(acceleration=self.config.acceleration))
        first = scene.persons[0].position
        self.robot = Robot(np.array([first[0] - scene.start, first[1], 0.0]))
        self._standing = _points(scene.plan)
        self._half = (0.5 * self.config.length, 0.5 * self.config.width)
        self._ahead = np.zeros((len(scene.persons), 2))  # where each walked last
        self.mute = ""

    def run(self) -> Any:
        """Instants, PERIOD apart."""
        often = round(PERIOD_S / STEP)
        command = np.zeros(3)
        for tick in range(round(self._scene.seconds / STEP)):
            now = tick * STEP
            if tick % 2 == 0:
                self._follower.on_odometry(now, self.robot.pose.tolist(), self.robot.velocity)
                command = self._mux.update(now).velocity
            if tick % often == 0:
                self._look(now)
                begin = process_time()
                plan = self._follower.step(now)
                took = process_time() - begin
                if self.mute != "planner":
                    self._mux.receive(FOLLOW.name, now, plan.velocity)
                yield self._instant(now, command, plan.state, plan.reason, 1e3 * took)
            self.robot.step(command)
            self._walk()

    def _look(self, now: float) -> None:
        """Scan and track."""
        plan = self._scene.plan.with_circles(leg_circles(self._scene.persons))
        ranges = self._hit_ground(LASER.scan(plan, self.robot.sensor, self._rng))
        if self.mute == "scan":
            return
        scan = Scan(now, ranges, LASER.angle_min, LASER.angle_increment)
        meant = self._follower.on_scan(now, scan, self.robot.sensor)
        if self.mute != "person":
            self._follower.on_person(now, meant)

    def _hit_ground(self, ranges: Array) -> Array:
        """Now and then rays ahead end on the ground, 3 to 6 m away, as the trunk pitches."""
        if self._rng.random() < GROUND:
            hit = np.abs(LASER.angles - self._rng.uniform(-0.8, 0.8)) < self._rng.uniform(0.0, 0.4)
            ranges = np.where(hit, np.fmin(ranges, self._rng.uniform(3.0, 6.0)), ranges)
        return ranges

    def _walk(self) -> None:
        """Everybody a step on; nobody walks into a robot."""
        for i, walker in enumerate(self._scene.persons):
            before = walker.position
            nearest = before + 0.3 * self._ahead[i]
            gap = outline_distance(nearest, self.robot.pose, self._half)
            if gap < POLITE and (self.robot.pose[:2] - before) @ self._ahead[i] > 0.0:
                walker.time += STEP
                continue
            walker.step(STEP)
            way = walker.position - before
            if way.any():
                self._ahead[i] = way / np.hypot(*way)

    def _instant(self, now: float, command: Array, state: State, words: str, took: float) -> Instant:
        pose, persons = self.robot.pose, leg_circles(self._scene.persons)
        standing = outline_distance(self._standing[:, :2], pose, self._half) - self._standing[:, 2]
        legs = outline_distance(persons[:, :2], pose, self._half) - persons[:, 2]
        return Instant(
            now,
            pose.copy(),
            self.robot.velocity.copy(),
            command,
            self._scene.persons[0].position,
            state,
            words,
            float(standing.min()),
            float(legs.min()),
            took,
        )


def _points(plan: FloorPlan) -> Array:
    """Circles, and segments as circles without a radius, (n, 3)."""
    found = [plan.circles]
    for ax, ay, bx, by in plan.segments:
        share = np.linspace(0.0, 1.0, 2 + int(np.hypot(bx - ax, by - ay) / WIDE))
        found.append(np.column_stack([ax + share * (bx - ax), ay + share * (by - ay), np.zeros(len(share))]))
    return np.concatenate(found)
