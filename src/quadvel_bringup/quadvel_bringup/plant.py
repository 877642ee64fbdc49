"""The plant of `quadvel twin`: a simulated robot whose drives do something that the stack's model does not know.

A process of its own, which alone reads its configuration: python -m quadvel_bringup.plant FILE --ros-args ... The
physics here is written from the mechanics and the circuit, apart from the laws that identification fits; the other
processes see what it does to the joints, and nothing else.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description import robot
from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.state import RobotState
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import DT, Simulator

Array = NDArray[np.float64]


class Physics(Protocol):
    """What a drive does to the torque it was asked for; `memory` is all that it remembers."""

    memory: Array

    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        """The torque (12,) N m of the next `dt` (s)."""


@attrs.define
class DryGear:
    """Friction of a gear that runs dry: bristles that bend and slip (the LuGre model). Numbers a joint, (12,)."""

    slip: Array  # N m, sliding
    stick: Array  # N m, breaking away
    stribeck_speed: float = 0.25  # rad/s
    stiffness: float = 250.0  # N m/rad, of the bristles
    memory: Array = attrs.Factory(lambda: np.zeros(12))  # rad, their bending

    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        level = self.slip + (self.stick - self.slip) * np.exp(-((dq / self.stribeck_speed) ** 2))
        rate = self.stiffness * np.abs(dq) / np.maximum(level, 1e-9)
        self.memory = (self.memory + dt * dq) / (1.0 + dt * rate)  # implicit: stiff where the joint runs fast
        return np.where(level > 0.0, asked - self.stiffness * self.memory, asked)


@attrs.define
class SlowCurrent:
    """A weak current loop: proportional control of the current through a winding, with its back-EMF left over."""

    constant: Array  # s, winding over loop gain, (12,)
    droop: Array  # N m s/rad, what the back-EMF takes off the torque, (12,)
    memory: Array = attrs.Factory(lambda: np.full(12, np.nan))  # N m, current times torque constant

    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        end = asked - self.droop * dq
        begin = np.where(np.isnan(self.memory), end, self.memory)
        share = np.exp(-dt / np.maximum(self.constant, 1e-6))
        self.memory = end + (begin - end) * share
        mean = end + (begin - end) * (1.0 - share) * np.maximum(self.constant, 1e-6) / dt
        return np.where(self.constant > 0.0, mean, asked)


@attrs.define
class ChafingCable:
    """A cable that rubs in a part of a joint's range and is drawn tight there: friction and a pull, (12,) each."""

    rub: Array  # N m
    begin: Array  # rad, from where on, towards larger angles
    width: float = 0.08  # rad, over which it comes to lie on
    memory: Array = attrs.Factory(lambda: np.zeros(0))

    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        touching = 0.5 * (1.0 + np.tanh((q - self.begin) / self.width))
        return asked - self.rub * touching * (0.4 + np.tanh(dq / 0.2))


KINDS: dict[str, Callable[..., Physics]] = {
    "dry_gear": DryGear,
    "slow_current": SlowCurrent,
    "chafing_cable": ChafingCable,
}


class HiddenDrives(ActuatorModel):
    """The stack's actuator model with `physics` behind it; torque noise and limit come last."""

    def __init__(self, parameters: ActuatorParameters, physics: Physics, dt: float, seed: int) -> None:
        super().__init__(attrs.evolve(parameters, torque_noise=0.0), dt=dt, seed=seed)
        self._physics = physics
        self._deviation = np.sqrt(parameters.torque_noise)
        self._draws = np.random.default_rng(seed)
        self._next_draw = self._draws.standard_normal(12)

    def step(self, q: Array, dq: Array, *law: Any, **named: Any) -> Array:
        """As `ActuatorModel.step`."""
        torque = self._answer(q, dq, *law, **named)
        self._next_draw = self._draws.standard_normal(12)
        return torque

    def peek(self, q: Array, dq: Array, *law: Any, **named: Any) -> Array:
        """As `ActuatorModel.peek`."""
        memory, draw, draws = self._physics.memory, self._next_draw, self._draws.bit_generator.state
        torque = super().peek(q, dq, *law, **named)
        self._physics.memory, self._next_draw, self._draws.bit_generator.state = memory, draw, draws
        return torque

    def _answer(self, q: Array, dq: Array, *law: Any, **named: Any) -> Array:
        asked = super().step(q, dq, *law, **named)
        torque = self._physics.torque(asked, q, dq, self.dt) + self._deviation * self._next_draw
        return np.clip(torque, -robot.TORQUE_LIMIT, robot.TORQUE_LIMIT)


class Plant(Simulator):
    """A simulated robot with hidden drives, made from a plant's file.

    `log` is given its state every ms, as the board of a robot logs its joints faster than it reports them.
    """

    def __init__(
        self,
        config: SimulatorConfig,
        physics: Callable[[], Physics],
        log: Callable[[RobotState], None] = lambda state: None,
    ) -> None:
        self._make_physics = physics
        self._log = log
        super().__init__(config)

    def step(self, n: int = 1) -> None:
        """As `Simulator.step`."""
        super().step()
        for _ in range(n - 1):
            self.state()
            super().step()

    def state(self) -> RobotState:
        """As `Simulator.state`; logged, as every reading is."""
        state = super().state()
        self._log(state)
        return state

    def _make_actuator(self, seed: int) -> ActuatorModel:
        return HiddenDrives(self.config.actuator, self._make_physics(), DT, seed)


def read_plant(path: Path) -> Callable[[], Physics]:
    """What makes the physics that the file describes. ValueError names file, field and what was expected."""
    content = read_yaml(path, "a YAML file of a plant")
    if not isinstance(content, Mapping) or content.get("kind") not in KINDS:
        found = content.get("kind") if isinstance(content, Mapping) else content
        raise ValueError(f"{path}: kind: found {found!r}, expected one of {', '.join(KINDS)}")
    values = {name: _value(path, name, value) for name, value in content.items() if name != "kind"}
    try:
        KINDS[content["kind"]](**values)
    except TypeError as error:
        raise ValueError(f"{path}: {error}") from None
    return lambda: KINDS[content["kind"]](**values)


def _value(path: Path, name: str, value: Any) -> Any:
    """A number, or numbers by joint (joints that are not named have 0), as (12,)."""
    if isinstance(value, Mapping):
        numbers = np.zeros(12)
        try:
            numbers[robot.joint_index(list(value))] = list(value.values())
        except ValueError as error:
            raise ValueError(f"{path}: {name}: {error}") from None
        return numbers
    if not isinstance(value, (int, float)):
        raise ValueError(f"{path}: {name}: found {value!r}, expected a number, or numbers by joint")
    return float(value)


def main() -> None:
    """FILE, and then what ROS 2 wants. The log of the joints goes to the topic joint_log."""
    path, *arguments = sys.argv[1:]
    try:
        physics = read_plant(Path(path))
    except ValueError as error:
        print(f"plant: {error}", file=sys.stderr)
        sys.exit(2)
    import quadvel_dds

    quadvel_dds.install()
    from quadvel_msgs.msg import LowState
    from quadvel_nodes.messages import write_low_state
    from quadvel_nodes.node import run
    from quadvel_sim.sim_node import SimNode

    class PlantNode(SimNode):
        def __init__(self, physics: Callable[[], Physics]) -> None:
            super().__init__(lambda config: Plant(config, physics, self._log_joints()))

        def _log_joints(self) -> Callable[[RobotState], None]:
            publisher = self.create_publisher(LowState, "joint_log", 10)

            def log(state: RobotState) -> None:
                message = LowState(stamp=self.stamp(state.time))
                write_low_state(state, message)
                publisher.publish(message)

            return log

    run(lambda: PlantNode(physics), ["plant", *arguments])


if __name__ == "__main__":
    main()
