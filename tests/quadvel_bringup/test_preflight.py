"""What is wrong with a stack is said once, before any of its processes starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import pytest

from quadvel_bringup import up
from quadvel_bringup.preflight import NODE_CHECKS, check_arguments, check_stack
from quadvel_bringup.stack import LOW_LEVELS, PARAMETERS, Stack
from quadvel_description.robot import load_robot
from quadvel_policy.policy_file import SHIPPED_POLICY
from tests.helpers.robots import write_third_robot


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(up.ProcessGroup, "start", lambda *arguments: pytest.fail("a process started"))


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_the_shipped_stack_is_in_order() -> None:
    check_stack(Stack())
    check_stack(Stack(use_sim_time=True))
    for low_level in LOW_LEVELS:
        check_stack(Stack(low_level=low_level))
    assert set(NODE_CHECKS) == {
        name for low_level in LOW_LEVELS for name in Stack(low_level=low_level).node_parameters()
    }


def test_a_robot_without_a_policy_may_stand() -> None:
    check_stack(Stack(robot="go2", policy=Path("none"), estimator="kalman"))


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ({}, "no policy is shipped for the robot 'third': .* --policy FILE"),
        (
            {"policy": Path("none")},
            "no velocity estimator is shipped for the robot 'third': .* --estimator kalman",
        ),
    ],
)
def test_a_robot_without_shipped_networks_needs_those_of_the_user(
    tmp_path: Path, choice: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(FileNotFoundError, match=sentence):
        check_stack(Stack(robot=str(write_third_robot(tmp_path)), **choice))


@pytest.mark.parametrize("low_level", ["driver", "board"])
def test_a_robot_without_a_board_that_is_known_here_has_no_driver(tmp_path: Path, low_level: str) -> None:
    for file in load_robot("go2").folder.iterdir():
        text = file.read_text()
        (tmp_path / file.name).write_text(text.partition("drive:")[0] if file.suffix == ".yaml" else text)
    stack = Stack(robot=str(tmp_path), policy=Path("none"), estimator="kalman", low_level=low_level)
    with pytest.raises(
        ValueError, match=r"robot\.yaml: drive\.board: found 'external', expected unitree_udp or"
    ):
        check_stack(stack)
    check_stack(attrs.evolve(stack, low_level="external"))


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ({"terrain": "moon"}, "sim_node: .*'moon', expected one of flat, slope, rough"),
        (
            {"world": "moon"},
            "sim_node: world moon: .*, expected a YAML file or one of corridor, park, campus",
        ),
        (
            {"estimator": "magic"},
            "estimator: kind: found 'magic', expected one of learned, kalman",
        ),
        ({"policy": Path("nowhere.onnx")}, r"controller: .*nowhere\.onnx: no such file"),
        ({"policy": PARAMETERS}, r"controller: .*params\.yaml"),
        (
            {"robot": "spot", "low_level": "external"},
            "robot: found 'spot', expected aliengo, go2 or the path of a robot.yaml",
        ),
        (
            {"robot": "go2", "low_level": "driver", "estimator": "kalman", "policy": SHIPPED_POLICY},
            r"controller: .*crl_eam\.onnx: metadata field robot is 'aliengo', expected 'go2'",
        ),
        (
            {"actuator": Path("nowhere.yaml")},
            "sim_node: actuator_file: cannot read .*nowhere.yaml: No such file",
        ),
        ({"parameters": Path("nowhere.yaml")}, "nowhere.yaml' cannot be read: No such file"),
    ],
)
def test_a_wrong_name_or_file_is_refused_before_anything_starts(
    choice: dict[str, Any], sentence: str
) -> None:
    with pytest.raises((ValueError, OSError), match=sentence):
        up.up(Stack(**choice))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "sim_node:\n  ros__parameters: {payloat: 1.0}",
            r"sim_node: found the parameter payloat, did you mean payload\?$",
        ),
        ("sim_node:\n  ros__parameters: {payload: 1}", "sim_node: payload is 1, expected a float: write 1.0"),
        (
            "/**:\n  ros__parameters: {max_tilt: 0.9}",
            r"p\.yaml: found max_tilt in the section /\*\*, but .* expected it in the section controller$",
        ),
        ("sim_node:\n  ros__parameters: {payload: 99.0}", "sim_node: .*payload.*99"),
        (
            "simnode:\n  ros__parameters: {payload: 1.0}",
            r"p\.yaml: found a section for '/simnode', did you mean sim_node\?$",
        ),
        ("moon:\n  ros__parameters: {payload: 1.0}", "section for '/moon', expected one of sim_node, board,"),
        (
            "view:\n  ros__parameters: {prot: 8080}",  # of a node that is not started
            r"p\.yaml: view: found the parameter prot, did you mean port\?$",
        ),
        (
            "/**:\n  ros__parameters: {max_tlit: 0.9}",
            r"p\.yaml: /\*\*: found the parameter max_tlit, did you mean max_tilt\?$",
        ),
        ("driver:\n  ros__parameters: {calibration: nowhere.yaml}", r"driver: .*nowhere\.yaml"),
        ("sim_node: [", "p.yaml' is not valid YAML"),
        (
            "sim_node:\n  ros__parameters: 5",
            "p.yaml': '/sim_node' ros__parameters: expected names and values",
        ),
        ("command_mux:\n  ros__parameters: {names: [a]}", "command_mux: topics has 3 entries, expected 1"),
    ],
)
def test_a_wrong_parameter_file_is_refused_before_anything_starts(
    tmp_path: Path, text: str, sentence: str
) -> None:
    low_level = "board" if text.startswith("driver") else "sim"
    with pytest.raises(ValueError, match=sentence) as refusal:
        up.up(Stack(low_level=low_level, parameters=written(tmp_path / "p.yaml", text)))
    assert "\n" not in str(refusal.value)


def test_a_controller_of_another_robot_than_the_drivers_is_refused_before_anything_starts(
    tmp_path: Path,
) -> None:
    file = written(tmp_path / "p.yaml", "driver:\n  ros__parameters: {robot: go2}")
    with pytest.raises(
        ValueError, match="estimator: robot is 'aliengo', expected 'go2', the robot of driver"
    ):
        up.up(Stack(low_level="driver", parameters=file))


def test_parameters_for_every_node_and_for_one_in_any_namespace_are_understood(tmp_path: Path) -> None:
    text = (
        "/**:\n  ros__parameters: {use_sim_time: true}\n/**/controller:\n  ros__parameters: {max_tilt: 0.9}"
    )
    check_stack(Stack(parameters=written(tmp_path / "p.yaml", text)))


def test_a_file_that_is_no_text_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"p\.yaml' is not text"):
        check_stack(Stack(parameters=tmp_path / "p.yaml"))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["-p", "controllers:max_tilt:=0.9"],
            r"found a section for '/\*\*/controllers', did you mean controller\?",
        ),
        (["-p", "max_tlit:=0.9"], r"found the parameter max_tlit, did you mean max_tilt\?"),
        (["-p", "view:prot:=1"], r"view: found the parameter prot, did you mean port\?"),
        (
            ["-r", "__node:=legs", "-p", "legs:max_tlit:=0.9"],
            r"controller: .* max_tlit, did you mean max_tilt\?",
        ),
    ],
)
def test_a_misspelt_name_in_the_arguments_of_a_node_is_refused_with_the_nearest_one(
    words: list[str], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        check_arguments("controller", ["--ros-args", *words])


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["-p", "max_tilt:=0.9", "-p", "use_sim_time:=true"],
        ["-r", "__node:=legs", "-r", "__ns:=/robot", "-p", "legs:max_tilt:=0.9"],
        ["-p", "view:port:=1"],
        ["--an-argument-of-ros-only"],  # left to rclpy
    ],
)
def test_arguments_of_a_node_with_known_names_are_accepted(words: list[str]) -> None:
    check_arguments("controller", ["--ros-args", *words])


def test_a_parameter_file_for_several_namespaces_is_understood_by_one_node(tmp_path: Path) -> None:
    text = "/one/controller:\n  ros__parameters: {max_tilt: 0.9}\n/two/view:\n  ros__parameters: {port: 1}"
    file = written(tmp_path / "p.yaml", text)
    check_arguments("controller", ["--ros-args", "-r", "__ns:=/one", "--params-file", str(file)])
