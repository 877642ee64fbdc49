"""Recordings of joints from other robots and with other faults: read, or refused with the true cause."""

from __future__ import annotations

import resource
import struct
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_recordings import bounds
from quadvel_recordings.definitions import STORE
from quadvel_recordings.joint_log import LEG_JOINTS, JointLog, read_joint_log, require_commands
from quadvel_recordings.reading import RecordingError, lazy_messages, read_messages
from tests.quadvel_recordings.joint_bags import (
    PERIOD,
    ROWS,
    T0,
    empty,
    go2,
    joint_states,
    motion,
    own,
    ros1,
    rosbag2,
)


def check(log: JointLog, joints: tuple[str, ...] = LEG_JOINTS) -> None:
    """The log holds `motion`."""
    moved = motion(len(joints))
    assert log.state.joints == joints
    assert log.command is not None
    np.testing.assert_allclose(log.state.time, 1e-9 * PERIOD * np.arange(ROWS), atol=2e-6)
    for name in ("q", "dq", "tau"):
        np.testing.assert_allclose(log.state.values[name], moved[name], atol=1e-5)
    np.testing.assert_allclose(log.command.values["q"], moved["q_des"], atol=1e-6)


def test_legs_are_in_the_models_order() -> None:
    assert LEG_JOINTS == JOINT_NAMES


@pytest.mark.parametrize("topics", [
    ("/joint_states", "/joint_commands"), ("/robot/joint_states", "/robot/joint_cmd"), ("/joint_states", "/joint_states_desired"),
    ("/isaac_joint_states", "/isaac_joint_commands"), ("/measured", "/target_positions"),
    ("/joint_states", "/arm_controller/reference"),
])  # fmt: skip
def test_a_pair_of_joint_states_is_told_apart_by_its_names(tmp_path: Path, topics: tuple[str, str]) -> None:
    names = ("shoulder", "elbow", "wrist")
    log = read_joint_log(rosbag2(tmp_path / "bag", joint_states(names, topics)))
    check(log, names)
    assert (log.start_ns, log.uses_receipt_times) == (T0, False)
    assert log.command is not None
    assert log.command.values.keys() == {"q"}


def test_commands_may_name_the_joints_in_another_order(tmp_path: Path) -> None:
    names = ("a", "b", "c")
    log = read_joint_log(rosbag2(tmp_path / "bag", joint_states(names, commanded=("c", "a"))))
    assert log.command is not None
    assert log.command.joints == ("c", "a")
    np.testing.assert_allclose(log.command.values["q"], motion(3)["q_des"][:, [2, 0]])


def test_where_several_topics_may_hold_the_states_an_option_says_which(tmp_path: Path) -> None:
    names = ("a", "b")
    both = joint_states(names) + joint_states(names, ("/gripper/joint_states", "/gripper/joint_commands"))
    path = rosbag2(tmp_path / "bag", both)
    with pytest.raises(RecordingError, match=r"/gripper/joint_states: several topics .* --state-topic"):
        read_joint_log(path)
    with pytest.raises(RecordingError, match=r"several topics .* --command-topic"):
        read_joint_log(path, state_topic="/joint_states")
    check(read_joint_log(path, "/gripper/joint_states", "/gripper/joint_commands"), names)
    with pytest.raises(
        RecordingError, match=r"/nothing: found no such topic, expected .*; the recording has /gripper"
    ):
        read_joint_log(path, "/nothing")


def test_options_pair_topics_whose_names_say_nothing(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "bag", joint_states(("a",), ("/one", "/two")))
    check(read_joint_log(path, "/one", "/two"), ("a",))


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_the_low_level_of_a_go2_is_read(tmp_path: Path, storage: StoragePlugin) -> None:
    """Twelve of its twenty motors, at the times of receipt, as its messages have no stamps."""
    slow = [(f"/lf{topic}", *rest) for topic, *rest in go2()[::20] if topic == "/lowstate"]
    log = read_joint_log(rosbag2(tmp_path / "bag", [*go2(off=(7,)), *slow], storage))
    assert log.command is not None
    assert (log.state.topic, log.uses_receipt_times, log.start_ns) == ("/lowstate", True, T0)
    assert log.command.values["kp"][6].tolist() == [30.0] * 12
    assert all(not log.command.values[name][7].any() for name in ("q", "dq", "kp", "kd"))
    np.testing.assert_allclose(log.state.values["tau"], motion()["tau"], atol=1e-4)


@pytest.mark.parametrize(("name", "size"), [("LowState", 1176), ("LowCmd", 808)])
def test_definitions_of_unitree_go_have_the_bytes_of_the_robot(name: str, size: int) -> None:
    kind = f"unitree_go/msg/{name}"
    data = bytearray(b"\0\1\0\0" + bytes(size))
    motor, stride, first = (76, 48, "motor_state") if name == "LowState" else (20, 36, "motor_cmd")
    q = motor + 11 * stride + 4
    struct.pack_into("<f", data, 4 + q, 0.5)
    struct.pack_into("<I", data, 4 + size - 4, 0xABCD)
    message = STORE.deserialize_cdr(bytes(data), kind)
    assert getattr(message, first)[11].q == 0.5
    assert message.crc == 0xABCD
    assert len(STORE.serialize_cdr(empty(name), kind)) == 4 + size


@pytest.mark.parametrize(
    "packing", [None, Ros1Writer.CompressionFormat.BZ2, Ros1Writer.CompressionFormat.LZ4]
)
def test_a_bag_of_ros_1_is_read(tmp_path: Path, packing: Any) -> None:
    log = read_joint_log(ros1(tmp_path / "run.bag", packing))
    check(log)
    assert log.start_ns == T0


@pytest.mark.parametrize(("zeros", "count"), [(range(ROWS), ROWS), (range(20), 20), ([100], 1)])
def test_where_stamps_are_0_the_times_of_receipt_count(tmp_path: Path, zeros: Any, count: int) -> None:
    said: list[str] = []
    log = read_joint_log(rosbag2(tmp_path / "bag", own(zeros)), warn=said.append)
    check(log)
    assert (log.uses_receipt_times, log.start_ns) == (True, T0)
    assert [f"{count} of {ROWS} stamps are 0" in text for text in said] == [True, True]


def test_a_simulated_clock_may_begin_at_0(tmp_path: Path) -> None:
    messages = [(topic, kind, now, at(message, now - T0)) for topic, kind, now, message in own(())]
    log = read_joint_log(rosbag2(tmp_path / "bag", messages))
    assert (log.uses_receipt_times, log.start_ns) == (False, 0)


def at(message: Any, nanoseconds: int) -> Any:
    message.stamp.sec, message.stamp.nanosec = nanoseconds // 10**9, nanoseconds % 10**9
    return message


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("fault", ["no metadata", "''", "", "null", "rosbag_v9", "other"])
def test_the_kind_of_storage_is_taken_from_the_files(
    tmp_path: Path, storage: StoragePlugin, fault: str
) -> None:
    path = rosbag2(tmp_path / "bag", own(()), storage)
    metadata = path / "metadata.yaml"
    if fault == "no metadata":
        metadata.unlink()
    else:
        name, other = ("mcap", "sqlite3") if storage == StoragePlugin.MCAP else ("sqlite3", "mcap")
        fault = other if fault == "other" else fault
        text = metadata.read_text()
        metadata.write_text(text.replace(f"storage_identifier: {name}", f"storage_identifier: {fault}"))
        assert metadata.read_text() != text
    said: list[str] = []
    check(read_joint_log(path, notify=said.append))
    assert "metadata.yaml" in said[0]
    assert "topics" not in said[0]


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("lines", [0, 1, 7, 11, -6, -1])
def test_cut_metadata_is_reported_and_the_data_are_read(
    tmp_path: Path, storage: StoragePlugin, lines: int
) -> None:
    path = rosbag2(tmp_path / "bag", own(()), storage)
    metadata = path / "metadata.yaml"
    metadata.write_text("\n".join(metadata.read_text().splitlines()[:lines]))
    said: list[str] = []
    check(read_joint_log(path, notify=said.append))
    assert "metadata.yaml" in said[0]
    for file in path.glob("bag*"):
        file.unlink()
    with pytest.raises(RecordingError, match=r"metadata\.yaml is (empty|cut off)"):
        read_joint_log(path)


@pytest.mark.parametrize("end", ["  extra:", "  ext"])
def test_metadata_that_end_within_a_line_are_reported_and_the_data_are_read(tmp_path: Path, end: str) -> None:
    path = rosbag2(tmp_path / "bag", own(()))
    with (path / "metadata.yaml").open("a") as metadata:
        metadata.write(end)
    said: list[str] = []
    check(read_joint_log(path, notify=said.append))
    assert "cut off" in said[0]


def test_renamed_file_of_a_folder_is_read_with_a_note(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "bag", own(()))
    (path / "bag.mcap").rename(path / "walk.mcap")
    said: list[str] = []
    check(read_joint_log(path, notify=said.append))
    assert "walk.mcap" in said[0]


def test_folder_of_several_recordings_is_refused_by_their_names(tmp_path: Path) -> None:
    bag = rosbag2(tmp_path / "bag", own(())) / "bag.mcap"
    for name in ("run_0.mcap", "run_1.mcap"):
        (tmp_path / name).write_bytes(bag.read_bytes())
    read_joint_log(tmp_path, notify=lambda _: None)
    (tmp_path / "other.mcap").write_bytes(bag.read_bytes())
    with pytest.raises(RecordingError, match=r"several recordings: other\.mcap, run_0\.mcap"):
        read_joint_log(tmp_path)


def test_first_bytes_of_a_file_count_more_than_its_suffix(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "bag", own(()))
    (path / "bag.mcap").rename(path / "bag.db3")
    check(read_joint_log(path / "bag.db3"))
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag.mcap", "bag.db3").replace(": mcap", ": sqlite3"))
    check(read_joint_log(path, notify=lambda _: None))


def test_a_file_that_is_no_recording_is_refused_by_its_suffix(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# A page")
    with pytest.raises(RecordingError, match=r"README\.md: the suffix is '\.md', expected \.mcap"):
        next(lazy_messages(tmp_path / "README.md", lambda topic, kind: True))


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("metadata", [True, False])
def test_compressed_messages_are_read_with_and_without_metadata(
    tmp_path: Path, storage: StoragePlugin, metadata: bool
) -> None:
    path = rosbag2(tmp_path / "bag", own(()), storage, CompressionMode.MESSAGE)
    if not metadata:
        (path / "metadata.yaml").unlink()
    check(read_joint_log(path, notify=lambda _: None))


@pytest.mark.parametrize("metadata", [None, "", "rosbag2_bagfile_information:\n  version: 9\n"])
def test_compressed_file_without_metadata_is_refused_with_the_way_to_unpack_it(
    tmp_path: Path, metadata: str | None
) -> None:
    path = rosbag2(tmp_path / "bag", own(()), StoragePlugin.SQLITE3, CompressionMode.FILE)
    check(read_joint_log(path))
    (path / "metadata.yaml").unlink()
    if metadata is not None:
        (path / "metadata.yaml").write_text(metadata)
    for place in (path, path / "bag.db3.zstd"):
        with pytest.raises(RecordingError, match=r"zstd -d bag\.db3\.zstd"):
            read_joint_log(place)


def test_other_topics_are_listed_where_no_joints_are(tmp_path: Path) -> None:
    text = STORE.types["std_msgs/msg/String"](data="x")
    path = rosbag2(tmp_path / "bag", [("/chatter", "std_msgs/msg/String", T0, text)])
    with pytest.raises(
        RecordingError, match=r"expected states .*; the recording has /chatter \(std_msgs/msg/String\)"
    ):
        read_joint_log(path)


def test_states_without_commands_are_read_and_the_commands_are_asked_for(tmp_path: Path) -> None:
    states = [one for one in joint_states() if one[0] == "/joint_states"]
    path = rosbag2(tmp_path / "bag", states)
    log = read_joint_log(path)
    assert log.command is None
    with pytest.raises(
        RecordingError, match=r"expected commands .*/joint_states.*the recording has /joint_states"
    ):
        require_commands(path, log)


def mcap_of(path: Path, *chunks: tuple[int, int, bytes, str]) -> Path:
    """An MCAP file of nothing but chunks: size that each claims, its time, packed data and packing."""
    with path.open("wb") as file:
        file.write(bounds.MAGIC + record(1, text("ros2") + text("test")))
        for size, now, data, packing in chunks:
            head = struct.pack("<QQQI", now, now, size, 0) + text(packing) + struct.pack("<Q", len(data))
            file.write(record(6, head + data))
        file.write(record(2, bytes(20)) + bounds.MAGIC)
    return path


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def zeros(packing: str, megabytes: int) -> bytes:
    from backports import zstd

    return (
        lz4.frame.compress(bytes(megabytes << 20))
        if packing == "lz4"
        else zstd.compress(bytes(megabytes << 20))
    )


@pytest.mark.parametrize("packing", ["lz4", "zstd"])
@pytest.mark.parametrize("claimed", [100, 300 << 20, 1 << 60])
@pytest.mark.parametrize("cut", [False, True])
def test_a_chunk_that_unpacks_to_too_much_is_refused_within_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packing: str, claimed: int, cut: bool
) -> None:
    monkeypatch.setattr(bounds, "MAX_CHUNK_BYTES", 4 << 20)
    data = zeros(packing, 64)
    path = mcap_of(tmp_path / "a.mcap", (claimed, 0, data, packing))
    if cut:
        path.write_bytes(path.read_bytes()[:-8])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RecordingError, match=r"a\.mcap: found a chunk of .* bytes, expected"):
        list(read_messages(path, lambda *_: True))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 60_000  # kB


def test_chunks_of_one_instant_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "MAX_OVERLAP_BYTES", 8 << 20)
    chunk = (1 << 20, 7, zeros("lz4", 1), "lz4")
    with pytest.raises(
        RecordingError, match=r"a\.mcap: found chunks of 12582912 bytes that hold the same instant"
    ):
        list(read_messages(mcap_of(tmp_path / "a.mcap", *[chunk] * 12), lambda *_: True))


@pytest.mark.parametrize("packing", [Ros1Writer.CompressionFormat.BZ2, Ros1Writer.CompressionFormat.LZ4])
def test_chunks_of_ros_1_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packing: Any) -> None:
    monkeypatch.setattr(bounds.decompress, "__defaults__", (1000,))
    path = ros1(tmp_path / "a.bag", packing)
    with pytest.raises(RecordingError, match=r"a\.bag: found a chunk of more than 1000 bytes"):
        list(read_messages(path, lambda *_: True))


def test_a_packed_file_needs_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = rosbag2(tmp_path / "bag", own(()))
    (path / "bag.mcap.zstd").write_bytes(zeros("zstd", 8))
    monkeypatch.setattr(bounds.shutil, "disk_usage", lambda _: type("Disk", (), {"free": 4 << 20}))
    with pytest.raises(RecordingError, match="half of the free disk"):
        list(read_messages(path, lambda *_: True))
