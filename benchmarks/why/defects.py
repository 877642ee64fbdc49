"""Defects of the blind suite: 32 kinds, four strengths each, drawn from a seed.

`make_defect(kind, strength, rng)` returns the defect. The kinds are the names that a diagnosis is expected to give;
`ALSO_RIGHT` lists further names that are right for a kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from quadvel_actuator.parameters import ActuatorParameters, Effect
from quadvel_description.arrays import Array
from quadvel_description.network_input import InputLayout
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.state import JointCommand, RobotState
from quadvel_policy.modes import Policy
from quadvel_sim.simulator import Simulator
from quadvel_sim.terrain import Terrain
from tests.helpers.robots import ALIENGO

from .walks import TICK_MS, Defect, Velocity

Rng = np.random.Generator
SWAPS = {
    "left and right": [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8],
    "front and rear": [6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5],
    "by kind": [0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11],
    "diagonal": [9, 10, 11, 6, 7, 8, 3, 4, 5, 0, 1, 2],
}
ALSO_RIGHT: Mapping[str, Sequence[str]] = {}


def _joints(state: RobotState, change: Callable[[Array], Array], fields: Sequence[str]) -> RobotState:
    return attrs.evolve(state, **{f: change(getattr(state, f)) for f in fields})


@attrs.define
class JointOrder(Defect):
    """The drives receive commands in another order, or states and commands come in another order."""

    order: list[int]
    both: bool

    @override
    def reported(self, state: RobotState) -> RobotState:
        return _joints(state, lambda x: x[self.order], ("q", "dq", "tau")) if self.both else state

    @override
    def received(self, command: JointCommand) -> JointCommand:
        where = np.argsort(self.order)
        return attrs.evolve(
            command, **{f: getattr(command, f)[where] for f in ("q", "dq", "tau", "kp", "kd")}
        )


@attrs.define
class JointSign(Defect):
    """Some joints count the other way, for the drives alone or for states and commands."""

    sign: Array
    both: bool

    @override
    def reported(self, state: RobotState) -> RobotState:
        return _joints(state, lambda x: x * self.sign, ("q", "dq", "tau")) if self.both else state

    @override
    def received(self, command: JointCommand) -> JointCommand:
        return attrs.evolve(command, **{f: getattr(command, f) * self.sign for f in ("q", "dq", "tau")})


@attrs.define
class JointOffset(Defect):
    """The zero of some joints is off, for the states alone or for states and commands."""

    offset: Array
    both: bool

    @override
    def reported(self, state: RobotState) -> RobotState:
        return attrs.evolve(state, q=state.q + self.offset)

    @override
    def received(self, command: JointCommand) -> JointCommand:
        return attrs.evolve(command, q=command.q - self.offset) if self.both else command


@attrs.define
class JointScale(Defect):
    """Angles or speeds of some joints have another unit or gear ratio."""

    q: Array
    dq: Array

    @override
    def reported(self, state: RobotState) -> RobotState:
        return attrs.evolve(state, q=state.q * self.q, dq=state.dq * self.dq)


@attrs.define
class Gains(Defect):
    """The drives act with other gains than commanded."""

    kp: float
    kd: float

    @override
    def received(self, command: JointCommand) -> JointCommand:
        return attrs.evolve(command, kp=self.kp * command.kp, kd=self.kd * command.kd)


@attrs.define
class Imu(Defect):
    """The orientation or the angular velocity is reported in another convention."""

    quaternion: Callable[[Array], Array] = lambda x: x
    gyro: Callable[[Array, Array], Array] = lambda w, _: w

    @override
    def reported(self, state: RobotState) -> RobotState:
        w = self.gyro(state.angular_velocity, state.quaternion)
        return attrs.evolve(state, quaternion=self.quaternion(state.quaternion), angular_velocity=w)


class _Wrapped:
    """A policy whose input, output or memory is treated wrongly."""

    def __init__(self, policy: Policy) -> None:
        self.inner, self.metadata = policy, policy.metadata

    def reset(self) -> None:
        self.inner.reset()

    def prepare(self) -> None:
        pass

    def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self.inner.step(observation)


@attrs.define
class Observation(Defect):
    """The controller builds another observation: `change` acts on the finished vector."""

    change: Callable[[NDArray[np.float32], InputLayout], NDArray[np.float32]]

    @override
    def policy(self, policy: Policy) -> Policy:
        change = self.change

        class Changed(_Wrapped):
            def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
                return self.inner.step(change(observation.copy(), self.metadata.observation))

        return Changed(policy)


@attrs.define
class ActionScale(Defect):
    """The controller scales the actions by another factor."""

    factor: float

    @override
    def policy(self, policy: Policy) -> Policy:
        changed = _Wrapped(policy)
        scale = tuple(self.factor * x for x in policy.metadata.action_scale)
        changed.metadata = attrs.evolve(policy.metadata, action_scale=scale)
        return changed


@attrs.define
class MemoryReset(Defect):
    """The memory of the network is cleared every few ticks."""

    every: int

    @override
    def policy(self, policy: Policy) -> Policy:
        every = self.every

        class Forgetful(_Wrapped):
            ticks = 0

            def reset(self) -> None:
                self.ticks = 0
                self.inner.reset()

            def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
                if self.ticks % every == 0:
                    self.inner.reset()
                self.ticks += 1
                return self.inner.step(observation)

        return Forgetful(policy)


@attrs.define
class MemoryKept(Defect):
    """The memory of an earlier run is still there when the walk begins."""

    size: float
    seed: int

    @override
    def policy(self, policy: Policy) -> Policy:
        size, seed = self.size, self.seed

        class Remembering(_Wrapped):
            def reset(self) -> None:
                self.inner.reset()
                rng = np.random.default_rng(seed)
                for _ in range(100):
                    self.inner.step((size * rng.standard_normal(48)).astype(np.float32))

        return Remembering(policy)


@attrs.define
class PolicyRate(Defect):
    """The controller answers every n-th state only."""

    every: int
    plant: dict[str, Any] = attrs.field(factory=lambda: {"watchdog": 0.1})

    @override
    def answers(self, tick: int) -> bool:
        return tick % self.every == 0


@attrs.define
class Jitter(Defect):
    """The controller answers after a random time."""

    longest_ms: int
    rng: Rng
    plant: dict[str, Any] = attrs.field(factory=lambda: {"watchdog": 0.1})

    @override
    def latency_ms(self) -> int:
        return int(self.rng.integers(0, self.longest_ms + 1))


@attrs.define
class RepeatedStates(Defect):
    """The driver publishes an old state again, with a new stamp."""

    share: float
    rng: Rng
    last: RobotState | None = None

    @override
    def reported(self, state: RobotState) -> RobotState:
        if self.last is not None and state.time > 0.3 and self.rng.random() < self.share:
            return attrs.evolve(self.last, time=state.time, tick=state.tick)
        self.last = state
        return state


@attrs.define
class LostCommands(Defect):
    """Commands are lost on the way to the drives."""

    share: float
    rng: Rng
    plant: dict[str, Any] = attrs.field(factory=lambda: {"watchdog": 0.1})

    @override
    def received(self, command: JointCommand) -> JointCommand | None:
        return None if self.rng.random() < self.share else command


@attrs.define
class Delay(Defect):
    """Commands need longer to the drives."""

    ms: int
    plant: dict[str, Any] = attrs.field(factory=lambda: {"watchdog": 0.1})

    @override
    def transport_ms(self) -> int:
        return self.ms


@attrs.define
class Encoder(Defect):
    """The encoder of a joint reads zero, or keeps its last value, for some ticks again and again."""

    joint: int
    held: bool
    every: int
    ticks: int
    last: tuple[float, float] = (0.0, 0.0)

    @override
    def reported(self, state: RobotState) -> RobotState:
        phase = (state.tick // TICK_MS + 7 * self.joint) % self.every
        if state.time > 0.3 and phase < self.ticks:
            q, dq = state.q.copy(), state.dq.copy()
            q[self.joint], dq[self.joint] = self.last if self.held else (0.0, 0.0)
            return attrs.evolve(state, q=q, dq=dq)
        self.last = float(state.q[self.joint]), float(state.dq[self.joint])
        return state


@attrs.define
class Estimate(Defect):
    """The published velocity is off."""

    bias: Array = attrs.field(factory=lambda: np.zeros(3))
    scale: float = 1.0
    lag: int = 0
    past: list[Array] = attrs.field(factory=list)

    @override
    def estimate(self, velocity: Array) -> Array:
        self.past.append(self.scale * velocity + self.bias)
        return self.past[max(len(self.past) - 1 - self.lag, 0)]


@attrs.define
class Plant(Defect):
    """A robot or a ground that differs, and velocities that differ."""

    plant: dict[str, Any]
    fastest: float | None = None
    jammed: tuple[int, float] | None = None
    after: float = 0.9
    degrees: Array | None = None

    @override
    def at(self, simulator: Simulator, time: float) -> None:
        if self.jammed is not None and time >= self.after:
            simulator.model.dof_frictionloss[6 + self.jammed[0]] = self.jammed[1]

    @override
    def velocities(self, wanted: Velocity) -> Velocity:
        return wanted if self.fastest is None else (self.fastest, 0.0, 0.0)

    @override
    def temperatures(self, time: float) -> Array:
        usual = super().temperatures(time)
        return usual if self.degrees is None else self.degrees + usual - 42.0


@attrs.define
class WeakDrive(Defect):
    """One drive gives a share of its torque."""

    joint: int
    share: float

    @override
    def received(self, command: JointCommand) -> JointCommand:
        factor = np.ones(12)
        factor[self.joint] = self.share
        return attrs.evolve(command, **{f: factor * getattr(command, f) for f in ("kp", "kd", "tau")})


def _flip(joints: Sequence[int]) -> Array:
    sign = np.ones(12)
    sign[list(joints)] = -1.0
    return sign


def _place(joints: Sequence[int], value: float, base: float = 0.0) -> Array:
    values = np.full(12, base)
    values[list(joints)] = value
    return values


def _actuator(**fields: Any) -> dict[str, Any]:
    return {"actuator": attrs.evolve(ActuatorParameters.of(ALIENGO), **fields)}


def _speed_limit(stall: float, no_load: float) -> dict[str, Any]:
    effect = Effect("torque_speed_limit", JOINT_NAMES, {"stall": stall, "no_load": no_load})
    return _actuator(effects=(effect,))


def _term(layout: InputLayout, name: str) -> slice:
    first = 0
    for term in layout.terms:
        if term.name == name:
            return slice(first, first + term.size)
        first += term.size
    raise KeyError(name)


def _scaled(name: str, factor: float) -> Observation:
    def change(x: NDArray[np.float32], layout: InputLayout) -> NDArray[np.float32]:
        x[_term(layout, name)] *= factor
        return x

    return Observation(change)


def _swapped(first: str, second: str) -> Observation:
    def change(x: NDArray[np.float32], layout: InputLayout) -> NDArray[np.float32]:
        a, b = _term(layout, first), _term(layout, second)
        x[a], x[b] = x[b].copy(), x[a].copy()
        return x

    return Observation(change)


def _reordered(order: Sequence[int]) -> Observation:
    def change(x: NDArray[np.float32], layout: InputLayout) -> NDArray[np.float32]:
        for name in ("q", "dq"):
            place = _term(layout, name)
            x[place] = x[place][list(order)]
        return x

    return Observation(change)


def _world(w: Array, quaternion: Array) -> Array:
    from quadvel_description.kinematics import rotate

    return rotate(quaternion, w)


def _conjugate(q: Array) -> Array:
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


Maker = Callable[[int, Rng], Defect]
ISAAC = [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
DEFECTS: dict[str, Maker] = {
    "joint_order": lambda s, r: [
        JointOrder(SWAPS["left and right"], False),
        JointOrder(SWAPS["front and rear"], False),
        JointOrder(SWAPS["left and right"], True),
        JointOrder(SWAPS["by kind"], False),
    ][s],
    "joint_sign": lambda s, r: JointSign(
        _flip([[0, 6], [3 * r.integers(4) + 1], [0, 3, 6, 9], [3 * r.integers(4)]][s]), s >= 2
    ),
    "joint_offset": lambda s, r: JointOffset(
        _place([r.integers(12)], r.choice([-1, 1]) * (0.06, 0.12, 0.12, 0.25)[s]), s % 2 == 1
    ),
    "joint_scale": lambda s, r: [
        JointScale(_place([r.integers(12)], 1.25, 1.0), np.ones(12)),
        JointScale(np.ones(12), np.full(12, 180 / np.pi)),
        JointScale(_place([k := int(r.integers(12))], 0.7, 1.0), _place([k], 0.7, 1.0)),
        JointScale(np.full(12, 180 / np.pi), np.ones(12)),
    ][s],
    "gains": lambda s, r: Gains(*((0.8, 1.0), (1.3, 1.3), (0.6, 1.4), (1.0, 3.0))[s]),
    "quaternion_order": lambda s, r: Imu(
        quaternion=(_conjugate, lambda q: q[[1, 2, 3, 0]], lambda q: q[[3, 0, 1, 2]], _conjugate)[s]
    ),
    "gyro_frame": lambda s, r: Imu(
        gyro=(
            lambda w, q: w * [1, -1, -1],
            lambda w, q: w * 180 / np.pi,
            lambda w, q: w[[1, 0, 2]],
            lambda w, q: -w,
        )[s]
    ),
    "observation_scale": lambda s, r: [
        _scaled("dq", 2.0),
        _scaled("angular_velocity", 4.0),
        _scaled("q", 0.5),
        _scaled("linear_velocity", 2.0),
    ][s],
    "observation_order": lambda s, r: [
        _swapped("linear_velocity", "angular_velocity"),
        _reordered(SWAPS["left and right"]),
        _reordered(ISAAC),
        _swapped("q", "dq"),
    ][s],
    "action_scale": lambda s, r: ActionScale((0.85, 1.25, 0.5, 1.6)[s]),
    "memory_reset": lambda s, r: MemoryReset((20, 5, 2, 1)[s]),
    "memory_kept": lambda s, r: MemoryKept((0.5, 1.0, 2.0, 5.0)[s], int(r.integers(1000))),
    "policy_rate": lambda s, r: PolicyRate((2, 3, 4, 5)[s]),
    "jitter": lambda s, r: Jitter((4, 7, 10, 14)[s], r),
    "repeated_states": lambda s, r: RepeatedStates((0.05, 0.2, 0.4, 0.6)[s], r),
    "lost_commands": lambda s, r: LostCommands((0.05, 0.15, 0.3, 0.5)[s], r),
    "long_delay": lambda s, r: Delay((8, 12, 16, 25)[s]),
    "encoder_dropout": lambda s, r: Encoder(
        int(r.integers(12)), False, (200, 80, 40, 10)[s], (1, 2, 3, 3)[s]
    ),
    "encoder_held": lambda s, r: Encoder(int(r.integers(12)), True, (200, 80, 40, 20)[s], (4, 6, 10, 15)[s]),
    "estimate_bias": lambda s, r: Estimate(
        bias=_place([r.integers(2)], r.choice([-1, 1]) * (0.2, 0.3, 0.5, 0.7)[s])[:3]
    ),
    "estimate_scale": lambda s, r: Estimate(scale=(0.7, 1.5, 0.4, -1.0)[s]),
    "estimate_lag": lambda s, r: Estimate(lag=(10, 20, 40, 80)[s]),
    "torque_limit": lambda s, r: Plant(_actuator(torque_limit=(22.0, 18.0, 14.0, 10.0)[s])),
    "speed_torque_limit": lambda s, r: Plant(
        _speed_limit(*((30.0, 12.0), (24.0, 10.0), (30.0, 7.0), (20.0, 6.0))[s])
    ),
    "temperature": lambda s, r: Plant(
        _actuator(delta_kp=-30.0 * (0.0, 0.1, 0.2, 0.35)[s], delta_kd=-0.5 * (0.0, 0.1, 0.2, 0.35)[s]),
        degrees=_place(range(3 * (s % 2), 12, 3), (84.0, 88.0, 95.0, 110.0)[s], 60.0),
    ),
    "weak_drive": lambda s, r: WeakDrive(int(r.integers(12)), (0.7, 0.5, 0.25, 0.0)[s]),
    "jammed_joint": lambda s, r: Plant({}, jammed=(int(r.integers(12)), (12.0, 25.0, 60.0, 500.0)[s])),
    "slipping": lambda s, r: Plant({"friction": (0.2, 0.15, 0.1, 0.05)[s]}),
    "steep_ground": lambda s, r: Plant(
        {"terrain": Terrain(kind="slope", slope=float(r.choice([-1, 1])) * (0.32, 0.37, 0.42, 0.47)[s])}
    ),
    "rough_ground": lambda s, r: Plant(
        {
            "terrain": Terrain(
                kind="rough", roughness=(0.10, 0.13, 0.17, 0.22)[s], wavelength=0.6, seed=int(r.integers(99))
            )
        },
        fastest=1.2,  # the ground is level where the robot starts
    ),
    "payload": lambda s, r: Plant({"payload": (7.0, 9.0, 12.0, 16.0)[s]}),
    "command_out_of_range": lambda s, r: Plant({}, fastest=(3.2, 3.6, 4.0, 4.4)[s]),
}
"""Maker of each kind, from strength (0 to 3) and random generator."""
NOMINAL = ALIENGO.nominal_q


def make_defect(kind: str, strength: int, rng: Rng) -> Defect:
    """The defect of a kind; `none` for a robot without one."""
    return Defect() if kind == "none" else DEFECTS[kind](strength, rng)
