"""Simulated joints with effects outside the registry, each a change of the actuator model's torque.

Signals have the names of the report. A correct report names one of `signals`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np

from quadvel_sysid.logs.log import Log
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = 4
DT = 0.001
Distort = Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@attrs.frozen
class Odd:
    """An effect outside the registry.

    Attributes:
        make: Creates the law (k, q, dq, tau) -> tau for one log, as it may have memory.
        signals: Signals of which a correct report names one.
        joints: Indices of the affected joints.
    """

    make: Callable[[], Distort]
    signals: tuple[str, ...]
    joints: tuple[int, ...]


def _on(joints: tuple[int, ...], extra: Callable[..., Any]) -> Callable[[], Distort]:
    """A law without memory on these joints."""
    mask = np.isin(np.arange(JOINTS), joints)
    return lambda: lambda k, q, dq, tau: tau + mask * extra(k, q, dq, tau)


def _resonance(frequency: float, damping: float, gain: float, joints: tuple[int, ...]) -> Odd:
    """Resonance of a flexible part that the torque of the joint excites."""
    w = 2.0 * np.pi * frequency
    mask = np.isin(np.arange(JOINTS), joints)

    def make() -> Distort:
        z, dz = np.zeros(JOINTS), np.zeros(JOINTS)

        def distort(k: int, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
            nonlocal z, dz
            dz = dz + DT * (w * w * (tau - z) - 2.0 * damping * w * dz)
            z = z + DT * dz
            return tau + mask * gain * (z - tau)

        return distort

    return Odd(make, ("tau@history",), joints)


def _creep() -> Odd:
    """Spring that relaxes slowly, so that its torque depends on the past of the angle."""
    mask = np.isin(np.arange(JOINTS), (1, 2))

    def make() -> Distort:
        past = np.zeros(JOINTS)

        def distort(k: int, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
            nonlocal past
            past = past + DT / 0.08 * (q - past)
            return tau - mask * 9.0 * (q - past)

        return distort

    return Odd(make, ("q@history",), (1, 2))


def _sign(dq: np.ndarray) -> np.ndarray:
    return np.tanh(dq / 0.05)


def _bump(x: np.ndarray, centre: float, width: float) -> np.ndarray:
    return np.exp(-(((x - centre) / width) ** 2))


ALL = tuple(range(JOINTS))
ODD = {
    "resonance": _resonance(18.0, 0.05, 0.5, (0, 1)),
    "creep": _creep(),
    "rubbing": Odd(_on((2,), lambda k, q, dq, tau: -2.5 * _bump(q, 0.1, 0.06) * _sign(dq)), ("q",), (2,)),
    "ripple_on_a_neighbour": Odd(
        _on((1,), lambda k, q, dq, tau: 0.7 * np.sin(25.0 * q[3])), (f"{NAMES[3]}/q",), (1,)
    ),
    "stiffness_with_error": Odd(
        lambda: _error_stiffness(), ("q_des", "q", "tau"), ALL
    ),
    "hum": Odd(_on(ALL, lambda k, q, dq, tau: 0.3 * np.sin(2 * np.pi * 50.0 * k * DT + 0.4)), ("t",), ALL),
    "friction_with_a_neighbours_load": Odd(
        _on((0,), lambda k, q, dq, tau: -0.4 * np.abs(tau[2]) * _sign(dq)), (f"{NAMES[2]}/tau",), (0,)
    ),
    "drag_in_part_of_the_range": Odd(
        _on((3,), lambda k, q, dq, tau: -0.6 * dq * (q > 0.05)), ("q",), (3,)
    ),
    "gain_over_angle": Odd(_on((0, 1), lambda k, q, dq, tau: 0.5 * np.sin(4.0 * q) * tau), ("q",), (0, 1)),
    "friction_that_wears_in": Odd(
        _on(ALL, lambda k, q, dq, tau: -1.6 * np.exp(-k * DT / 1.5) * _sign(dq)), ("t",), ALL
    ),
    "knocks": Odd(
        _on((2,), lambda k, q, dq, tau: 2.5 * _bump(q, -0.05, 0.01)), ("q",), (2,)
    ),
}  # fmt: skip


def _error_stiffness() -> Distort:
    """Drive whose gain increases with its torque."""
    return lambda k, q, dq, tau: tau + 0.05 * tau * np.abs(tau)


def log(name: str, motion: str = "mixed", seed: int = 0, seconds: float = 5.0, rate: int = 500) -> Log:
    """Simulate and log joints with the effect `name`."""
    truth = attrs.evolve(parameters(), joints=NAMES[:JOINTS])
    return record(truth, JOINTS, seconds, rate, motion, seed, distort=ODD[name].make())
