"""The nodes of a walking robot, and the parameters of each.

`up` starts the nodes, and `preflight` checks them before.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import attrs

from quadvel_description.robot_name import shipped_robots

from .nodes import Parameters, process_command, ros_arguments

PARAMETERS = Path(__file__).parent / "config" / "params.yaml"
"""Parameter file with the default values of all nodes."""

VIEW = "view"
"""The node of the operator page; the robot continues after its end."""

BOARD_PORT = 8007
"""UDP port of the AlienGo's board.

Simulated boards add the number of the ROS domain, which differs per user.
"""


@attrs.frozen
class LowLevel:
    """A source of low_state and sink of low_cmd.

    Attributes:
        nodes: Its nodes with their parameters.
        controller: Parameters that it needs of the controller.
        simulation: Its simulating node, or "".
        urgent: Whether missed deadlines are unsafe, so that the control loop needs real-time
            priority.
    """

    nodes: Mapping[str, Parameters]
    controller: Parameters
    simulation: str = ""
    urgent: bool = False


def _on_loopback() -> dict[str, Parameters]:
    """Return the simulated board, and the driver connected to it."""
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    port = BOARD_PORT + (int(domain) if domain.isdecimal() else 0)
    return {
        "board": {"port": port},
        "driver": {"board_address": "127.0.0.1", "board_port": port, "local_port": 0, "dds_domain": 1},
    }


URGENT: Parameters = {"realtime_priority": 50}
# Stand up and walk only on request of an operator; until then the policy is loaded but inactive.
_BY_OPERATOR: Parameters = {"auto_stand": False, "require_operator": True}
# robot_waits: simulated time stands still until a late answer comes.
LOW_LEVELS = {
    "sim": LowLevel({"sim_node": {}}, {"auto_stand": True, "robot_waits": True}, simulation="sim_node"),
    "board": LowLevel(_on_loopback(), {"auto_stand": True}, simulation="board"),
    "driver": LowLevel({"driver": URGENT}, _BY_OPERATOR, urgent=True),
    "external": LowLevel({}, _BY_OPERATOR),  # started elsewhere, possibly a real robot
}


@attrs.frozen(kw_only=True)
class Stack:
    """The options of a robot; None keeps the value of the parameter file.

    Attributes:
        low_level: Key of LOW_LEVELS.
        parameters: Parameter file.
        robot: Name of the robot, or path of a robot.yaml.
        policy: ONNX file of the policy, or `none`.
        terrain: "flat", "slope" or "rough".
        world: Name or file of a world.
        actuator: YAML file of the actuator model.
        estimator: "learned" or "kalman".
        use_sim_time: Whether the simulator waits for the answer to each state and the other nodes
            use its clock; requires the low level "sim", because a board does not wait.
        network: Parameters of "board" for a bad network.
    """

    low_level: str = attrs.field(default="sim", validator=attrs.validators.in_(LOW_LEVELS))
    parameters: Path = attrs.field(default=PARAMETERS, converter=Path)
    robot: str | None = None
    policy: Path | None = None
    terrain: str | None = None
    world: str | None = None
    actuator: Path | None = None
    estimator: str | None = None
    use_sim_time: bool = attrs.field(default=False)
    network: Parameters = attrs.field(factory=dict)

    @use_sim_time.validator
    def _can_wait(self, attribute: object, value: bool) -> None:
        """Require the low level "sim" for simulated time."""
        if value and self.low_level != "sim":
            raise ValueError(f"low_level is '{self.low_level}', expected 'sim' for simulated time")

    @network.validator
    def _has_network(self, attribute: object, value: Parameters) -> None:
        """Require the low level "board" for a bad network."""
        if value and self.low_level != "board":
            raise ValueError(f"low_level is '{self.low_level}', expected 'board' for a simulated bad network")

    @property
    def brings_robot(self) -> bool:
        """Whether one of the nodes serves the robot's topics."""
        return bool(LOW_LEVELS[self.low_level].nodes)

    def node_parameters(self) -> dict[str, Parameters]:
        """Return the nodes to start, with the parameters that override those of the file.

        Returns:
            Parameters by name of the nodes to start.

        Raises:
            ValueError: An option needs a simulated robot.
        """
        low_level = LOW_LEVELS[self.low_level]
        policy = absolute_file(None if self.policy is None else str(self.policy))
        urgent: Parameters = URGENT if low_level.urgent else {}
        robot = _given(robot=absolute_file(self.robot))
        followers: dict[str, Parameters] = {
            "estimator": {**urgent, **robot, **_given(kind=self.estimator)},
            "controller": {**low_level.controller, **urgent, **robot, **_given(policy=policy)},
            "command_mux": {},
        }
        actuator = None if self.actuator is None else str(self.actuator.resolve())
        simulated = _given(terrain=self.terrain, world=absolute_file(self.world), actuator_file=actuator)
        if simulated and not low_level.simulation:
            raise ValueError(f"{', '.join(simulated)}: only a simulated robot has this, not {self.low_level}")
        serving = {name: {**values, **robot} for name, values in low_level.nodes.items()}
        if low_level.simulation:
            mode = _given(mode="lockstep" if self.use_sim_time else None)
            own = serving[low_level.simulation]
            serving[low_level.simulation] = {**own, **simulated, **mode, **self.network}
        if self.use_sim_time:
            followers = {name: {**values, "use_sim_time": True} for name, values in followers.items()}
        return serving | followers

    def arguments(self, view: bool = False) -> dict[str, list[str]]:
        """Return the arguments of ROS 2 of each node.

        Args:
            view: Whether to add the node `view`, which never uses simulated time.

        Returns:
            Arguments by name of the node.
        """
        robot = _given(robot=absolute_file(self.robot))
        nodes = self.node_parameters() | ({VIEW: robot} if view else {})
        return {name: ros_arguments(name, values, self.parameters) for name, values in nodes.items()}

    def commands(self, view: bool = False) -> dict[str, list[str]]:
        """Return the command lines that run each node in its own process.

        Args:
            view: Whether to add the node `view`.

        Returns:
            Command lines by name of the node.
        """
        return {name: process_command(name, words) for name, words in self.arguments(view).items()}


def absolute_file(chosen: str | None) -> str | None:
    """Make the path of a world, robot or policy absolute.

    Args:
        chosen: The file or folder, the name of a shipped one or of another choice, or None.

    Returns:
        The absolute path; a name and None unchanged.
    """
    if chosen is None or chosen in shipped_robots():
        return chosen
    path = Path(chosen)
    is_path = path.suffix or len(path.parts) > 1 or (path / "robot.yaml").is_file()
    return str(path.resolve()) if is_path else chosen


def _given(**values: str | None) -> Parameters:
    """Return the given values without None."""
    return {name: value for name, value in values.items() if value is not None}
