"""Sections on changed plants: their conditions, survival rate and errors."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.robot import load_robot
from quadvel_eval.grid import Cell, CellResult
from quadvel_eval.paper import conditions as paper_conditions
from quadvel_eval.paper import slopes
from quadvel_eval.paper.conditions import HARD_PLANTS, walk_under
from quadvel_eval.paper.energy import Energy
from quadvel_eval.paper.gap import Gap, drive_conditions
from quadvel_eval.paper.jitter import Jitter
from quadvel_eval.paper.robustness import Robustness, conditions
from quadvel_eval.paper.section import Study
from quadvel_eval.paper.slopes import MAX_FOLLOWING_ERROR, STARTS, TITLES, Slopes
from quadvel_eval.segments import Segment
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.physics import HELD_OUT_PHYSICS
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO


def answer(labels: dict, command: tuple[float, float, float], error: float | None) -> tuple[dict, CellResult]:
    cell = Cell(command, 0)
    if error is None:
        return labels, CellResult(cell)
    mean = np.array(command) - [error, 0.0, 0.0]
    return labels, CellResult(cell, Segment(np.array(command), mean), 0.002, 0.8)


def test_every_condition_is_a_plant_that_stands() -> None:
    found = conditions(seed=1)
    assert {one.group for one in found} == {"friction", "payload", "rough ground", "push"}
    found += [c for plant in HARD_PLANTS for c in slopes.conditions(plant, "")]
    for one in found:
        simulator = Simulator(SimulatorConfig(robot=ALIENGO, **one.plant))
        simulator.reset("stand")
        assert not simulator.fallen, one.labels


def test_plants_of_the_gap_have_one_more_effect_or_the_drives_of_another_robot() -> None:
    drives = {one.level: one.plant["actuator"] for one in drive_conditions(ALIENGO)}
    trained = drives.pop("as in training")
    assert trained == ActuatorParameters.of(ALIENGO)
    others, theirs = drives.pop("drives of the go2"), ActuatorParameters.of(load_robot("go2"))
    assert (others.pairs, others.effects, others.kp_ref) == (theirs.pairs, theirs.effects, theirs.kp_ref)
    assert (others.torque_limit, others.robot) == (trained.torque_limit, "aliengo")
    for one in drives.values():
        assert len(one.effects) == 1
        assert attrs.evolve(one, effects=(), name=trained.name) == trained
    q, fast = np.zeros(12), np.full(12, 15.0)
    slow_drive, limited = (ActuatorModel(p, seed=1) for p in (trained, drives["torque-speed limit"]))
    for _ in range(20):
        strong, weak = (m.step(q, fast, np.full(12, 2.0), 30.0, 0.5) for m in (slow_drive, limited))
    assert (np.abs(weak) < np.abs(strong)).all()


def test_survival_counts_the_robots_that_did_not_fall() -> None:
    section = Robustness()
    labels = {"policy": "mine", "group": "payload", "level": 5}
    command = (1.0, 0.0, 0.0)
    records = section.to_records(
        [answer(labels, command, 0.1), answer(labels, command, 0.3), answer(labels, command, None)]
    )
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours["payload: survival"] == pytest.approx(100.0 * 2 / 3)
    assert ours["payload: mean error"] == pytest.approx(0.2)
    section.figure(records)


def test_a_robot_that_is_stuck_on_a_slope_fails_there_and_slopes_are_not_pooled() -> None:
    section, command = Slopes(), (1.0, 0.0, 0.0)
    errors = {
        "15 degrees up": (MAX_FOLLOWING_ERROR + 0.01, MAX_FOLLOWING_ERROR - 0.01, None),
        "7.5 degrees up": (0.01, 0.02, 0.03),
        "15 degrees down": (None, None, 0.02),
    }
    records = section.to_records(
        [
            answer({"policy": "mine", "group": plant, "level": level}, command, error)
            for plant in TITLES
            for level, some in errors.items()
            for error in some
        ]
    )
    ours = {row.what: row.ours.get("mine") for row in section.rows(records)}
    for what, follow in (
        ("15 degrees up", 100 / 3),
        ("7.5 degrees up", 100.0),
        ("15 degrees down", 100 / 3),
    ):
        for where in (
            what,
            f"second plant, {what}",
            f"started at once, {what}",
            f"second plant, loose joints, started at once, {what}",
        ):
            assert ours[f"{where}: survive and follow"] == pytest.approx(follow)
    section.figure(records)


def test_robots_walk_on_slopes_after_both_starts_on_every_plant() -> None:
    jobs = Slopes().jobs(Study(seeds=1))
    assert len(jobs) == 2 * 3 * (6 * 3 + 4)
    stood = {(job.labels["group"].endswith("at once"), job.call[-1]) for job in jobs}
    assert stood == {(False, STARTS[""]), (True, 0.0)}
    plants = {
        (plant.get("physics"), "joint_friction" in plant) for plant in (job.call[1].plant for job in jobs)
    }
    assert plants == {(None, False), (HELD_OUT_PHYSICS, False), (HELD_OUT_PHYSICS, True)}


def test_a_robot_that_falls_while_it_stands_has_fallen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_conditions, "record_walk", lambda loop, commands: None)
    cell = Cell((0.3, 0.0, 0.0), 0)
    assert walk_under(Study().setup("crl_eam"), cell, None, 1.0).segment is None


def test_the_gap_has_rows_for_each_plant() -> None:
    section = Gap()
    command = (1.0, 0.0, 0.0)
    records = section.to_records(
        [
            answer({"policy": name, "group": "drives", "level": level}, command, error)
            for name, level, error in (
                ("a", "friction", 0.2),
                ("b", "friction", None),
                ("a", "backlash", 0.1),
            )
        ]
    )
    rows = {row.what: row.ours for row in section.rows(records)}
    assert rows["friction: falls"] == {"a": 0.0, "b": 1.0}
    assert rows["friction: largest error"] == {"a": pytest.approx(0.2), "b": None}
    section.figure(records)


def test_before_and_after_are_compared_on_the_walks_that_neither_fell_on() -> None:
    section, ahead, aside = Gap(), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0)
    records = section.to_records(
        [
            answer({"policy": name, "group": "drives", "level": "friction"}, command, error)
            for name, command, error in (
                ("before", ahead, 0.2),
                ("before", aside, 0.9),
                ("after", ahead, 0.05),
                ("after", aside, None),
            )
        ]
    )
    ours = {row.what: row.ours for row in section.rows(records)}
    assert ours["friction: mean error below that of before"] == {"after": pytest.approx(75.0)}


def test_the_least_cost_is_that_of_the_best_speed() -> None:
    section = Energy()
    labels = {"policy": "mine"}
    records = section.to_records([answer(labels, (1.0, 0.0, 0.0), 0.1), answer(labels, (0.0, 0.0, 1.0), 0.1)])
    records[0]["cot"] = 0.5
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours["cost of transport, the least"] == 0.5
    assert ours["cost of turning at 1 rad/s"] == 0.8
    section.figure(records)


def test_only_speeds_that_the_policy_takes_are_walked() -> None:
    study = Study(seeds=1)
    speeds = [job.call[2].command[0] for job in Jitter(speeds=(0.5, 99.0)).jobs(study)]
    assert speeds == [0.5]
    records = Jitter().to_records([answer({"policy": "mine"}, (0.5, 0.0, 0.0), 0.0)])
    assert Jitter().rows(records)[0].ours["mine"] == pytest.approx(2.0)
    Jitter().figure(records)
