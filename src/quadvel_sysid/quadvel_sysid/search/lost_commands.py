"""Find commands that were lost or late, with a hidden Markov model of the drive's backlog.

The hidden state is the number of commands that the drive is behind. The Baum-Welch algorithm
(expectation maximisation) estimates the probabilities of a loss from the log itself; the
forward-backward algorithm then gives the probability of each state in each row. A loss concerns
all joints at once, so the torque of the other joints replaces that of a joint whose rows are held
out.

Reference: L. Rabiner, A tutorial on hidden Markov models, Proceedings of the IEEE 77, 1989.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

from ..data.split import DataSplit
from ..model.applied_effect import AppliedEffect
from ..model.fit import fit, squared_error
from ..model.torque_model import Model
from .effect_candidates.commands import CommandHoldCandidate, InferredCommandLoss

MAX_BACKLOG = 6
"""Largest number of commands lost in a row that is considered."""
SUSPICION_NATS = 6.0
"""nats of log likelihood by which a command looks lost or late on its own."""
_MIN_LOST_SHARE = 0.003
"""Share of the commands; losses are not modelled if fewer commands lag."""
_MIN_UNPREDICTABLE_SHARE = 0.5
"""Share of the error reduction that has to come from distinguishing individual commands. A lag also
delays the response, but after each command alike; random losses cannot be predicted.
"""

_PIECE_ROWS, _OVERLAP_ROWS = 600, 150
"""Rows that are computed together, and the overlap at either end."""

_MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_EM_ROUNDS, _EM_TOLERANCE = 8, 1e-3
"""Rounds of expectation maximisation at most, and the relative change that ends them."""
_MIN_PROBABILITY = 1e-6
"""Bounds of the estimated probabilities: from this to 1 minus this."""
_MAX_ROW_NATS = 50.0
"""nats that one row contributes at most, since it may be an outlier."""
_PROBABILITY_FLOOR = 1e-100
"""Smallest probability of a state, so that contradicting rows leave one possible state."""


@attrs.frozen
class LossProbabilities:
    """Probabilities of the transitions between backlogs.

    Attributes:
        lost: Probability that a new command is lost.
        lost_again: Probability that a new command is lost if the drive is behind already.
        delivered_late: Probability that a delayed command arrives in a row without a new one.
    """

    lost: float = 0.02
    lost_again: float = 0.3
    delivered_late: float = 0.02

    def transition_matrices(self, most: int) -> Array:
        """Compute the transition probabilities between backlogs.

        Args:
            most: Largest backlog, commands.

        Returns:
            (D, M, M) matrices from backlog i to backlog j, for D = 0 to most + 1 new commands; M
            = most + 1.
        """
        # No new command: from backlog i to each j < i with delivered_late / i, else i stays.
        # D new commands: to 0 with 1 - p, else to min(i + D, most) with p, where p is `lost` for
        # i = 0 and `lost_again` for i > 0.
        count = most + 1
        arriving = np.tril(
            np.full((count, count), self.delivered_late) / np.maximum(np.arange(count), 1)[:, None], -1
        )
        arriving += np.diag(1.0 - arriving.sum(axis=1))
        loses = np.where(np.arange(count) == 0, self.lost, self.lost_again)
        steps = [arriving]
        for sent in range(1, count + 1):
            step = np.zeros((count, count))
            step[:, 0] = 1.0 - loses
            step[np.arange(count), np.minimum(np.arange(count) + sent, most)] += loses
            steps.append(step)
        return np.array(steps)

    @classmethod
    def estimate(cls, counts: Array) -> LossProbabilities:
        """Estimate the probabilities by maximum likelihood (M step).

        Args:
            counts: (D, M, M) expected number of each transition.

        Returns:
            The probabilities.
        """
        sent = counts[1:].sum(axis=0)
        arriving = counts[0]
        back = np.tril(arriving, -1).sum()
        return cls(
            _share(sent[0, 1:].sum(), sent[0].sum()),
            _share(sent[1:, 1:].sum(), sent[1:].sum()),
            _share(back, arriving[1:].sum()),
        )


def _share(part: float, whole: float) -> float:
    """Quotient, bounded away from 0 and 1."""
    return float(np.clip(part / (whole + 1e-12), _MIN_PROBABILITY, 1.0 - _MIN_PROBABILITY))


def lost_commands(
    model: Model, parts: DataSplit, noise: Array, at_random: bool = True
) -> list[tuple[Array, Array]]:
    """Estimate the backlog of the drive in each row.

    The probabilities of a joint do not use its own torque in rows that are used for selection or
    held out.

    Args:
        model: The fitted model.
        parts: Which rows are fitted, used for selection, or held out.
        noise: (J,) variance of the torque's noise, N^2 m^2.
        at_random: Whether only losses count that the age of a command does not predict.

    Returns:
        A list with one pair: probabilities of a backlog of 0 to `MAX_BACKLOG` commands in each
        row, (N, J, M), and their mean over the fitted rows, (M,). Empty if losses are rare or
        predictable.
    """
    noise = _residual_variance(model, parts, noise)
    if len(noise) < 2 or not _has_suspects(model, noise):
        return []
    odds = backlog_probabilities(model, noise, MAX_BACKLOG, ~parts.fit)
    usual = odds[parts.fit].mean(axis=0)
    if 1.0 - usual[0] < _MIN_LOST_SHARE:
        return []
    if at_random and not _at_random(model, odds, usual, parts):
        return []
    return [(_expand_rows(odds, model.samples.row), usual)]


def _with_losses(model: Model, odds: Array, usual: Array, parts: DataSplit) -> Model:
    """Add losses with these probabilities to the model and fit it."""
    every = np.ones(odds.shape[1], dtype=bool)
    loss = InferredCommandLoss(_expand_rows(odds, model.samples.row), usual)
    one = AppliedEffect(
        CommandHoldCandidate(loss), every, np.full((1, len(every)), 0.05), np.arange(len(every))
    )
    return fit(model.with_effect(one), parts.fit, 3)


def _at_random(model: Model, odds: Array, usual: Array, parts: DataSplit) -> bool:
    """Whether individual losses explain much more than losses predicted from a command's age."""
    losing = _with_losses(model, odds, usual, parts)
    fitted = parts.fit.any(axis=1)
    since = np.rint(losing.signals.age[:, 0] / losing.samples.period).astype(int)
    since = np.minimum(since, since[fitted].max())
    total = np.zeros((since.max() + 1, *odds.shape[1:]))
    np.add.at(total, since[fitted], odds[fitted])
    mean = total / np.maximum(total.sum(axis=-1, keepdims=True), 1.0)
    bare = losing.without_effect(len(model.effects))
    tried = (model, fit(bare, parts.fit, 3), losing, _with_losses(bare, mean[since], usual, parts))
    *without, observed, predicted = (squared_error(one, parts.fit_or_select) for one in tried)
    return predicted - observed > _MIN_UNPREDICTABLE_SHARE * (min(without) - observed) > 0.0


def _expand_rows(odds: Array, rows: Indices) -> Array:
    """Repeat the probabilities (N, J, M) of some `rows` (N,) for every row up to the last one."""
    at = np.searchsorted(rows, np.arange(rows[-1] + 1))
    return odds[at]


def reassign_losses(model: Model, parts: DataSplit, noise: Array) -> Model:
    """Estimate the backlog again, on the rows of a model that was moved to other samples.

    Args:
        model: The model on its new samples.
        parts: Parts of these samples.
        noise: (J,) variance of the torque's noise, N^2 m^2.

    Returns:
        The model with new probabilities of its losses.
    """
    for k, one in enumerate(model.effects):
        if isinstance(one.candidate, CommandHoldCandidate):
            odds = backlog_probabilities(model.without_effect(k), noise, MAX_BACKLOG, ~parts.fit)
            loss = InferredCommandLoss(odds, odds[parts.fit].mean(axis=0))
            model = model.with_replaced_effect(k, attrs.evolve(one, candidate=CommandHoldCandidate(loss)))
    return model


def _residual_variance(model: Model, parts: DataSplit, noise: Array) -> Array:
    """Robust variance (J,) of the model's residual, at least the noise, N^2 m^2."""
    size = [np.median(np.abs(one[keep])) for one, keep in zip(model.residual().T, parts.fit.T, strict=True)]
    usual: Array = np.maximum((_MAD_TO_STD * np.array(size)) ** 2, noise)
    return usual


def _has_suspects(model: Model, noise: Array) -> bool:
    """Whether enough commands look lost or late, each on its own; otherwise the search is skipped."""
    s = model.signals
    gain = np.where(model.samples.evaluated, -np.diff(_row_costs(model, noise, 1), axis=-1)[..., 0], 0.0)
    gain = np.column_stack([gain, gain.sum(axis=1)])  # of each joint, and of all joints together
    first = np.flatnonzero(np.diff(s.packet[:, 0], prepend=-1))
    total = np.cumsum(gain, axis=0)
    most = np.maximum.reduceat(total, first) - total[first] + gain[first]
    return bool(((most > SUSPICION_NATS).mean(axis=0) > _MIN_LOST_SHARE).any())


def backlog_probabilities(model: Model, noise: Array, most: int, excluded: Bools) -> Array:
    """Compute the probability of each backlog in each row.

    Args:
        model: The fitted model, without losses.
        noise: (J,) variance of the torque's noise, N^2 m^2.
        most: Largest backlog, commands.
        excluded: (N, J) rows in which a joint's torque is not used for its own probabilities, nor
            for the probabilities of a loss.

    Returns:
        (N, J, most + 1) probabilities.
    """
    costs = _row_costs(model, noise, most)
    packet = model.signals.packet[:, 0]
    new = np.minimum(np.diff(packet, prepend=packet[0]), most + 1)
    hidden = np.where(excluded[..., None], costs, 0.0)
    read = (costs - hidden).sum(axis=1, keepdims=True)
    chances = LossProbabilities()
    for _ in range(_EM_ROUNDS):
        before, chances = chances, LossProbabilities.estimate(_forward_backward(read, new, chances)[1])
        if np.allclose(attrs.astuple(chances), attrs.astuple(before), rtol=_EM_TOLERANCE):
            break
    return _forward_backward(costs.sum(axis=1, keepdims=True) - hidden, new, chances)[0]


def _row_costs(model: Model, noise: Array, most: int) -> Array:
    """Negative log likelihood (N, J, most + 1) of each row and backlog, nats."""
    # With the command of k packets ago the torque changes by kp (q_des_{n-k} - q_des_n). The cost is
    # (residual - change)^2 / (2 noise variance).
    s = model.signals
    left = np.where(model.samples.evaluated, model.samples.tau - model.predict(), 0.0)
    stiffness = model.gains[0] * s.kp
    joint = np.arange(left.shape[1])
    cost = []
    for behind in range(most + 1):
        old = s.sent[np.maximum(s.packet - behind, 0), joint]
        change = stiffness * (old - s.q_des) if behind else 0.0
        cost.append(np.where(model.samples.evaluated, (left - change) ** 2 / (2.0 * noise), 0.0))
    return np.stack(cost, axis=-1)


def _forward_backward(costs: Array, new: Indices, chances: LossProbabilities) -> tuple[Array, Array]:
    """State probabilities (N, G, M) and expected transitions (D, M, M), given costs (N, G, M).

    `new` (N,) commands arrive before each row. The rows are divided into pieces that are computed
    side by side. Each piece has `_OVERLAP_ROWS` more at either end, after which the initial state
    no longer matters.
    """
    rows = len(costs)
    first = np.arange(-(-rows // _PIECE_ROWS)) * _PIECE_ROWS - _OVERLAP_ROWS
    at = np.clip(first + np.arange(_PIECE_ROWS + 2 * _OVERLAP_ROWS)[:, None], 0, rows - 1)  # (R, pieces)
    inside = first + np.arange(len(at))[:, None] == at
    likely = np.exp(np.maximum(np.min(costs, axis=-1, keepdims=True) - costs, -_MAX_ROW_NATS))[at]
    likely = np.where(inside[..., None, None], likely, 1.0)  # (R, S, G, M)
    moves = chances.transition_matrices(costs.shape[-1] - 1)
    which = np.where(inside, new[at], 0)
    # With transitions A_n and likelihoods b_n of row n, each normalised (Rabiner, forward-backward):
    #   alpha_n = (alpha_{n-1} A_n) b_n,  beta_{n-1} = A_n (b_n beta_n),  gamma_n ~ alpha_n beta_n,
    #   xi_n[i, j] ~ alpha_{n-1}[i] A_n[i, j] b_n[j] beta_n[j].
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
