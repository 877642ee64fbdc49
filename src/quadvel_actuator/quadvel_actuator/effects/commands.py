"""Commands that are lost or late: the drive continues with an earlier one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from .base import ErrorLaw, Errors, InitialGuess, Memory, MemoryLaw, Parameter, Params, Stage, View

MAX_BACKLOG = 6
"""Largest number of commands lost in a row that is considered"""


@attrs.frozen(eq=False)
class CommandHold(ErrorLaw):
    """Loss of commands: a `share` of the commands acts late or never.

    Which commands were lost is inferred from the measured torque, so `odds` are a posterior given
    this log and not available for prediction. A running model draws its losses at random.

    Attributes:
        odds: (N, J, most + 1), probability that the drive is 0, 1, ... commands behind at each row.
        usual: (most + 1,), the same for any row.
    """

    name = "command_hold"
    parameters = (Parameter("share", "1", 0.0, 1.0, 0.05),)
    signal = "q_des@history"
    shifts = True
    all_joints_together = True
    motion = "commands that change at every sending, with the sender's sequence number logged"
    odds: Array | None = attrs.field(default=None, repr=False)
    usual: Array | None = attrs.field(default=None, repr=False)

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {}

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[CommandHold]:
        return tuple(cls(*odds) for odds in about.lost_commands)

    @override
    def predictive(self) -> CommandHold:
        if self.odds is None or self.usual is None:
            return self
        return attrs.evolve(self, odds=np.broadcast_to(self.usual, self.odds.shape))

    @override
    def record_statistics(self) -> dict[str, float]:
        """Return the share of samples at which another command than the newest was in force."""
        return {} if self.odds is None else {"samples_hit": float(1.0 - self.odds[..., 0].mean())}

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        if self.odds is None:
            return [{"share": 0.05}]
        fresh = np.diff(s.packet[:, 0], prepend=s.packet[0, 0] - 1) > 0
        share = 1.0 - self.odds[s.row[fresh, 0], :, 0].mean(axis=0)
        return [{"share": share}]

    @override
    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        if self.odds is None:
            return e
        odds, joint = self.odds[s.row[:, 0]], np.arange(s.q.shape[-1])
        # Expected position target given the odds p_b of being b commands behind:
        #     q_des + sum_b p_b (sent[packet - b] - q_des)
        late = sum(
            odds[..., behind] * (s.sent[np.maximum(s.packet - behind, 0), joint] - s.q_des)
            for behind in range(1, odds.shape[-1])
        )
        return e[0] + late, e[1]

    @override
    def sampling_error(self, p: Params, s: View) -> dict[str, Array]:
        """Binomial error of a share, with one trial per command."""
        share, count = p["share"], len(np.unique(s.packet))
        return {"share": 2.0 * np.sqrt(share * (1.0 - share) / count) + 1.0 / count}

    @override
    def runtime_form(self, rng: np.random.Generator) -> _RandomCommandLoss:
        return _RandomCommandLoss(rng)


@attrs.frozen(eq=False)
class _RandomCommandLoss(MemoryLaw):
    """Random loss of each new command with the probability `share`, for all joints together."""

    name = CommandHold.name
    stage = Stage.ERRORS
    parameters = CommandHold.parameters
    inputs = ("q_des",)
    rng: np.random.Generator

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return []  # runs only; `CommandHold` is the form to identify

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return u[0], u[0]

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        held, before = memory
        fresh = (u[0] != before).any(axis=-1, keepdims=True)
        lost = self.rng.random((*u[0].shape[:-1], 1)) < p["share"]
        held = np.where(fresh & ~lost, u[0], held)
        return (x[0] + held - u[0], x[1]), (held, u[0])


LAWS = (CommandHold,)
