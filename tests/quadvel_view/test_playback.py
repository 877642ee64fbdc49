"""A recording as a film: any moment of it is the picture that was there then."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from quadvel_description.robot import load_robot
from quadvel_recordings.definitions import STORE
from quadvel_recordings.reading import RecordingError
from quadvel_view import playback, replay
from quadvel_view.page_protocol import Pace, Seek, Stop
from quadvel_view.picture import RobotPicture
from quadvel_view.playback import Playback
from quadvel_view.replay import execute

from .conftest import SECONDS, SPEED, message


def test_it_plays_at_its_pace_and_ends(walked: Path) -> None:
    film = Playback(walked)
    assert film.length == pytest.approx(SECONDS)
    film.advance(1.0)
    assert film.picture.position[0] == pytest.approx(SPEED, abs=0.011)
    film.set_pace(0.5)
    film.advance(1.0)
    assert film.picture.position[0] == pytest.approx(1.5 * SPEED, abs=0.011)
    film.set_pace(2.0)
    film.advance(60.0)
    assert film.time == film.length
    assert not film.playing
    film.toggle()
    assert film.playing
    assert film.time == 0.0


def test_paused_it_stands_still(walked: Path) -> None:
    film = Playback(walked)
    film.toggle()
    film.advance(1.0)
    assert film.time == 0.0


def test_a_jump_back_shows_the_way_up_to_there_alone(walked: Path) -> None:
    film = Playback(walked)
    film.advance(2.5)
    film.seek(1.0)
    assert film.picture.position[0] == pytest.approx(SPEED, abs=0.011)
    assert max(point[0] for point in film.picture.trail) <= SPEED
    assert min(point[0] for point in film.picture.trail) == pytest.approx(0.0, abs=0.06)


def test_the_slider_and_the_pace_are_held_to_what_there_is_and_a_robot_is_not_commanded(
    walked: Path,
) -> None:
    film = Playback(walked)
    execute(film, Stop())
    assert (film.time, film.pace, film.playing) == (0.0, 1.0, True)
    execute(film, Seek(99.0))
    assert film.time == film.length
    execute(film, Seek(-1e300))
    assert film.time == 0.0
    execute(film, Pace(1e300))
    assert film.pace == 4.0


def test_a_recording_without_a_robot_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(RecordingError, match="not a recording of a robot"):
        Playback(path)


def test_the_robot_is_the_one_that_the_recording_names(tmp_path: Path, walked: Path) -> None:
    path, go2 = tmp_path / "go2.mcap", load_robot("go2")
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for topic, one in {
            "/robot_description": message("std_msgs/msg/String", data=go2.urdf_file.read_text()),
            "/joint_states": message(
                "sensor_msgs/msg/JointState", name=["FR_hip_joint"], position=np.zeros(1)
            ),
        }.items():
            text, _ = STORE.generate_msgdef(one.__msgtype__, ros_version=2)
            schema = writer.register_schema(one.__msgtype__, "ros2msg", text.encode())
            data = bytes(STORE.serialize_cdr(one, one.__msgtype__))
            writer.add_message(writer.register_channel(topic, "cdr", schema), 0, data, 0)
        writer.finish()
    assert Playback(path).picture.robot is go2
    assert Playback(walked).picture.robot is load_robot("aliengo")
    assert Playback(walked, "go2").picture.robot is go2
    with pytest.raises(ValueError, match=r"go2\.mcap: robot is 'go2', expected 'aliengo'"):
        Playback(path, "aliengo")


def test_the_trail_is_built_from_a_limited_number_of_messages(
    walked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = Playback(walked)
    built: list[str] = []
    monkeypatch.setattr(playback, "MAX_TRAIL_MESSAGES", 80)
    monkeypatch.setattr(RobotPicture, "update_lazily", lambda self, topic, *_: built.append(topic))
    film.seek(SECONDS)
    assert built.count("/odom") <= 80 + 1  # the newest once more


class FloodedViewer:
    """A page that sends very many orders at once, and more with each frame."""

    url, is_watched = "http://nowhere", True

    def __init__(self, robot: Any, host: str, port: int, on_message: Any, on_disconnect: Any) -> None:
        self._send = on_message
        self.show(None, None, 0.0)

    def show(self, picture: Any, operator: Any, now: float, **more: Any) -> None:
        for step in range(5000):
            self._send(1, Seek(step / 5000))
            self._send(1, Pace(1.0))

    def close(self) -> None:
        pass


def test_of_many_jumps_at_once_the_newest_counts_and_the_replay_goes_on(
    walked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jumps: list[float] = []
    frames = iter([False, False, True])
    monkeypatch.setattr(replay, "Viewer", FloodedViewer)
    monkeypatch.setattr(Playback, "seek", lambda self, time: jumps.append(time))
    replay.replay(walked, None, "127.0.0.1", 0, lambda wait: next(frames), lambda url: None)
    assert jumps == [0.0, 4999 / 5000, 4999 / 5000]  # the first by the playback itself
