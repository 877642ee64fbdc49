"""The nodes that make a walking robot, and the parameters that each of them gets."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import attrs

from .nodes import Parameters, arguments, command

PARAMETERS = Path(__file__).parent / "config" / "params.yaml"
"""The shipped values of all nodes' parameters."""

VIEW = "view"
"""The node that serves the operator's page: where it ends, the robot goes on"""

BOARD_PORT = 8007
"""UDP port of the AlienGo's board; the simulated one adds the number of the ROS domain, as nobody shares one"""


@attrs.frozen
class LowLevel:
    """What serves low_state and low_cmd: its nodes with their parameters, and what it wants of the controller.

    simulation: the one of these nodes that simulates, if one does. urgent: whether real time is a matter of safety, so that
    the threads of the control loop run before all others.
    """

    nodes: Mapping[str, Parameters]
    controller: Parameters
    simulation: str = ""
    urgent: bool = False


def _on_loopback() -> dict[str, Parameters]:
    """The simulated board and the driver that finds it."""
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    port = BOARD_PORT + (int(domain) if domain.isdecimal() else 0)
    return {
        "board": {"port": port},
        "driver": {"board_address": "127.0.0.1", "board_port": port, "local_port": 0},
    }


URGENT: Parameters = {"realtime_priority": 50}
# It stands up and walks only on an operator's call, with the policy loaded but inactive until then.
_BY_OPERATOR: Parameters = {"auto_stand": False, "require_operator": True}
LOW_LEVELS = {
    "sim": LowLevel({"sim_node": {}}, {"auto_stand": True, "robot_waits": True}, simulation="sim_node"),
    "board": LowLevel(_on_loopback(), {"auto_stand": True}, simulation="board"),
    "aliengo": LowLevel({"driver": URGENT}, _BY_OPERATOR, urgent=True),
    "external": LowLevel({}, _BY_OPERATOR),  # started by somebody else, and perhaps a real robot
}


@attrs.frozen(kw_only=True)
class Stack:
    """What may be chosen; None leaves what the parameter file says.

    use_sim_time: the simulator sets the pace, waiting for the answer to each of its states; all others follow
    its clock. Only "sim" can: a board waits for nobody. network: parameters of "board", how bad its network is.
    """

    low_level: str = attrs.field(default="sim", validator=attrs.validators.in_(LOW_LEVELS))
    parameters: Path = attrs.field(default=PARAMETERS, converter=Path)
    policy: Path | None = None
    terrain: str | None = None
    world: str | None = None
    actuator: Path | None = None
    estimator: str | None = None
    use_sim_time: bool = attrs.field(default=False)
    network: Parameters = attrs.field(factory=dict)

    @use_sim_time.validator
    def _can_wait(self, attribute: object, value: bool) -> None:
        if value and self.low_level != "sim":
            raise ValueError(
                f"low_level is '{self.low_level}', expected 'sim' where simulated time sets the pace"
            )

    @network.validator
    def _has_network(self, attribute: object, value: Parameters) -> None:
        if value and self.low_level != "board":
            raise ValueError(
                f"low_level is '{self.low_level}', expected 'board' for a network that is bad on purpose"
            )

    @property
    def brings_robot(self) -> bool:
        """Whether one of its nodes serves the robot's topics."""
        return bool(LOW_LEVELS[self.low_level].nodes)

    def overrides(self) -> dict[str, Parameters]:
        """For each node to start, by name, the parameters that stand above those of the file."""
        low_level = LOW_LEVELS[self.low_level]
        policy = None if self.policy is None else str(self.policy.resolve())
        urgent: Parameters = URGENT if low_level.urgent else {}
        followers: dict[str, Parameters] = {
            "estimator": {**urgent, **_given(kind=self.estimator)},
            "controller": {**low_level.controller, **urgent, **_given(policy=policy)},
            "command_mux": _given(),
        }
        actuator = None if self.actuator is None else str(self.actuator.resolve())
        simulated = _given(terrain=self.terrain, world=_found(self.world), actuator_file=actuator)
        if simulated and not low_level.simulation:
            raise ValueError(f"{', '.join(simulated)}: only a simulated robot has this, not {self.low_level}")
        serving = dict(low_level.nodes)
        if low_level.simulation:
            mode = _given(mode="lockstep" if self.use_sim_time else None)
            own = serving[low_level.simulation]
            serving[low_level.simulation] = {**own, **simulated, **mode, **self.network}
        if self.use_sim_time:
            followers = {name: {**values, "use_sim_time": True} for name, values in followers.items()}
        return serving | followers

    def arguments(self, view: bool = False) -> dict[str, list[str]]:
        """The same as arguments of ROS 2.

        view: with the node `view`, which is no part of the robot and stays in the time of who looks at it.
        """
        nodes = self.overrides() | ({VIEW: {}} if view else {})
        return {name: arguments(name, values, self.parameters) for name, values in nodes.items()}

    def commands(self, view: bool = False) -> dict[str, list[str]]:
        """The same as command lines, which run each node as a process of its own."""
        return {name: command(name, words) for name, words in self.arguments(view).items()}


def _found(world: str | None) -> str | None:
    """A shipped world's name as it is, a file, which has a suffix, for whatever folder a node runs in."""
    return str(Path(world).resolve()) if world and Path(world).suffix else world


def _given(**values: str | None) -> Parameters:
    return {name: value for name, value in values.items() if value is not None}
