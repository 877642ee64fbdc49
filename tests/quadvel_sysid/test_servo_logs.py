"""Servo logs with one defect each are corrected with a finding, or refused for the true cause."""

from __future__ import annotations

import gzip
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from quadvel_sysid.logs.check_log import CheckedLog, check_log
from quadvel_sysid.logs.checks.slopes import resting_rows
from quadvel_sysid.logs.checks.table import markdown_table
from quadvel_sysid.logs.log import LogError
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.logs.readers.columns import ColumnMap
from tests.quadvel_sysid.servo_logs import KP, recorded

SEEDS = (3, 14)


def inspect_file(folder: Path, log: dict[str, Any]) -> CheckedLog:
    """Write the log to a file, read it and inspect it."""
    np.savez(folder / "log.npz", **log)
    return check_log(read_log(folder / "log.npz"))


def texts(checked: CheckedLog, *kinds: str) -> list[str]:
    return [finding.text for finding in checked.findings if finding.kind in kinds]


def refusal(checked: CheckedLog) -> str:
    (text,) = texts(checked, "refusal")
    return text


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("seed", SEEDS)
def test_clean_log_is_not_corrected(tmp_path: Path, seed: int) -> None:
    log = recorded(seed)
    found = inspect_file(tmp_path, log)
    assert texts(found, "refusal") == []
    assert not [text for text in texts(found, "warning") if "hardly separates" not in text]
    for name in ("t", "q", "dq", "tau", "q_des"):
        np.testing.assert_array_equal(getattr(found.log, name), log[name])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("rows", [1, 5])
def test_a_torque_before_its_command_is_refused(tmp_path: Path, seed: int, rows: int) -> None:
    log = recorded(seed)
    late = np.concatenate([np.repeat(log["q_des"][:1], rows + 2, 0), log["q_des"][: -rows - 2]])
    assert "ms before its command" in refusal(inspect_file(tmp_path, log | {"q_des": late}))


@pytest.mark.parametrize("seed", SEEDS)
def test_rows_that_repeat_the_state_are_dropped(tmp_path: Path, seed: int) -> None:
    log = recorded(seed)
    rows = np.arange(len(log["t"])) // 12 * 12
    found = inspect_file(tmp_path, log | {name: log[name][rows] for name in ("q", "dq", "tau")})
    assert any("92 % of the rows repeat the state before" in text for text in texts(found, "warning"))
    np.testing.assert_array_equal(found.log.t, log["t"][::12])
    np.testing.assert_array_equal(found.log.t_cmd, log["t"])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("torque", [True, False])
def test_missing_speeds_are_computed_from_the_angles(tmp_path: Path, seed: int, torque: bool) -> None:
    log = recorded(seed)
    left_out = ("dq",) if torque else ("dq", "tau")
    found = inspect_file(tmp_path, {name: value for name, value in log.items() if name not in left_out})
    assert any(text.startswith("dq: not in the log; made from q") for text in texts(found, "note"))
    assert rms(found.log.dq - log["dq"]) < 0.1 * rms(log["dq"])


@pytest.mark.parametrize("seed", SEEDS)
def test_speeds_without_a_sign_are_replaced(tmp_path: Path, seed: int) -> None:
    log = recorded(seed)
    found = inspect_file(tmp_path, log | {"dq": np.abs(log["dq"])})
    assert any(text.startswith("dq: has no sign on hip_joint, thigh") for text in texts(found, "warning"))
    assert rms(found.log.dq - log["dq"]) < 0.1 * rms(log["dq"])


@pytest.mark.parametrize("seed", SEEDS)
def test_speeds_of_a_coarse_encoder_are_recomputed(tmp_path: Path, seed: int) -> None:
    log, tick = recorded(seed), 2.0 * np.pi / 1024.0
    q = np.round(log["q"] / tick) * tick
    dq = np.concatenate([np.zeros((1, 3)), np.diff(q, axis=0) / 0.004])
    found = inspect_file(tmp_path, log | {"q": q, "dq": dq})
    assert any(
        "q counts in steps of 6.14 mrad, dq is its difference" in text for text in texts(found, "warning")
    )
    assert rms(found.log.dq - log["dq"]) < 0.2 * rms(dq - log["dq"])
    assert rms(found.log.q - log["q"]) < 0.5 * rms(q - log["q"])


def test_a_coarse_encoder_rests_where_it_stays_on_one_count_for_long() -> None:
    t, tick = 0.004 * np.arange(500), 0.006
    moving = (t < 0.8) | (t > 1.2)
    angle = np.cumsum(0.5 * 0.004 * moving)  # 0.5 rad/s, and a pause
    q = np.stack([np.round(angle / tick) * tick, angle], axis=1)
    found = resting_rows(t, q, np.array([tick, 0.0]))
    assert found[205:298, 0].all()
    assert not found[:195].any()
    assert not found[305:].any()
    assert not found[:, 1].any()


def test_coarse_speeds_that_the_drive_used_are_kept(tmp_path: Path) -> None:
    log = recorded(3, ticks=2.0 * np.pi / 1024.0)
    found = inspect_file(tmp_path, log)
    assert any("but the drive acted on it" in text for text in texts(found, "note"))
    np.testing.assert_array_equal(found.log.dq, log["dq"])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_torque_without_a_sign_is_refused(tmp_path: Path, seed: int) -> None:
    log = recorded(seed)
    text = refusal(inspect_file(tmp_path, log | {"tau": np.abs(log["tau"])}))
    assert text.startswith("tau: has no sign on")


def test_one_sided_torque_under_load_is_not_unsigned(tmp_path: Path) -> None:
    log = recorded(3)
    carried = log["q_des"] - (np.abs(log["tau"]).max() + 1.0) / KP  # what it takes to carry the load
    found = inspect_file(
        tmp_path, log | {"tau": log["tau"] - np.abs(log["tau"]).max() - 1.0, "q_des": carried}
    )
    assert texts(found, "refusal") == []


@pytest.mark.parametrize("seed", SEEDS)
def test_gap_is_reported_and_accepted(tmp_path: Path, seed: int) -> None:
    log = recorded(seed)
    keep = (log["t"] < 2.0) | (log["t"] > 3.5)
    rows = ("t", "q", "dq", "tau", "q_des")
    found = inspect_file(tmp_path, log | {name: log[name][keep] for name in rows})
    assert texts(found, "refusal") == []
    assert any(text.startswith("t: 1 gap, the longest of 1.5") for text in texts(found, "warning"))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("both", [True, False])
def test_angles_that_jump_by_a_turn_are_unwrapped(tmp_path: Path, seed: int, both: bool) -> None:
    log = recorded(seed, middle=np.pi - 0.1)
    turned = {name: (log[name] + np.pi) % (2.0 * np.pi) - np.pi for name in ("q", "q_des")[: 1 + both]}
    found = inspect_file(tmp_path, log | turned)
    assert any(text.startswith("q: jumps by 2 pi in one row") for text in texts(found, "warning"))
    np.testing.assert_allclose(found.log.q - found.log.q_des, log["q"] - log["q_des"], atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("torque", [True, False])
def test_inverted_joint_is_not_another_order_of_joints(tmp_path: Path, seed: int, torque: bool) -> None:
    log = recorded(seed, middle=0.0)
    q_des = log["q_des"] * [1.0, -1.0, 1.0]
    given = log | {"q_des": q_des}
    text = refusal(
        inspect_file(tmp_path, given if torque else {k: v for k, v in given.items() if k != "tau"})
    )
    assert text.startswith("q_des: thigh_joint")
    assert "own command with the opposite sign" in text
    assert "columns" not in text


def test_joints_with_the_same_command_are_not_reordered(tmp_path: Path) -> None:
    log = recorded(3)
    one = {name: np.repeat(log[name][:, :1], 3, 1) for name in ("q", "dq", "tau", "q_des")}
    one["tau"] = one["tau"] + np.random.default_rng(0).normal(0.0, 0.05, one["tau"].shape)
    assert not [text for text in texts(inspect_file(tmp_path, log | one), "refusal") if "columns" in text]


def test_periodic_motion_has_a_definite_sign(tmp_path: Path) -> None:
    """A wave is inverted half a period later."""
    t = 0.002 * np.arange(3000)
    wave = np.sin(10.0 * np.pi * t[:, None] + [0.0, 1.0, 2.0])
    q, dq = 0.1 * np.sin(10.0 * np.pi * t[:, None] - 0.5), np.pi * np.cos(10.0 * np.pi * t[:, None] - 0.5)
    tau = (
        KP * (np.roll(wave, 4, axis=0) - q) - 0.5 * dq + np.random.default_rng(0).normal(0.0, 0.3, wave.shape)
    )
    log = {"t": t, "q": np.tile(q, 3), "dq": np.tile(dq, 3), "q_des": wave, "tau": tau, "kp": KP, "kd": 0.5}
    assert texts(inspect_file(tmp_path, log), "refusal") == []


def test_uncommanded_damping_is_reported(tmp_path: Path) -> None:
    found = inspect_file(tmp_path, recorded(3) | {"kd": 0.0})
    assert "kd: 0 was commanded; the drive's own damping is fitted" in texts(found, "note")


def test_gains_in_a_unit_of_their_own_are_fitted_and_those_of_one_joint_are_refused(tmp_path: Path) -> None:
    found = inspect_file(tmp_path, recorded(3) | {"kp": 850.0, "kd": 30.0})
    assert found.log.kp is None
    assert any("in a unit of its own, as a servo's is" in text for text in texts(found, "warning"))
    log = recorded(3)
    assert "kp in N m/degree" in refusal(inspect_file(tmp_path, log | {"kp": KP * np.pi / 180.0}))
    assert "on thigh_joint" in refusal(inspect_file(tmp_path, log | {"kp": KP * np.array([1.0, 40.0, 1.0])}))


def test_exchanged_gains_are_refused_by_their_cause(tmp_path: Path) -> None:
    text = refusal(inspect_file(tmp_path, recorded(3) | {"kp": 0.5, "kd": KP}))
    assert f"kp 0.5 and kd {KP:.3g} exchanged" in text


# Files


def columns(log: dict[str, Any]) -> dict[str, list[Any]]:
    """The fields of a log under the names of PACE, as lists."""
    names = {"t": "time", "q": "dof_pos", "q_des": "des_dof_pos"}
    return {other: log[name].tolist() for name, other in names.items()}


@pytest.mark.parametrize("form", ["columns", "records"])
@pytest.mark.parametrize("suffix", [".json", ".json.gz"])
def test_a_document_is_read_by_columns_and_by_records(tmp_path: Path, form: str, suffix: str) -> None:
    log = recorded(3, 1.0)
    given: dict[str, Any] = columns(log)
    if form == "records":
        given = {
            "kp": 30.0,
            "entries": [dict(zip(given, row, strict=True)) for row in zip(*given.values(), strict=True)],
        }
    text = json.dumps(given).encode()
    path = tmp_path / f"log{suffix}"
    path.write_bytes(gzip.compress(text) if suffix.endswith("gz") else text)
    read = read_log(path)
    np.testing.assert_allclose(read.q, log["q"])
    np.testing.assert_allclose(read.q_des, log["q_des"])
    assert "q: read from 'dof_pos'" in read.remarks
    assert read.derived == ("dq",)


def test_a_table_may_hold_lists_in_its_cells_and_its_commands_in_another_file(tmp_path: Path) -> None:
    log = recorded(3, 1.0)
    for name, field in (("arm_state.csv", "q"), ("arm_control.csv", "q_des")):
        lines = [f'STATE,{1e6 * t},"{row.tolist()}"' for t, row in zip(log["t"], log[field], strict=True)]
        (tmp_path / name).write_text("\n".join(["type,timestamp,positions", *lines]) + "\n")
    micro = {"from": "timestamp", "scale": 1e-6}
    other = {"file": ["state", "control"]}
    names = {
        "t": micro,
        "q": "positions",
        "t_cmd": micro | other,
        "q_des_cmd": {"from": "positions", "scale": [1.0, -1.0, 1.0]} | other,
        "kp": {"value": 30.0},
        "joint_names": ["hip", "thigh", "calf"],
    }
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(names))
    read = read_log(tmp_path / "arm_state.csv", names=ColumnMap.load(tmp_path / "map.yaml"))
    np.testing.assert_allclose(read.t, log["t"])
    np.testing.assert_allclose(read.q, log["q"])
    np.testing.assert_allclose(read.q_des, log["q_des"] * [1.0, -1.0, 1.0])
    assert read.joints == ("hip_joint", "thigh_joint", "calf_joint")
    assert read.kp is not None
    assert (read.kp == 30.0).all()


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        ({"angle": "q"}, "angle: unknown, expected one of t, q, dq"),
        ({"q": {"column": "pos"}}, "q/column: unknown, expected one of from, scale"),
        ({"q": {"from": "pos", "scale": "deg"}}, "q/scale: found 'deg', expected a number"),
        ({"q": {"from": "pos", "scale": 0}}, "q/scale: found 0, expected a number other than 0"),
        ({"q": 3}, r"q/from: found 3, expected a name"),
        ({"joint_names": "hip"}, "joint_names: found 'hip', expected a list"),
        (["q"], "expected a line for each field"),
    ],
)
def test_invalid_map_is_refused_by_its_entry(tmp_path: Path, names: Any, sentence: str) -> None:
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(names))
    with pytest.raises(LogError, match=rf"map\.yaml: .*{sentence}"):
        ColumnMap.load(tmp_path / "map.yaml")


def test_a_column_that_a_map_names_and_the_log_lacks_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", **recorded(3, 1.0))
    (tmp_path / "map.yaml").write_text("q: angles\n")
    with pytest.raises(LogError, match=r"log\.npz: q: no 'angles' in it, found t, dq, tau"):
        read_log(tmp_path / "log.npz", names=ColumnMap.load(tmp_path / "map.yaml"))


@pytest.mark.parametrize("text", ["", "[1, 2", '{"t": ["a"]}', '{"t": [[1, 2], [1]]}', "[" * 100_000])
def test_a_document_that_is_no_log_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "log.json").write_text(text)
    with pytest.raises(LogError, match=r"log\.json: "):
        read_log(tmp_path / "log.json")


MEASURED = Path(os.environ.get("QUADVEL_MEASURED", ""))


@pytest.mark.skipif(
    "QUADVEL_MEASURED" not in os.environ, reason="QUADVEL_MEASURED names no folder of measured logs"
)
@pytest.mark.parametrize(
    ("name", "names", "sentence"),
    [
        ("bam_sts3250_1.json", {}, "tau, kd: not in the log; expected the torque, or the commanded gains"),
        ("igris_chirp.npz", {}, "q_des: 1_joint, 8_joint, 14_joint follows its own command with the opposite sign"),
        ("so101_chirp_sweep_state_motor.csv.gz", {"q": "positions", "q_des": "positions"}, "t: a row comes every 2.006e+04 s"),
        (
            "so101_chirp_sweep_state_motor.csv.gz",
            {"t": {"from": "timestamp", "scale": 1e-6}, "q_des": {"from": "positions", "file": ["state_motor", "control"]}},
            "tau: has no sign on",
        ),
    ],
)  # fmt: skip
def test_measured_logs_of_servos_are_refused_for_what_they_lack(
    tmp_path: Path, name: str, names: Any, sentence: str
) -> None:
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(names))
    read = read_log(MEASURED / name, names=ColumnMap.load(tmp_path / "map.yaml"))
    with pytest.raises(LogError) as refused:
        check_log(read).raise_refusal()
    assert sentence in str(refused.value)


def test_table_of_checks_is_documented() -> None:
    assert markdown_table() in (Path(__file__).parents[2] / "docs" / "identification.md").read_text()
