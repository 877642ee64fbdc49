"""Commands that are lost or late: the drive goes on with the old one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from .base import Array, ErrorLaw, Errors, Memory, MemoryLaw, Parameter, Params, Stage, Start, View

MAX_BACKLOG = 6
"""commands lost in a row that are looked for"""


@attrs.frozen(eq=False)
class CommandHold(ErrorLaw):
    """A `share` of the commands never acts, or late; which ones is read off the torque, as far as that shows.

    `odds` (N, J, most + 1) are the chances that the drive is so many commands behind at each row, `usual` (most + 1,)
    those of any row. The former are an inference about this record, which nobody could have made before; a model that
    runs draws its losses at random.
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
    def settings(self) -> dict[str, Any]:
        return {}

    @classmethod
    def variants(cls, about: Any) -> Sequence[CommandHold]:
        return tuple(cls(*odds) for odds in about.lost_commands)

    def predictive(self) -> CommandHold:
        if self.odds is None or self.usual is None:
            return self
        return attrs.evolve(self, odds=np.broadcast_to(self.usual, self.odds.shape))

    def observed(self) -> dict[str, float]:
        """The share of samples at which another command than the newest was in force."""
        return {} if self.odds is None else {"samples_hit": float(1.0 - self.odds[..., 0].mean())}

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        if self.odds is None:
            return [{"share": 0.05}]
        fresh = np.diff(s.packet[:, 0], prepend=s.packet[0, 0] - 1) > 0
        share = 1.0 - self.odds[s.row[fresh, 0], :, 0].mean(axis=0)
        return [{"share": share}]

    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        if self.odds is None:
            return e
        odds, joint = self.odds[s.row[:, 0]], np.arange(s.q.shape[-1])
        late = sum(
            odds[..., behind] * (s.sent[np.maximum(s.packet - behind, 0), joint] - s.q_des)
            for behind in range(1, odds.shape[-1])
        )
        return e[0] + late, e[1]

    def sampling_error(self, p: Params, s: View) -> dict[str, Array]:
        """As of as many tosses as there were commands."""
        share, count = p["share"], len(np.unique(s.packet))
        return {"share": 2.0 * np.sqrt(share * (1.0 - share) / count) + 1.0 / count}

    def running(self, rng: np.random.Generator) -> _Losing:
        return _Losing(rng)


@attrs.frozen(eq=False)
class _Losing(MemoryLaw):
    """Each new command is lost with the probability `share`, for all joints of a robot at once."""

    name = CommandHold.name
    stage = Stage.ERRORS
    parameters = CommandHold.parameters
    inputs = ("q_des",)
    rng: np.random.Generator

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return []  # it runs; what is searched for is `CommandHold`

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return u[0], u[0]

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        held, before = memory
        fresh = (u[0] != before).any(axis=-1, keepdims=True)
        lost = self.rng.random((*u[0].shape[:-1], 1)) < p["share"]
        held = np.where(fresh & ~lost, u[0], held)
        return (x[0] + held - u[0], x[1]), (held, u[0])


LAWS = (CommandHold,)
