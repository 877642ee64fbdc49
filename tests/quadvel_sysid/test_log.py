"""Logs read from every format, and refusals that name the file and the field."""

from __future__ import annotations

import io
import re
import resource
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_sysid.logs.check_log import check_logs
from quadvel_sysid.logs.log import LogError
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.logs.readers import raw
from tests.helpers.robots import ALIENGO, GO2
from tests.quadvel_sysid.joint_logs import csv, fields, mcap, npz

PLAIN = [name.removesuffix("_joint") for name in JOINT_NAMES]


def test_archive_is_read(tmp_path: Path) -> None:
    log = read_log(npz(tmp_path / "a.npz"))
    expected = fields()
    assert log.joints == JOINT_NAMES
    for name in ("t", "q", "dq", "tau", "q_des"):
        np.testing.assert_array_equal(getattr(log, name), expected[name])
    assert log.kp is not None
    assert log.kp.shape == log.q.shape
    assert (log.kp == 30.0).all()
    assert log.valid.all()
    assert (log.dq_des, log.tau_ff, log.temperature, log.voltage) == (None,) * 4


def test_table_equals_archive(tmp_path: Path) -> None:
    given = fields(0.5)
    archive = read_log(npz(tmp_path / "a.npz", **given, valid=None))
    table = read_log(csv(tmp_path / "a.csv", given | {"kp": np.full(250, 30.0)}))
    for name in ("t", "q", "dq", "tau", "q_des", "kp"):
        np.testing.assert_allclose(getattr(table, name), getattr(archive, name), rtol=1e-12)


def test_a_recording_of_the_stack_is_stamped_as_its_messages_are(tmp_path: Path) -> None:
    given = fields(0.5)
    log = read_log(mcap(tmp_path / "a.mcap", given))
    np.testing.assert_allclose(log.t, given["t"], atol=1e-9)
    np.testing.assert_allclose(log.t_cmd, given["t"] + 0.002, atol=1e-9)
    np.testing.assert_allclose(log.q_des, given["q_des"], atol=1e-6)
    np.testing.assert_allclose(log.tau, given["tau"], atol=1e-5)
    assert log.joints == JOINT_NAMES


def test_damping_mode_is_a_gain_of_zero(tmp_path: Path) -> None:
    log = read_log(mcap(tmp_path / "a.mcap", fields(0.2), mode=0))
    assert log.kp is not None
    assert log.kd is not None
    assert (log.kp == 0.0).all()
    assert (log.kd == 0.5).all()


def test_commands_with_their_own_times_take_precedence(tmp_path: Path) -> None:
    t_cmd = np.arange(0.0, 4.0, 0.005)
    q_des_cmd = np.full((len(t_cmd), 12), 0.25)
    log = read_log(npz(tmp_path / "a.npz", t_cmd=t_cmd, q_des_cmd=q_des_cmd))
    np.testing.assert_array_equal(log.t_cmd, t_cmd)
    assert (log.q_des == 0.25).all()


def test_a_table_may_hold_two_time_bases(tmp_path: Path) -> None:
    given = fields(0.5)
    del given["q_des"]
    given |= {"t_cmd": np.arange(40) * 0.01, "q_des_cmd": np.full((40, 12), 0.25)}
    log = read_log(csv(tmp_path / "a.csv", given))
    assert (len(log.t), log.q_des.shape) == (250, (40, 12))


@pytest.mark.parametrize("shape", [(), (12,), (2000,), (2000, 12)])
def test_gains_are_one_number_one_a_joint_or_one_a_sample(tmp_path: Path, shape: tuple[int, ...]) -> None:
    log = read_log(npz(tmp_path / "a.npz", kp=np.full(shape, 20.0)))
    assert log.kp is not None
    assert log.kp.shape == (2000, 12)
    assert (log.kp == 20.0).all()


def test_gains_on_state_rows_apply_to_the_following_commands(tmp_path: Path) -> None:
    kp = np.where(fields()["t"] < 2.0, 20.0, 40.0)
    t_cmd = np.array([*np.arange(0.5, 2.0, 0.1), *np.arange(2.05, 3.5, 0.1)])
    log = read_log(npz(tmp_path / "a.npz", kp=kp, t_cmd=t_cmd, q_des_cmd=np.zeros((len(t_cmd), 12))))
    assert log.kp is not None
    np.testing.assert_array_equal(log.kp[:, 0], np.where(t_cmd < 2.0, 20.0, 40.0))


def test_joints_are_matched_by_name_with_or_without_its_ending(tmp_path: Path) -> None:
    order = [5, 0, 11]
    given = {name: fields()[name][:, order] for name in ("q", "dq", "q_des", "tau")}
    log = read_log(npz(tmp_path / "a.npz", **given, joint_names=[PLAIN[k] for k in order]))
    assert log.joints == tuple(JOINT_NAMES[k] for k in order)
    picked = log.select_joints([PLAIN[11], JOINT_NAMES[5]])
    np.testing.assert_array_equal(picked.q, given["q"][:, [2, 0]])
    assert picked.kp is not None
    assert picked.kp.shape == (2000, 2)


def test_valid_is_read_and_foreign_fields_are_not(tmp_path: Path) -> None:
    valid = fields()["t"] < 1.0
    log = read_log(npz(tmp_path / "a.npz", valid=valid, valid_kp35=~valid, note="walked"))
    np.testing.assert_array_equal(log.valid.all(axis=1), valid)


def test_repeated_stamps_are_dropped_and_reported(tmp_path: Path) -> None:
    t = fields()["t"].copy()
    t[100] = t[99]
    log = read_log(npz(tmp_path / "a.npz", t=t))
    assert len(log.t) == len(t) - 1
    assert "t: 1 of 2000 rows repeat a time stamp" in log.remarks[0]


def test_the_command_in_force_is_the_last_one_sent(tmp_path: Path) -> None:
    t_cmd = np.arange(10) * 0.1
    log = read_log(npz(tmp_path / "a.npz", t_cmd=t_cmd, q_des_cmd=np.zeros((10, 12))))
    np.testing.assert_array_equal(log.command_rows(np.array([-1.0, 0.0, 0.09, 0.1, 9.0])), [0, 0, 0, 1, 9])


def shuffled() -> np.ndarray:
    return np.random.default_rng(0).permutation(fields()["t"])


def with_nan(name: str) -> np.ndarray:
    values = fields()[name].copy()
    values[17, 3] = np.nan
    return values


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"t": shuffled()}, "t: the time does not rise from row"),
        ({"t": np.zeros(2000)}, "t: the time does not rise from row 0 to row 1"),
        ({"q": with_nan("q")}, "q/FL_hip_joint: 1 of 24000 values are not finite, the first in row 17"),
        ({"q": None}, "q: the field is missing"),
        ({"t": None}, "t: the field is missing"),
        ({"q_des": None}, "q_des: the field is missing"),
        ({"q_des": None, "q_des_cmd": np.zeros((5, 12))}, "t_cmd: the field is missing"),
        ({"q": np.zeros((12, 2000))}, "q: found shape (12, 2000), expected (2000, J)"),
        ({"tau": np.zeros((2000, 11))}, "tau: found shape (2000, 11), expected (2000, 12)"),
        ({"q_des": np.zeros((1999, 12))}, "q_des: found shape (1999, 12), expected (2000, 12)"),
        ({"kp": np.zeros(7)}, "kp: found shape (7,), expected one number, 12,"),
        ({"joint_names": JOINT_NAMES[:11]}, "joint_names: found 11 names, expected 12"),
        ({"joint_names": (*JOINT_NAMES[:11], "FR_hip")}, "joint_names: 'FR_hip_joint' stands there twice"),
        ({"valid": np.full(2000, 3)}, "valid: found numbers other than 0 and 1"),
        ({"q": np.full((2000, 12), "a")}, "q: found the type <U1, expected numbers"),
        ({"q": np.full((2000, 12), None)}, "q: found the type object, expected numbers"),
    ],
)
def test_a_wrong_archive_is_refused_with_its_field(tmp_path: Path, changes: Any, sentence: str) -> None:
    path = npz(tmp_path / "wrong.npz", **changes)
    with pytest.raises(LogError) as refusal:
        read_log(path)
    assert str(refusal.value).startswith(f"{path}: {sentence}")


@pytest.mark.parametrize("rows", [0, 1])
def test_an_empty_log_and_one_sample_are_refused(tmp_path: Path, rows: int) -> None:
    few = {name: fields()[name][:rows] for name in ("t", "q", "dq", "q_des", "tau")}
    with pytest.raises(LogError, match=rf"few\.npz: t: found shape \({rows},\)"):
        read_log(npz(tmp_path / "few.npz", **few))


@pytest.mark.parametrize("suffix", ["npz", "mcap", "csv", "db3", "txt"])
@pytest.mark.parametrize("content", [b"", b"\0" * 1000, b"what is this"])
def test_what_is_no_log_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"wrong.{suffix}"
    path.write_bytes(content)
    with pytest.raises(LogError, match=rf"wrong\.{suffix}: "):
        read_log(path)


def test_an_empty_folder_and_no_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=str(tmp_path)):
        read_log(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        read_log(tmp_path / "nothing.npz")


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_whole_part_of_a_truncated_recording_is_read(tmp_path: Path, share: float) -> None:
    path = mcap(tmp_path / "cut.mcap", fields(2.0), chunk_size=100_000)
    whole, data = read_log(path), path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    log = read_log(path)
    rows = len(log.t)
    assert share - 0.2 < rows / len(whole.t) <= share + 0.05
    np.testing.assert_array_equal(log.q, whole.q[:rows])
    assert re.fullmatch(
        r"recording: it is truncated; the first \d\.\d s, \d+ messages are readable", log.remarks[0]
    )


@pytest.mark.parametrize("share", [0.01, 0.5])
def test_recording_truncated_before_its_first_chunk_is_refused(tmp_path: Path, share: float) -> None:
    path = mcap(tmp_path / "cut.mcap", fields(0.2))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(LogError, match=r"cut\.mcap: the recording is truncated and holds no complete chunk"):
        read_log(path)


def test_folder_without_rosbag2_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no recording")
    with pytest.raises(
        LogError, match=r"the folder is no recording: a rosbag2 folder holds a metadata\.yaml"
    ):
        read_log(tmp_path)


def test_truncated_archive_is_refused(tmp_path: Path) -> None:
    path = npz(tmp_path / "cut.npz")
    path.write_bytes(path.read_bytes()[:100_000])
    with pytest.raises(LogError, match=r"cut\.npz: no whole NPZ archive"):
        read_log(path)


def test_one_column_is_not_used_for_every_joint(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"dq: found shape \(2000,\), expected \(2000, 12\)"):
        read_log(npz(tmp_path / "a.npz", dq=fields()["dq"][:, 0]))


def test_unused_fields_are_reported(tmp_path: Path) -> None:
    log = read_log(npz(tmp_path / "a.npz", Tau=np.zeros(3), t_cmd=fields()["t"]))
    assert "Tau: not used, as no field is read from columns of this name" in log.remarks
    assert "t_cmd: not used, as q_des_cmd is not there; q_des is taken at the times t" in log.remarks


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("0.1,1,2,x", "line 22: q_des/a: found 'x', expected a number with a decimal point"),
        ("0.1,1,2", "line 22: found 3 cells, expected 4"),
        ("0.1,1,2,0.8#x", "line 22: q_des/a: found '0.8#x'"),
        ("0.1;1;2;3", "line 22: found 1 cells, expected 4"),
    ],
)
def test_a_wrong_line_of_a_table_is_refused(tmp_path: Path, line: str, sentence: str) -> None:
    rows = [f"{k / 100},1,2,3" for k in range(20)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["t,q/a,dq/a,q_des/a", *rows, line]) + "\n")
    with pytest.raises(LogError, match=sentence):
        read_log(path)


def test_columns_of_different_joints_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,q/a,dq/b,q_des/a\n" + "".join(f"{k},1,2,3\n" for k in range(20)))
    with pytest.raises(LogError, match=r"a\.csv: dq: found columns of b, expected those of q: a"):
        read_log(path)


def test_two_gigabytes_of_zeros_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "zeros.npz"
    header = io.BytesIO()
    rows = 2**31 // 8
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (rows,)})
    block = bytes(1 << 20)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("t", "q", "dq", "q_des"):
            archive.writestr(f"{name}.npy", header.getvalue() + block)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=r"zeros\.npz: t: found shape \(268435456,\)"):
        read_log(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize("suffix", ["npz", "mcap", "csv"])
def test_a_file_of_nothing_but_zeros_is_refused_within_little_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"zeros.{suffix}"
    with path.open("wb") as file:
        file.truncate(2**31)
    program = (
        "import resource, sys; from quadvel_sysid.logs.log import LogError\n"
        "from quadvel_sysid.logs.read_log import read_log\n"
        "resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))\n"
        "try: read_log(sys.argv[1])\n"
        "except LogError as error: print(error)"
    )
    result = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True)
    assert result.stdout.startswith(f"{path}: "), result.stderr


def test_a_long_log_is_kept_in_single_precision() -> None:
    assert raw.storage_dtype(raw.MAX_DOUBLE_VALUES + 1) == np.float32
    assert raw.storage_dtype(raw.MAX_DOUBLE_VALUES) == np.float64


def test_command_is_in_force_from_its_time_despite_rounding(tmp_path: Path) -> None:
    log = read_log(npz(tmp_path / "a.npz"))
    at = (log.t_cmd - 0.1) + 0.1
    assert (log.command_rows(at) == np.arange(len(at))).all()


def test_a_log_is_that_of_the_aliengo_unless_it_names_another_robot_or_one_is_asked_for(
    tmp_path: Path,
) -> None:
    own, go2 = npz(tmp_path / "a.npz"), tmp_path / "go2.mcap"
    mcap(go2, fields(), description=GO2.urdf_file.read_text())
    assert read_log(own).robot is ALIENGO
    assert read_log(own, robot="go2").robot is GO2
    assert read_log(go2).robot is GO2
    with pytest.raises(LogError, match=r"go2\.mcap: robot is 'go2', expected 'aliengo'"):
        read_log(go2, robot="aliengo")
    with pytest.raises(LogError, match=r"go2\.mcap: robot is 'go2', expected 'aliengo' as of .*a\.npz"):
        check_logs([read_log(own)], [read_log(go2)])
