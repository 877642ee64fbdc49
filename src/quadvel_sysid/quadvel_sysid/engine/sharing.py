"""Which joints share what: gains and delays for all, for each kind of joint, or for each joint; effects likewise.

The paper has one set for all joints. A finer one is taken only where held-out rows say that it pays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np

from .delays import fit_with_delays
from .few import Few
from .judging import Judge
from .model import Groups, Model, fit
from .signals import Array

_LEVEL = 0.01
_HARMLESS = 0.01  # of the noise: a loss that sharing may bring


def kinds(joints: Sequence[str]) -> Groups:
    """The same number for joints whose names differ in their first part only: FR_hip_joint, FL_hip_joint."""
    names = [name.partition("_")[2] or name for name in joints]
    found: Groups = np.unique(names, return_inverse=True)[1]
    return found


def regroupings(model: Model, few: Few) -> Iterator[tuple[str, Model]]:
    """The model with gains or delays for each kind of joint, and for each joint, fitted."""
    joints = model.samples.joints
    each = np.arange(len(joints))
    for word, groups in (("kind", kinds(joints)), ("joint", each)):
        if word == "kind" and len(np.unique(groups)) == len(joints):
            continue
        if not model.gains_held and len(np.unique(groups)) > len(np.unique(model.gain_groups[0])):
            yield (
                f"gains per {word}",
                few.fitted(attrs.evolve(model, gain_groups=np.array([groups, groups])), fit, 4),
            )
        if len(np.unique(groups)) > len(np.unique(model.delay_groups)):
            yield (
                f"delays per {word}",
                few.fitted(attrs.evolve(model, delay_groups=groups), fit_with_delays, 4),
            )


def pooled(model: Model, judge: Judge, noise: Array) -> Model:
    """The model with the values of each effect shared by its joints, or by those of a kind, where that costs nothing."""
    for k, one in enumerate(model.applied):
        for groups in (np.zeros(len(one.active), dtype=np.intp), kinds(model.samples.joints)):
            if len(np.unique(groups[one.active])) == int(one.active.sum()):
                continue
            values = one.values.copy()
            for g in np.unique(groups[one.active]):
                alike = one.active & (groups == g)
                values[:, alike] = values[:, alike].mean(axis=1, keepdims=True)
            common = attrs.evolve(one, groups=groups, values=values)
            tried = fit(model.replacing(k, common), judge.fit, 5)
            lost = judge.compare(tried.samples.tau - tried.predict(), model.samples.tau - model.predict())
            if lost.gain < _HARMLESS * float(noise.mean()) or lost.p_any > _LEVEL:
                model = tried
                break
    return model
