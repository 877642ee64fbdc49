from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from quadvel_eval.cli import compare_command
from quadvel_eval.compare import comparison_figures, comparison_table, errors_on_common_runs, read_evaluation


def evaluation(errors: dict[float, float | None]) -> dict[str, Any]:
    """Cells by their vx; None where the robot fell."""
    known = [error for error in errors.values() if error is not None]
    cells = [
        {"command": [vx, 0.0, 0.0], "seed": 0, "mean": None, "error_xy": e, "error_wz": e, "fell": e is None}
        for vx, e in errors.items()
    ]
    return {
        "schema": 1,
        "cells": cells,
        "max_error_xy": max(known),
        "mean_error_xy": sum(known) / len(known),
        "max_error_wz": max(known),
        "mean_error_wz": sum(known) / len(known),
        "delay_xy": 0.2,
        "delay_wz": None,
        "falls": len(errors) - len(known),
        "jitter": 0.01,
        "cot": [0.5, None],
        "stance": {"drift_10s_m": None},
        "estimator": {"learned": {"rmse": [0.03, 0.05, 0.01], "drift": 0.02}},
    }


FIRST = evaluation({0.5: 0.1, 1.0: 0.2, 2.0: None})
SECOND = evaluation({0.5: 0.05, 1.0: 0.1, 2.0: 0.9})


def test_only_common_runs_are_compared() -> None:
    assert errors_on_common_runs(FIRST, SECOND) == pytest.approx((0.15, 0.075))
    assert errors_on_common_runs(FIRST, evaluation({3.0: 0.1})) is None


def test_figures_equal_those_of_the_evaluation() -> None:
    found = comparison_figures(FIRST)
    assert found["falls"] == 1
    assert found["cost of transport, mean"] == 0.5
    assert found["drift in 10 s of standing, m"] is None
    assert found["learned estimator, largest RMSE, m/s"] == 0.05


def test_the_table_shows_the_second_minus_the_first() -> None:
    console = Console(file=io.StringIO(), width=200)
    console.print(comparison_table({"a": FIRST, "b": SECOND}))
    line = next(line for line in console.file.getvalue().splitlines() if "falls" in line)  # type: ignore[attr-defined]
    assert "-1" in line


def test_a_folder_stands_for_the_evaluation_in_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "eval.json").write_text(json.dumps(FIRST))
    (tmp_path / "other.json").write_text(json.dumps(SECOND))
    monkeypatch.chdir(tmp_path)
    compare_command(Path(), Path("other.json"))
    assert "largest error" in capsys.readouterr().out


@pytest.mark.parametrize("content", ["no json", '{"schema": 2, "cells": []}', "[]"])
def test_a_file_that_is_no_evaluation_is_refused_by_its_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "eval.json").write_text(content)
    with pytest.raises(ValueError, match=r"eval\.json: "):
        read_evaluation(tmp_path)


def test_a_folder_without_an_evaluation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"eval\.json: no such file"):
        read_evaluation(tmp_path)
