"""Simulates person following with a planar robot of delay, lag and bounded acceleration.

Laser, tracker, planner and mux are the real classes.
"""

from __future__ import annotations

from collections import deque
from time import process_time
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_follow.clearance import outline_distance
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, State
from quadvel_follow.leg_detector import LegDetector
from quadvel_policy.command_mux import CommandMux, MuxConfig, MuxInput
from quadvel_sim.laser import Scan
from quadvel_sim.walker import leg_circles

from ..people.laser import FloorPlan, Laser
from .follower import Follower
from .scenes import FollowScene

STEP_S = 0.01
COMMAND_DELAY_S = 0.06  # from a command to the first motion
VELOCITY_LAG_S = 0.15  # time constant of the velocity
MAX_ACCELERATION = np.array([2.6, 2.0, 6.0])  # m/s^2, rad/s^2
FOLLOW_INPUT = MuxInput("follow", 50, 0.15)
MOUNTING = np.array([0.3, 0.0, 0.0])  # m, rad, of the laser on the robot
CONFIG = FollowConfig(laser_x=float(MOUNTING[0]))
LASER = Laser(rays=541, angle_min=-0.75 * np.pi, angle_increment=np.deg2rad(0.5), range_max=12.0)
GROUND_HIT_PROBABILITY = 0.15  # share of scans in which some rays hit the ground
DISTANCE_BAND_M = 0.5  # around the set distance
SETTLING_TIME_S = 6.0  # until the person starts to walk and the distance counts
YIELD_DISTANCE_M = 0.3  # from the robot's outline, at which a person waits
WALL_POINT_SPACING_M = 0.02  # between points of a wall


@attrs.define
class PlanarRobot:
    """Planar robot with command delay, velocity lag and bounded acceleration.

    Attributes:
        pose: x, y (m) and yaw (rad), (3,).
        velocity: vx, vy (m/s) and wz (rad/s), body frame, (3,).
    """

    pose: Array
    velocity: Array = attrs.field(factory=lambda: np.zeros(3))
    _commands: deque[Array] = attrs.field(factory=deque, init=False)

    def step(self, command: Array) -> None:
        """Simulate one step of STEP_S.

        Args:
            command: vx, vy (m/s) and wz (rad/s); it takes effect after COMMAND_DELAY_S.
        """
        # v' = clip((u(t - delay) - v) / lag, -a_max, a_max); p' = R(yaw) v. Explicit Euler.
        self._commands.append(command)
        if len(self._commands) > COMMAND_DELAY_S / STEP_S:
            late = self._commands.popleft()
            change = (late - self.velocity) / VELOCITY_LAG_S
            self.velocity = self.velocity + STEP_S * np.clip(change, -MAX_ACCELERATION, MAX_ACCELERATION)
        (vx, vy, wz), c, s = self.velocity, np.cos(self.pose[2]), np.sin(self.pose[2])
        self.pose = self.pose + STEP_S * np.array([c * vx - s * vy, s * vx + c * vy, wz])

    @property
    def sensor(self) -> Array:
        """Pose of the laser: x, y (m) and yaw (rad), (3,)."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        x, y, yaw = MOUNTING
        return self.pose + np.array([c * x - s * y, s * x + c * y, yaw])


@attrs.frozen
class FollowSample:
    """State of the simulation at one planner period.

    Attributes:
        time: Time, s.
        pose: x, y (m) and yaw (rad) of the robot, world frame.
        velocity: vx, vy (m/s) and wz (rad/s) of the robot, body frame.
        command: Commanded vx, vy (m/s) and wz (rad/s) after the mux, body frame.
        person: Position of the person (2,), m.
        state: State of the planner.
        words: Explanation of the state.
        clearance: Distance from the outline to the nearest obstacle, m.
        gap: Distance from the outline to the nearest leg, m.
        milliseconds: Computing time of the planner step, ms.
    """

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


class FollowSimulation:
    """Simulation of a scene; `run` yields its samples.

    Args:
        scene: The scene.
        seed: Seed of the noise.
        detector: Leg detector.
        config: Parameters of the planner.

    Attributes:
        config: Parameters of the planner.
        robot: The robot.
        mute: Message to suppress: "scan", "person" or "planner"; empty: none.
    """

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
        self._mux = CommandMux([FOLLOW_INPUT], MuxConfig(acceleration=self.config.acceleration))
        first = scene.people[0].position
        self.robot = PlanarRobot(np.array([first[0] - scene.initial_distance, first[1], 0.0]))
        self._obstacles = _points(scene.plan)
        self._half = (0.5 * self.config.length, 0.5 * self.config.width)
        self._directions = np.zeros((len(scene.people), 2))  # last walking direction of each person
        self.mute = ""

    def run(self) -> Any:
        """Simulate the scene.

        Yields:
            Samples, one per planner period.
        """
        often = round(PERIOD_S / STEP_S)
        command = np.zeros(3)
        for tick in range(round(self._scene.duration / STEP_S)):
            now = tick * STEP_S
            if tick % 2 == 0:
                self._follower.on_odometry(now, self.robot.pose.tolist(), self.robot.velocity)
                command = self._mux.update(now).velocity
            if tick % often == 0:
                self._scan_and_track(now)
                begin = process_time()
                plan = self._follower.step(now)
                took = process_time() - begin
                if self.mute != "planner":
                    self._mux.receive(FOLLOW_INPUT.name, now, plan.velocity)
                yield self._sample(now, command, plan.state, plan.reason, 1e3 * took)
            self.robot.step(command)
            self._move_people()

    def _scan_and_track(self, now: float) -> None:
        """Simulate a scan and pass it to the follower."""
        plan = self._scene.plan.with_circles(leg_circles(self._scene.people))
        ranges = self._hit_ground(LASER.scan(plan, self.robot.sensor, self._rng))
        if self.mute == "scan":
            return
        scan = Scan(now, ranges, LASER.angle_min, LASER.angle_increment)
        target = self._follower.on_scan(now, scan, self.robot.sensor)
        if self.mute != "person":
            self._follower.on_person(now, target)

    def _hit_ground(self, ranges: Array) -> Array:
        """Let some rays hit the ground 3 to 6 m ahead in some scans, as a pitching trunk does."""
        if self._rng.random() < GROUND_HIT_PROBABILITY:
            hit = np.abs(LASER.angles - self._rng.uniform(-0.8, 0.8)) < self._rng.uniform(0.0, 0.4)
            ranges = np.where(hit, np.fmin(ranges, self._rng.uniform(3.0, 6.0)), ranges)
        return ranges

    def _move_people(self) -> None:
        """Move all people by one step; they wait before they walk into the robot."""
        for i, walker in enumerate(self._scene.people):
            before = walker.position
            nearest = before + 0.3 * self._directions[i]
            gap = outline_distance(nearest, self.robot.pose, self._half)
            if gap < YIELD_DISTANCE_M and (self.robot.pose[:2] - before) @ self._directions[i] > 0.0:
                walker.time += STEP_S
                continue
            walker.step(STEP_S)
            way = walker.position - before
            if way.any():
                self._directions[i] = way / np.hypot(*way)

    def _sample(self, now: float, command: Array, state: State, words: str, took: float) -> FollowSample:
        """Sample of the present state."""
        pose, legs_at = self.robot.pose, leg_circles(self._scene.people)
        standing = outline_distance(self._obstacles[:, :2], pose, self._half) - self._obstacles[:, 2]
        legs = outline_distance(legs_at[:, :2], pose, self._half) - legs_at[:, 2]
        return FollowSample(
            now,
            pose.copy(),
            self.robot.velocity.copy(),
            command,
            self._scene.people[0].position,
            state,
            words,
            float(standing.min()),
            float(legs.min()),
            took,
        )


def _points(plan: FloorPlan) -> Array:
    """Circles, and points on segments as circles of radius 0, (n, 3)."""
    found = [plan.circles]
    for ax, ay, bx, by in plan.segments:
        share = np.linspace(0.0, 1.0, 2 + int(np.hypot(bx - ax, by - ay) / WALL_POINT_SPACING_M))
        found.append(np.column_stack([ax + share * (bx - ax), ay + share * (by - ay), np.zeros(len(share))]))
    return np.concatenate(found)
