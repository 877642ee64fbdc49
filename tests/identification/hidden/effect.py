"""What an effect is to the plant, and what it may know when its size is drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tests.identification.hidden.plant import State, Step, Trace

Maker = Callable[[State, int, float], Step]


@dataclass(frozen=True)
class Effect:
    """One effect on some joints: where it hooks into the plant, and its true parameters (SI units).

    `signals` says what an effect outside the registry depends on: a report has to name one of `key`; `all` holds a
    set of alternatives for each signal that takes part. Other joints' signals carry that joint's name.
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
    signals: dict[str, list] = field(default_factory=dict)
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class Draw:
    """Where the parameters of an effect come from: chance, its strength, and how the joints move without it."""

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
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def place(self) -> str:
        """In the drive, before its output delay, or at the joint."""
        return str(self.rng.choice(["drive", "joint"]))

    def smooth_sign_width(self) -> float:
        return self.uniform(0.02, 0.1)

    def neighbour(self, joint: int) -> int:
        """Another joint of the same leg."""
        first = joint - joint % 3
        return first + (joint - first + self.turn) % 3

    def torque(self, quantile: float) -> float:
        """The size of torque that the affected joints stay under for this share of time, N m."""
        return float(np.quantile(np.abs(self.nominal.tau[:, list(self.joints)]), quantile))

    def speed(self, quantile: float) -> float:
        return float(np.quantile(np.abs(self.nominal.dq[:, list(self.joints)]), quantile))

    def travel(self) -> float:
        """How far the affected joint that moves least moves, rad."""
        q = self.nominal.q[:, list(self.joints)]
        return float(np.min(np.quantile(q, 0.98, axis=0) - np.quantile(q, 0.02, axis=0)))


def smooth(width: float) -> Callable[[float], float]:
    """A sign that is smooth over speeds of about `width`."""
    tanh = math.tanh
    return lambda speed: tanh(speed / width)
