"""Which nodes there are, and how to start one: in this process, or as a process of its own.

The one table of nodes; the entry points in the packages' setup.cfg files name the same modules.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import attrs

Parameters = Mapping[str, bool | str | int | float]


@attrs.frozen
class NodeEntry:
    """The module with the node's `main`, and what the node does, in a few words."""

    module: str
    about: str

    @property
    def package(self) -> str:
        """The ROS 2 package that the node belongs to."""
        return self.module.partition(".")[0]


NODES = {
    "sim_node": NodeEntry("quadvel_sim.sim_node", "the stand-in robot: MuJoCo behind low_state and low_cmd"),
    "board": NodeEntry("quadvel_sim.board_node", "the same robot behind the UDP interface of the AlienGo"),
    "driver": NodeEntry("quadvel_driver.driver", "the AlienGo itself: its UDP interface and its remote"),
    "estimator": NodeEntry("quadvel_estimator.estimator", "linear velocity from IMU and encoders"),
    "controller": NodeEntry("quadvel_policy.controller", "the policy at 200 Hz, its modes and its safety"),
    "command_mux": NodeEntry("quadvel_policy.command_mux_node", "which of several cmd_vel counts"),
    "person_tracker": NodeEntry("quadvel_follow.person_tracker_node", "persons in the scans of a 2-D laser"),
    "follow_planner": NodeEntry("quadvel_follow.follow_planner_node", "follows a person, at a set distance"),
    "trajectory_planner": NodeEntry("quadvel_follow.trajectory_planner", "walks a way from a file"),
    "view": NodeEntry("quadvel_view.view_node", "the operator's page in the browser"),
    "planner": NodeEntry(
        "quadvel_eval.scripted_planner", "walks the robot through a script, as the demo does"
    ),
}


def entry(name: str) -> NodeEntry:
    """The node's entry. Raises ValueError that lists the known ones."""
    if name not in NODES:
        raise ValueError(f"there is no node '{name}'; known are {', '.join(NODES)}")
    return NODES[name]


def run(name: str, arguments: Sequence[str]) -> None:
    """Run a node in this process until it ends, as `ros2 run` would.

    `arguments` are those of ROS 2 ("--ros-args", "-p", "terrain:=rough", ...). Without ROS 2 it runs on the
    embedded middleware. Raises ValueError on an unknown node, or an argument that is not one of ROS 2.
    """
    module = entry(name).module
    if arguments and arguments[0] != "--ros-args":
        raise ValueError(f"unexpected argument '{arguments[0]}'; parameters go as --ros-args -p NAME:=VALUE")
    import quadvel_dds

    quadvel_dds.install()
    sys.argv = [name, *arguments]
    import_module(module).main()


def enclave(name: str) -> list[str]:
    """The arguments of ROS 2 that name a process's rights under SROS 2 (docs/security.md); without it they change nothing."""
    return ["--enclave", f"/quadvel/{name}"]


def launch_arguments(name: str) -> dict[str, Any]:
    """What `launch_ros.actions.Node` wants to know of a node, but for its parameters."""
    package = entry(name).package
    return {
        "package": package, "executable": name, "name": name, "output": "screen", "ros_arguments": enclave(name)
    }  # fmt: skip


def arguments(name: str, parameters: Parameters, file: Path | None = None) -> list[str]:
    """A node's arguments of ROS 2: its enclave and its parameters, which stand above those of the parameter file."""
    words = ["--ros-args", *enclave(name)]
    if file is not None:
        words += ["--params-file", str(file.resolve())]  # before the parameters: what comes later counts
    for parameter, value in parameters.items():
        # JSON is YAML with quotes, and without them a file named "1" would be a number.
        words += ["-p", f"{parameter}:={json.dumps(value)}"]
    return words


def command(name: str, arguments: Sequence[str] = ()) -> list[str]:
    """The command line that runs a node as a process of its own."""
    entry(name)
    return [sys.executable, "-m", "quadvel_bringup.nodes", name, *arguments]


if __name__ == "__main__":
    run(sys.argv[1], sys.argv[2:])
