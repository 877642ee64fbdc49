"""Which nodes a robot is made of, where they live, and with what parameters they start."""

from __future__ import annotations

import os
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import attrs
import pytest
import yaml

import quadvel_dds
from quadvel_bringup import nodes
from quadvel_bringup.stack import PARAMETERS, Stack
from quadvel_dds.arguments import parse
from quadvel_lab.follow_demo import FOLLOW_TOPICS
from quadvel_lab.recorded_run import RECORDED_TOPICS
from quadvel_nodes.parameters import parameter_fields

SRC = Path(__file__).parents[2] / "src"


def console_scripts(setup_file: Path) -> list[str]:
    """The "name = module:function" of a setup.cfg."""
    setup = ConfigParser()
    setup.read(setup_file)
    return setup["options.entry_points"]["console_scripts"].strip().splitlines()


def declared_parameters() -> dict[str, dict[str, Any]]:
    """The defaults of all parameters, by node, as the nodes' own classes have them."""
    quadvel_dds.install()
    from quadvel_driver.parameters import DriverParameters
    from quadvel_estimator.estimator import EstimatorParameters
    from quadvel_follow.follow_planner import FollowConfig
    from quadvel_follow.person_tracker_node import PersonTrackerParameters
    from quadvel_follow.trajectory_planner import TrajectoryParameters
    from quadvel_lab.scripted_planner import PlannerParameters
    from quadvel_policy.command_mux_node import MuxParameters
    from quadvel_policy.controller import ControllerParameters
    from quadvel_sim.parameters import BoardParameters, SimParameters
    from quadvel_view.view_node import ViewParameters

    classes: dict[str, type[attrs.AttrsInstance]] = {
        "sim_node": SimParameters,
        "board": BoardParameters,
        "driver": DriverParameters,
        "estimator": EstimatorParameters,
        "controller": ControllerParameters,
        "command_mux": MuxParameters,
        "person_tracker": PersonTrackerParameters,
        "follow_planner": FollowConfig,
        "trajectory_planner": TrajectoryParameters,
        "planner": PlannerParameters,
        "view": ViewParameters,
    }
    return {
        name: {
            field.name: list(field.default) if isinstance(field.default, tuple) else field.default
            for field in parameter_fields(kind).values()
        }
        for name, kind in classes.items()
    }


@pytest.mark.parametrize("name", nodes.NODES)
def test_the_table_of_nodes_agrees_with_the_entry_points_for_ros(name: str) -> None:
    entry = nodes.NODES[name]
    assert f"{name} = {entry.module}:main" in console_scripts(SRC / entry.package / "setup.cfg")


def test_every_node_of_the_stack_is_in_the_table() -> None:
    assert set(Stack().node_parameters()) <= set(nodes.NODES)


def test_an_unknown_node_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        ValueError, match=r"no node 'simnode'; known nodes: sim_node, board, driver, estimator"
    ):
        nodes.process_command("simnode")


def test_arguments_that_ros_would_overlook_are_refused() -> None:
    with pytest.raises(ValueError, match=r"unexpected argument 'terrain:=rough'; .* --ros-args -p"):
        nodes.run("sim_node", ["terrain:=rough"])


def test_the_parameter_file_holds_every_parameter_of_every_node_with_its_default() -> None:
    document = yaml.safe_load(PARAMETERS.read_text())
    assert {name: part["ros__parameters"] for name, part in document.items()} == declared_parameters()


def test_what_was_chosen_stands_above_the_parameter_file(tmp_path: Path) -> None:
    stack = Stack(
        policy=tmp_path / "1",
        terrain="rough",
        actuator=tmp_path / "found.yaml",
        estimator="kalman",
        parameters=tmp_path / "my.yaml",
    )
    file = ["--params-file", str(tmp_path / "my.yaml")]
    given = {
        "sim_node": ["-p", 'terrain:="rough"', "-p", f'actuator_file:="{tmp_path}/found.yaml"'],
        "estimator": ["-p", 'kind:="kalman"'],
        "controller": [
            *("-p", "auto_stand:=true", "-p", "robot_waits:=true", "-p", f'policy:="{tmp_path}/1"')
        ],
        "command_mux": [],
    }
    assert stack.arguments() == {
        name: ["--ros-args", "--enclave", f"/quadvel/{name}", *file, *words] for name, words in given.items()
    }


def test_a_world_is_a_name_or_a_file_of_any_folder() -> None:
    for world, handed_on in (("campus", "campus"), ("mine.yaml", str(Path("mine.yaml").resolve()))):
        assert Stack(world=world).node_parameters()["sim_node"] == {"world": handed_on}


@pytest.mark.parametrize(
    "chosen", [{"terrain": "rough"}, {"world": "park"}, {"actuator": Path("found.yaml")}]
)
def test_what_only_a_simulated_robot_has_is_refused_for_another(chosen: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"only a simulated robot has this, not external"):
        Stack(low_level="external", **chosen).node_parameters()


def test_in_simulated_time_the_simulator_waits_and_the_others_follow_its_clock() -> None:
    overrides = Stack(use_sim_time=True).node_parameters()
    assert overrides.pop("sim_node") == {"mode": "lockstep"}
    assert all(values["use_sim_time"] is True for values in overrides.values())


def test_beside_a_robot_that_others_serve_nothing_moves_without_an_operator() -> None:
    overrides = Stack(low_level="external").node_parameters()
    assert "sim_node" not in overrides
    assert overrides["controller"] == {"auto_stand": False, "require_operator": True}


def test_behind_the_boards_interface_stand_the_simulated_board_and_the_real_driver() -> None:
    overrides = Stack(low_level="board", terrain="rough", network={"network_loss": 0.1}).node_parameters()
    assert list(overrides) == ["board", "driver", "estimator", "controller", "command_mux"]
    port = 8007 + int(os.environ["ROS_DOMAIN_ID"])
    assert overrides["board"] == {"port": port, "terrain": "rough", "network_loss": 0.1}
    assert overrides["driver"] == {
        "board_address": "127.0.0.1",
        "board_port": port,
        "local_port": 0,
        "dds_domain": 1,
    }
    assert overrides["controller"] == {"auto_stand": True}


def test_the_robot_itself_stands_up_and_walks_only_on_an_operators_call() -> None:
    overrides = Stack(low_level="driver").node_parameters()
    assert list(overrides) == ["driver", "estimator", "controller", "command_mux"]
    assert overrides["driver"] == overrides["estimator"] == {"realtime_priority": 50}
    assert overrides["controller"] == {
        "auto_stand": False,
        "require_operator": True,
        "realtime_priority": 50,
    }


def test_every_node_that_has_to_know_the_robot_is_told_its_name_or_file() -> None:
    for low_level, serving in (("driver", {"driver"}), ("sim", {"sim_node"}), ("board", {"board", "driver"})):
        overrides = Stack(low_level=low_level, robot="go2").node_parameters()
        robots = {name for name, values in overrides.items() if values.get("robot") == "go2"}
        assert robots == {*serving, "estimator", "controller"}
    file = Stack(low_level="external", robot="mine/robot.yaml").node_parameters()["controller"]["robot"]
    assert file == str(Path("mine/robot.yaml").resolve())


def test_the_folder_of_a_robot_may_be_named_but_hides_no_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mine", "go2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "robot.yaml").touch()
    robots = [Stack(robot=name).node_parameters()["estimator"]["robot"] for name in ("mine", "go2", "spot")]
    assert robots == [str(tmp_path / "mine"), "go2", "spot"]


def test_what_a_robot_cannot_do_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="low_level is 'board', expected 'sim' for simulated time"):
        Stack(low_level="board", use_sim_time=True)
    with pytest.raises(ValueError, match="low_level is 'sim', expected 'board' for a simulated bad network"):
        Stack(network={"network_loss": 0.1})


def test_another_robot_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="low_level"):
        Stack(low_level="spot")


def test_the_page_is_one_more_node_and_none_of_the_robot() -> None:
    robot = Stack(use_sim_time=True)
    assert set(robot.commands(view=True)) - set(robot.commands()) == {"view"}
    assert "use_sim_time:=true" not in robot.arguments(view=True)["view"]


def test_rviz_shows_topics_that_are_recorded_with_the_types_of_its_displays() -> None:
    known = RECORDED_TOPICS | FOLLOW_TOPICS
    config = yaml.safe_load((PARAMETERS.parent / "robot.rviz").read_text())
    shown = {}
    for display in config["Visualization Manager"]["Displays"]:
        place = display.get("Topic") or display.get("Description Topic")
        if place:
            shown[place["Value"]] = display["Class"].rpartition("/")[2]
    message = {"RobotModel": "String", "Pose": "PoseStamped"}
    assert {topic: known[topic].rpartition("/")[2] for topic in shown} == {
        topic: message.get(kind, kind) for topic, kind in shown.items()
    }
    assert {"/scan", "/person", "/follow_planner/path"} <= set(shown)


def test_a_parameter_that_is_given_stands_above_the_file() -> None:
    """The laser of a world, for one, above the file's: a tracker that took the file's saw everybody 0.25 m too near."""
    words = nodes.ros_arguments("person_tracker", {"laser_x": 0.4}, PARAMETERS)
    found = parse(words).parameters_for("/person_tracker")
    assert (found["laser_x"], found["select_nearest"]) == (0.4, True)
