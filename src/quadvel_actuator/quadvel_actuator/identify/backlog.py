"""Which commands never acted, or late: the likeliest course of the drive's backlog, read off the torque.

A Viterbi search over "how many commands is the drive behind". A command that is lost costs a fixed number of nats, so
that noise alone is next to never explained by losses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .model import Model
from .signals import Array

LOST, STILL_LOST, LATE = 6.0, 3.0, 4.0
"""nats: the first command lost, one more in a row, one that takes effect between two sendings"""

_PIECE, _AROUND = 600, 150
"""Rows that are searched one after the other, and how many more at either end"""


def suspicious(model: Model, noise: Array, least: float) -> bool:
    """Do more than `least` of the commands look lost or late, each on its own? If not, the search finds nothing."""
    s = model.signals
    gain = np.where(model.samples.judged, -np.diff(_costs(model, noise, 1), axis=-1)[..., 0], 0.0)
    gain = np.column_stack([gain, gain.sum(axis=1)])  # of each joint, and of all together
    first = np.flatnonzero(np.diff(s.packet[:, 0], prepend=-1))
    total = np.cumsum(gain, axis=0)
    most = np.maximum.reduceat(total, first) - total[first] + gain[first]
    return bool(((most > LOST).mean(axis=0) > least).any())


def backlog(model: Model, noise: Array, most: int, together: bool) -> NDArray[np.intp]:
    """By how many commands, 0 to `most`, the drive is behind at each row: (N, 1), or (N, J) unless `together`."""
    emission = _costs(model, noise, most)
    if together:
        emission = emission.sum(axis=1, keepdims=True)
    packet = model.signals.packet[:, 0]
    return _likeliest(emission, np.diff(packet, prepend=packet[0]))


def _costs(model: Model, noise: Array, most: int) -> Array:
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


def _likeliest(emission: Array, new: NDArray[np.intp]) -> NDArray[np.intp]:
    """The cheapest path (N, G) through costs (N, G, M), `new` (N,) commands arriving before each row.

    Searched in pieces of the rows, side by side, each with some rows more at either end, from where paths agree.
    """
    rows = len(emission)
    count = -(-rows // _PIECE)
    first = np.arange(count) * _PIECE - _AROUND
    at = np.clip(first + np.arange(_PIECE + 2 * _AROUND)[:, None], 0, rows - 1)  # (R, pieces)
    inside = (first + np.arange(len(at))[:, None] == at)[..., None, None]
    paths = _paths(np.where(inside, emission[at], 0.0), np.where(inside[..., 0, 0], new[at], 0))
    path: NDArray[np.intp] = np.concatenate(paths[_AROUND : _AROUND + _PIECE].swapaxes(0, 1))[:rows]
    return path


def _paths(emission: Array, new: NDArray[np.intp]) -> NDArray[np.intp]:
    """The cheapest paths (R, S, G) of S pieces through costs (R, S, G, M), `new` (R, S)."""
    rows, count = len(emission), emission.shape[-1]
    came_from = np.zeros(emission.shape, dtype=np.int8)
    price = np.where(np.arange(count) == 0, 0.0, LOST) + np.zeros(emission.shape[1:])
    for n in range(rows):
        after, best = _held_back(price)
        for d in np.unique(new[n][new[n] > 0]):
            which = new[n] == d
            after[which], best[which] = _sent(price[which], min(int(d), count))
        came_from[n] = best
        price = after + emission[n]
    path = np.zeros(emission.shape[:-1], dtype=np.intp)
    at = np.argmin(price, axis=-1)
    for n in range(rows - 1, -1, -1):
        path[n] = at
        at = np.take_along_axis(came_from[n], at[..., None], axis=-1)[..., 0].astype(np.intp)
    return path


def _held_back(price: Array) -> tuple[Array, NDArray[np.int8]]:
    """Price (..., M) and origin of each state where nothing was sent: a command that was held back may arrive."""
    after = price.copy()
    best = np.broadcast_to(np.arange(price.shape[-1], dtype=np.int8), price.shape).copy()
    least, origin = price[..., -1].copy(), best[..., -1].copy()
    for m in range(price.shape[-1] - 2, -1, -1):
        late = least + LATE < price[..., m]
        after[..., m][late], best[..., m][late] = (least + LATE)[late], origin[late]
        nearer = price[..., m] < least
        least[nearer], origin[nearer] = price[..., m][nearer], m
    return after, best


def _sent(price: Array, d: int) -> tuple[Array, Array]:
    """The same where `d` commands were sent: the last of them acts, or none."""
    count = price.shape[-1]
    stay = np.arange(count)
    after, best = np.full_like(price, np.inf), np.zeros(price.shape)
    after[..., 0], best[..., 0] = price.min(axis=-1), price.argmin(axis=-1)
    after[..., d:] = price[..., : count - d] + np.where(stay[: count - d] == 0, LOST, STILL_LOST)
    best[..., d:] = stay[: count - d]
    return after, best
