"""Logs in MATLAB, HDF5, Parquet, LeRobot and numpy formats, and formats that are refused."""

from __future__ import annotations

import io
import json
import pickle
import re
import resource
import shlex
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from quadvel_sysid.logs.log import Log, LogError
from quadvel_sysid.logs.read_log import read_log
from tests.quadvel_sysid.joint_logs import fields

JOINTS = ["hip", "knee"]
GIVEN = {name: values[:, :2] if np.ndim(values) == 2 else values for name, values in fields(0.2).items()}
GIVEN = {name: GIVEN[name] for name in ("t", "q", "dq", "q_des", "tau")}


def mat(path: Path) -> None:
    scipy.io.savemat(path, GIVEN | {"joint_names": np.array(JOINTS, object)})


def packed_struct(path: Path) -> None:
    log = GIVEN | {"joint_names": np.array(JOINTS, object)}
    scipy.io.savemat(path, {"run": {"log": log}, "gain": 3.0}, do_compression=True)


def mat_7_3(path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in GIVEN.items():
            file[name] = np.atleast_2d(values.T)
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        names = [file.create_dataset(f"#refs#/{one}", data=[[ord(c)] for c in one]).ref for one in JOINTS]
        file["joint_names"] = np.array([names], h5py.ref_dtype)
        file["joint_names"].attrs["MATLAB_class"] = np.bytes_("cell")
    with path.open("r+b") as plain:
        plain.write(b"MATLAB 7.3 MAT-file".ljust(128))


def hdf5(path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values in GIVEN.items():
            file.create_dataset(f"runs/3/{name}", data=values, compression="gzip")
        file["runs/3/joint_names"] = JOINTS
        file["camera"] = np.zeros((3, 4, 4), np.uint8)


def parquet(path: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {
        f"{name}/{one}": GIVEN[name][:, k] for name in GIVEN if name != "t" for k, one in enumerate(JOINTS)
    }
    pq.write_table(pa.table({"note": ["x"] * len(GIVEN["t"]), "t": GIVEN["t"], **columns}), path)


def records() -> np.ndarray:
    kinds = [(name, "f8", values.shape[1:]) for name, values in GIVEN.items()]
    rows = np.zeros(len(GIVEN["t"]), kinds)
    for name, values in GIVEN.items():
        rows[name] = values
    return rows


FORMATS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "MATLAB": ("log.mat", mat),
    "MATLAB, a struct": ("log.mat", packed_struct),
    "MATLAB 7.3": ("log.mat", mat_7_3),
    "HDF5": ("log.hdf5", hdf5),
    "Parquet": ("log.parquet", parquet),
}


def check(log: Log, names: list[str] | None = None) -> None:
    assert log.joints == tuple(f"{name}_joint" for name in names or JOINTS)
    for name in ("t", "q", "dq", "q_des", "tau"):
        np.testing.assert_allclose(getattr(log, name), GIVEN[name], atol=1e-9)


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_yields_the_same_log(tmp_path: Path, form: str) -> None:
    name, write = FORMATS[form]
    write(tmp_path / name)
    check(read_log(tmp_path / name))


def test_records_of_numpy_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "log.npy", records())
    check(read_log(tmp_path / "log.npy"), ["1", "2"])


def test_a_table_of_hdf5_is_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["log/table"] = records()
    check(read_log(tmp_path / "log.h5"), ["1", "2"])


def test_lists_and_times_of_parquet_are_read(tmp_path: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    times = (1e9 * GIVEN["t"]).round().astype("datetime64[ns]")
    lists = {name: pa.array(list(GIVEN[name])) for name in ("q", "dq", "q_des", "tau")}
    pq.write_table(pa.table({"timestamp": times, **lists}), tmp_path / "log.parquet")
    check(read_log(tmp_path / "log.parquet"), ["1", "2"])


def le_robot(folder: Path, names: Any, episodes: int = 2) -> Path:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (folder / "meta").mkdir(parents=True)
    features = {name: {"dtype": "float32", "names": names} for name in ("observation.state", "action")}
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v2.1", "features": features}))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    for k in range(episodes):
        columns = {"observation.state": pa.array(list(GIVEN["q"])), "action": pa.array(list(GIVEN["q_des"]))}
        rows = {"timestamp": GIVEN["t"], "episode_index": np.full(len(GIVEN["t"]), k), **columns}
        pq.write_table(pa.table(rows), folder / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
    return folder


@pytest.mark.parametrize("names", [JOINTS, {"motors": JOINTS}, ["hip.pos", "knee.pos"]])
def test_a_lerobot_data_set_is_read_episode_by_episode(tmp_path: Path, names: Any) -> None:
    log = read_log(le_robot(tmp_path / "set", names))
    rows = len(GIVEN["t"])
    assert log.joints == ("hip_joint", "knee_joint")
    np.testing.assert_allclose(log.q, np.vstack([GIVEN["q"]] * 2))
    np.testing.assert_allclose(log.q_des[rows:], GIVEN["q_des"])
    assert np.flatnonzero(log.after_gap).tolist() == [rows]
    alone = read_log(tmp_path / "set" / "data" / "chunk-000" / "episode_000001.parquet")
    np.testing.assert_allclose(alone.t, GIVEN["t"])
    assert alone.joints == log.joints


@pytest.mark.parametrize("name", ["log.h5", "log.parquet"])
def test_missing_optional_dependency_is_named(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("h5py", "pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(LogError, match=r"pip install 'quadvel-core\[formats\]'"):
        read_log(tmp_path / name)


def rows() -> list[dict[str, Any]]:
    return [
        {name: float(values[k]) if name == "t" else list(values[k]) for name, values in GIVEN.items()}
        for k in range(len(GIVEN["t"]))
    ]


def pickled(content: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(pickle.dumps(content))

    return write


def objects(content: Any) -> np.ndarray:
    return np.array(content, dtype=object)


def torch_saved(convert: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Writer of a file of PyTorch; `convert` makes its content from a dict of tensors."""

    def write(path: Path) -> None:
        torch = pytest.importorskip("torch", reason="torch is not installed")
        torch.save(convert({name: torch.tensor(values) for name, values in GIVEN.items()}), path)

    return write


COMMANDLESS = {name: values for name, values in GIVEN.items() if name != "q_des"}
PICKLES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "dict": ("log.pkl", pickled(GIVEN)),
    "nested dicts": ("log.pkl", pickled({"config": {"kp": [1.0]}, "runs": {"first": GIVEN, "n": 1}})),
    "dict and its units": ("log.pickle", pickled(GIVEN | {"units": dict.fromkeys(GIVEN, "SI") | {"seed": "-"}})),
    "list of dicts": ("log.pkl", pickled(rows())),
    "nested list of dicts": ("log.pkl", pickled({"rate": 200.0, "steps": rows()})),
    "list of nested dicts": ("log.pkl", pickled([{"t": row.pop("t"), "joints": row} for row in rows()])),
    "tensors": ("log.pt", torch_saved(dict)),
    "nested tensors": ("log.pth", torch_saved(lambda log: {"log": log, "epoch": 3})),
    "arrays of NumPy": ("log.pt", torch_saved(lambda _: GIVEN)),
    "list in a file of PyTorch": ("log.pt", torch_saved(lambda _: rows())),
    "array of a dict": ("log.npy", lambda path: np.save(path, objects(GIVEN))),
    "array of dicts": ("log.npy", lambda path: np.save(path, objects(rows()))),
    "archive of a dict": ("dict.npz", lambda path: np.savez(path, log=objects(GIVEN))),
    "archive of a dict and times": ("dict.npz", lambda path: np.savez(path, log=objects(GIVEN), t=GIVEN["t"])),
    "archive of commands in a dict": (
        "log.npz", lambda path: np.savez(path, **COMMANDLESS, commands=objects({"q_des": GIVEN["q_des"]}))),
}  # fmt: skip


@pytest.mark.parametrize("kind", PICKLES)
def test_a_pickle_is_refused_with_the_line_that_converts_it(tmp_path: Path, kind: str) -> None:
    name, write = PICKLES[kind]
    write(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    with pytest.raises(LogError, match="pickle") as refusal:
        read_log(tmp_path / name)
    line = re.search(r"python -c .*", str(refusal.value))
    assert line is not None
    program = shlex.split(line[0])[2]
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
    assert (tmp_path / name).read_bytes() == content
    check(read_log(tmp_path / ("log_arrays.npz" if name == "log.npz" else "log.npz")), ["1", "2"])


@pytest.mark.parametrize(
    "name",
    ["log.xlsx", "log.feather", "log.zip", "log.jsonl", "log.db3.zstd", "log.unknown", "log", "log.mcap.gz"],
)
def test_unsupported_format_is_refused_by_its_suffix(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(LogError, match=r"the suffix is '.*': |the suffix is '.*', expected"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("name", ["log.db3.zstd", "log.csv.zst"])
def test_compressed_file_is_refused_with_the_line_that_unpacks_it(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(LogError, match=f"zstd -d '{name}' -o '{Path(name).stem}'"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("name", ["log.mat", "log.hdf5", "log.parquet", "log.npy", "v73.mat", "log.bag"])
@pytest.mark.parametrize("content", [b"", b"\0" * 5000, np.random.default_rng(0).bytes(5000)])
def test_a_broken_file_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    if name in ("log.hdf5", "v73.mat"):
        pytest.importorskip("h5py")
    if name == "log.parquet":
        pytest.importorskip("pyarrow")
    start = {
        "log.hdf5": b"\x89HDF\r\n\x1a\n",
        "v73.mat": bytes(512) + b"\x89HDF\r\n\x1a\n",
        "log.parquet": b"PAR1",
    }
    (tmp_path / name).write_bytes(start.get(name, b"") + content)
    with pytest.raises(LogError, match=re.escape(name)):
        read_log(tmp_path / name)


@pytest.mark.parametrize("form", FORMATS)
def test_truncated_file_is_refused(tmp_path: Path, form: str) -> None:
    name, write = FORMATS[form]
    write(tmp_path / name)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(LogError, match=re.escape(name)):
        read_log(tmp_path / name)


def test_a_link_out_of_an_hdf5_file_is_not_followed(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    hdf5(tmp_path / "other.hdf5")
    (tmp_path / "secret").write_bytes(bytes(8 * len(GIVEN["t"])))
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        file["t"] = GIVEN["t"]
        file["q"] = h5py.ExternalLink("other.hdf5", "/runs/3/q")
        file.create_dataset(
            "q_des", (len(GIVEN["t"]),), "f8", external=[(str(tmp_path / "secret"), 0, h5py.h5f.UNLIMITED)]
        )
        file["loop"] = h5py.SoftLink("/")
    with pytest.raises(LogError, match=r"log\.hdf5: q: the field is missing, found t"):
        read_log(tmp_path / "log.hdf5")


def long_header() -> bytes:
    """The start of an array whose header declares the greatest length."""
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 30)


def test_a_header_of_an_array_is_not_unpacked_whole(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "log.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        with file.open("t.npy", "w") as member:
            member.write(long_header())
            for _ in range(256):
                member.write(b" " * (1 << 20))
        good = io.BytesIO()
        np.save(good, GIVEN["q"])
        file.writestr("q.npy", good.getvalue())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=r"log\.npz: t: no NumPy array"):
        read_log(tmp_path / "log.npz")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_an_encrypted_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    np.savez(path, **GIVEN)
    data = bytearray(path.read_bytes())
    for mark, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(mark)
        while at >= 0:
            data[at + flags] |= 1
            at = data.find(mark, at + 4)
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"log\.npz: no whole NPZ archive"):
        read_log(path)


def test_a_mat_file_that_grows_is_refused_within_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from quadvel_sysid.logs.readers import matlab

    monkeypatch.setattr(matlab, "MAX_UNPACKED_BYTES", 20_000_000)
    packer = zlib.compressobj(1)
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(200)) + packer.flush()
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)
    (tmp_path / "log.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=r"log\.mat: more than 20000000 bytes unpacked"):
        read_log(tmp_path / "log.mat")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_a_parquet_file_of_billions_of_rows_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from quadvel_sysid.logs.readers import raw

    monkeypatch.setattr(raw, "MAX_VALUES", 400)
    parquet(tmp_path / "log.parquet")
    with pytest.raises(LogError, match=r"log\.parquet: .* expected 400 at most"):
        read_log(tmp_path / "log.parquet")
