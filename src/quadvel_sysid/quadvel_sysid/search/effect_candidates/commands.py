"""Candidate of lost commands, whose times are inferred from the measured torque.

`search.lost_commands` computes the probabilities; this module only turns them into an effect.
`quadvel_actuator.effects.commands` has the effect of a running model, which draws losses at random.
`EffectCandidate` explains the class variables and what each method is for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator.effects import EffectModel, ErrorEffect
from quadvel_actuator.effects.base import Errors, Params
from quadvel_actuator.effects.commands import CommandHold
from quadvel_description.arrays import Array

from ...data.signals import Signals
from ...model.effect_candidate import EffectCandidate, FormContext, InitialGuess


@attrs.frozen(eq=False)
class InferredCommandLoss(ErrorEffect):
    """Expected effect of commands that arrive late or never, from their probabilities at each row.

    Which commands were lost is inferred from the measured torque, so `odds` are a posterior given
    this log and not available for prediction. A running model draws its losses at random.

    Attributes:
        odds: (N rows, J joints, M), probability (0 to 1) that the drive is 0, 1, ... M - 1 commands
            behind at each row.
        usual: (M,), their mean over the fitted rows, used for prediction.
    """

    name = CommandHold.name
    parameters = CommandHold.parameters
    odds: Array = attrs.field(repr=False)
    usual: Array = attrs.field(repr=False)

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {}

    @override
    def errors(self, e: Errors, s: Any, p: Params) -> Errors:
        # `share` is not needed: the odds are given. It is estimated for the running `CommandHold`.
        odds, joint = self.odds[s.row[:, 0]], np.arange(s.q.shape[-1])
        # Expected position target given the odds p_b of being b commands behind:
        #     q_des + sum_b p_b (sent[packet - b] - q_des)
        late = sum(
            odds[..., behind] * (s.sent[np.maximum(s.packet - behind, 0), joint] - s.q_des)
            for behind in range(1, odds.shape[-1])
        )
        return e[0] + late, e[1]


@attrs.frozen(eq=False)
class CommandHoldCandidate(EffectCandidate):
    """Loss of commands."""

    effect: InferredCommandLoss
    signal = "q_des@history"
    shifts = True
    all_joints_together = True
    motion = "commands that change at every sending, with the sender's sequence number logged"

    @classmethod
    @override
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[EffectCandidate]:
        return tuple(cls(InferredCommandLoss(*odds)) for odds in context.lost_commands)

    @override
    def predictive(self) -> CommandHoldCandidate:
        usual = self.effect.usual
        odds = np.broadcast_to(usual, self.effect.odds.shape)
        return CommandHoldCandidate(InferredCommandLoss(odds, usual))

    @override
    def record_statistics(self) -> dict[str, float]:
        """Return the share of samples at which another command than the newest was in force."""
        return {"samples_hit": float(1.0 - self.effect.odds[..., 0].mean())}

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        # Rows at which a new command was sent; `share` starts as the mean probability of being
        # behind.
        fresh = np.diff(s.packet[:, 0], prepend=s.packet[0, 0] - 1) > 0
        return [{"share": 1.0 - self.effect.odds[s.row[fresh, 0], :, 0].mean(axis=0)}]

    @override
    def sampling_error(self, p: Mapping[str, Array], s: Signals) -> dict[str, Array]:
        """Return the binomial error of a share, with one trial per command."""
        share, count = p["share"], len(np.unique(s.packet))
        return {"share": 2.0 * np.sqrt(share * (1.0 - share) / count) + 1.0 / count}


CANDIDATES = {CommandHold: CommandHoldCandidate}
