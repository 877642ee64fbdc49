"""`quadvel world` and the worlds of following: what is wrong is said before anything starts."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import pytest
import typer
from typer.testing import CliRunner

from quadvel_eval.following.tour import load_followed_world
from quadvel_eval.world_map import world_command

WALL = "schema: 1\nwalls:\n  - {points: [[3, 1], [5, 1]]}\n"
WALL_AT_THE_START = "schema: 1\nwalls:\n  - {points: [[0, 0], [2, 0]]}\n"
STRAIGHT = "schema: 1\npersons:\n  - {way: [[2, 0], [12, 0]]}\n"


def draw(world: Path, out: Path) -> str:
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(world_command)
    return CliRunner().invoke(app, [str(world), "--out", str(out)], catch_exceptions=False).output


@pytest.fixture
def write(tmp_path: Path):
    def write_world(text: str) -> Path:
        (tmp_path / "mine.yaml").write_text(text)
        return tmp_path / "mine.yaml"

    return write_world


def test_an_obstacle_where_the_robot_starts_is_refused(write, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="world mine: wall_0 stands where the robot starts"):
        draw(write(WALL_AT_THE_START), tmp_path / "map.png")
    assert not (tmp_path / "map.png").exists()


def test_a_world_without_people_is_named_by_the_map_and_refused_by_following(write, tmp_path: Path) -> None:
    assert "no person to follow" in draw(write(WALL), tmp_path / "map.png")
    with pytest.raises(ValueError, match="persons: found none, expected a person to follow"):
        load_followed_world(str(write(WALL)))
    assert "no person" not in draw(write(STRAIGHT), tmp_path / "map.png")
    assert len(load_followed_world(str(write(STRAIGHT))).persons) == 1


@pytest.mark.parametrize("name", ["o[red]w.png", "[/red]/w.png"])
def test_brackets_in_a_path_are_printed_as_they_are(name: str, write, tmp_path: Path) -> None:
    assert name in draw(write(STRAIGHT), tmp_path / name)
    assert (tmp_path / name).exists()


def test_the_map_of_a_straight_path_has_a_height(write, tmp_path: Path) -> None:
    draw(write(STRAIGHT), tmp_path / "map.png")
    picture = matplotlib.image.imread(tmp_path / "map.png")[..., :3]
    dark_rows = (picture.min(axis=2) < 0.2).any(axis=1)  # frame, labels
    assert dark_rows.sum() > 0.4 * len(dark_rows)


def test_the_map_has_the_name_of_the_file_whatever_the_world_is_called(
    write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write('name: "../../evil"\n' + STRAIGHT)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(world_command)
    CliRunner().invoke(app, [str(file)], catch_exceptions=False)
    assert [path.name for path in tmp_path.rglob("*.png")] == ["mine.png"]
    assert (tmp_path / "here" / "out" / "mine.png").exists()
