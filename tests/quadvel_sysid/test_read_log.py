"""Whose log a file is, and options that do not fit it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_sysid import cli
from quadvel_sysid.logs.log import Log, LogError
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.logs.readers.columns import ColumnMap, Source
from quadvel_sysid.logs.readers.recordings import Topics
from tests.helpers.robots import ALIENGO, GO2
from tests.quadvel_recordings.joint_bags import go2, rosbag2
from tests.quadvel_sysid.joint_logs import csv, fields, mcap, npz

STILL = np.zeros(200)


def test_a_table_of_leg_joints_is_of_an_assumed_robot_and_says_so(tmp_path: Path) -> None:
    log = read_log(npz(tmp_path / "log.npz"))
    assert log.robot is ALIENGO
    assert [text for text in log.remarks if "AlienGo is assumed" in text]
    named = read_log(tmp_path / "log.npz", robot="go2")
    assert named.robot is GO2
    assert not [text for text in named.remarks if "assumed" in text]


def test_messages_of_unitree_go_are_those_of_a_go2(tmp_path: Path) -> None:
    log = read_log(rosbag2(tmp_path / "walk", go2()))
    assert log.robot is GO2
    assert [text for text in log.remarks if "Go2 is assumed" in text]


def test_of_other_joints_no_robot_is_assumed_aloud(tmp_path: Path) -> None:
    knee = {"t": fields()["t"], "q/knee": fields()["q"][:, 0], "q_des/knee": fields()["q_des"][:, 0]}
    assert not [text for text in read_log(csv(tmp_path / "log.csv", knee)).remarks if "assumed" in text]


def test_the_model_to_correct_names_the_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ActuatorParameters.of(GO2).save(tmp_path / "actuator.yaml")
    robots: list[str] = []

    def stop(logs: list[Path], heldout: list[Path], read: Callable[[Path], Log], *_: object) -> None:
        robots.extend(one.robot.name for one in map(read, logs) if one.robot)
        raise ValueError("enough")

    monkeypatch.setattr(cli, "_identify", stop)
    log = npz(tmp_path / "log.npz")
    arguments = [str(log), "--base", str(tmp_path / "actuator.yaml"), "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", ["identify", *arguments])
    with pytest.raises(SystemExit):
        cli.main()
    assert capsys.readouterr().err.endswith("enough\n")
    assert robots == ["go2"]


def test_a_model_of_another_robot_is_refused_with_what_to_do(tmp_path: Path) -> None:
    ActuatorParameters.of(ALIENGO).save(tmp_path / "actuator.yaml")
    with pytest.raises(ValueError, match=r"found 'aliengo', expected 'go2': .*--robot go2"):
        ActuatorParameters.load(GO2, tmp_path / "actuator.yaml")


def test_options_that_a_log_cannot_use_are_named(tmp_path: Path) -> None:
    recording = read_log(mcap(tmp_path / "log.mcap", fields()), names=ColumnMap({"q": Source(("a",))}))
    assert [text for text in recording.warnings if text.startswith("--columns: not used")]
    table = read_log(npz(tmp_path / "log.npz"), topics=Topics(state="/joint_states"))
    assert [text for text in table.warnings if text.startswith("--state-topic")]


def test_more_names_than_joints_are_the_mistake_not_the_column(tmp_path: Path) -> None:
    given = {"t": fields()["t"], **{name: fields()[name][:, 0] for name in ("q", "dq", "q_des", "tau")}}
    np.savez(tmp_path / "log.npz", **given)
    with pytest.raises(LogError, match="joint_names: found 2 names, expected 1"):
        read_log(tmp_path / "log.npz", names=ColumnMap(joints=("knee", "hip")))


@pytest.mark.parametrize("entries", [{}, {"q": Source(("q",)), "q_des": Source(("q_des",))}])
def test_names_of_a_map_that_contradict_those_of_the_columns_are_refused(
    entries: dict[str, Source], tmp_path: Path
) -> None:
    columns = {f"{name}/{joint}": STILL for name in ("q", "q_des") for joint in ("hip", "knee")}
    np.savez(tmp_path / "log.npz", t=np.arange(len(STILL)) / 200.0, **columns)
    for names in (("a", "b"), ("hip", "ankle"), ("hip", "knee", "ankle"), ("hip",)):
        with pytest.raises(LogError, match=r"joint_names: found .* are of hip, knee"):
            read_log(tmp_path / "log.npz", names=ColumnMap(entries, joints=names))
    for names in (("knee", "hip"), ("hip_joint", "knee_joint"), ()):
        log = read_log(tmp_path / "log.npz", names=ColumnMap(entries, joints=names))
        assert sorted(log.joints) == ["hip_joint", "knee_joint"]


def test_times_of_each_joint_are_no_matter_of_names(tmp_path: Path) -> None:
    given = {name: fields()[name] for name in ("q", "dq", "q_des", "tau", "joint_names")}
    np.savez(tmp_path / "log.npz", **given, t=np.tile(fields()["t"][:, None], 12))
    with pytest.raises(LogError, match=r"q: found shape"):
        read_log(tmp_path / "log.npz")


def test_a_scale_may_be_written_as_people_write_it(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text("t: {from: us, scale: 1e-6}\nq: {from: q, scale: [1E+3, 2]}\n")
    found = ColumnMap.load(tmp_path / "map.yaml").sources
    assert (found["t"].scale, found["q"].scale) == (1e-6, [1e3, 2])
    (tmp_path / "map.yaml").write_text("t: {from: us, scale: micro}\n")
    with pytest.raises(LogError, match="t/scale: found 'micro'"):
        ColumnMap.load(tmp_path / "map.yaml")


def test_a_unit_of_the_head_is_said(tmp_path: Path) -> None:
    rows = "\n".join(f"{5 * k},{0.1 * k},{0.1 * k}" for k in range(50))
    (tmp_path / "log.csv").write_text(f"t [ms],q [deg],q_des [deg]\n{rows}\n")
    log = read_log(tmp_path / "log.csv")
    assert log.t[1] == pytest.approx(0.005)
    assert [text for text in log.remarks if text.startswith("t: converted from ms")]
    assert [text for text in log.remarks if text.startswith("q: converted from deg")]


def test_an_archive_of_objects_names_the_conversion(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", t=STILL, q=np.array([{"a": 1}] * 200, object))
    with pytest.raises(LogError, match=r"q: found the type object, .*python -c"):
        read_log(tmp_path / "log.npz")
