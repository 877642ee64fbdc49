from __future__ import annotations

import json

import numpy as np
import pytest

from quadvel_eval import grid
from quadvel_eval.grid import (
    GRIDS,
    Cell,
    CellResult,
    evaluate,
    evaluate_walk,
    grid_cells,
    max_displacement,
    run_cell,
    run_stance,
    summarise,
)
from quadvel_eval.segments import Segment
from quadvel_eval.walk import Setup, Walk


def walk(velocity: tuple[float, float, float], seconds: float = 6.0) -> Walk:
    n = round(seconds / 0.005)
    time = np.arange(n) * 0.005
    return Walk(
        time=time,
        position=np.outer(time, [*velocity[:2], 0.0]),
        velocity=np.where(time[:, None] < 2.0, 0.0, velocity),
        commanded=np.where(time[:, None] < 1.5, 0.0, velocity),
        heading=np.zeros(n),
        contact=np.ones((n, 4), dtype=bool),
        targets=np.tile((0.5 * 0.002 * np.arange(n) ** 2)[:, None], (1, 12)),
        joint_velocity=np.zeros((n, 12)),
        torque=np.zeros((n, 12)),
        power=np.where(time < 2.0, 9e9, 250.0),
        estimate_errors={"learned": np.full((n, 3), [0.03, -0.04, 0.0])},
        estimate_drifts={"learned": 0.3},
    )


def result(command: tuple[float, float, float], mean: tuple[float, float, float]) -> CellResult:
    return CellResult(
        Cell(command, 0),
        Segment(np.array(command), np.array(mean)),
        0.01,
        0.5,
        {"learned": np.full(3, 0.04)},
        {"learned": 0.1},
        path_length=4.0,
    )


FALLEN = CellResult(Cell((1.0, 0.0, 0.0), 0))


def test_quick_grid_is_every_combination_with_every_seed() -> None:
    found = grid_cells("quick", seeds=2)
    assert len(found) == 2 * 6 * 3 * 3
    assert len({(cell.command, cell.seed) for cell in found}) == len(found)
    assert {cell.command[0] for cell in found} == {-1.0, -0.5, 0.0, 0.5, 1.0, 1.5}
    assert {cell.command[1] for cell in found} == {-0.4, 0.0, 0.4}
    assert {cell.command[2] for cell in found} == {-1.0, 0.0, 1.0}


def test_paper_grid_is_that_of_section_4() -> None:
    commands = np.array([cell.command for cell in grid_cells("paper", seeds=1)])
    assert commands.shape == (11 * 11, 3)
    np.testing.assert_allclose(np.unique(commands[:, 0]), np.linspace(-2.5, 2.5, 11))
    np.testing.assert_allclose(np.unique(commands[:, 1]), np.linspace(-1.0, 1.0, 11))
    assert not commands[:, 2].any()


def test_a_cell_is_evaluated_over_its_last_four_seconds() -> None:
    evaluated = evaluate_walk(walk((0.9, 0.1, 0.0)), Cell((1.0, 0.0, 0.0), 0), mass=25.0)
    assert evaluated.segment is not None
    assert evaluated.segment.error_xy == pytest.approx(np.hypot(0.1, 0.1))
    assert evaluated.jitter == pytest.approx(0.002)
    assert evaluated.cot == pytest.approx(250.0 / (25.0 * 9.81 * 0.9))
    np.testing.assert_allclose(evaluated.estimator_mse["learned"], [9e-4, 16e-4, 0.0])
    assert evaluated.estimator_drift == {"learned": 0.3}
    assert evaluated.delay_xy == pytest.approx(0.5, abs=0.02)
    assert evaluated.delay_wz is None  # no turn was commanded
    assert evaluated.path_length == pytest.approx(np.hypot(0.9, 0.1) * (6.0 - 0.005))


def test_evaluation_has_the_fields_of_schema_1() -> None:
    evaluation = summarise([result((0.5, 0.0, 0.0), (0.4, 0.0, 0.1)), FALLEN], [0.012, 0.003])
    assert evaluation["schema"] == 1
    assert evaluation["cells"][0] == {
        "command": [0.5, 0.0, 0.0],
        "seed": 0,
        "mean": [0.4, 0.0, 0.1],
        "error_xy": 0.1,
        "error_wz": 0.1,
        "fell": False,
    }
    assert evaluation["stance"] == {"drift_10s_m": 0.012}
    assert evaluation["estimator"] == {"learned": {"rmse": [0.2, 0.2, 0.2], "drift": 0.025}}
    json.dumps(evaluation, allow_nan=False)


def test_a_fallen_cell_is_null_and_out_of_the_aggregates() -> None:
    evaluation = summarise(
        [result((0.5, 0.0, 0.0), (0.4, 0.0, 0.0)), FALLEN, result((0.5, 0.0, 0.0), (0.2, 0.0, 0.0))], [0.01]
    )
    fallen = evaluation["cells"][1]
    assert (fallen["mean"], fallen["error_xy"], fallen["error_wz"], fallen["fell"]) == (
        None,
        None,
        None,
        True,
    )
    assert evaluation["falls"] == 1
    assert evaluation["max_error_xy"] == pytest.approx(0.3)
    assert evaluation["mean_error_xy"] == pytest.approx(0.2)
    assert evaluation["jitter"] == pytest.approx(0.01)
    assert evaluation["cot"] == [0.5, None, 0.5]


def test_aggregates_are_numbers_even_if_every_robot_fell() -> None:
    evaluation = summarise([FALLEN, CellResult(Cell((0.0, 0.5, 0.0), 0))], [None])
    assert evaluation["falls"] == 2
    assert evaluation["max_error_xy"] == pytest.approx(1.0)  # as a robot that does not move
    assert evaluation["mean_error_xy"] == pytest.approx(0.75)
    assert evaluation["jitter"] == 0.0
    assert evaluation["stance"] == {"drift_10s_m": None}


def test_drift_is_the_largest_distance_and_horizontal() -> None:
    assert max_displacement(np.array([[1.0, 1.0, 0.4], [1.3, 1.4, 0.4], [1.0, 1.0, 9.0]])) == pytest.approx(
        0.5
    )


def short_cell(setup: Setup, cell: Cell) -> CellResult:
    """As `run_cell`, for 2.5 s; in a process of its own."""
    grid.COMMAND_DURATION_S = 2.5
    return run_cell(setup, cell)


def short_stance(setup: Setup, seed: int) -> float | None:
    """As `run_stance`, for 1 s after a walk of 1 s; in a process of its own."""
    grid.WALK_BEFORE_STANCE = [((0.5, 0.0, 0.0), 0.5), ((0.0, 0.0, 0.0), 0.5)]
    grid.STANCE_DURATION_S = 1.0
    return run_stance(setup, seed)


def test_a_grid_over_processes_equals_itself_in_the_order_of_its_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = np.array([0.0, 0.3]), np.array([0.0]), np.array([0.0])
    monkeypatch.setitem(GRIDS, "quick", few)
    monkeypatch.setattr(grid, "run_cell", short_cell)
    monkeypatch.setattr(grid, "run_stance", short_stance)
    heard: list[tuple[int, int]] = []
    evaluation = evaluate(Setup(estimator="truth"), "quick", 1, lambda done, of: heard.append((done, of)))
    assert [cell["command"][0] for cell in evaluation["cells"]] == [0.0, 0.3]
    assert heard == [(done, 6) for done in range(1, 7)]  # two plants, two commands and a stance on each
    assert evaluation["second_plant"]["cells"] != evaluation["cells"]
    assert set(evaluation["estimator"]) == {"learned", "kalman"}
