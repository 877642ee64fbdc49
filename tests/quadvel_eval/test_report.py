from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from rich.console import Console

from quadvel_eval.grid import Cell, CellResult, summarise
from quadvel_eval.report import evaluation_table, write_evaluation, write_json
from quadvel_eval.segments import Segment
from quadvel_recordings.output import atomic_write, output_file, output_folder

WALKED = CellResult(
    Cell((0.5, 0.0, 0.0), 0),
    Segment(np.array([0.5, 0.0, 0.0]), np.array([0.4, 0.0, 0.0])),
    jitter=0.01,
    cot=0.5,
    estimator_mse={"learned": np.full(3, 0.04)},
    estimator_drift={"learned": 0.1},
    path_length=4.0,
)
FALLEN = CellResult(Cell((1.0, 0.0, 0.0), 0))
ONE = summarise([WALKED, FALLEN], [0.01])
EVALUATION = {**ONE, "second_plant": ONE}


def test_only_own_outputs_of_a_folder_are_replaced(tmp_path: Path) -> None:
    for name in ("eval.json", "eval.csv", "notes.txt"):
        (tmp_path / name).write_text("old")
    write_evaluation(tmp_path, EVALUATION)
    assert (tmp_path / "notes.txt").read_text() == "old"
    assert json.loads((tmp_path / "eval.json").read_text()) == EVALUATION
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "eval.csv",
        "eval.json",
        "eval.png",
        "notes.txt",
    ]


def test_csv_has_a_row_a_cell_and_nothing_where_a_robot_fell(tmp_path: Path) -> None:
    write_evaluation(tmp_path, EVALUATION)
    with (tmp_path / "eval.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["plant"], row["vx"], row["error_xy"], row["fell"]) for row in rows] == [
        ("usual", "0.5", "0.1", "0"),
        ("usual", "1.0", "", "1"),
        ("second", "0.5", "0.1", "0"),
        ("second", "1.0", "", "1"),
    ]


def test_heatmap_is_drawn_even_if_every_robot_fell(tmp_path: Path) -> None:
    fallen = summarise([FALLEN, CellResult(Cell((0.5, 0.2, 1.0), 0))], [None])
    write_evaluation(tmp_path, {**fallen, "second_plant": fallen})
    assert matplotlib.image.imread(tmp_path / "eval.png").size > 0


def test_a_file_that_is_not_finished_leaves_the_old_one_and_no_draft(tmp_path: Path) -> None:
    (tmp_path / "eval.json").write_text("old")
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "eval.json", {"mean_error_xy": float("nan")})
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "eval.json") as draft:  # noqa: PT012
        draft.write_text("half")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["eval.json"]
    assert (tmp_path / "eval.json").read_text() == "old"


def test_a_folder_that_is_a_file_is_refused_with_its_name(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    for path in (tmp_path / "out", tmp_path / "out" / "eval"):
        with pytest.raises(
            NotADirectoryError, match=rf"{path}: {tmp_path / 'out'} is a file, expected a folder"
        ):
            output_folder(path)


def test_a_missing_folder_is_made_with_its_first_file(tmp_path: Path) -> None:
    folder = output_folder(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    write_json(folder / "eval.json", {})
    assert [path.name for path in folder.iterdir()] == ["eval.json"]


def test_a_folder_that_was_made_for_a_file_goes_where_the_file_fails(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for folder in (tmp_path / "a" / "b", tmp_path / "there"):
        with pytest.raises(KeyboardInterrupt), atomic_write(folder / "walk.mcap") as draft:  # noqa: PT012
            draft.write_text("half")
            raise KeyboardInterrupt
    assert list(tmp_path.rglob("*")) == [tmp_path / "there"]


def test_a_device_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="is a device or a pipe"):
        output_file(tmp_path / "pipe")


def test_table_shows_falls_and_the_worst_cell() -> None:
    console = Console(record=True, width=100)
    console.print(evaluation_table(EVALUATION))
    text = console.export_text()
    assert "2, 1" in text
    assert "0.5, 0, 0" in text


@pytest.mark.parametrize("folder", ["/proc", "/sys"])  # where no user can write, not even root
def test_an_unwritable_folder_fails_before_the_work(folder: str) -> None:
    with pytest.raises(OSError, match=rf"^{folder}: the folder can't be written: "):
        output_folder(Path(folder))
    with pytest.raises(OSError, match=rf"^{folder}/x: the folder can't be written: "):
        output_folder(Path(folder) / "x")


def test_an_unwritable_file_fails_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError, match="is a folder, expected a file to write"):
        output_file(tmp_path)
    for nameless in (Path(), Path("/")):
        with pytest.raises(IsADirectoryError, match="is a folder, expected a file to write"):
            output_file(nameless)
    with pytest.raises(OSError, match="the file can't be written: File name too long"):
        output_file(tmp_path / ("x" * 300))
    assert output_file(tmp_path / "new" / "bench.json") == tmp_path / "new" / "bench.json"
    assert list(tmp_path.iterdir()) == []
