"""The plant of `quadvel twin`: a simulated robot with a hidden effect in its drives.

The stack's model lacks that effect. The plant runs in its own process, which alone reads its
configuration: python -m quadvel_lab.plant FILE --ros-args ... The physics is written from mechanics
and circuit theory, separately from the effects that identification fits.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.arrays import Array
from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.fields import field
from quadvel_description.quadruped import joint_index
from quadvel_description.records import structure_record
from quadvel_description.state import RobotState
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import DT, Simulator


class HiddenPhysics(Protocol):
    """An effect on the torque of a drive.

    Attributes:
        memory: Its complete state; `torque` replaces the array and never changes it in place.
    """

    memory: Array

    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        """Compute the joint torque.

        Args:
            asked: Torque that the stack's own model predicts, (12,) N m.
            q: (12,) rad.
            dq: (12,) rad/s.
            dt: Time step, s.

        Returns:
            Torque (12,) N m during the next step.
        """


@attrs.define(kw_only=True)
class DryGear(HiddenPhysics):
    """Friction of a dry gear: the LuGre bristle model (Canudas de Wit et al., 1995).

    Attributes:
        slip: Coulomb friction F_c, (12,) N m.
        stick: Static friction F_s, (12,) N m.
        stribeck_speed: Stribeck speed v_s, rad/s.
        stiffness: Stiffness sigma_0 of the bristles, N m/rad.
        memory: Deflection z of the bristles, (12,) rad.
    """

    slip: Array = field(size=12)
    stick: Array = field(size=12)
    stribeck_speed: float = 0.25
    stiffness: float = 250.0
    memory: Array = attrs.Factory(lambda: np.zeros(12))

    @override
    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        # LuGre model with bristle deflection z and friction F = sigma_0 z:
        #     g(v) = F_c + (F_s - F_c) exp(-(v / v_s)^2),  dz/dt = v - sigma_0 |v| z / g(v)
        # The decay term is integrated implicitly, because it is stiff at high speed:
        #     z <- (z + dt v) / (1 + dt sigma_0 |v| / g(v))
        level = self.slip + (self.stick - self.slip) * np.exp(-((dq / self.stribeck_speed) ** 2))
        rate = self.stiffness * np.abs(dq) / np.maximum(level, 1e-9)
        self.memory = (self.memory + dt * dq) / (1.0 + dt * rate)
        return np.where(level > 0.0, asked - self.stiffness * self.memory, asked)


@attrs.define(kw_only=True)
class SlowCurrent(HiddenPhysics):
    """A slow current loop: proportional current control of a winding, with uncompensated back-EMF.

    Attributes:
        constant: Time constant of the loop, (12,) s: inductance over loop gain.
        droop: Torque lost to the back-EMF, (12,) N m s/rad.
        memory: Current times torque constant, (12,) N m; NaN before the first step.
    """

    constant: Array = field(size=12)
    droop: Array = field(size=12)
    memory: Array = attrs.Factory(lambda: np.full(12, np.nan))

    @override
    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        # First-order lag towards tau_end = tau_asked - droop dq:
        #     tau(t) = tau_end + (tau_0 - tau_end) exp(-t / T)
        # The result is its mean over the step:
        #     tau_end + (tau_0 - tau_end) (1 - exp(-dt / T)) T / dt
        end = asked - self.droop * dq
        begin = np.where(np.isnan(self.memory), end, self.memory)
        share = np.exp(-dt / np.maximum(self.constant, 1e-6))
        self.memory = end + (begin - end) * share
        mean = end + (begin - end) * (1.0 - share) * np.maximum(self.constant, 1e-6) / dt
        return np.where(self.constant > 0.0, mean, asked)


@attrs.define(kw_only=True)
class ChafingCable(HiddenPhysics):
    """Friction of a cable that chafes in a part of a joint's range, and its constant pull.

    Attributes:
        rub: Friction, (12,) N m; the pull is 0.4 times as large.
        begin: Angle where the contact starts, towards larger angles, (12,) rad.
        width: Range over which the contact builds up, rad.
        memory: Empty; the effect has no state.
    """

    rub: Array = field(size=12)
    begin: Array = field(size=12)
    width: float = 0.08
    memory: Array = attrs.Factory(lambda: np.zeros(0))

    @override
    def torque(self, asked: Array, q: Array, dq: Array, dt: float) -> Array:
        # Contact share c(q) = (1 + tanh((q - q_0) / w)) / 2; tau = tau_asked - r c (0.4 + tanh(dq / 0.2)).
        touching = 0.5 * (1.0 + np.tanh((q - self.begin) / self.width))
        return asked - self.rub * touching * (0.4 + np.tanh(dq / 0.2))


PLANT_KINDS: dict[str, type[HiddenPhysics]] = {
    "dry_gear": DryGear,
    "slow_current": SlowCurrent,
    "chafing_cable": ChafingCable,
}


class HiddenDrives(ActuatorModel):
    """The stack's actuator model followed by a hidden effect, torque noise and the torque limit.

    Args:
        parameters: The stack's actuator parameters.
        physics: The hidden effect.
        torque_limit: Torque limit of the drives, (12,), N m.
        dt: Time step, s.
        seed: Seed of the noise.
    """

    def __init__(
        self,
        parameters: ActuatorParameters,
        physics: HiddenPhysics,
        torque_limit: Array,
        dt: float,
        seed: int,
    ) -> None:
        super().__init__(attrs.evolve(parameters, torque_noise=0.0), dt=dt, seed=seed)
        self._physics, self._torque_limit = physics, torque_limit
        self._deviation = np.sqrt(parameters.torque_noise)
        self._draws = np.random.default_rng(seed)
        self._next_draw = self._draws.standard_normal(12)

    def step(self, q: Array, dq: Array, *arguments: Any, **named: Any) -> Array:
        """Advance one step, as `ActuatorModel.step`.

        Args:
            q: (12,) rad.
            dq: (12,) rad/s.
            arguments: Further arguments of `ActuatorModel.step`.
            named: Further arguments of `ActuatorModel.step`.

        Returns:
            Torque (12,) N m.
        """
        torque = self._answer(q, dq, *arguments, **named)
        self._next_draw = self._draws.standard_normal(12)
        return torque

    def peek(self, q: Array, dq: Array, *arguments: Any, **named: Any) -> Array:
        """Return the torque of the next step without a change of state, as `ActuatorModel.peek`.

        Args:
            q: (12,) rad.
            dq: (12,) rad/s.
            arguments: Further arguments of `ActuatorModel.peek`.
            named: Further arguments of `ActuatorModel.peek`.

        Returns:
            Torque (12,) N m.
        """
        # The base class calls `step`, which changes the memory and draws noise.
        memory, draw, draws = self._physics.memory, self._next_draw, self._draws.bit_generator.state
        torque = super().peek(q, dq, *arguments, **named)
        self._physics.memory, self._next_draw, self._draws.bit_generator.state = memory, draw, draws
        return torque

    def _answer(self, q: Array, dq: Array, *arguments: Any, **named: Any) -> Array:
        """Return the torque of one step with the present noise."""
        asked = super().step(q, dq, *arguments, **named)
        torque = self._physics.torque(asked, q, dq, self.dt) + self._deviation * self._next_draw
        return np.clip(torque, -self._torque_limit, self._torque_limit)


class Plant(Simulator):
    """A simulated robot with hidden drives.

    Args:
        config: Configuration of the simulator.
        physics: Makes the hidden effect.
        log: Is called with the state every ms, as a robot's board logs; the stack gets 200 Hz only.
    """

    def __init__(
        self,
        config: SimulatorConfig,
        physics: Callable[[], HiddenPhysics],
        log: Callable[[RobotState], None] = lambda state: None,
    ) -> None:
        self._make_physics = physics
        self._log = log
        super().__init__(config)

    def step(self, n: int = 1) -> None:
        """Advance and log each ms, as `Simulator.step`.

        Args:
            n: Number of steps of 1 ms.
        """
        super().step()
        for _ in range(n - 1):
            self.state()
            super().step()

    def state(self) -> RobotState:
        """Read and log the state, as `Simulator.state`.

        Returns:
            The state with sensor noise.
        """
        state = super().state()
        self._log(state)
        return state

    def _make_actuator(self, seed: int) -> ActuatorModel:
        """Make the hidden drives."""
        return HiddenDrives(
            self.config.actuator, self._make_physics(), self.config.robot.torque_limit, DT, seed
        )


def read_plant(path: Path) -> Callable[[], HiddenPhysics]:
    """Read the file of a plant.

    Args:
        path: YAML file with `kind` and the parameters of that class.

    Returns:
        A function that makes the hidden effect.

    Raises:
        ValueError: The content is wrong; the sentence names file, field and expectation.
    """
    content = read_yaml(path, "a YAML file of a plant")
    fields = dict(content) if isinstance(content, Mapping) else {"kind": content}
    kind = fields.pop("kind", None)
    if not isinstance(kind, str) or kind not in PLANT_KINDS:
        raise ValueError(f"{path}: kind: found {kind!r}, expected one of {', '.join(PLANT_KINDS)}")
    values = {name: _by_joint(path, name, value) for name, value in fields.items()}
    make = partial(structure_record, PLANT_KINDS[kind], values, path)
    make()  # refuse wrong fields now
    return make


def _by_joint(path: Path, name: str, value: Any) -> Any:
    """Convert numbers by joint to (12,), 0 for missing joints; leave any other value."""
    if not isinstance(value, Mapping):
        return value
    numbers = np.zeros(12)
    try:
        numbers[joint_index(list(value))] = list(value.values())
    except ValueError as error:
        raise ValueError(f"{path}: {name}: {error}") from None
    return numbers


def main() -> None:
    """Run the plant with the arguments FILE and those of ROS 2.

    The joint log goes to the topic joint_log.
    """
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
        def __init__(self, physics: Callable[[], HiddenPhysics]) -> None:
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
