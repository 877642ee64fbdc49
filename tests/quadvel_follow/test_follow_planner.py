"""Tests of the follow planner: missing inputs, blocked paths, and safety."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from quadvel_eval.following.scenes import FollowScene
from quadvel_eval.following.stage import LASER, FollowSample, FollowSimulation
from quadvel_eval.people.laser import FloorPlan
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, FollowPlanner, Plan, State
from quadvel_follow.leg_detector import LegDetector
from quadvel_sim.walker import Walker

WALL = FloorPlan((), [[-5.0, -3.0, 20.0, -3.0]])
OPEN = np.full(LASER.rays, np.inf)


def walk(mute: Callable[[float], str], seconds: float) -> list[FollowSample]:
    """Follow a person at 0.8 m/s along a wall; `mute` names the missing inputs at each time."""
    stage = FollowSimulation(
        FollowScene(WALL, [Walker([[0.0, 0.0], [30.0, 0.0]], 0.8)], seconds), 0, LegDetector()
    )
    instants = []
    for instant in stage.run():
        instants.append(instant)
        stage.mute = mute(instant.time)
    return instants


@pytest.mark.parametrize("what", ["scan", "person", "planner"])
def test_the_command_is_zero_within_0_6_s_of_the_last_word_and_goes_on_after_it(what: str) -> None:
    instants = walk(lambda time: what if 4.0 <= time < 5.0 else "", 6.0)
    speeds = {round(i.time, 2): float(np.hypot(*i.command[:2])) for i in instants}
    assert speeds[4.0] > 0.5
    assert max(speed for time, speed in speeds.items() if 4.0 + 0.6 < time < 5.0) == 0.0
    assert speeds[5.9] > 0.4


def test_the_same_seed_walks_the_same_way() -> None:
    first, second = (walk(lambda time: "", 2.5) for _ in range(2))
    assert first[-1].velocity.any()
    np.testing.assert_array_equal([i.pose for i in first], [i.pose for i in second])


class Bench:
    """A planner that has received odometry, a scan and a person."""

    def __init__(self, **config: object) -> None:
        self.planner = FollowPlanner(FollowConfig(**{"laser_x": 0.0, **config}))  # type: ignore[arg-type]
        self.now = 0.0
        self.pose = np.zeros(3)

    def step(
        self, person: tuple[float, ...] | None, ranges: np.ndarray = OPEN, seconds: float = PERIOD_S
    ) -> list:
        """The plans of so many seconds, the robot being where it is commanded to be."""
        plans: list[Plan] = []
        for _ in range(round(seconds / PERIOD_S)):
            self.now += PERIOD_S
            velocity = plans[-1].velocity if plans else np.zeros(3)
            c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
            ahead = [c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1], velocity[2]]
            self.pose = self.pose + PERIOD_S * np.array(ahead)
            self.planner.on_odometry(self.now, self.now, self.pose.tolist(), velocity)
            self.planner.on_scan(self.now, self.now, ranges, LASER.angle_min, LASER.angle_increment)
            if person is not None:
                self.planner.on_person(self.now, self.now, person, 0.1)
            plans.append(self.planner.step(self.now))
        return plans


def test_a_person_who_comes_near_does_not_make_it_back_into_what_it_does_not_see() -> None:
    bench = Bench()
    plans = bench.step((0.8, 0.0, 0.0, 0.0), seconds=0.5) + bench.step((0.7, 0.0, -0.5, 0.0), seconds=1.5)
    assert min(plan.velocity[0] for plan in plans) >= 0.0


def test_it_looks_around_once_where_the_person_was_lost_and_takes_up_again() -> None:
    bench = Bench()
    bench.step((2.0, 1.0, 0.0, 0.0), seconds=0.5)
    plans = bench.step(None, seconds=12.0)
    states = [plan.state for plan in plans]
    assert State.LOOKING in states
    assert states[-1] is State.LOST
    assert not plans[-1].velocity.any()
    assert abs(bench.pose[2]) == pytest.approx(2.0 * np.pi, abs=1.0)
    (plan,) = bench.step((bench.pose[0] + 3.0, bench.pose[1], 0.0, 0.0))
    assert plan.state is State.FOLLOWING


def test_commands_change_no_faster_than_they_may() -> None:
    bench = Bench()
    plans = bench.step((6.0, 1.0, 0.0, 0.0), seconds=3.0)
    commands = np.array([plan.velocity for plan in plans])
    steps = np.abs(np.diff(commands, axis=0)) / PERIOD_S
    assert {plan.reason for plan in plans} == {"follows"}
    assert (steps < np.maximum(FollowConfig().acceleration, FollowConfig().deceleration) + 1e-6).all()
    assert commands[:, 0].max() > 1.0


def test_a_lone_far_reading_is_no_obstacle_and_a_near_one_is_at_once() -> None:
    bench, middle = Bench(), LASER.rays // 2
    far, near = OPEN.copy(), OPEN.copy()
    far[middle - 5 : middle + 5] = 4.0
    bench.step(None, far)
    assert len(bench.planner.obstacles) == 0
    near[middle - 5 : middle + 5] = 1.0
    bench.step(None, near)
    assert len(bench.planner.obstacles) > 0
    bench.step(None, far, seconds=0.5)
    assert np.hypot(*bench.planner.obstacles.T).min() > 3.5


def test_what_left_the_view_is_remembered() -> None:
    bench, middle = Bench(), LASER.rays // 2
    near = OPEN.copy()
    near[middle - 5 : middle + 5] = 1.0
    bench.step(None, near)
    bench.pose = np.array([0.0, 0.0, np.pi])
    bench.step(None)
    assert np.hypot(*(bench.planner.obstacles - [1.0, 0.0]).T).min() < 0.1


@pytest.mark.parametrize(
    ("ranges", "increment", "words"),
    [
        (np.ones((2, 2)), 0.1, "ranges has the shape"),
        (np.ones(10), 0.0, "angle_increment is 0.0"),
        (np.ones(10), 1.0, "expected a step"),
    ],
)
def test_scans_that_are_none_are_refused(ranges: np.ndarray, increment: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FollowPlanner().on_scan(0.0, 0.0, ranges, 0.0, increment)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(bad: float) -> None:
    planner = FollowPlanner()
    with pytest.raises(ValueError, match="finite"):
        planner.on_odometry(0.0, 0.0, (0.0, 0.0, 0.0), (bad, 0.0, 0.0))
    with pytest.raises(ValueError, match="finite"):
        planner.on_person(0.0, 0.0, (bad, 0.0, 0.0, 0.0), 0.1)


@pytest.mark.parametrize("config", [{"distance": -1.0}, {"side": "above"}, {"max_velocity": (1.0, 0.0, 1.0)}])
def test_configurations_without_sense_are_refused(config: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(config))):
        FollowConfig(**config)  # type: ignore[arg-type]
