"""Commands that are lost or late: the drive goes on with the old one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from .base import Array, ErrorLaw, Errors, Memory, MemoryLaw, Parameter, Params, Stage, Start, View

MOST = 6
"""commands lost in a row that are looked for"""


@attrs.frozen(eq=False)
class CommandHold(ErrorLaw):
    """A `share` of the commands never acts, or late; which ones is read off the residual, `behind` (N, 1) or (N, J).

    `behind` counts by how many commands the drive lags at each row. It is an inference about this record: a model that
    runs draws its losses at random.
    """

    name = "command_hold"
    parameters = (Parameter("share", "1", 0.0, 1.0, 0.05),)
    signal = "q_des@history"
    shifts = True
    motion = "commands that change at every sending, with the sender's sequence number logged"
    behind: NDArray[np.intp] | None = attrs.field(default=None, repr=False)

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    @classmethod
    def variants(cls, about: Any) -> Sequence[CommandHold]:
        return tuple(cls(behind) for behind in about.lost_commands(MOST))

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        if self.behind is None:
            return [{"share": 0.05}]
        fresh = np.diff(s.packet[:, 0], prepend=s.packet[0, 0] - 1) > 0
        lost = (self.behind[s.row[:, 0]] > 0) & fresh[:, None]
        share = lost.sum(axis=0) / max(int(fresh.sum()), 1)
        return [{"share": np.broadcast_to(share, s.q.shape[-1:]).copy()}]

    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        if self.behind is None:
            return e
        behind = self.behind[s.row[:, 0]]
        old: Array = s.sent[np.maximum(s.packet - behind, 0), np.arange(s.q.shape[-1])]
        return np.where(behind > 0, e[0] + old - s.q_des, e[0]), e[1]

    def chance(self, p: Params, s: View) -> dict[str, Array]:
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
