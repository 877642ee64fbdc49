"""Tour in one process: clearances against closed-form values, figures, and a short walk."""

from __future__ import annotations

import json
import re
from io import StringIO
from pathlib import Path

import attrs
import numpy as np
import pytest
from rich.console import Console

from quadvel_eval.following import tour
from quadvel_eval.following.obstacles import PERSON_RADIUS_M, Clearances, outline_points
from quadvel_eval.following.tour import Outcome, TourSample, TourSetup, summarise_tour
from quadvel_eval.following.tour_cli import run_tour
from quadvel_eval.following.tour_report import tour_figure
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, State
from quadvel_sim.world import World
from quadvel_sim.world_parts import Box, Trees, Wall

CONFIG = FollowConfig(length=0.6, width=0.4)
STANDING = World(
    walls=(Wall(points=[[-5.0, 2.0], [5.0, 2.0]], thickness=0.2),),
    trees=(Trees(positions=[[3.0, 0.0]], radius=0.5),),
    boxes=(Box(position=[0.0, -2.0], size=[1.0, 1.0, 1.0], yaw=45.0),),
)


def test_clearance_is_from_the_outline_to_the_nearest_thing() -> None:
    clearances = Clearances(STANDING, CONFIG)
    assert clearances.to_obstacles(np.array([1.9, 0.0, 0.0])) == pytest.approx(
        3.0 - 0.5 - 1.9 - 0.3, abs=0.002
    )
    assert clearances.to_obstacles(np.array([-3.0, 1.0, 0.0])) == pytest.approx(
        2.0 - 0.1 - 1.0 - 0.2, abs=0.002
    )
    corner = -2.0 + np.sqrt(0.5)
    assert clearances.to_obstacles(np.array([0.0, -0.5, 0.0])) == pytest.approx(-0.5 - 0.2 - corner, abs=0.02)
    assert clearances.to_obstacles(np.array([0.0, 50.0, 0.0])) == np.inf
    assert clearances.to_people(np.array([0.0, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0]])) == pytest.approx(
        0.7 - PERSON_RADIUS_M
    )
    assert outline_points(World()).shape == (0, 2)


def moment(time: float, away: float, state: State = State.FOLLOWING) -> TourSample:
    asked, velocity = np.array([1.0, 0.0, 0.2]), np.array([0.97, 0.04, 0.15])
    person = np.array([away, 0.0, 0.0])
    return TourSample(time, np.zeros(3), person, asked, velocity, state, "", 0.5, float("inf"))


def test_figures_have_errors_distance_and_losses_without_the_start() -> None:
    states = 140 * [State.FOLLOWING] + 20 * [State.LOST] + 20 * [State.LOOKING] + 20 * [State.FOLLOWING]
    away = np.where(np.arange(200) < 120, 9.0, np.where(np.arange(200) < 180, 1.6, 3.0))
    moments = [moment(PERIOD_S * k, float(d), s) for k, (d, s) in enumerate(zip(away, states, strict=True))]
    outcome = Outcome(
        world="w",
        seed=0,
        distance=1.5,
        walked=10.0,
        fell=False,
        touched={"tree_0": 1},
        planning=[0.002, 0.004],
    )
    found = summarise_tour(outcome, moments)
    assert found["error_xy"] == pytest.approx(0.05)
    assert found["error_wz"] == pytest.approx(0.05)
    assert found["distance_kept"] == pytest.approx(60 / 80)
    assert (found["losses"], found["lost_seconds"]) == (1, pytest.approx(2.0))
    assert (found["least_clearance"], found["least_gap"]) == (0.5, None)
    assert found["planner_ms"]["mean"] == pytest.approx(3.0)
    assert "planner_ms" not in summarise_tour(attrs.evolve(outcome, planning=()), moments)
    json.dumps(found, allow_nan=False)


def test_some_metres_down_the_corridor_behind_a_person(tmp_path: Path) -> None:
    setup = TourSetup(world="corridor", path_length=5.0)
    said = StringIO()
    assert run_tour(setup, tmp_path, Console(file=said, width=120))
    assert re.search(r"^[2-4] of \d m: ", said.getvalue(), re.MULTILINE)  # where no terminal shows a bar
    found = json.loads((tmp_path / "tour.json").read_text())
    assert found["walked"] > 5.0
    assert not found["fell"]
    assert found["touched"] == {}
    assert found["least_clearance"] > 0.3
    assert found["error_xy"] < 0.2  # most of it while the robot sets off
    assert (tmp_path / "tour.png").stat().st_size > 10_000


def test_a_robot_that_no_longer_moves_on_ends_the_tour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tour, "STUCK_TIME_S", 1.0)
    setup = TourSetup(world="corridor", path_length=5.0, distance=12.0)  # the person never gets so far away
    assert not run_tour(setup, tmp_path, Console(file=StringIO(), width=120))
    found = json.loads((tmp_path / "tour.json").read_text())
    assert found["stuck"]
    assert not found["fell"]


def test_the_picture_counts_minutes_from_its_first_moment(tmp_path: Path) -> None:
    """Of a run in real time the moments are seconds since 1970."""
    moments = [moment(1.8e9 + PERIOD_S * k, 1.5) for k in range(1200)]
    figure = tour_figure(World.load("corridor"), 1.5, moments)
    below = next(axes for axes in figure.axes if axes.get_xlabel() == "min")
    assert below.get_xlim() == pytest.approx((0.0, 1.0), abs=0.01)
    assert all(0.0 <= x <= 1.0 for line in below.lines for x in line.get_xdata())
