"""Features at work on joints, fitted beside a model's gains, delays and effects, and what one more would add to them."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from .features import Feature, Scene
from .judging import Comparison
from .model import gather
from .signals import Array, Bools

WORTH = 0.03
"""Least gain on a joint, as a share of its noise."""

_RIDGE = 1e-6
_FREEDOM = 1e-3  # the same of the model's parameters, in shares of what they do to the joints that move most
_ENOUGH = 1500  # rows for a first look


@attrs.frozen(eq=False)
class Pick:
    """A feature at work on the joints where it pays."""

    feature: Feature
    joints: Bools
    each: Array  # (J,), the joint's share of the gain, 0 where it is not at work

    @property
    def gain(self) -> float:
        """Of all joints together."""
        return float(self.each.sum())


Picks = tuple[Pick, ...]
"""What is taken at once: one feature, or one for each joint of a neighbour of its own"""


class Together:
    """Picks fitted together to what the scene leaves; with `free` the model's parameters move, too, shared as they are."""

    def __init__(self, picks: Sequence[Pick], scene: Scene, free: bool = True) -> None:
        joints = range(len(scene.joints))
        fit = scene.judge.fit
        mine = [[k for k, pick in enumerate(picks) if pick.joints[j]] for j in joints]
        columns = columns_of(picks, scene)
        inverse = [
            _inverse(columns[j][fit[:, j]], [picks[k].feature.shape.penalty for k in mine[j]]) for j in joints
        ]

        def onto(j: int, values: Array) -> Array:
            """Weights of the joint's columns that come closest to `values` (N, ...)."""
            fitted = values.T * fit[:, j]
            weights: Array = inverse[j] @ (fitted @ columns[j]).T
            return weights

        left = scene.residual.copy()
        if free:
            slots = scene.slots
            slopes = np.stack([scene.slopes[j] - (columns[j] @ onto(j, scene.slopes[j].T)).T for j in joints])
            slopes *= fit.T[:, None]
            rest = np.stack([left[:, j] - columns[j] @ onto(j, left[:, j]) for j in joints], axis=1)
            self.hessian = gather(slots, slopes @ slopes.transpose(0, 2, 1))
            self.gradient = gather(slots, np.einsum("jan,nj->ja", slopes, rest))
            size = np.diagonal(self.hessian) * _RIDGE + 1e-9
            moved = np.linalg.solve(self.hessian + np.diag(size), self.gradient)
            change = np.where(slots.index >= 0, moved[slots.index], 0.0)  # (A, J)
            left -= np.einsum("jan,aj->nj", scene.slopes, change)
        self.weights = [np.zeros((pick.feature.shape.count, len(joints))) for pick in picks]
        self.parts = [np.zeros_like(left) for _ in picks]
        for j in joints:
            solution, first = onto(j, left[:, j]), 0
            for k in mine[j]:
                last = first + picks[k].feature.shape.count
                self.weights[k][:, j] = solution[first:last]
                self.parts[k][:, j] = columns[j][:, first:last] @ solution[first:last]
                first = last
        self.left = np.where(scene.rows, left - sum(self.parts, start=np.zeros_like(left)), 0.0)
        self.error = float(np.sum((self.left * fit) ** 2))
        """sum of squares of the fitted rows"""


def columns_of(picks: Sequence[Pick], scene: Scene) -> tuple[Array, ...]:
    """Of each joint, what the picks on it are sums of, (N, K)."""

    def of(j: int) -> Array:
        parts = [scene.taken(one.feature, one.joints)[j] for one in picks if one.joints[j]]
        return (
            np.concatenate([np.zeros((len(scene.residual), 0)), *parts], axis=1)
            if len(parts) != 1
            else parts[0]
        )

    return tuple(of(j) for j in range(len(scene.joints)))


class Trial:
    """What a feature would add to the picks: each joint's torque on the feature, the model and the picks left free."""

    def __init__(self, picks: Sequence[Pick], scene: Scene) -> None:
        self.scene = scene
        parts = Together(picks, scene).parts
        sizes, rows = _sizes(scene), int(scene.judge.fit.sum(axis=0).max())
        self.others = []  # of each joint: (N, X), columns of size 1 over the fitted rows; slopes over those of all joints
        self.inverse = []
        self.few = slice(None, None, max(1, len(scene.residual) // _ENOUGH))
        self.counted = scene.judge.fit[self.few].T[..., None]  # (J, n, 1), those of few rows that are fitted
        few = []  # of each joint: (n, X), the columns there
        onto = []  # of each joint: (X, n), weights of these that come closest
        self.bare = np.empty_like(scene.residual)
        for j in range(len(scene.joints)):
            keep = scene.judge.fit[:, j]
            taken = np.column_stack([np.zeros((len(keep), 0)), *(part[:, j] for part in parts)])
            taken = taken / (np.sqrt(np.mean(taken[keep] ** 2, axis=0)) + 1e-12)
            x = np.hstack([scene.slopes[j].T / sizes, taken])
            ridge = np.repeat([_FREEDOM, _RIDGE], [len(sizes), len(parts)])
            gram = x[keep].T @ x[keep] + np.diag(ridge * rows)
            self.others.append(x)
            self.inverse.append(np.linalg.inv(gram))
            some = x[self.few] * self.counted[j]
            share = ridge * rows * int(self.counted[j].sum()) / max(int(keep.sum()), 1)
            few.append(some)
            onto.append(np.linalg.lstsq(some.T @ some + np.diag(share), some.T, rcond=None)[0])
            self.bare[:, j] = self._without(j, scene.residual[:, j : j + 1])[:, 0]
        self.some, self.onto = np.array(few), np.array(onto)
        self.few_left = self.bare[self.few].T[..., None] * self.counted

    def _without(self, j: int, values: Array) -> Array:
        """What the other columns do not explain of `values` (N, K)."""
        x, keep = self.others[j], self.scene.judge.fit[:, j]
        left: Array = values - x @ (self.inverse[j] @ (x.T @ (values * keep[:, None])))
        return left

    def promising(self, feature: Feature, noise: Array) -> Bools:
        """The joints where the feature fitted to some of the rows gains more than chance would."""
        columns = self.scene.columns(feature, self.few).transpose(2, 0, 1) * self.counted  # (J, n, K)
        own = columns - self.some @ (self.onto @ columns)
        left, rows = self.few_left, self.counted.sum(axis=(1, 2))
        onto = own.swapaxes(1, 2) @ left
        gain = (onto.swapaxes(1, 2) @ _inverse(own, [feature.shape.penalty]) @ onto)[:, 0, 0] / rows
        chance = np.sum(left * left, axis=(1, 2)) * feature.shape.count / rows**2
        found: Bools = gain - chance > 0.5 * WORTH * noise
        return found

    def compare(self, feature: Feature, joints: Bools) -> Comparison:
        """Held-out residuals without the feature, and with it on these joints."""
        return self.scene.judge.compare(self.bare, self._after(feature, joints))

    def error(self, feature: Feature, joints: Bools) -> float:
        """Sum of squares that the feature leaves of the fitted rows of these joints."""
        left = (self._after(feature, joints) * self.scene.judge.fit)[:, joints]
        return float(np.sum(left * left))

    def _after(self, feature: Feature, joints: Bools) -> Array:
        """Residual (N, J) with the feature fitted to each of these joints."""
        after = self.bare.copy()
        for j in np.flatnonzero(joints).tolist():
            own = self._without(j, self.scene.column(feature, j))
            fitted = own * self.scene.judge.fit[:, j, None]
            inverse = _inverse(fitted, [feature.shape.penalty])
            after[:, j] -= own @ (inverse @ (fitted.T @ self.bare[:, j]))
        return after


def _sizes(scene: Scene) -> Array:
    """What each of the model's parameters does, root mean square over the fitted rows of the joint that shows it most.

    (A,). A joint that hardly moves while the model is fitted says nothing of them; it must not be free to make them up.
    """
    square = np.einsum("jan,nj->ja", scene.slopes**2, scene.judge.fit.astype(float))
    rows = np.maximum(scene.judge.fit.sum(axis=0), 1)
    sizes: Array = np.sqrt((square / rows[:, None]).max(axis=0)) + 1e-12
    return sizes


def _inverse(x: Array, penalties: Sequence[Array]) -> Array:
    """Of the second moments of x (..., N, K), each block of columns with its penalty, in shares of its mean square."""
    gram: Array = x.swapaxes(-1, -2) @ x
    first = 0
    for penalty in penalties:
        last = first + len(penalty)
        block = gram[..., first:last, first:last]
        size = np.einsum("...kk->...", block) / len(penalty)
        block += size[..., None, None] * penalty + 1e-12 * np.eye(len(penalty))
        first = last
    return np.asarray(np.linalg.inv(gram), dtype=np.float64)
