"""Reads recordings that are written message by message, as the nodes do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from quadvel_eval.demo_figures import loop_figure, tracking_figure
from quadvel_eval.demo_summary import constant_commands, count_falls, recorded_segments, summarise_demo
from quadvel_eval.recording import read_recording
from quadvel_recordings.definitions import STORE

T0 = 1_700_000_000.0  # s, some time on the system clock
FIRST = np.array([0.5, 0.0, 0.2])
FASTER = np.array([0.1, 0.0, 0.0])
ESTIMATE_ERROR = np.array([0.03, -0.04, 0.0])
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
TYPES = STORE.types


def stamp(time: float) -> Any:
    nanoseconds = round(time * 1e9)
    return TYPES["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def header(time: float) -> Any:
    return TYPES["std_msgs/msg/Header"](stamp=stamp(time), frame_id="")


def vector(x: float, y: float, z: float, kind: str = "Vector3") -> Any:
    return TYPES[f"geometry_msgs/msg/{kind}"](x=x, y=y, z=z)


def twist(vx: float, vy: float, wz: float) -> Any:
    return TYPES["geometry_msgs/msg/Twist"](linear=vector(vx, vy, 0.0), angular=vector(0.0, 0.0, wz))


def with_covariance(value: Any, kind: str, field: str) -> Any:
    return TYPES[f"geometry_msgs/msg/{kind}"](**{field: value, "covariance": np.zeros(36)})


def odometry(time: float, velocity: np.ndarray, height: float) -> Any:
    pose = TYPES["geometry_msgs/msg/Pose"](
        position=vector(0.0, 0.0, height, "Point"),
        orientation=TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return TYPES["nav_msgs/msg/Odometry"](
        header=header(time),
        child_frame_id="base_link",
        pose=with_covariance(pose, "PoseWithCovariance", "pose"),
        twist=with_covariance(twist(*velocity), "TwistWithCovariance", "twist"),
    )


def estimate(time: float, velocity: np.ndarray) -> Any:
    return TYPES["geometry_msgs/msg/TwistWithCovarianceStamped"](
        header=header(time), twist=with_covariance(twist(*velocity), "TwistWithCovariance", "twist")
    )


def controller_state(time: float, mode: str, compute_p99_us: float) -> Any:
    return TYPES["quadvel_msgs/msg/ControllerState"](
        stamp=stamp(time), mode=3, mode_name=mode, reason="", fault="", findings=[],
        walk_allowed=True, walk_refusal="", command=twist(0.0, 0.0, 0.0), trim=twist(0.0, 0.0, 0.0),
        stance=False, rate_hz=200.0 if mode == "walk" else 150.0, period_p99_ms=5.5, inference_p50_us=30.0,
        compute_p50_us=200.0, compute_p99_us=compute_p99_us, overruns=2, refused=0,
    )  # fmt: skip


def low_state(time: float, tick: int) -> Any:
    zeros = {name: np.zeros(12, np.float32) for name in ("q", "dq", "tau")}
    three = {name: np.zeros(3, np.float32) for name in ("angular_velocity", "linear_acceleration")}
    four = {name: np.zeros(4, np.float32) for name in ("orientation_wxyz", "foot_force")}
    return TYPES["quadvel_msgs/msg/LowState"](stamp=stamp(time), tick=tick, **zeros, **three, **four)


def low_cmd(time: float, tick: int) -> Any:
    zeros = {name: np.zeros(12, np.float32) for name in ("q", "dq", "tau", "kp", "kd")}
    return TYPES["quadvel_msgs/msg/LowCmd"](stamp=stamp(time), tick=tick, mode=10, **zeros)


def diagnostics(time: float, factor: float) -> Any:
    pair = TYPES["diagnostic_msgs/msg/KeyValue"](key="realtime_factor", value=str(factor))
    status = TYPES["diagnostic_msgs/msg/DiagnosticStatus"](
        level=0, name="sim_node", message="", hardware_id="", values=[pair]
    )
    return TYPES["diagnostic_msgs/msg/DiagnosticArray"](header=header(time), status=[status])


def joints(time: float) -> Any:
    return TYPES["sensor_msgs/msg/JointState"](
        header=header(time), name=[], position=np.zeros(12), velocity=np.zeros(0), effort=np.zeros(0)
    )


def demo(fall_at: float = np.inf, rise_at: float = 0.0) -> Iterator[tuple[str, float, Any]]:
    """Five seconds of FIRST, four of standing; the robot lags for a second, then is 0.1 m/s too fast along x."""
    for k in range(9 * 200):
        t, tick = 0.005 * k, 5 * k
        command = FIRST if t < 5.0 else np.zeros(3)
        settled = (t >= 1.0 and t < 5.0) or t >= 6.0
        velocity = command + FASTER if settled else np.array([9.0, 9.0, 9.0])
        now = T0 + t
        yield "/ground_truth/odom", now, odometry(now, velocity, 0.42 if rise_at <= t < fall_at else 0.1)
        yield "/velocity_estimate", now + 0.001, estimate(now, velocity + ESTIMATE_ERROR)
        yield "/low_state", now, low_state(now, tick)
        yield "/low_cmd", now + 0.002, low_cmd(now + 0.0015, tick)
        if k % 4 == 0:
            yield "/cmd_vel", now, twist(*command)
            mode = "walk" if t > 0.5 else "stance"
            yield "/controller/state", now, controller_state(now, mode, compute_p99_us=400.0 + t)
            yield "/joint_states", now, joints(now)
            message = TYPES["quadvel_msgs/msg/VelocityCommand"](
                stamp=stamp(now), twist=twist(*command), stance=False, source="planner"
            )
            yield "/command", now, message
        if k % 200 == 100:
            yield "/diagnostics", now, diagnostics(now, 1.0 if k < 1000 else 0.9)


def write(path: Path, messages: Iterator[tuple[str, float, Any]]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            nanoseconds = round(time * 1e9)
            data = STORE.serialize_cdr(message, kind)
            writer.add_message(channels[topic], nanoseconds, bytes(data), nanoseconds)
        writer.finish()
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """recorded(fall_at) -> the file, written once."""
    folder = tmp_path_factory.mktemp("recorded")
    return cache(lambda fall_at=np.inf: write(folder / f"{fall_at}.mcap", demo(fall_at)))


def test_summary_has_the_means_after_the_transition_and_all_fields(recorded: Callable[..., Path]) -> None:
    summary = summarise_demo(read_recording(recorded()))
    first, second = summary["segments"]
    assert first == {"command": [0.5, 0.0, 0.2], "mean": [0.6, 0.0, 0.2], "error_xy": 0.1, "error_wz": 0.0}
    assert (second["command"], second["mean"]) == ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0])
    assert (summary["max_error_xy"], summary["mean_error_xy"], summary["falls"]) == (0.1, 0.1, 0)
    assert summary["estimator"]["rmse"] == pytest.approx([0.03, 0.04, 0.0], abs=1e-6)
    assert summary["realtime_factor"] == pytest.approx((5 * 1.0 + 4 * 0.9) / 9)
    loop = summary["loop"]
    assert loop.pop("compute_p99_us") == pytest.approx(400.0 + 8.98, abs=1e-3)  # the last one
    assert loop == {
        "rate_hz": 200.0,  # of walking
        "period_p99_ms": 5.5,
        "inference_p50_us": 30.0,
        "compute_p50_us": 200.0,
        "overruns": 2,
    }


def test_time_from_state_to_command_is_found_by_the_tick(recorded: Callable[..., Path]) -> None:
    answers = read_recording(recorded()).answer_time
    assert answers.value.shape == (1800, 1)
    np.testing.assert_allclose(answers.value, 0.0015, atol=1e-6)


def test_a_fall_is_counted_once(recorded: Callable[..., Path]) -> None:
    assert summarise_demo(read_recording(recorded(fall_at=7.0)))["falls"] == 1


def test_a_robot_that_lies_before_the_first_report_of_the_controller_has_not_fallen(tmp_path: Path) -> None:
    late = T0 + 1.0
    messages = (
        (topic, time, message)
        for topic, time, message in demo(rise_at=0.9)
        if topic != "/controller/state" or time > late
    )
    assert summarise_demo(read_recording(write(tmp_path / "late.mcap", messages)))["falls"] == 0


def test_pictures_are_drawn(recorded: Callable[..., Path], tmp_path: Path) -> None:
    recording = read_recording(recorded())
    frame = np.zeros((27, 36, 3), np.uint8)
    for number, figure in enumerate(
        (
            tracking_figure(recording),
            tracking_figure(recording, [("vx 0.5", frame)] * 3),
            loop_figure(recording),
        )
    ):
        figure.savefig(tmp_path / f"{number}.png")
    assert len(list(tmp_path.iterdir())) == 3


def test_a_recording_without_a_needed_topic_is_refused_by_its_name(tmp_path: Path) -> None:
    messages = (entry for entry in demo() if entry[0] != "/low_cmd")
    with pytest.raises(ValueError, match="nothing was recorded on /low_cmd"):
        read_recording(write(tmp_path / "part.mcap", messages))


def test_stretches_end_where_the_command_changes_or_the_planner_falls_silent() -> None:
    time = np.concatenate(
        [np.arange(0.0, 4.0, 0.02), np.arange(6.0, 10.0, 0.02), np.arange(10.0, 11.0, 0.02)]
    )
    planned = np.where(time[:, None] < 10.0, [0.5, 0.0, 0.0], [0.7, 0.0, 0.0])
    found = constant_commands(time, planned)
    assert [(start, round(end, 2)) for start, end, _ in found] == [(0.0, 3.98), (6.0, 9.98)]
    assert constant_commands(np.zeros(0), np.zeros((0, 3))) == []


def test_a_planner_that_was_starved_for_a_moment_has_not_stopped() -> None:
    time = np.concatenate([np.arange(0.0, 2.0, 0.02), np.arange(2.75, 4.0, 0.02)])
    assert len(constant_commands(time, np.tile([0.5, 0.0, 0.0], (len(time), 1)))) == 1


def test_lying_down_is_no_fall_but_tilting_over_is_one() -> None:
    lying, still = np.array([0.4, 0.1, 0.1, 0.4]), np.tile(UPRIGHT, (4, 1))
    assert count_falls(lying, still, np.array([True, True, True, True])) == 1
    assert count_falls(lying, still, np.array([True, False, False, True])) == 0
    tilted = still.copy()
    tilted[1:3] = [np.cos(0.6), np.sin(0.6), 0.0, 0.0]  # 1.2 rad
    assert count_falls(np.full(4, 0.4), tilted, np.array([False] * 4)) == 1


def test_a_recording_without_a_walk_fails(recorded: Callable[..., Path]) -> None:
    recording = read_recording(recorded())
    assert len(recorded_segments(recording)) == 2
    object.__setattr__(recording.planned, "time", np.zeros(0))
    object.__setattr__(recording.planned, "value", np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"found no command of 2\.5 s"):
        summarise_demo(recording)
