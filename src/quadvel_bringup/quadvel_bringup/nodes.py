"""The table of all nodes, and how to start one in this process or in its own.

The entry points in the packages' setup.cfg files name the same modules.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import attrs

from .installation import check_installed

Parameters = Mapping[str, bool | str | int | float]


@attrs.frozen
class NodeEntry:
    """A node.

    Attributes:
        module: Module with its `main`.
        about: What it does, in a few words.
        extra: Extra of quadvel-core with the libraries that it needs.
    """

    module: str
    about: str
    extra: str = "robot"

    @property
    def package(self) -> str:
        """ROS 2 package of the node."""
        return self.module.partition(".")[0]


NODES = {
    "sim_node": NodeEntry(
        "quadvel_sim.sim_node", "the simulated robot: MuJoCo behind low_state and low_cmd", "sim"
    ),
    "board": NodeEntry(
        "quadvel_sim.board_node", "the same robot behind the network interface of its board", "sim"
    ),
    "driver": NodeEntry(
        "quadvel_driver.driver", "the real robot (-p robot:=aliengo or go2): its board and its remote"
    ),
    "estimator": NodeEntry("quadvel_estimator.estimator", "estimates linear velocity from IMU and encoders"),
    "controller": NodeEntry("quadvel_policy.controller", "runs the policy at 200 Hz, its modes and guards"),
    "command_mux": NodeEntry("quadvel_policy.command_mux_node", "selects a velocity source by priority"),
    "person_tracker": NodeEntry(
        "quadvel_follow.person_tracker_node", "detects and tracks people in 2-D laser scans", "follow"
    ),
    "follow_planner": NodeEntry(
        "quadvel_follow.follow_planner_node", "follows a person, at a set distance", "follow"
    ),
    "trajectory_planner": NodeEntry(
        "quadvel_follow.trajectory_planner", "walks a path from a file", "follow"
    ),
    "view": NodeEntry("quadvel_view.view_node", "the operator's page in the browser", "view"),
    "planner": NodeEntry(
        "quadvel_lab.scripted_planner", "commands a scripted walk, as the demo does", "eval"
    ),
}


def node_entry(name: str) -> NodeEntry:
    """Return the entry of a node.

    Args:
        name: The node.

    Returns:
        Its entry.

    Raises:
        ValueError: There is no such node; the sentence lists all.
    """
    if name not in NODES:
        raise ValueError(f"there is no node '{name}'; known nodes: {', '.join(NODES)}")
    return NODES[name]


def installed_node(name: str) -> NodeEntry:
    """Return the entry of a node that is installed here.

    Args:
        name: The node.

    Returns:
        Its entry.

    Raises:
        ValueError: There is no such node, or it is not installed; the sentence says how to install it.
    """
    entry = node_entry(name)
    check_installed(name, entry.module, entry.extra)
    return entry


def run(name: str, arguments: Sequence[str]) -> None:
    """Run a node in this process until it ends, as `ros2 run` would.

    Without ROS 2 it runs on the embedded middleware.

    Args:
        name: The node.
        arguments: Arguments of ROS 2 ("--ros-args", "-p", "terrain:=rough", ...).

    Raises:
        ValueError: The node is unknown or not installed, or an argument is not one of ROS 2.
    """
    module = installed_node(name).module
    if arguments and arguments[0] != "--ros-args":
        raise ValueError(f"unexpected argument '{arguments[0]}'; set parameters by --ros-args -p NAME:=VALUE")
    import quadvel_dds

    quadvel_dds.install()
    sys.argv = [name, *arguments]
    import_module(module).main()


def enclave(name: str) -> list[str]:
    """Return the arguments for the SROS 2 enclave of a process (docs/security.md).

    Without SROS 2 they have no effect.

    Args:
        name: Name of the enclave.

    Returns:
        Arguments of ROS 2.
    """
    return ["--enclave", f"/quadvel/{name}"]


def launch_arguments(name: str) -> dict[str, Any]:
    """Return the keyword arguments of `launch_ros.actions.Node` for a node, without its parameters.

    Args:
        name: The node.

    Returns:
        Keyword arguments.
    """
    package = node_entry(name).package
    return {
        "package": package, "executable": name, "name": name, "output": "screen", "ros_arguments": enclave(name)
    }  # fmt: skip


def ros_arguments(name: str, parameters: Parameters, file: Path | None = None) -> list[str]:
    """Return the arguments of ROS 2 for a node.

    Args:
        name: The node.
        parameters: Parameters, which override those of the file.
        file: Parameter file, or None.

    Returns:
        Enclave, parameter file and parameters.
    """
    words = ["--ros-args", *enclave(name)]
    if file is not None:
        words += ["--params-file", str(file.resolve())]  # before the parameters: later values override
    for parameter, value in parameters.items():
        # JSON is quoted YAML; without quotes a file named "1" would be read as a number.
        words += ["-p", f"{parameter}:={json.dumps(value)}"]
    return words


def process_command(name: str, arguments: Sequence[str] = ()) -> list[str]:
    """Return the command line that runs a node in its own process.

    Args:
        name: The node.
        arguments: Arguments of ROS 2.

    Returns:
        The command line.

    Raises:
        ValueError: The node is unknown or not installed.
    """
    installed_node(name)
    return [sys.executable, "-m", "quadvel_bringup.nodes", name, *arguments]


if __name__ == "__main__":
    run(sys.argv[1], sys.argv[2:])
