"""Commands that are lost: the drive continues with an earlier one.

Here the losses are drawn; the identification infers their times from a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from .base import Memory, MemoryEffect, Parameter, Params, Stage


@attrs.frozen(eq=False)
class CommandHold(MemoryEffect):
    """Random loss of each new command with the probability `share`, for all joints together.

    Attributes:
        rng: source of randomness.
    """

    name = "command_hold"
    stage = Stage.ERRORS
    parameters = (Parameter("share", "1", 0.0, 1.0, 0.05),)
    inputs = ("q_des",)
    rng: np.random.Generator = attrs.field(factory=np.random.default_rng, repr=False)

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {}

    @override
    def runtime_form(self, rng: np.random.Generator) -> CommandHold:
        return CommandHold(rng)

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return u[0], u[0]

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        held, before = memory
        fresh = (u[0] != before).any(axis=-1, keepdims=True)
        lost = self.rng.random((*u[0].shape[:-1], 1)) < p["share"]
        held = np.where(fresh & ~lost, u[0], held)
        position_error, speed_error = x
        return (position_error + held - u[0], speed_error), (held, u[0])


EFFECTS = (CommandHold,)
