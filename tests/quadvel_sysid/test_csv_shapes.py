"""One log in the table formats of spreadsheets, loggers, numpy, pandas, PlotJuggler and rostopic."""

from __future__ import annotations

import gzip
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from quadvel_sysid.logs.log import Log, LogError
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.logs.readers import csv_table
from quadvel_sysid.logs.readers.columns import ColumnMap, Source

RNG = np.random.default_rng(7)
T = np.round(np.arange(60) * 0.005, 3)
ROWS = np.column_stack([T, RNG.normal(0.0, 0.3, (60, 4)).round(5)])
HEAD = ("t", "q/knee", "dq/knee", "q_des/knee", "tau/knee")


def table(separator: str = ",", head: tuple[str, ...] = HEAD, number: Callable[[float], str] = str) -> str:
    lines = [separator.join(map(number, row)) for row in ROWS.tolist()]
    return "\n".join([separator.join(head), *lines]) + "\n"


def with_comma(value: float) -> str:
    return str(value).replace(".", ",")


def quoted(value: float) -> str:
    return f'"{value}"'


def before(text: str, *lines: str) -> str:
    return "\n".join([*lines, text])


def below_head(text: str, *lines: str) -> str:
    head, _, rest = text.partition("\n")
    return "\n".join([head, *lines, rest])


def with_column(text: str, name: str, cell: Callable[[int], str]) -> str:
    head, *rows = text.splitlines()
    return "\n".join([f"{name},{head}", *(f"{cell(k)},{row}" for k, row in enumerate(rows))]) + "\n"


def date(value: float) -> str:
    return f"2026-03-01T10:00:{value:09.6f}" if value in T else str(value)


PLAIN = table()
SHAPES: dict[str, str | bytes] = {
    "plain": PLAIN,
    "byte order mark": "\ufeff" + PLAIN,
    "spreadsheet's unicode": table("\t").encode("utf-16"),
    "line ends of Windows": PLAIN.replace("\n", "\r\n"),
    "line ends of old Macs": PLAIN.replace("\n", "\r"),
    "no line end at the end": PLAIN.rstrip("\n"),
    "comments": before(PLAIN.replace("\n", "\n# changed the load\n", 20), "# bench 3, 24 V", "", "# kt = 0.13"),
    "semicolons": table(";"),
    "decimal commas": table(";", number=with_comma),
    "decimal commas and tabs": table("\t", number=with_comma),
    "decimal commas in quotes": table(",", number=lambda x: quoted(x).replace(".", ",")),
    "quotes": table(number=quoted),
    "tabs": table("\t"),
    "bars": table("|"),
    "spaces": table(" "),
    "savetxt": "# " + table(" "),
    "savetxt with commas": "# a note\n# " + PLAIN,
    "more numbered columns than names": "".join(
        f"{line},{','.join('01234567')}\n" for line in PLAIN.splitlines()),
    "savetxt with text": "# " + with_column(PLAIN, "stage", lambda k: "chirp" if k < 30 else "sine"),
    "separator named": "sep=;\n" + table(";"),
    "spaces behind commas": PLAIN.replace(",", ", "),
    "commas at the line ends": PLAIN.replace("\n", ",\n"),
    "commas at the line ends of rows": PLAIN.replace("\n", ",\n").replace(",\n", "\n", 1),
    "units": below_head(PLAIN, "s,rad,rad/s,rad,Nm"),
    "units in brackets": below_head(PLAIN, "[s],[rad],[rad/s],[rad],[N m]"),
    "units in the head": table(head=("t [s]", "q/knee [rad]", "dq/knee (rad/s)", "q_des/knee [rad]", "tau/knee [Nm]")),
    "milliseconds": table(head=("t [ms]", *HEAD[1:]), number=lambda x: repr(1e3 * x) if x in T else repr(x)),
    "index": with_column(PLAIN, "", str),
    "index of pandas": with_column(PLAIN, "Unnamed: 0", str),
    "stages": with_column(PLAIN, "stage", lambda k: "chirp" if k < 30 else "sine"),
    "texts with commas": with_column(PLAIN, "note", lambda k: '"one, two"'),
    "texts over two lines": with_column(PLAIN, "note", lambda k: '"one\ntwo"'),
    "truth values": with_column(PLAIN, "enabled", lambda k: str(k > 3)),
    "position mode": with_column(PLAIN, "position_mode", lambda k: "servo"),
    "rows of nothing at the end": PLAIN + "nan,nan,nan,nan,nan\n" * 2 + ",,,,\n" + "NULL,NA,None,-,nan\n",
    "half a row at the end": PLAIN + "0.3,0.1",
    "dates": table(number=date),
    "dates with a zone": table(number=lambda x: date(x) + ("Z" if x in T else "")),
    "dates with a space": table(number=lambda x: date(x).replace("T", " ")),
    "times of the day": table(number=lambda x: date(x).partition("T")[2] or str(x)),
    "nanoseconds": table(number=lambda x: date(x) + ("000" if x in T else "")),
    "capitals": table(head=("Time", "Q/knee", "DQ/knee", "Q_des/knee", "Tau/knee")),
    "joint before": table(head=("time", "knee_q", "knee_dq", "knee_q_des", "knee_tau")),
    "underscores": table(head=("timestamp", "q_knee", "dq_knee", "q_des_knee", "tau_knee")),
    "words": table(head=("Time", "joint_position_knee", "joint_velocity_knee", "target_position_knee", "joint_effort_knee")),
    "other words": table(head=("t", "knee.pos", "knee.vel", "knee.pos_cmd", "knee.torque")),
    "PlotJuggler": table(head=("__time", *(f"/joint_states/knee/{name}" for name in (
        "position", "velocity", "position_command", "effort")))),
    "tau_limit": with_column(table(head=("t", "q_knee", "dq_knee", "q_des_knee", "tau_knee")), "tau_limit", lambda k: "high"),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_of_table_yields_the_same_log(tmp_path: Path, shape: str) -> None:
    content = SHAPES[shape]
    path = tmp_path / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    check(read_log(path))


def check(log: Log) -> None:
    assert log.joints == ("knee_joint",)
    np.testing.assert_allclose(log.t - log.t[0], T, atol=1e-6)
    assert log.tau is not None
    assert "dq" not in log.derived
    for values, column in ((log.q, 1), (log.dq, 2), (log.q_des, 3), (log.tau, 4)):
        np.testing.assert_allclose(values[:, 0], ROWS[:, column], atol=1e-12)


@pytest.mark.parametrize(
    "tail", ["0.3,nan,nan,nan,nan", "0.3,0.1,0.2,,", "0.3,,0.2,0.1,1", ",0.1,0.2,0.3,1", "0.3,1,-,1,1"]
)
@pytest.mark.parametrize("count", [1, 3])
def test_rows_that_lack_a_value_at_the_end_are_left_out_with_a_note(
    tmp_path: Path, tail: str, count: int
) -> None:
    (tmp_path / "log.csv").write_text(PLAIN + f"{tail}\n" * count)
    log = read_log(tmp_path / "log.csv")
    check(log)
    assert any(f"last {count} of {60 + count} rows" in text for text in log.remarks)


def test_column_that_ends_halfway_is_refused_by_its_row(tmp_path: Path) -> None:
    lines = PLAIN.splitlines()
    (tmp_path / "log.csv").write_text(
        "\n".join([*lines[:21], *(line.rpartition(",")[0] + "," for line in lines[21:])])
    )
    with pytest.raises(LogError, match=r"log\.csv: tau: .* row 20 "):
        read_log(tmp_path / "log.csv")


def test_unused_column_is_named_in_a_note(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(SHAPES["stages"])  # type: ignore[arg-type]
    assert any(text.startswith("stage: not used") for text in read_log(tmp_path / "log.csv").remarks)


@pytest.mark.parametrize(
    "head",
    ["q/hip,q/knee,q_des/hip,q_des/knee", "joint_pos_0,joint_pos_1,q_des_0,q_des_1", "q1,q2,q_des1,q_des2",
     "position[0],position[1],q_des[0],q_des[1]", "field.position0,field.position1,q_des0,q_des1"],
)  # fmt: skip
def test_joints_are_named_by_their_columns(tmp_path: Path, head: str) -> None:
    rows = [f"{k / 100},1,2,3,4" for k in range(20)]
    (tmp_path / "log.csv").write_text("\n".join([f"%time,{head}", *rows]) + "\n")
    log = read_log(tmp_path / "log.csv")
    assert log.q[5].tolist() == [1, 2]
    assert log.q_des[5].tolist() == [3, 4]


def test_degrees_become_radians_and_a_map_overrides_them(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(below_head(PLAIN, "ms,deg,deg/s,deg,mNm"))
    log = read_log(tmp_path / "log.csv")
    np.testing.assert_allclose(log.q[:, 0], np.radians(ROWS[:, 1]))
    np.testing.assert_allclose(log.t, 1e-3 * T)
    own = read_log(tmp_path / "log.csv", names=ColumnMap({"q": Source(("q",), 2.0)}))
    np.testing.assert_allclose(own.q[:, 0], 2.0 * ROWS[:, 1])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (PLAIN.partition("\n")[2], r"line 1: found the numbers .* no head"),
        (table(";", number=with_comma).partition("\n")[2], r"line 1: found the numbers .* no head"),
        (below_head(PLAIN, "s,rad,counts,rad,Nm"), "dq/knee: the unit 'counts' is unknown"),
        (PLAIN + "0.31,a,1,1,1\n", "line 62: q/knee: found 'a', expected a number"),
        (PLAIN + "01/03/2026 10:00:00,1,1,1,1\n", "line 62: t: found '01/03/2026 10:00:00', expected .* date such as"),
        (PLAIN.replace("dq/knee", "q/knee"), "q/knee: the column stands there twice"),
        ("# only\n# comments\n", "expected"),
        ("t,q/knee,q_des/knee\n" + "1,nan,2\n" * 20, "q: no row holds a number"),
        (
            "t,q/hip,q/knee,q_des/hip,q_des/knee\n" + "1,1,nan,nan,2\n" * 20,
            "q: no joint holds a number in all of q, q_des",
        ),
    ],
)  # fmt: skip
def test_a_table_that_is_none_is_refused_by_line_and_column(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(LogError, match=rf"log\.csv: .*{sentence}"):
        read_log(tmp_path / "log.csv")


@pytest.mark.parametrize("field", ["q", "tau"])
def test_a_joint_that_was_never_measured_is_left_out_by_name(field: str, tmp_path: Path) -> None:
    lost = np.where(np.arange(2) == 1, np.nan, 0.1)
    fields = {name: np.tile(lost if name == field else [0.1, 0.2], (60, 1)) for name in ("q", "q_des", "tau")}
    np.savez(tmp_path / "log.npz", t=T[:60], kp=np.array([20.0, 30.0]), joint_names=["hip", "knee"], **fields)
    log = read_log(tmp_path / "log.npz")
    assert log.joints == ("hip_joint",)
    assert log.kp is not None
    assert (log.kp == 20.0).all()
    assert [text for text in log.remarks if text.startswith(f"{field}: no number for knee_joint")]


def bare_rows(separator: str = ",", number: Callable[[float], str] = str) -> list[str]:
    return table(separator, number=number).splitlines()[1:]


@pytest.mark.parametrize(
    "rows",
    [
        [f"{row},chirp" for row in bare_rows()],
        [f"True,{row},False" for row in bare_rows()],
        [f"{row}," for row in bare_rows()],
        [f",{row},," for row in bare_rows()],
        [f"{row},NaN,null" for row in bare_rows()],
        [f"{row};chirp" for row in bare_rows(";", with_comma)],
        [f"{row}\tTrue" for row in bare_rows("\t", with_comma)],
        [f"{row} chirp" for row in bare_rows(" ")],
        [f'{row},"[1, 2]",position' for row in bare_rows()],
        bare_rows(number=date),
        bare_rows(number=lambda x: date(x).replace("T", " ")),
        bare_rows(number=lambda x: date(x).partition("T")[2] or str(x)),
        [f"2026/03/01 10:00:{k},{row}" for k, row in enumerate(bare_rows())],
    ],
)
def test_rows_without_a_head_are_refused_as_such(tmp_path: Path, rows: list[str]) -> None:
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    with pytest.raises(LogError, match=r"line 1: .* no head"):
        read_log(tmp_path / "log.csv")


@pytest.mark.parametrize("head", ["0,1,2,3,4", ",0,1,2,3,4", "t,1,2,3,4"])
def test_numbers_as_names_of_columns_are_a_head_if_a_map_names_them(tmp_path: Path, head: str) -> None:
    rows = [f"{k},{row}" if head.startswith(",") else row for k, row in enumerate(bare_rows())]
    (tmp_path / "log.csv").write_text("\n".join([head, *rows]) + "\n")
    time = "t" if "t" in head else "0"
    names = {"t": time, "q": "1", "dq": "2", "q_des": "3", "tau": "4"}
    sources = {field: Source((column,)) for field, column in names.items()}
    check(read_log(tmp_path / "log.csv", names=ColumnMap(sources, ("knee",))))


@pytest.mark.parametrize("line", [b"\n", b"# comment\n", b"1,2,3\n", b"0" * 999_000 + b",1,1\n", b"0"])
def test_a_packed_table_that_grows_is_refused_within_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: bytes
) -> None:
    monkeypatch.setattr(csv_table, "MAX_TEXT_CHARS", 3_000_000)
    path = tmp_path / "log.csv.gz"
    with gzip.open(path, "wb", compresslevel=1) as file:
        file.write(b"t,q/knee,q_des/knee\n")
        for _ in range(6):
            file.write(line * (1_000_000 // len(line)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=r"log\.csv\.gz: more than 3000000 characters"):
        read_log(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
