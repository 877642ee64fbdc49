"""The nodes that make a walking robot, and the parameters that each of them gets."""

from __future__ import annotations

import json
from pathlib import Path

import attrs

from .nodes import command

PARAMETERS = Path(__file__).parent / "config" / "params.yaml"
"""The shipped values of all nodes' parameters."""

Parameters = dict[str, bool | str]


@attrs.frozen
class LowLevel:
    """What serves low_state and low_cmd: its nodes, and what it wants of the controller."""

    nodes: tuple[str, ...]
    controller: Parameters


LOW_LEVELS = {
    "sim": LowLevel(("sim_node",), {"auto_stand": True, "robot_waits": True}),
    # Started by somebody else, and perhaps a real robot: it stands up and walks only on an operator's call.
    "external": LowLevel((), {"auto_stand": False, "require_operator": True}),
}


@attrs.frozen(kw_only=True)
class Stack:
    """What may be chosen; None leaves what the parameter file says.

    use_sim_time: the simulator sets the pace, waiting for the answer to each of its states; all others follow
    its clock.
    """

    low_level: str = attrs.field(default="sim", validator=attrs.validators.in_(LOW_LEVELS))
    parameters: Path = attrs.field(default=PARAMETERS, converter=Path)
    policy: Path | None = None
    terrain: str | None = None
    actuator: Path | None = None
    estimator: str | None = None
    use_sim_time: bool = False

    @property
    def simulates(self) -> bool:
        """Whether it brings the robot itself."""
        return bool(LOW_LEVELS[self.low_level].nodes)

    def overrides(self) -> dict[str, Parameters]:
        """For each node to start, by name, the parameters that stand above those of the file."""
        low_level = LOW_LEVELS[self.low_level]
        policy = None if self.policy is None else str(self.policy.resolve())
        followers = {
            "estimator": _given(kind=self.estimator),
            "controller": low_level.controller | _given(policy=policy),
            "command_mux": _given(),
        }
        actuator = None if self.actuator is None else str(self.actuator.resolve())
        simulated = _given(terrain=self.terrain, actuator_file=actuator)
        if simulated and not low_level.nodes:
            raise ValueError(f"{', '.join(simulated)}: only a simulated robot has this, not {self.low_level}")
        serving = dict.fromkeys(low_level.nodes, simulated)
        if self.use_sim_time:
            serving = {name: values | {"mode": "lockstep"} for name, values in serving.items()}
            followers = {name: values | {"use_sim_time": True} for name, values in followers.items()}
        return serving | followers

    def arguments(self) -> dict[str, list[str]]:
        """The same as arguments of ROS 2."""
        return {name: self._arguments(values) for name, values in self.overrides().items()}

    def commands(self) -> dict[str, list[str]]:
        """The same as command lines, which run each node as a process of its own."""
        return {name: command(name, arguments) for name, arguments in self.arguments().items()}

    def _arguments(self, values: Parameters) -> list[str]:
        arguments = ["--ros-args", "--params-file", str(self.parameters.resolve())]
        for name, value in values.items():
            # JSON is YAML with quotes, and without them a file named "1" would be a number.
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        return arguments


def _given(**values: str | None) -> Parameters:
    return {name: value for name, value in values.items() if value is not None}
