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
    return _likeliest(emission, np.diff(packet, prepend=packet[0]).tolist())


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


def _likeliest(emission: Array, new: list[int]) -> NDArray[np.intp]:
    """The cheapest path (N, G) through costs (N, G, M), `new` commands arriving before each row."""
    rows, groups, count = emission.shape
    came_from = np.zeros((rows, groups, count), dtype=np.int8)
    price = np.full((groups, count), np.inf)
    price[:, 0] = 0.0
    stay, every = np.arange(count), np.arange(groups)
    for n in range(rows):
        best = came_from[n]
        best[:] = stay
        if new[n] == 0:
            after = price.copy()
            late = np.minimum.accumulate(price[:, :0:-1], axis=1)[:, ::-1] + LATE
            for group, m in np.argwhere(late < price[:, :-1]):  # a command that was held back arrives now
                after[group, m] = late[group, m]
                best[group, m] = m + 1 + np.argmin(price[group, m + 1 :])
        else:
            after = np.full_like(price, np.inf)
            source = np.argmin(price, axis=1)
            after[:, 0] = price[every, source]
            best[:, 0] = source
            d = min(new[n], count)
            lost = price[:, : count - d] + np.where(stay[: count - d] == 0, LOST, STILL_LOST)
            after[:, d:] = lost
            best[:, d:] = stay[: count - d]
        price = after + emission[n]
    path = np.zeros((rows, groups), dtype=np.intp)
    at = np.argmin(price, axis=1)
    for n in range(rows - 1, -1, -1):
        path[n] = at
        at = came_from[n][every, at]
    return path
