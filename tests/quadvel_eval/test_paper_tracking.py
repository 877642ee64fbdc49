from __future__ import annotations

import attrs
import numpy as np
import pytest

from quadvel_eval.grid import Cell, CellResult
from quadvel_eval.paper.cells import cell_record, is_within_limits, max_command_along
from quadvel_eval.paper.section import Study
from quadvel_eval.paper.sustained import Sustained
from quadvel_eval.paper.tracking import Tracking, left_right_difference
from quadvel_eval.segments import Segment
from quadvel_policy.observation import VelocityCommandLimits
from quadvel_policy.policy_file import SHIPPED_POLICY

LIMITS = VelocityCommandLimits((-1.0, -0.5, -1.0), (2.0, 0.5, 1.0))


def answer(
    vx: float, vy: float, error: float | None, inside: int = 1, plant: str = "usual"
) -> tuple[dict, CellResult]:
    cell = Cell((vx, vy, 0.0), 0)
    labels = {"policy": "mine", "plant": plant, "grid": "paper", "within": inside}
    if error is None:
        return labels, CellResult(cell)
    return labels, CellResult(
        cell, Segment(np.array(cell.command), np.array([vx - error, vy, 2.0 * error])), 0.01, 0.5
    )


def test_commands_beyond_the_limits_of_a_policy_are_marked() -> None:
    assert is_within_limits((2.0, -0.5, 1.0), LIMITS)
    assert not is_within_limits((2.0, -0.6, 0.0), LIMITS)
    assert not is_within_limits((2.0, -0.5, 1.0), attrs.evolve(LIMITS, curve=1.0))
    assert not is_within_limits((2.1, 0.0, 0.0), LIMITS)
    assert max_command_along((-1.0, 0.0, 0.0), LIMITS) == 1.0
    assert max_command_along((0.0, 0.0, 1.0), LIMITS) == 1.0


def test_left_right_is_the_largest_difference_between_mirrored_commands() -> None:
    records = [cell_record(*answer(*one)) for one in ((1.0, 0.4, 0.05), (1.0, -0.4, 0.08), (1.0, 0.0, 0.3))]
    assert left_right_difference(records) == pytest.approx(0.03)
    assert np.isnan(left_right_difference(records[2:]))


def test_the_table_counts_falls_and_separates_errors_within_the_limits() -> None:
    section = Tracking()
    answers = [answer(1.0, 0.0, 0.02), answer(1.0, 0.4, None), answer(2.5, 0.0, 0.5, inside=0)]
    records = section.to_records([*answers, answer(1.0, 0.0, 0.04, plant="second")])
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours["paper grid, all: runs"] == 3
    assert ours["paper grid, all: falls"] == 1
    assert ours["paper grid, all: largest error"] == pytest.approx(0.5)
    assert ours["paper grid, within the policy's limits: largest error"] == pytest.approx(0.02)
    assert ours["paper grid, within the policy's limits: largest left-right difference"] is None
    assert ours["paper grid, within the policy's limits: largest error of the yaw rate"] == pytest.approx(
        0.04
    )
    assert ours["paper grid, second plant: largest error"] == pytest.approx(0.04)
    assert ours["paper grid, second plant: mean error of the yaw rate"] == pytest.approx(0.08)
    assert len(section.figure(records).axes) == 2  # the grid and its scale


def test_the_grid_has_every_command_with_every_seed_on_both_plants() -> None:
    jobs = Tracking(grids=("paper",)).jobs(Study(seeds=3))
    assert len(jobs) == 2 * 363
    assert {job.labels["plant"] for job in jobs} == {"usual", "second"}
    assert {job.labels["policy"] for job in jobs} == {SHIPPED_POLICY.stem}


def test_the_largest_velocity_is_that_of_a_robot_that_stood() -> None:
    section = Sustained()
    labels = {"policy": "mine", "plant": "usual", "direction": "forward", "limit": 4.0}
    stood = {"reached": 2.9, "fell": 0, "ended": "", "joint_speed": 0.9, "torque": 0.7}
    fell = {"reached": None, "fell": 1, "ended": "the robot fell", "joint_speed": 1.2, "torque": 1.0}
    records = section.to_records([({**labels, "command": 3.0}, stood), ({**labels, "command": 4.0}, fell)])
    rows = {row.what: row for row in section.rows(records)}
    assert rows["forward: reached"].ours == {"mine": 2.9}
    assert rows["forward: reached"].paper == 4.2
    assert rows["forward: fastest joint, share of its drive's speed"].ours == {"mine": 1.2}
    assert rows["falls"].ours == {"mine": 1.0}
    section.figure(records)


def test_the_drive_load_of_other_plants_has_its_own_rows() -> None:
    section = Sustained(shares=(1.0,), directions=("forward",))
    plants = [job.labels["plant"] for job in section.jobs(Study(seeds=1))]
    assert plants == ["usual", "second", "loose joints"]
    labels = {"policy": "mine", "direction": "forward", "limit": 3.0, "command": 3.0}
    records = section.to_records(
        [
            (
                {**labels, "plant": plant},
                {"reached": 2.9 - k, "fell": k // 2, "joint_speed": 0.9 + 0.1 * k, "torque": 0.5},
            )
            for k, plant in enumerate(plants)
        ]
    )
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours["forward: reached"] == 2.9
    speed = "forward: fastest joint, share of its drive's speed"
    assert ours[speed] == pytest.approx(0.9)
    assert ours[f"second plant, {speed}"] == pytest.approx(1.0)
    assert ours[f"second plant, loose joints, {speed}"] == pytest.approx(1.1)
    assert (ours["falls"], ours["second plant: falls"], ours["second plant, loose joints: falls"]) == (
        0.0,
        0.0,
        1.0,
    )
