"""The nodes that make a walking robot, and the arguments that each of them gets."""

from __future__ import annotations

import json
from pathlib import Path

import attrs

PARAMETERS = Path(__file__).parent / "config" / "params.yaml"
"""The shipped values of all nodes' parameters."""

LOW_LEVELS = {"sim": "sim_node"}
"""What may serve low_state and low_cmd, and the node that does."""


@attrs.frozen(kw_only=True)
class Stack:
    """What may be chosen; None leaves a node's own default, or what the parameter file says."""

    low_level: str = attrs.field(default="sim", validator=attrs.validators.in_(LOW_LEVELS))
    parameters: Path = attrs.field(default=PARAMETERS, converter=Path)
    policy: Path | None = None
    terrain: str | None = None
    estimator: str | None = None
    use_sim_time: bool = False

    def nodes(self) -> dict[str, list[str]]:
        """The ROS 2 arguments of each node to start, by the node's name."""
        chosen: dict[str, dict[str, object]] = {
            LOW_LEVELS[self.low_level]: {"terrain": self.terrain},
            "estimator": {"kind": self.estimator},
            "controller": {"policy": self.policy and self.policy.resolve()},
            "command_mux": {},
        }
        return {name: self._arguments(values) for name, values in chosen.items()}

    def _arguments(self, values: dict[str, object]) -> list[str]:
        arguments = ["--ros-args", "--params-file", str(self.parameters.resolve())]
        if self.use_sim_time:
            arguments += ["-p", "use_sim_time:=true"]
        for name, value in values.items():
            if value is not None:
                # Quoted, because ROS 2 reads values as YAML and a file may be named "1" or "on".
                arguments += ["-p", f"{name}:={json.dumps(str(value))}"]
        return arguments
