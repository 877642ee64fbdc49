"""Which commands never acted, or late: how likely the drive was how many commands behind, read off the torque.

A hidden Markov model of "how many commands is the drive behind": the chances of a loss are found from the log itself
(Baum and Welch), then those of each row. Commands are lost for all joints at once, so what the others' torque says of a
row stands in for the torque of a joint where that is not to be looked at.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.effects.commands import MAX_BACKLOG, CommandHold

from .criterion import DataSplit
from .fit import fit, squared_error
from .model import AppliedEffect, Model
from .signals import Array, Bools

SUSPICION_NATS = 6.0
"""nats by which a command has to look lost or late on its own"""
_MIN_LOST_SHARE = 0.003
"""Of the commands: they are not looked at as lost where fewer lag behind"""
_MIN_UNPREDICTABLE_SHARE = 0.5
"""Of what the reading takes off the error: what has to come of its telling one command from another. A lag answers late, too,
but after each command alike; losses at random cannot be foretold."""

_PIECE_ROWS, _OVERLAP_ROWS = 600, 150
"""Rows that are searched one after the other, and how many more at either end"""

_MAD_TO_STD = 1.4826
"""Standard deviation of normal numbers over the median of their sizes"""
_EM_ROUNDS, _EM_TOLERANCE = 8, 1e-3
_MIN_PROBABILITY = 1e-6
_MAX_ROW_NATS = 50.0
"""nats that one row can say at most: it may be an outlier"""
_PROBABILITY_FLOOR = 1e-100  # a chance, so that two accounts that contradict each other leave one


@attrs.frozen
class LossProbabilities:
    """Of a new command to be lost, of one more to be, and of a command that was held back to arrive at a row."""

    lost: float = 0.02
    lost_again: float = 0.3
    delivered_late: float = 0.02

    def transition_matrices(self, most: int) -> Array:
        """Chances (D, M, M) from so far behind to so far behind, as D = 0 to `most` + 1 commands were sent."""
        count = most + 1
        held = np.tril(
            np.full((count, count), self.delivered_late) / np.maximum(np.arange(count), 1)[:, None], -1
        )
        held += np.diag(1.0 - held.sum(axis=1))
        loses = np.where(np.arange(count) == 0, self.lost, self.lost_again)
        steps = [held]
        for sent in range(1, count + 1):
            step = np.zeros((count, count))
            step[:, 0] = 1.0 - loses
            step[np.arange(count), np.minimum(np.arange(count) + sent, most)] += loses
            steps.append(step)
        return np.array(steps)

    @classmethod
    def estimate(cls, counts: Array) -> LossProbabilities:
        """The likeliest ones where moves were so frequent, `counts` (D, M, M)."""
        sent = counts[1:].sum(axis=0)
        held = counts[0]
        back = np.tril(held, -1).sum()
        return cls(
            _share(sent[0, 1:].sum(), sent[0].sum()),
            _share(sent[1:, 1:].sum(), sent[1:].sum()),
            _share(back, held[1:].sum()),
        )


def _share(part: float, whole: float) -> float:
    return float(np.clip(part / (whole + 1e-12), _MIN_PROBABILITY, 1.0 - _MIN_PROBABILITY))


def lost_commands(model: Model, parts: DataSplit, noise: Array) -> list[tuple[Array, Array]]:
    """How likely the drive lags by 0 to MOST commands: at each row, (N, J, MOST + 1), and at any; none if it rarely does.

    For each joint without a look at its torque where that selects or is reported.
    """
    noise = _residual_variance(model, parts, noise)
    if len(noise) < 2 or not _has_suspects(model, noise):
        return []
    odds = backlog_probabilities(model, noise, MAX_BACKLOG, ~parts.fit)
    usual = odds[parts.fit].mean(axis=0)
    if 1.0 - usual[0] < _MIN_LOST_SHARE or not _at_random(model, odds, usual, parts):
        return []
    return [(_expand_rows(odds, model.samples.row), usual)]


def _with_losses(model: Model, odds: Array, usual: Array, parts: DataSplit) -> Model:
    """The model with losses of these odds, fitted."""
    every = np.ones(odds.shape[1], dtype=bool)
    law = CommandHold(_expand_rows(odds, model.samples.row), usual)
    one = AppliedEffect(law, every, np.full((1, len(every)), 0.05), np.arange(len(every)))
    return fit(model.with_effect(one), parts.fit, 3)


def _at_random(model: Model, odds: Array, usual: Array, parts: DataSplit) -> bool:
    """Does the model with losses tell much more than one whose losses follow from the time since the command arrived?"""
    losing = _with_losses(model, odds, usual, parts)
    fitted = parts.fit.any(axis=1)
    since = np.rint(losing.signals.age[:, 0] / losing.samples.period).astype(int)
    since = np.minimum(since, since[fitted].max())
    total = np.zeros((since.max() + 1, *odds.shape[1:]))
    np.add.at(total, since[fitted], odds[fitted])
    mean = total / np.maximum(total.sum(axis=-1, keepdims=True), 1.0)
    bare = losing.without_effect(len(model.effects))
    tried = (model, fit(bare, parts.fit, 3), losing, _with_losses(bare, mean[since], usual, parts))
    *without, read, foreseen = (squared_error(one, parts.fit_or_select) for one in tried)
    return foreseen - read > _MIN_UNPREDICTABLE_SHARE * (min(without) - read) > 0.0


def _expand_rows(odds: Array, rows: NDArray[np.intp]) -> Array:
    """The odds (N, J, M) of some `rows` (N,) of the logs as those of every row up to the last."""
    at = np.searchsorted(rows, np.arange(rows[-1] + 1))
    return odds[at]


def reassign_losses(model: Model, parts: DataSplit, noise: Array) -> Model:
    """The model, whose samples reach further than those that its lost commands were read off, with these read off them all."""
    for k, one in enumerate(model.effects):
        if isinstance(one.law, CommandHold):
            odds = backlog_probabilities(model.without_effect(k), noise, MAX_BACKLOG, ~parts.fit)
            law = CommandHold(odds, odds[parts.fit].mean(axis=0))
            model = model.with_replaced_effect(k, attrs.evolve(one, law=law))
    return model


def _residual_variance(model: Model, parts: DataSplit, noise: Array) -> Array:
    """Variance (J,) of what the model leaves of most rows, N^2 m^2: what a row says of losses is held against that."""
    size = [np.median(np.abs(one[keep])) for one, keep in zip(model.residual().T, parts.fit.T, strict=True)]
    usual: Array = np.maximum((_MAD_TO_STD * np.array(size)) ** 2, noise)
    return usual


def _has_suspects(model: Model, noise: Array) -> bool:
    """Do some of the commands look lost or late, each on its own? If not, the search finds nothing."""
    s = model.signals
    gain = np.where(model.samples.judged, -np.diff(_row_costs(model, noise, 1), axis=-1)[..., 0], 0.0)
    gain = np.column_stack([gain, gain.sum(axis=1)])  # of each joint, and of all together
    first = np.flatnonzero(np.diff(s.packet[:, 0], prepend=-1))
    total = np.cumsum(gain, axis=0)
    most = np.maximum.reduceat(total, first) - total[first] + gain[first]
    return bool(((most > SUSPICION_NATS).mean(axis=0) > _MIN_LOST_SHARE).any())


def backlog_probabilities(model: Model, noise: Array, most: int, unread: Bools) -> Array:
    """Chances (N, J, most + 1) that the drive is 0 to `most` commands behind at each row.

    Those of a joint do not look at its own torque in the rows `unread` (N, J), the chances of a loss at nobody's there.
    """
    costs = _row_costs(model, noise, most)
    packet = model.signals.packet[:, 0]
    new = np.minimum(np.diff(packet, prepend=packet[0]), most + 1)
    hidden = np.where(unread[..., None], costs, 0.0)
    read = (costs - hidden).sum(axis=1, keepdims=True)
    chances = LossProbabilities()
    for _ in range(_EM_ROUNDS):
        before, chances = chances, LossProbabilities.estimate(_forward_backward(read, new, chances)[1])
        if np.allclose(attrs.astuple(chances), attrs.astuple(before), rtol=_EM_TOLERANCE):
            break
    return _forward_backward(costs.sum(axis=1, keepdims=True) - hidden, new, chances)[0]


def _row_costs(model: Model, noise: Array, most: int) -> Array:
    """How little each row agrees with a drive that is 0 to `most` commands behind, nats, (N, J, most + 1)."""
    s = model.signals
    left = np.where(model.samples.judged, model.samples.tau - model.predict(), 0.0)
    stiffness = model.gains[0] * s.kp
    joint = np.arange(left.shape[1])
    cost = []
    for behind in range(most + 1):
        old = s.sent[np.maximum(s.packet - behind, 0), joint]
        change = stiffness * (old - s.q_des) if behind else 0.0
        cost.append(np.where(model.samples.judged, (left - change) ** 2 / (2.0 * noise), 0.0))
    return np.stack(cost, axis=-1)


def _forward_backward(costs: Array, new: NDArray[np.intp], chances: LossProbabilities) -> tuple[Array, Array]:
    """Chances (N, G, M) of each state given the costs (N, G, M), and how often which move was made, (D, M, M).

    `new` (N,) commands arrive before each row. Computed in pieces of the rows, side by side, each with some rows more
    at either end, from where the start no longer counts.
    """
    rows = len(costs)
    first = np.arange(-(-rows // _PIECE_ROWS)) * _PIECE_ROWS - _OVERLAP_ROWS
    at = np.clip(first + np.arange(_PIECE_ROWS + 2 * _OVERLAP_ROWS)[:, None], 0, rows - 1)  # (R, pieces)
    inside = first + np.arange(len(at))[:, None] == at
    likely = np.exp(np.maximum(np.min(costs, axis=-1, keepdims=True) - costs, -_MAX_ROW_NATS))[at]
    likely = np.where(inside[..., None, None], likely, 1.0)  # (R, S, G, M)
    moves = chances.transition_matrices(costs.shape[-1] - 1)
    which = np.where(inside, new[at], 0)
    forward, backward = np.empty_like(likely), np.empty_like(likely)
    state = np.zeros(likely.shape[1:])
    state[..., 0] = 1.0
    for n in range(len(at)):
        state = (state @ moves[which[n]]) * likely[n]
        state = np.maximum(state / state.sum(axis=-1, keepdims=True), _PROBABILITY_FLOOR)
        forward[n] = state
    state = np.ones(likely.shape[1:])
    back = moves.swapaxes(-1, -2)
    for n in range(len(at) - 1, -1, -1):
        backward[n] = state
        state = (state * likely[n]) @ back[which[n]]
        state = np.maximum(state / state.sum(axis=-1, keepdims=True), _PROBABILITY_FLOOR)
    odds = forward * backward
    odds /= odds.sum(axis=-1, keepdims=True)
    own = slice(_OVERLAP_ROWS, _OVERLAP_ROWS + _PIECE_ROWS)
    counts = np.zeros_like(moves)
    before, after = forward[_OVERLAP_ROWS - 1 : _OVERLAP_ROWS + _PIECE_ROWS - 1], (backward * likely)[own]
    for d, step in enumerate(moves):
        here = (which[own] == d) & inside[own]
        made = before[here][..., :, None] * step * after[here][..., None, :]
        counts[d] = (made / made.sum(axis=(-1, -2), keepdims=True)).sum(axis=(0, 1))
    whole = odds[own].swapaxes(0, 1).reshape(-1, *costs.shape[1:])[:rows]
    return whole, counts
