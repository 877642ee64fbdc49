"""What the doctor concludes from what it finds."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import pytest

from quadvel_bringup import doctor
from quadvel_bringup.doctor import Finding
from quadvel_bringup.version import version
from tests.helpers.robots import write_third_robot

GOOD = [Finding(name, True, "1.0") for name in ("Python", *doctor.REQUIRED_PACKAGES, "GL", "ffmpeg")]


def test_without_torch_all_but_training_can_run() -> None:
    abilities = dict(doctor.abilities([*GOOD, Finding("torch", True, "not installed")]))
    assert [name for name, possible in abilities.items() if not possible] == ["training"]


def test_without_the_simulator_only_a_robot_can_run() -> None:
    findings = [Finding("mujoco", False, "missing") if f.subject == "mujoco" else f for f in GOOD]
    findings.append(Finding("torch", True, "2.13.0: training can run"))
    possible = [name for name, possible in doctor.abilities(findings) if possible]
    assert len(possible) == 1
    assert possible[0].startswith("a robot's nodes")


def test_without_a_shipped_policy_no_demo_can_run() -> None:
    abilities = dict(doctor.abilities([*GOOD, Finding("robot files", False, "no policy is shipped")]))
    (demo,) = (possible for name, possible in abilities.items() if "demo" in name and "video" not in name)
    assert not demo
    assert not abilities["the video of the demo"]


def test_a_backend_that_cannot_draw_is_not_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no such backend")
    assert doctor.gl_backend() is None


def test_a_missing_gl_library_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "gl_backend", lambda: None)
    finding = next(f for f in doctor.examine() if f.subject == "GL")
    assert (finding.good, "apt install libegl1" in finding.text) == (False, True)


@pytest.mark.parametrize("missing", ["GL", "ffmpeg"])
def test_a_video_needs_both_what_draws_and_what_encodes(missing: str) -> None:
    findings = [Finding(f.subject, f.subject != missing, f.text) for f in GOOD]
    assert not dict(doctor.abilities(findings))["the video of the demo"]


def test_a_missing_encoder_is_named_with_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert doctor.video_encoder().text == "imageio-ffmpeg is missing, so no video; pip install -e '.[eval]'"


def test_an_encoder_that_does_not_run_is_no_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    assert not doctor.video_encoder().good


def test_ros_is_found_where_rclpy_is_importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.util, "find_spec", lambda name: object())
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    finding = next(f for f in doctor.examine() if f.subject == "ROS 2")
    assert finding.text.startswith("jazzy with ")


def test_an_rclpy_too_old_for_real_time_on_two_cores_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.util, "find_spec", lambda name: object() if name == "rclpy" else None)
    finding = next(f for f in doctor.examine() if f.subject == "ROS 2")
    assert "rclpy 7.1.4" in finding.text


@pytest.mark.parametrize(
    ("robot", "good", "text"),
    [
        ("aliengo", True, "AlienGo: crl_eam.onnx, estimator.onnx"),
        ("go2", True, "Go2: crl_eam.onnx, estimator.onnx"),
        ("spot", False, "robot: found 'spot', expected aliengo, go2 or the path of a robot.yaml"),
    ],
)
def test_what_is_shipped_for_a_robot_is_named(robot: str, good: bool, text: str) -> None:
    finding = doctor.robot_files(robot)
    assert (finding.good, text in finding.text) == (good, True), finding


def test_a_robot_without_a_policy_is_named(tmp_path: Path) -> None:
    finding = doctor.robot_files(str(write_third_robot(tmp_path)))
    assert not finding.good
    assert "no policy is shipped for the robot 'third'" in finding.text


def test_a_report_shows_versions_and_system_and_no_name_of_a_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    found = Finding("robot", True, "running: policy_controller; policy /home/somebody/mine.onnx")
    text = doctor.report([found])
    assert f"quadvel: {version()}" in text
    assert f"cyclonedds {metadata.version('cyclonedds')}" in text
    assert "ROS_DISTRO: jazzy" in text
    assert "ok   robot        running: policy_controller; policy ~/mine.onnx" in text
    assert "somebody" not in text
