"""Tests of command-line arguments, parameter files and names."""

import re
from pathlib import Path

import pytest

from quadvel_dds import arguments, names


def overrides(*args: str, node: str = "/robot/controller") -> dict[str, object]:
    return arguments.parse(["program", "--ros-args", *args]).parameters_for(node)


def test_arguments_of_others_are_left_alone() -> None:
    args = ["program", "-p", "x", "--ros-args", "-p", "a:=1", "--", "-p", "b:=1", "--ros-args", "-p", "c:=1"]
    assert arguments.parse(args).parameters_for("/robot") == {"a": 1, "c": 1}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1), ("1.0", 1.0), ("1e-3", 1e-3), ("-2E4", -2e4), (".5", 0.5), ("true", True), ("walk", "walk"),
        ("'1'", "1"), ("", ""), ("[1, 2]", [1, 2]), ("[a, b]", ["a", "b"]), ("[]", []),
        ("2024-01-01", "2024-01-01"),
    ],
)  # fmt: skip
def test_values_are_read_as_yaml(text: str, value: object) -> None:
    found = overrides("-p", f"gain:={text}")["gain"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("text", ["[1, 2.0]", "{a: 1}", "null", "[1, [2]]", "[unclosed"])
def test_values_that_no_parameter_can_hold_are_refused(text: str) -> None:
    with pytest.raises(arguments.InvalidROSArgsError, match=re.escape(f"gain:={text}")):
        overrides("-p", f"gain:={text}")


def test_an_enclave_is_read_over_as_there_is_no_security() -> None:
    assert overrides("--enclave", "/quadvel/controller", "-p", "a:=1", "-e", "/other") == {"a": 1}


@pytest.mark.parametrize(
    "args", [["-p"], ["-p", "gain"], ["--frob"], ["-r", "a=b"], ["-r", "rostopic://a:=b"]]
)
def test_arguments_that_are_not_understood_are_refused(args: list[str]) -> None:
    with pytest.raises(arguments.InvalidROSArgsError, match=re.escape(args[-1])):
        overrides(*args)


def test_parameter_for_one_node_reaches_no_other() -> None:
    args = ["-p", "controller:gain:=2", "-p", "mux:gain:=3", "-p", "rate:=5"]
    assert overrides(*args) == {"gain": 2, "rate": 5}


FILE = """
/**:
  ros__parameters: {rate: 100, gains: {kp: 30.0, kd: 0.5}}
/robot/controller:
  ros__parameters: {rate: 200}
robot:
  mux:
    ros__parameters: {rate: 50}
/*/estimator:
  ros__parameters: {rate: 400}
"""


@pytest.mark.parametrize(
    ("node", "rate"),
    [
        ("/robot/controller", 200),
        ("/robot/mux", 50),
        ("/robot/estimator", 400),
        ("/estimator", 100),
        ("/a/b/c", 100),
    ],
)
def test_file_gives_each_node_its_own(tmp_path: Path, node: str, rate: int) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(FILE)
    found = overrides("--params-file", str(file), node=node)
    assert found == {"rate": rate, "gains.kp": 30.0, "gains.kd": 0.5}


def test_later_arguments_win(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(FILE)
    assert overrides("-p", "rate:=1", "--params-file", str(file))["rate"] == 200
    assert overrides("--params-file", str(file), "-p", "rate:=1")["rate"] == 1


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("controller: 5", "found 5 under '/controller'"),
        ("a: [", "is not valid YAML"),
        ("/**: {ros__parameters: {gain: [1, two]}}", "'gain': found [1, 'two']"),
        ("/**: {ros__parameters: 3}", "expected names and values"),
        (None, "cannot be read: No such file"),
        ("/**: {ros__parameters: {a: &x [1], b: *x}}", "found an alias, expected values in full"),
        ("a: &x {b: *x}", "found an alias"),
        (
            "/**: {ros__parameters: {a: !!python/object/apply:os.getcwd []}}",
            "could not determine a constructor",
        ),
        ("[" * 400, "is not valid YAML"),
        ("a: " + "9" * 5000, "is not valid YAML"),
        ("\udcff", "is not text"),
    ],
)
def test_faults_of_a_file_are_named(tmp_path: Path, content: str | None, fault: str) -> None:
    file = tmp_path / "parameters.yaml"
    if content is not None:
        file.write_text(content, errors="surrogateescape")
    with pytest.raises(arguments.InvalidROSArgsError, match=re.escape(fault)) as caught:
        overrides("--params-file", str(file))
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("cmd_vel", "/robot/cmd_vel"), ("/cmd_vel", "/cmd_vel"), ("~/state", "/robot/mux/state"),
        ("~", "/robot/mux"), ("a/b", "/robot/a/b"), ("{node}/x", "/robot/mux/x"), ("{ns}/x", "/robot/x"),
    ],
)  # fmt: skip
def test_names_are_expanded(name: str, full: str) -> None:
    assert names.fault(names.TOPIC, name) is None
    assert names.expand(name, "mux", "/robot") == full


@pytest.mark.parametrize("name", ["", "9a", "a//b", "a b", "a/", "/", "a-b", "a~", "{who}/x"])
def test_bad_topic_names_are_refused(name: str) -> None:
    assert names.fault(names.TOPIC, name) is not None


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("cmd_vel:=teleop", "/robot/teleop"), ("/robot/cmd_vel:=/teleop", "/teleop"),
        ("cmd_vel:=~/in", "/robot/mux/in"), ("mux:cmd_vel:=teleop", "/robot/teleop"),
        ("other:cmd_vel:=teleop", "/robot/cmd_vel"), ("/cmd_vel:=/teleop", "/robot/cmd_vel"),
    ],
)  # fmt: skip
def test_rules_remap_full_names(rule: str, expected: str) -> None:
    assert names.remap("/robot/cmd_vel", "mux", "/robot", [arguments.parse_rule("-r", rule)]) == expected
