"""Malicious logs are refused in one sentence: nothing in them runs, and memory stays bounded."""

from __future__ import annotations

import io
import os
import pickle
import resource
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_sysid.logs.log import LogError
from quadvel_sysid.logs.read_log import read_log
from tests.helpers.robots import ALIENGO

MAGIC = b"\x89MCAP0\r\n"
SECOND = np.arange(0.0, 1.0, 0.01)
JOINTS = np.zeros((len(SECOND), 12))


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, sprung: Path) -> None:
        self.sprung = sprung

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, int]]:
        return os.mkdir, (str(self.sprung), 0o700)


def array(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def header(shape: str, kind: str = "'<f8'") -> bytes:
    """Header of an array without its data."""
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def archive(path: Path, **changes: bytes) -> Path:
    """A valid log with some members replaced."""
    good = {"t": array(SECOND), **dict.fromkeys(("q", "dq", "q_des"), array(JOINTS))}
    with zipfile.ZipFile(path, "w") as file:
        for name, content in (good | changes).items():
            file.writestr(f"{name}.npy", content)
    return path


@pytest.mark.parametrize("field", ["q", "joint_names"])
def test_an_array_of_objects_is_refused_and_stays_packed(tmp_path: Path, field: str) -> None:
    sprung = tmp_path / "sprung"
    objects = np.array([Trap(sprung)] * 12, object)
    path = archive(tmp_path / "a.npz", **{field: array(objects)})
    with pytest.raises(LogError, match=rf"a\.npz: {field}: found the type object, expected"):
        read_log(path)
    read_log(archive(tmp_path / "b.npz", unknown=array(objects)))  # what is no part of a log is not read
    (tmp_path / "c.npz").write_bytes(pickle.dumps(Trap(sprung)))
    with pytest.raises(LogError, match=r"c\.npz: no whole NPZ archive"):
        read_log(tmp_path / "c.npz")
    assert not sprung.exists()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (header("(1000000000000, 12)"), r"q: found shape \(1000000000000, 12\), .* expected 120000000 at most"),
        (header("(4294967296, 4294967296)"), r"q: found shape .* 18446744073709\d+ values with the other"),
        (header("(-5, 12)"), r"q: found shape \(-5, 12\), expected no length below 0"),
        (header("(1000000, 12)"), "no whole NPZ archive: q: EOF"),
        (header("(__import__('os').mkdir('sprung'),)"), "q: no NumPy array"),
        (header("(12,)", "[('a', '<f8')]"), "q: found the type"),
        (b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 31) + b"(" * 1000, "q: no NumPy array"),
        (header("(" * 5000 + ")" * 5000), "q: no NumPy array"),
    ],
)  # fmt: skip
def test_false_header_is_refused_before_memory_is_allocated(
    tmp_path: Path, content: bytes, sentence: str
) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=rf"a\.npz: {sentence}"):
        read_log(archive(tmp_path / "a.npz", q=content))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_members_with_names_of_fields_only_by_prefix_are_ignored(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        for name in ("t", "q", "dq", "q_des", "../../t.npy", "/etc/passwd"):
            file.writestr(name, array(SECOND))
    with pytest.raises(LogError, match=r"a\.npz: t: the field is missing, found none"):
        read_log(tmp_path / "a.npz")


def test_table_of_a_hundred_thousand_columns_is_refused_quickly(tmp_path: Path) -> None:
    """In a time that grows with their number, not with its square."""
    (tmp_path / "a.csv").write_text(",".join(f"c{i}" for i in range(100_000)) + "\n")
    with pytest.raises(LogError, match=r"a\.csv: t: no such column"):
        read_log(tmp_path / "a.csv")


METADATA = """
rosbag2_bagfile_information:
  version: 5
  storage_identifier: {storage}
  duration: {{nanoseconds: 1}}
  starting_time: {{nanoseconds_since_epoch: 1}}
  message_count: 1
  topics_with_message_count: []
  compression_format: "{compression}"
  compression_mode: "{mode}"
  relative_file_paths: ["{file}"]
  files: []
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("file", ["../../../../../../../../etc/passwd", "/etc/passwd", "/dev/zero"])
@pytest.mark.parametrize("compression", ["", "zstd"])
def test_a_folder_that_points_elsewhere_is_refused(
    tmp_path: Path, storage: str, file: str, compression: str
) -> None:
    mode = "file" if compression else ""
    text = METADATA.format(storage=storage, file=file, compression=compression, mode=mode)
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(LogError, match=f"{tmp_path}: .*missing.*{tmp_path}/(passwd|zero)"):
        read_log(tmp_path)


@pytest.mark.parametrize(
    "text",
    ["!!python/object/apply:os.mkdir ['{sprung}']", "[" * 400, "a: &a [*a]", "a: &a [x, x]\nb: [*a, *a]", "\0"],
    ids=["object", "deep", "endless", "aliases", "binary"],
)  # fmt: skip
def test_malicious_metadata_is_refused(tmp_path: Path, text: str) -> None:
    sprung = tmp_path / "sprung"
    (tmp_path / "metadata.yaml").write_text(text.replace("{sprung}", str(sprung)))
    with pytest.raises(LogError, match=f"{tmp_path}: not a complete recording"):
        read_log(tmp_path)
    with pytest.raises(ValueError, match=r"metadata\.yaml: "):
        ActuatorParameters.load(ALIENGO, tmp_path / "metadata.yaml")
    assert not sprung.exists()


@pytest.mark.parametrize("end", [b"", MAGIC], ids=["cut off", "whole"])
@pytest.mark.parametrize(
    "body",
    [np.random.default_rng(0).bytes(5000), b"\x06" + struct.pack("<Q", 1 << 60) + bytes(100), bytes(10_000)],
    ids=["garbage", "a chunk of an exabyte", "zeros"],
)
def test_a_recording_of_garbage_is_refused(tmp_path: Path, body: bytes, end: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(MAGIC + body + end)
    with pytest.raises(LogError, match=r"a\.mcap: (the recording is truncated|not a complete recording)"):
        read_log(tmp_path / "a.mcap")
    (tmp_path / "a.db3").write_bytes(b"SQLite format 3\0" + body)
    with pytest.raises(LogError, match=r"a\.db3: not a complete recording"):
        read_log(tmp_path / "a.db3")
