"""Effects of position: offset, spring, cogging, deadband, backlash and hysteresis.

`base` defines the interface; in short: `s` holds signals (q in rad, dq in rad/s), `p` parameters.
An `AddedEffect` returns the torque to add, N m. An `ErrorEffect` changes the errors of the PD law:
e[0] = q_des - q (rad) and e[1] = dq_des - dq (rad/s). A `MemoryEffect` receives `x`, the errors or
the torque, and the signals `u` that `inputs` names.

`recurrence` computes backlash and hysteresis step by step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from . import recurrence
from .base import (
    AddedEffect,
    ErrorEffect,
    Errors,
    Memory,
    MemoryEffect,
    Parameter,
    Params,
    Stage,
    View,
    one_of,
    stage_from_field,
)
from .numerics import evaluate_distinct


class TorqueOffset(AddedEffect):
    """Constant torque; an encoder bias times kp looks the same."""

    name = "torque_offset"
    parameters = (Parameter("offset", "N m", -20.0, 20.0, 0.3),)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return p["offset"] + 0.0 * s.q


class ParallelSpring(AddedEffect):
    """Spring in parallel with the drive: -k (q - q0)."""

    name = "parallel_spring"
    parameters = (Parameter("k", "N m/rad", -200.0, 200.0, 1.0), Parameter("q0", "rad", -30.0, 30.0, 0.3))

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["k"] * (s.q - p["q0"])


class Cogging(AddedEffect):
    """Cogging torque: a sin(n q + phi)."""

    name = "cogging"
    parameters = (
        Parameter("a", "N m", -20.0, 20.0, 0.3),
        Parameter("n", "1/rad", 3.0, 400.0, 0.2),
        Parameter("phi", "rad", -20.0, 20.0, 0.3),
    )

    @override
    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        phi = p["phi"] + np.where(p["a"] < 0.0, np.pi, 0.0)
        return p | {"a": np.abs(p["a"]), "phi": np.remainder(phi + np.pi, 2.0 * np.pi) - np.pi}

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return p["a"] * evaluate_distinct(lambda n, phi: np.sin(n * s.q + phi), p["n"], p["phi"])


@attrs.frozen(eq=False)
class Deadband(ErrorEffect):
    """Deadband of the position error: no response below `width`.

    Beyond it the drive sees the whole error (`edge` hard) or what exceeds `width` (soft).
    """

    name = "deadband"
    parameters = (Parameter("width", "rad", 0.0005, 0.5, 0.01),)
    edge: str = attrs.field(default="soft", validator=one_of("soft", "hard"))

    @override
    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        beyond = np.abs(e[0]) > p["width"]
        less = p["width"] * np.sign(e[0]) if self.edge == "soft" else 0.0
        return np.where(beyond, e[0] - less, 0.0), e[1]


@attrs.frozen(eq=False)
class Backlash(MemoryEffect):
    """Backlash: the drive sees a signal through a gap of +-`gap`.

    `on` selects the signal: the position `q`, the error q_des - q, or the torque.
    """

    name = "backlash"
    stage = stage_from_field("on", error=Stage.ERRORS, q=Stage.ERRORS, torque=Stage.DYNAMICS)
    on: str = attrs.field(default="error", validator=one_of("error", "q", "torque"))

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:
        if self.on == "torque":
            return (Parameter("gap", "N m", 0.01, 50.0, 0.3),)
        return (Parameter("gap", "rad", 0.0002, 0.5, 0.01),)

    inputs = ("q",)

    def _gap_input(self, x: Any, u: Sequence[Array]) -> Array:
        """Select the signal that enters the gap."""
        if self.on == "q":
            return u[0]
        seen: Array = x if self.on == "torque" else x[0]
        return seen

    def _with_gap_output(self, x: Any, u: Sequence[Array], follows: Array) -> Any:
        """Insert the output of the gap into the errors or the torque."""
        if self.on == "torque":
            return follows
        return (follows if self.on == "error" else x[0] + u[0] - follows), x[1]

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (self._gap_input(x, u) + 0.0 * p["gap"],)

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        follows = recurrence.backlash_step(memory[0], self._gap_input(x, u), p["gap"])
        return self._with_gap_output(x, u, follows), (follows,)

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        return self._with_gap_output(
            x, (s.q,), recurrence.backlash_series(self._gap_input(x, (s.q,)), s.start, p["gap"])
        )


class Hysteresis(MemoryEffect):
    """Bouc-Wen hysteresis: -F z, with a state -1 <= z <= 1.

        dz/dq = (1 - (beta + (1 - beta) sign(z dq)) |z|) / reach

    Source: Wen, Journal of the Engineering Mechanics Division 102 (1976).
    """

    name = "hysteresis"
    stage = Stage.ADDED
    parameters = (
        Parameter("F", "N m", 0.0, 30.0, 0.3),
        Parameter("reach", "rad", 0.001, 1.0, 0.03),
        Parameter("beta", "1", 0.0, 1.0, 0.3),
    )
    inputs = ("q",)

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return 0.0 * (u[0] + p["reach"]), u[0]

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        z, before = memory
        z = recurrence.bouc_wen_step(z, (u[0] - before) / p["reach"], p["beta"])
        return -p["F"] * z, (z, u[0])

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        """Apply the effect to a series; z is computed once per distinct curve of a batch."""
        # The torque is proportional to F: solve for z once per distinct (reach, beta) of the batch.
        reach, beta = np.broadcast_arrays(p["reach"], p["beta"])
        if reach.ndim == 1:
            return -p["F"] * recurrence.bouc_wen_series(s.q, s.start, reach, beta)
        curves, which = np.unique(np.concatenate([reach, beta], axis=-1), axis=0, return_inverse=True)
        return (
            -p["F"] * recurrence.bouc_wen_series(s.q, s.start, *np.split(curves, 2, axis=-1))[which.ravel()]
        )


EFFECTS = (TorqueOffset, ParallelSpring, Cogging, Deadband, Backlash, Hysteresis)
