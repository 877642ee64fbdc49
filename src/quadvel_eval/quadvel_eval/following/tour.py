"""A walk after a person through a simulated world, in one process: laser, tracker, planner, mux, policy and robot.

As the nodes make it, and as fast as the machine allows. Odometry is dead reckoning with the estimated velocity, as the estimator's
node does it: where the robot really is, only the measurement knows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.kinematics import rotate, yaw
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import SHIPPED_MODEL
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, Plan, State
from quadvel_follow.pose_history import PoseHistory
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.simulator import Simulator, SimulatorConfig
from quadvel_sim.world import World

from ..robot_loop import PERIOD as TICK
from ..robot_loop import RobotLoop, Sample, make_estimator
from ..segments import rounded
from .follower import Follower
from .obstacles import Clearances
from .stage import BAND, SETTLED

Array = NDArray[np.float64]

STRIDE = 0.35  # s, over which velocities are averaged before they are compared: a stride's sway is no error
ODOMETRY = 4  # ticks from one odometry to the next


@attrs.frozen(kw_only=True)
class TourSetup:
    """Who walks where. world: a shipped one or a file; metres: how far the robot is to walk."""

    world: str = "campus"
    metres: float = 3100.0
    seed: int = 0
    policy: Path = SHIPPED_POLICY
    estimator: str = "learned"
    estimator_file: Path = SHIPPED_MODEL
    distance: float = 1.5
    plant: dict[str, Any] = attrs.field(factory=dict)


@attrs.frozen
class Moment:
    """What is kept every PERIOD. pose, person: true, x, y (m), yaw (rad); asked, velocity (3,): means over a stride.

    clearance, gap: m, from the robot's outline to what stands near and to the nearest person, inf where there is none.
    """

    time: float
    pose: Array
    person: Array
    asked: Array
    velocity: Array
    state: State
    words: str
    clearance: float
    gap: float


class Tour:
    """One walk: `moments` goes through it; what it came to is in the attributes afterwards.

    walked: m, way of the trunk. fell: whether the robot did. planning: s of one core for each step of the planner.
    """

    def __init__(self, setup: TourSetup) -> None:
        self.setup, self.world = setup, World.load(setup.world)
        self.simulator = Simulator(SimulatorConfig(world=self.world, seed=setup.seed, **setup.plant))
        self.simulator.reset("stand")
        supervisor = Supervisor(PolicyFile(setup.policy), backup=KalmanEstimator())
        estimator = make_estimator(setup.estimator, self.simulator, setup.estimator_file)
        self._loop = RobotLoop(self.simulator, supervisor, estimator)
        laser = self.world.laser
        x, y, _ = laser.position
        self._config = FollowConfig(distance=setup.distance, laser_x=float(x), laser_y=float(y))
        self._follower = Follower(self._config)
        self._poses = PoseHistory([self._config.laser_x, self._config.laser_y, self._config.laser_yaw])
        self._clearances = Clearances(self.world, self._config)
        self.walked, self.fell = 0.0, False
        self.planning: list[float] = []

    @property
    def outcome(self) -> Outcome:
        """What it has come to so far."""
        return Outcome(
            world=self.world.name,
            seed=self.setup.seed,
            distance=self.setup.distance,
            walked=self.walked,
            fell=self.fell,
            touched=self.simulator.touch_counts,
            planning=self.planning,
        )

    def moments(self) -> Iterator[Moment]:
        """PERIOD apart, until the way is walked, the robot fell, or the person has long been lost."""
        loop, follower, place = self._loop, self._follower, np.zeros(3)
        loop.start_walking()
        asked, velocity, command = np.zeros(3), np.zeros(3), np.zeros(3)
        share, often, tick = TICK / STRIDE, round(PERIOD_S / TICK), 0
        last = self.simulator.truth().position[:2].copy()
        plan: Plan | None = None
        while self.walked < self.setup.metres:
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
            place = place + TICK * rotate(sample.state.quaternion, estimated)
            true = np.append(sample.truth.linear_velocity[:2], sample.truth.angular_velocity[2])
            asked, velocity = asked + share * (sample.asked - asked), velocity + share * (true - velocity)
            if tick % ODOMETRY == 0:
                heading = float(yaw(sample.state.quaternion))
                motion = np.append(estimated[:2], sample.state.angular_velocity[2])
                pose = [*place[:2].tolist(), heading]
                self._poses.add(now, pose)
                follower.on_odometry(now, pose, motion)
                if (scan := self.simulator.scan()) is not None:
                    meant = follower.on_scan(now, scan, self._poses.sensor_at(now))
                    follower.on_person(now, meant)
            if tick % often == 0 and tick:
                begin = process_time()
                plan = follower.step(now)
                self.planning.append(process_time() - begin)
                command = plan.velocity
                here = sample.truth.position[:2]
                self.walked += float(np.hypot(*(here - last)))
                last = here.copy()
                yield self._moment(sample, asked, velocity, plan)
            tick += 1

    def _moment(self, sample: Sample, asked: Array, velocity: Array, plan: Plan) -> Moment:
        truth = sample.truth
        pose = np.array([*truth.position[:2], float(yaw(truth.quaternion))])
        persons = self.simulator.persons()
        return Moment(
            truth.time,
            pose,
            persons[0],
            asked,
            velocity,
            plan.state,
            plan.reason,
            self._clearances.of(pose),
            self._clearances.of_persons(pose, persons),
        )


@attrs.frozen(kw_only=True)
class Outcome:
    """What a walk after a person came to, moments apart. distance: m, that was to be kept; walked: m; touched: how often what was
    run into; planning: s of one core for each step of the planner, where that is known.
    """

    world: str
    seed: int
    distance: float
    walked: float
    fell: bool
    touched: Mapping[str, int]
    planning: Sequence[float] = ()


def summary(outcome: Outcome, moments: Sequence[Moment]) -> dict[str, Any]:
    """The figures of a walk; errors beside the paper's 0.077 m/s and 0.059 rad/s."""
    time = np.array([one.time for one in moments])
    late = time >= min(time[0] + SETTLED, time[-1])
    asked, velocity = (np.array([getattr(one, name) for one in moments]) for name in ("asked", "velocity"))
    off = asked - velocity
    away = np.array([np.hypot(*(one.person - one.pose)[:2]) for one in moments])
    lost = [one.state in (State.LOST, State.LOOKING) for one in moments]
    begins = np.flatnonzero(np.diff(np.append(False, lost).astype(int)) == 1)
    states = Counter(one.state.value for one in moments)
    found = {
        "schema": 1,
        **attrs.asdict(outcome, filter=lambda field, _: field.name != "planning"),
        "minutes": (time[-1] - time[0]) / 60.0,
        "error_xy": np.hypot(off[:, 0], off[:, 1]).mean(),
        "error_wz": np.abs(off[:, 2]).mean(),
        "distance_mean": away[late].mean(),
        "distance_kept": np.mean(np.abs(away[late] - outcome.distance) < BAND),
        "least_clearance": min(one.clearance for one in moments),
        "least_gap": min(one.gap for one in moments),
        "losses": len(begins),
        "lost_seconds": PERIOD_S * sum(lost),
        "seconds": {name: PERIOD_S * count for name, count in states.items()},
    }
    if outcome.planning:
        found["planner_ms"] = {
            "mean": 1e3 * np.mean(outcome.planning),
            "p99": 1e3 * np.quantile(outcome.planning, 0.99),
        }
    return {name: _plain(value) for name, value in found.items()}


def _plain(value: Any) -> Any:
    """As JSON keeps it; what is nowhere near is null."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, float | np.floating):
        return rounded(value) if np.isfinite(value) else None
    return value
