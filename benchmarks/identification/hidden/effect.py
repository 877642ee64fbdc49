"""Interface of a hidden effect to the plant, and the information for drawing its parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.identification.hidden.plant import State, Step, Trace

Maker = Callable[[State, int, float], Step]


@dataclass(frozen=True)
class Effect:
    """One effect on some joints, with its hooks into the plant and its true parameters (SI units).

    Attributes:
        name: Name of the effect.
        joints: Indices of the joints.
        params: True parameters by name.
        hooks: Step makers by stage of the plant.
        armature: Added inertia, kg m^2.
        lose: Draws which commands arrive, and how late (s), from a generator and their number.
        skew: Channel of the log with shifted stamps, and the shift, s.
        temperature: Logged temperature, degrees Celsius, over time, s.
        voltage: Logged voltage at each tick, V.
        signals: For effects outside the registry: the report has to name one of `key`; `all` has a
            list of alternatives for each signal. Signals of other joints have the joint's name.
        also: Names of laws that count as right too.
    """

    name: str
    joints: tuple[int, ...]
    params: dict[str, float]
    hooks: dict[str, Maker] = field(default_factory=dict)
    armature: float = 0.0
    lose: Callable[[np.random.Generator, int], tuple[np.ndarray, np.ndarray]] | None = None
    skew: tuple[str, float] | None = None
    temperature: Callable[[np.ndarray], np.ndarray] | None = None
    voltage: list[float] | None = None
    signals: dict[str, list[Any]] = field(default_factory=dict)
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class Draw:
    """Source of an effect's parameters: chance, strength, and the motion without the effect.

    Attributes:
        rng: Random generator.
        strength: Factor on the size of the effect.
        joints: Indices of the affected joints.
        names: Names of all joints.
        nominal: Series without effects.
        dt: Tick of `nominal`, s.
        duration: Duration of the log, s.
        kp: Commanded position gain, N m/rad.
        kd: Commanded velocity gain, N m s/rad.
        turn: Offset, 1 or 2, of the neighbour among the joints of a leg.
    """

    rng: np.random.Generator
    strength: float
    joints: tuple[int, ...]
    names: list[str]
    nominal: Trace
    dt: float
    duration: float
    kp: float
    kd: float
    turn: int  # 1 or 2: which of the leg's other joints is the neighbour

    def uniform(self, low: float, high: float) -> float:
        """Draw a uniform number between `low` and `high`."""
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        """Draw -1 or 1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def place(self) -> str:
        """Draw where a torque acts: in the drive, before its output delay, or at the joint."""
        return str(self.rng.choice(["drive", "joint"]))

    def smooth_sign_width(self) -> float:
        """Draw the width of a smooth sign, rad/s."""
        return self.uniform(0.02, 0.1)

    def neighbour(self, joint: int) -> int:
        """Return the index of another joint of the same leg."""
        first = joint - joint % 3
        return first + (joint - first + self.turn) % 3

    def torque(self, quantile: float) -> float:
        """Return a quantile of the affected joints' absolute torque, N m."""
        return float(np.quantile(np.abs(self.nominal.tau[:, list(self.joints)]), quantile))

    def speed(self, quantile: float) -> float:
        """Return a quantile of the affected joints' absolute speed, rad/s."""
        return float(np.quantile(np.abs(self.nominal.dq[:, list(self.joints)]), quantile))

    def travel(self) -> float:
        """Return the smallest travel of an affected joint, 2 % to 98 % quantile, rad."""
        q = self.nominal.q[:, list(self.joints)]
        return float(np.min(np.quantile(q, 0.98, axis=0) - np.quantile(q, 0.02, axis=0)))


def smooth(width: float) -> Callable[[float], float]:
    """Return a smooth sign function, tanh(speed / width); `width` in rad/s."""
    tanh = math.tanh
    return lambda speed: tanh(speed / width)
