"""Recording over the embedded middleware, read back by libraries that know nothing of it."""

from __future__ import annotations

import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from geometry_msgs.msg import Twist  # noqa: E402
from rclpy.node import Node  # noqa: E402

from quadvel_bringup.recorder import Recorder  # noqa: E402
from quadvel_bringup.recording_file import RawMessage, RecordingFile, RingBuffer  # noqa: E402
from quadvel_msgs.msg import ControllerState, LowState  # noqa: E402
from quadvel_recordings.reading import lazy_messages, read_messages  # noqa: E402


@pytest.fixture
def node() -> Iterator[Node]:
    rclpy.init(args=[])
    node = rclpy.create_node("tester")
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def spin_until(node: Node, holds: Callable[[], bool], what: str, seconds: float = 20.0) -> None:
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until, f"{what}: waited in vain"
        rclpy.spin_once(node, timeout_sec=0.02)


def low_state(tick: int) -> Any:
    message = LowState(tick=tick)
    message.q = [0.1 * i for i in range(12)]
    return message


def record_low_states(node: Node, path: Path, number: int) -> None:
    publisher = node.create_publisher(LowState, "low_state", 10)
    with Recorder(node, RecordingFile(path)) as recorder:
        recorder.record("/low_state", "quadvel_msgs/msg/LowState")
        spin_until(node, lambda: publisher.get_subscription_count() > 0, "discovery")
        for tick in range(number):
            publisher.publish(low_state(tick))
        spin_until(node, lambda: recorder.counts["/low_state"] == number, "messages")


def test_a_recording_is_read_by_rosbags_as_it_was_sent(node: Node, tmp_path: Path) -> None:
    record_low_states(node, tmp_path / "walk.mcap", 5)
    with AnyReader([tmp_path / "walk.mcap"], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        found = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()]
    assert [message.tick for message in found] == list(range(5))
    assert found[0].q == pytest.approx([0.1 * i for i in range(12)])


def test_three_seconds_of_a_fast_topic_wait_until_other_work_is_done(node: Node, tmp_path: Path) -> None:
    record_low_states(node, tmp_path / "walk.mcap", 3000)
    with (tmp_path / "walk.mcap").open("rb") as stream:
        assert sum(1 for _ in make_reader(stream).iter_messages()) == 3000


def test_a_recording_follows_the_ros2_profile_of_mcap(node: Node, tmp_path: Path) -> None:
    started = time.time_ns()
    record_low_states(node, tmp_path / "walk.mcap", 1)
    with (tmp_path / "walk.mcap").open("rb") as stream:
        reader = make_reader(stream)
        ((schema, channel, message),) = reader.iter_messages()
        assert reader.get_header().profile == "ros2"
    assert schema is not None
    assert (schema.name, schema.encoding) == ("quadvel_msgs/msg/LowState", "ros2msg")
    assert b"MSG: builtin_interfaces/Time" in schema.data
    assert (channel.topic, channel.message_encoding) == ("/low_state", "cdr")
    assert started <= message.publish_time <= message.log_time <= time.time_ns()


def test_a_type_without_definition_is_refused_by_name(node: Node, tmp_path: Path) -> None:
    recorder = Recorder(node, RecordingFile(tmp_path / "x.mcap"))
    with recorder, pytest.raises(ValueError, match=r"topic /scan2 has the type 'laser_msgs/msg/Scan'"):
        recorder.record("/scan2", "laser_msgs/msg/Scan")


def test_recording_all_takes_topics_as_they_come(node: Node, tmp_path: Path) -> None:
    with Recorder(node, RecordingFile(tmp_path / "all.mcap")) as recorder:
        recorder.record_all()
        publisher = node.create_publisher(Twist, "cmd_vel", 10)

        def heard() -> bool:
            recorder.record_all()
            publisher.publish(Twist())
            return recorder.counts["/cmd_vel"] > 0

        spin_until(node, heard, "cmd_vel")
    with (tmp_path / "all.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert "/cmd_vel" in topics
    assert not topics & {"/parameter_events", "/rosout"}


def publish_while_it_records(node: Node, path: Path) -> Any:
    """Publish states for a while once the recorder is there, which may find us later than we find it."""
    publisher = node.create_publisher(LowState, "low_state", 10)
    spin_until(node, lambda: publisher.get_subscription_count() and path.exists(), "recorder", 60.0)
    for _ in range(200):
        publisher.publish(low_state(0))
        time.sleep(0.01)
    return publisher


def test_ctrl_c_leaves_a_whole_file(node: Node, tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    program = "from quadvel_bringup.__main__ import main; main()"
    recording = subprocess.Popen([sys.executable, "-c", program, "record", "low_state", "--out", str(path)])
    publish_while_it_records(node, path)
    time.sleep(0.5)
    recording.send_signal(signal.SIGINT)
    recording.send_signal(signal.SIGINT)
    assert recording.wait(60) == 0
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count > 0


def start_recording(*arguments: str) -> subprocess.Popen[str]:
    program = "from quadvel_bringup.__main__ import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", program, "record", *arguments], stderr=subprocess.PIPE, text=True
    )


def test_of_a_recorder_that_was_killed_all_but_the_last_second_is_read(node: Node, tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    recording = start_recording("low_state", "--out", str(path))
    publisher = publish_while_it_records(node, path)
    size, ticks = path.stat().st_size, 0
    while path.stat().st_size < size + 20_000 and ticks < 4000:  # two chunks or more
        publisher.publish(low_state(ticks))
        ticks += 1
        time.sleep(0.01)
    recording.kill()
    recording.communicate(timeout=60)
    with pytest.warns(
        UserWarning, match=r"walk\.mcap: recording: it is truncated; the first \d\.\d s, \d+ messages"
    ):
        found = [message.tick for _, _, message in read_messages(path, lambda topic, typename: True)]
    assert found == sorted(found)
    assert len(found) > 50


def test_it_looks_up_in_time_although_more_comes_than_it_can_write(node: Node, tmp_path: Path) -> None:
    class Busy:
        def spin_once(self, timeout_sec: float) -> None:
            recorder.counts["/low_state"] += 1

    with Recorder(node, RecordingFile(tmp_path / "walk.mcap")) as recorder:
        began = time.monotonic()
        recorder.serve(Busy(), 0.2)  # type: ignore[arg-type]
        assert time.monotonic() - began < 10.0


def test_a_full_disk_ends_a_recording_in_words_and_what_was_written_is_read(
    node: Node, tmp_path: Path
) -> None:
    path = tmp_path / "full.mcap"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))  # what the recorder inherits
    recording = start_recording("low_state", "--out", str(path))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    publisher = publish_while_it_records(node, path)
    for tick in range(4000):
        publisher.publish(low_state(tick))
        time.sleep(0.003)
        if recording.poll() is not None:
            break
    _, said = recording.communicate(timeout=60)
    assert recording.returncode == 2
    assert re.search(r"full\.mcap: the recording ended after .* is unreadable: File too large", said)
    assert "Traceback" not in said
    with pytest.warns(UserWarning, match="it is truncated"):
        assert len(list(read_messages(path, lambda topic, typename: True))) > 50


def test_a_recording_on_which_nothing_came_leaves_neither_file_nor_folder(tmp_path: Path) -> None:
    recording = start_recording("low_state", "--out", str(tmp_path / "new" / "walk.mcap"), "--seconds", "0.5")
    _, said = recording.communicate(timeout=60)
    assert recording.returncode == 1
    assert "no message on /low_state on ROS domain" in said
    assert list(tmp_path.iterdir()) == []


def test_the_duration_of_a_recording_starts_with_its_first_message(node: Node, tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    recording = start_recording("low_state", "low_stat", "--out", str(path), "--seconds", "0.1")
    publisher = node.create_publisher(LowState, "low_state", 10)
    while recording.poll() is None:
        publisher.publish(low_state(0))
        time.sleep(0.01)
    _, said = recording.communicate(timeout=60)
    assert recording.returncode == 1, said  # nothing came on low_stat
    assert "did you mean /low_state?" in said
    assert list(read_messages(path, lambda topic, typename: True))


def test_a_recorder_of_faults_that_hears_no_controller_ends_with_1(tmp_path: Path) -> None:
    recording = start_recording("--ring", "2", "--out", str(tmp_path / "faults"), "--seconds", "0.5")
    recording.communicate(timeout=60)
    assert recording.returncode == 1


def test_a_ring_keeps_the_last_seconds_and_what_is_published_once(tmp_path: Path) -> None:
    ring = RingBuffer(2.0)
    blank = bytes(300)
    ring.keep(RawMessage("/robot_description", "std_msgs/msg/String", 0, 0, bytes(12)))
    for tenth in range(100):
        ring.keep(RawMessage("/low_state", "quadvel_msgs/msg/LowState", tenth * 10**8, tenth * 10**8, blank))
    assert ring.save(tmp_path / "fault.mcap") == 22
    found = [
        (topic, time) for topic, time, _ in lazy_messages(tmp_path / "fault.mcap", lambda topic, kind: True)
    ]
    assert found == [("/robot_description", 0), *(("/low_state", tenth * 10**8) for tenth in range(79, 100))]


def test_a_fault_leaves_a_recording_of_what_led_to_it(node: Node, tmp_path: Path) -> None:
    recording = start_recording("--ring", "2", "--out", str(tmp_path / "faults"))
    states = node.create_publisher(LowState, "low_state", 10)
    modes = node.create_publisher(ControllerState, "controller/state", 10)
    walking = ControllerState(mode=ControllerState.WALK, mode_name="walk")
    fault = ControllerState(mode=ControllerState.FAULT, fault="tilt", reason="the trunk leans by 1.2 rad")
    spin_until(
        node, lambda: states.get_subscription_count() and modes.get_subscription_count() > 1, "recorder", 60.0
    )
    for tick in range(200):
        states.publish(low_state(tick))
        modes.publish(walking if tick < 150 else fault)
        time.sleep(0.01)
    recording.send_signal(signal.SIGINT)  # sooner than it would write by itself
    _, said = recording.communicate(timeout=60)
    assert recording.returncode == 0
    (file,) = (tmp_path / "faults").glob("*_tilt.mcap")
    assert re.search(r"_tilt\.mcap: \d+ messages; the trunk leans by 1\.2 rad", said)
    assert "1 fault recorded" in said
    ticks = [
        message.tick for topic, _, message in read_messages(file, lambda topic, kind: topic == "/low_state")
    ]
    assert ticks[0] < 100 < 190 < ticks[-1]
