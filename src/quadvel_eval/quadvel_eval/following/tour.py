"""Simulates a walk behind a person through a world: laser, tracker, planner, mux, policy and robot.

The classes of the nodes run in one process, as fast as the machine allows. Odometry integrates
the estimated velocity, as the estimator node does. Only the evaluation uses the true pose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate, yaw
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, Plan, State
from quadvel_follow.pose_history import PoseHistory
from quadvel_policy.observation import CONTROL_PERIOD_S as TICK
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sim.world import World

from ..robot_loop import RobotLoop, Sample, make_estimator
from ..segments import rounded
from .follower import Follower
from .obstacles import Clearances
from .stage import DISTANCE_BAND_M, SETTLING_TIME_S

AVERAGING_TIME_S = 0.35  # of compared velocities, to remove the sway of a stride
ODOMETRY_INTERVAL_TICKS = 4  # between odometry messages
STUCK_TIME_S = 180.0  # a robot that stays within STUCK_RADIUS_M for so long ends the tour
STUCK_RADIUS_M = 1.0


@attrs.frozen(kw_only=True)
class TourSetup:
    """Setup of a tour.

    Attributes:
        robot: Name of a shipped robot, or path of a robot.yaml.
        world: Name of a shipped world, or a YAML file.
        path_length: Path length after which the tour ends, m.
        seed: Seed of the simulator.
        policy: ONNX file of the policy; None: the shipped one of the robot.
        estimator: Velocity estimator in the loop.
        estimator_file: ONNX file of the learned estimator; None: the shipped one of the robot.
        distance: Set distance to the person, m.
        plant: Fields of `SimulatorConfig` that differ from the nominal robot.
    """

    robot: str = DEFAULT_ROBOT
    world: str = "campus"
    path_length: float = 3100.0
    seed: int = 0
    policy: Path | None = None
    estimator: str = "learned"
    estimator_file: Path | None = None
    distance: float = 1.5
    plant: dict[str, Any] = attrs.field(factory=dict)


@attrs.frozen
class TourSample:
    """State of the tour at one planner period.

    Attributes:
        time: Time, s.
        pose: True x, y (m) and yaw (rad) of the robot.
        person: True x, y (m) and yaw (rad) of the person.
        commanded: Commanded vx, vy (m/s) and wz (rad/s), averaged over a stride.
        velocity: True vx, vy (m/s) and wz (rad/s), body frame, averaged over a stride.
        state: State of the planner.
        words: Explanation of the state.
        clearance: Distance from the outline to the nearest obstacle, m; inf if none is near.
        gap: Distance from the outline to the nearest person, m; inf without people.
    """

    time: float
    pose: Array
    person: Array
    commanded: Array
    velocity: Array
    state: State
    words: str
    clearance: float
    gap: float


def load_followed_world(source: str) -> World:
    """Load a world with a person to follow.

    Args:
        source: Name of a shipped world, or path of a file.

    Returns:
        The world.

    Raises:
        ValueError: The file cannot be read, is wrong, or has no person.
    """
    world = World.load(source)
    if not world.persons:
        raise ValueError(f"world {source}: persons: found none, expected a person to follow")
    return world


class Tour:
    """Walk behind a person through a world; iterate over `samples` once.

    Args:
        setup: World, robot and length of the tour.

    Attributes:
        setup: World, robot and length of the tour.
        world: The loaded world.
        simulator: The robot.
        walked: Path length of the trunk so far, m.
        fell: Whether the robot fell.
        stuck: Whether the robot stayed within `STUCK_RADIUS_M` for `STUCK_TIME_S`.
        planning: CPU time of each planner step, s.
    """

    def __init__(self, setup: TourSetup) -> None:
        self.setup, self.world = setup, load_followed_world(setup.world)
        robot = load_robot(setup.robot)
        self.simulator = Simulator(
            SimulatorConfig(robot=robot, world=self.world, seed=setup.seed, **setup.plant)
        )
        self.simulator.reset("stand")
        supervisor = Supervisor(robot, PolicyFile(robot, setup.policy), backup=KalmanEstimator(robot))
        estimator = make_estimator(setup.estimator, self.simulator, setup.estimator_file)
        self._loop = RobotLoop(self.simulator, supervisor, estimator)
        laser = self.world.laser
        x, y, _ = laser.position
        self._config = FollowConfig(distance=setup.distance, laser_x=float(x), laser_y=float(y))
        self._follower = Follower(self._config)
        self._poses = PoseHistory([self._config.laser_x, self._config.laser_y, self._config.laser_yaw])
        self._clearances = Clearances(self.world, self._config)
        self.walked, self.fell, self.stuck = 0.0, False, False
        self.planning: list[float] = []

    @property
    def outcome(self) -> Outcome:
        """Outcome of the tour so far."""
        return Outcome(
            world=self.world.name,
            seed=self.setup.seed,
            distance=self.setup.distance,
            walked=self.walked,
            fell=self.fell,
            stuck=self.stuck,
            touched=self.simulator.touch_counts,
            planning=self.planning,
        )

    def samples(self) -> Iterator[TourSample]:
        """Simulate until the path length is reached, or the robot falls or is stuck.

        Yields:
            Samples, one per planner period.
        """
        loop, follower, place = self._loop, self._follower, np.zeros(3)
        loop.start_walking()
        commanded, velocity, command = np.zeros(3), np.zeros(3), np.zeros(3)
        share, often, tick = TICK / AVERAGING_TIME_S, round(PERIOD_S / TICK), 0
        last = self.simulator.truth().position[:2].copy()
        anchor, anchored_at = last, self.simulator.truth().time  # where and since when the robot has stayed
        plan: Plan | None = None
        while self.walked < self.setup.path_length:
            try:
                sample = loop.tick(command)
            except FloatingPointError:
                self.fell = True
                return
            if sample.fallen or sample.mode != "walk":
                self.fell = True
                return
            now = sample.truth.time
            estimated = np.zeros(3) if loop.velocity is None else loop.velocity
            # Dead reckoning: p += dt R(q) v, with the estimated velocity v in the body frame.
            place = place + TICK * rotate(sample.state.quaternion, estimated)
            true = np.append(sample.truth.linear_velocity[:2], sample.truth.angular_velocity[2])
            commanded, velocity = (
                commanded + share * (sample.commanded - commanded),
                velocity + share * (true - velocity),
            )
            if tick % ODOMETRY_INTERVAL_TICKS == 0:
                heading = float(yaw(sample.state.quaternion))
                motion = np.append(estimated[:2], sample.state.angular_velocity[2])
                pose = [*place[:2].tolist(), heading]
                self._poses.add(now, pose)
                follower.on_odometry(now, pose, motion)
                if (scan := self.simulator.scan()) is not None:
                    target = follower.on_scan(now, scan, self._poses.sensor_at(now))
                    follower.on_person(now, target)
            if tick % often == 0 and tick:
                begin = process_time()
                plan = follower.step(now)
                self.planning.append(process_time() - begin)
                command = plan.velocity
                here = sample.truth.position[:2]
                self.walked += float(np.hypot(*(here - last)))
                last = here.copy()
                yield self._sample(sample, commanded, velocity, plan)
                if np.hypot(*(here - anchor)) > STUCK_RADIUS_M:
                    anchor, anchored_at = last, now
                elif now - anchored_at > STUCK_TIME_S:
                    self.stuck = True
                    return
            tick += 1

    def _sample(self, sample: Sample, commanded: Array, velocity: Array, plan: Plan) -> TourSample:
        """Sample of the present state."""
        truth = sample.truth
        pose = np.array([*truth.position[:2], float(yaw(truth.quaternion))])
        people = self.simulator.persons()
        return TourSample(
            truth.time,
            pose,
            people[0],
            commanded,
            velocity,
            plan.state,
            plan.reason,
            self._clearances.to_obstacles(pose),
            self._clearances.to_people(pose, people),
        )


@attrs.frozen(kw_only=True)
class Outcome:
    """Outcome of a walk behind a person, without its samples.

    Attributes:
        world: Name of the world.
        seed: Seed of the run.
        distance: Set distance to the person, m.
        walked: Path length of the trunk, m.
        fell: Whether the robot fell.
        stuck: Whether the robot no longer moved on.
        touched: Number of contacts with each obstacle.
        planning: CPU time of each planner step, s; empty if unknown.
    """

    world: str
    seed: int
    distance: float
    walked: float
    fell: bool
    stuck: bool = False
    touched: Mapping[str, int]
    planning: Sequence[float] = ()


def summarise_tour(outcome: Outcome, samples: Sequence[TourSample]) -> dict[str, Any]:
    """Compute the figures of a tour; the paper reports errors of 0.077 m/s and 0.059 rad/s.

    Args:
        outcome: Outcome of the tour.
        samples: Its samples.

    Returns:
        Content of `tour.json`.
    """
    time = np.array([one.time for one in samples])
    late = time >= min(time[0] + SETTLING_TIME_S, time[-1])
    commanded, velocity = (
        np.array([getattr(one, name) for one in samples]) for name in ("commanded", "velocity")
    )
    error = commanded - velocity
    away = np.array([np.hypot(*(one.person - one.pose)[:2]) for one in samples])
    lost = [one.state in (State.LOST, State.LOOKING) for one in samples]
    begins = np.flatnonzero(np.diff(np.append(False, lost).astype(int)) == 1)
    states = Counter(one.state.value for one in samples)
    found = {
        "schema": 1,
        **attrs.asdict(outcome, filter=lambda field, _: field.name != "planning"),
        "minutes": (time[-1] - time[0]) / 60.0,
        "error_xy": np.hypot(error[:, 0], error[:, 1]).mean(),
        "error_wz": np.abs(error[:, 2]).mean(),
        "distance_mean": away[late].mean(),
        "distance_kept": np.mean(np.abs(away[late] - outcome.distance) < DISTANCE_BAND_M),
        "least_clearance": min(one.clearance for one in samples),
        "least_gap": min(one.gap for one in samples),
        "losses": len(begins),
        "lost_seconds": PERIOD_S * sum(lost),
        "seconds": {name: PERIOD_S * count for name, count in states.items()},
    }
    if outcome.planning:
        found["planner_ms"] = {
            "mean": 1e3 * np.mean(outcome.planning),
            "p99": 1e3 * np.quantile(outcome.planning, 0.99),
        }
    return {name: _to_json(value) for name, value in found.items()}


def _to_json(value: Any) -> Any:
    """Convert a value for JSON; values that are not finite become null."""
    if isinstance(value, Mapping):
        return {key: _to_json(one) for key, one in value.items()}
    if isinstance(value, float | np.floating):
        return rounded(value) if np.isfinite(value) else None
    return value
