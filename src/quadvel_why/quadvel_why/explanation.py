"""Searches the change of the policy's inputs or outputs under which it gives the recorded actions.

Each change is a `Variant`, which `policy_replay` replays. `links.contract` turns the result into
causes. All errors are root mean squares of recorded minus replayed joint targets, rad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from weakref import WeakKeyDictionary

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.network_input import InputLayout

from .policy_replay import Observe, PolicyReplay, Replay, Variant, term_slice

AGREES_RAD, CLOSE_RAD = 0.012, 0.006
"""Largest error of targets that count as the policy's own, and of those that certainly are.

An observation with the velocity of a neighbouring tick causes 0.005.
"""
REPAIRED_SHARE = 0.35
"""Share of the error of the unchanged policy that an accepted variant may leave."""
SEARCH_TICKS = 150
"""Ticks of the walk that each variant replays."""
RESET_TICKS = (1, 2, 3, 4, 5, 8, 10, 20, 25, 40, 50, 100)
"""Periods of a regular reset of the memory that are tried, ticks."""
LATE_TICKS = (1, 2, 4, 8)
"""Ages of the states that are tried, ticks."""
SCALES = (0.0, 1.0 / 57.3, 0.1, 0.25, 0.5, 0.7, 1.4, 2.0, 4.0, 10.0, 57.3, -1.0)
"""Factors on a term of the observation that are tried; 57.3 is degrees instead of radians."""
REORDERINGS = {
    "left and right legs exchanged": (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8),
    "front and rear legs exchanged": (6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5),
    "diagonal legs exchanged": (9, 10, 11, 6, 7, 8, 3, 4, 5, 0, 1, 2),
    "FR, FL, RR, RL, grouped by kind of joint": (0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11),
    "FL, FR, RL, RR, grouped by kind of joint": (3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8),
}
"""Orders of twelve joints that other stacks use, as indices into ours."""
EARLY_S = 1.1
"""Time from the start of a walk in which a memory of earlier shows most, s."""
LATE_SHARE = 1 / 3
"""Last share of a walk, in which the network has forgotten what came before it."""


@attrs.frozen(eq=False)
class Explanation:
    """Which cause explains the recorded actions.

    Attributes:
        cause: Name of the cause; empty if the actions are the policy's.
        sentence: The variant with which recorded and replayed targets agree best, and its error,
            rad.
        error: Error of the unchanged policy, rad.
        base: Replay of the unchanged policy.
    """

    cause: str
    sentence: str
    error: float
    base: Replay

    @property
    def worst_joint(self) -> int:
        """Index of the joint with the largest error."""
        off = np.where(self.base.valid, self.base.recorded - self.base.expected, 0.0)
        return int(np.argmax((off**2).sum(axis=0)))

    @staticmethod
    def of(replay: PolicyReplay) -> Explanation:
        """Explain a walk; the search runs once for each replay.

        Args:
            replay: The policy on the run.

        Returns:
            The explanation.
        """
        if replay not in _FOUND:
            _FOUND[replay] = _explain(replay)
        return _FOUND[replay]


_FOUND: WeakKeyDictionary[PolicyReplay, Explanation] = WeakKeyDictionary()


def _explain(replay: PolicyReplay) -> Explanation:
    """Try all variants and return the one that leaves the smallest share of the error."""
    base = replay.base
    if kept := _kept_memory(replay):
        return kept
    error = base.error
    # A guard that replaces the velocity does so for a while: other policies differ all the time.
    if not error > AGREES_RAD or base.usual_error < CLOSE_RAD:
        return Explanation("", "", float(np.nan_to_num(error)), base)
    factor, left = _action_factor(replay)
    found = [("action_scale", f"with {factor:.2f} times the action scale by {left:.4f} rad", left / error)]
    short = replay.run(Variant("short"), SEARCH_TICKS).error
    for cause, variants in _variants(replay):
        best, after = replay.best(variants, SEARCH_TICKS)
        found.append((cause, f"with {best.name} by {after:.4f} rad", after / short))
    term, scale, left = _refined_scale(replay)
    found.append(
        ("observation_scale", f"with {scale:.3g} times the scale of {term} by {left:.4f} rad", left / short)
    )
    cause, text, share = min(found, key=lambda entry: entry[2])
    if share > REPAIRED_SHARE:
        return Explanation("other_actions", f"closest is {cause}: {text}", error, base)
    return Explanation(cause, text, error, base)


def _kept_memory(replay: PolicyReplay) -> Explanation | None:
    """Explain actions that differ at first, and agree later where the replay is given the recorded actions.

    A network that starts with another memory may keep another phase of its gait for ever, as its own
    previous actions maintain it. The recorded ones bring it back, unless something else differs.
    """
    base = replay.base
    early = base.error_within(slice(int(np.searchsorted(base.time, base.time[0] + EARLY_S))))
    if not early > AGREES_RAD:
        return None
    late = slice(-math.ceil(LATE_SHARE * len(base.time)), None)
    left = replay.run(Variant("the recorded actions", with_recorded_actions=True)).error_within(late)
    if not left < CLOSE_RAD:
        return None
    text = f"with the recorded actions as the previous ones they agree within {left:.4f} rad at the end"
    return Explanation("memory_kept", text, early, base)


def _action_factor(replay: PolicyReplay) -> tuple[float, float]:
    """Return the factor of the actions that fits best, and the remaining error, rad."""
    base, offset = replay.base, np.array(replay.policy.metadata.action_offset)
    x, y = (base.expected - offset)[base.valid], (base.recorded - offset)[base.valid]
    factor = float(x @ y / (x @ x))
    return factor, attrs.evolve(base, expected=offset + factor * (base.expected - offset)).error


def _variants(replay: PolicyReplay) -> Iterator[tuple[str, Sequence[Variant]]]:
    """Yield each cause with the variants that it may have caused."""
    layout = replay.policy.metadata.observation
    resets = [Variant(f"the memory cleared every {n} ticks", reset_every=n) for n in RESET_TICKS]
    yield "memory_reset", resets
    yield "stale_observation", [Variant(f"states that are {n} ticks older", late=n) for n in LATE_TICKS]
    orders = [Variant(name, observe=change) for name, change in _reorderings(layout)]
    yield "observation_order", orders


def _reorderings(layout: InputLayout) -> Iterator[tuple[str, Observe]]:
    """Yield other orders of an observation: joints reordered, and terms of equal size exchanged."""
    twelve = [term.name for term in layout.terms if term.size == 12]
    for name, order in REORDERINGS.items():
        for terms in (("q", "dq"), tuple(twelve)):
            yield f"{', '.join(terms)} with {name}", _reordered(terms, order)
    for k, first in enumerate(layout.terms):
        for second in layout.terms[k + 1 :]:
            if first.size == second.size:
                yield f"{first.name} and {second.name} exchanged", _exchanged(first.name, second.name)
    yield "roll and pitch exchanged", _reordered(("roll_pitch",), (1, 0))


def _reordered(terms: Sequence[str], order: Sequence[int]) -> Observe:
    """Return the change that reorders the numbers of each named term."""

    def change(x: NDArray[np.float32], layout: InputLayout) -> NDArray[np.float32]:
        for name in terms:
            place = term_slice(layout, name)
            x[place] = x[place][list(order)]
        return x

    return change


def _exchanged(first: str, second: str) -> Observe:
    """Return the change that exchanges two terms of equal size."""

    def change(x: NDArray[np.float32], layout: InputLayout) -> NDArray[np.float32]:
        a, b = term_slice(layout, first), term_slice(layout, second)
        x[a], x[b] = x[b].copy(), x[a].copy()
        return x

    return change


def _scaled(name: str, factor: float) -> Observe:
    """Return the change that multiplies a term by a factor."""

    def change(x: NDArray[np.float32], layout: InputLayout) -> NDArray[np.float32]:
        x[term_slice(layout, name)] *= factor
        return x

    return change


def _refined_scale(replay: PolicyReplay) -> tuple[str, float, float]:
    """Return the term and the factor on it that fit best, and the error that they leave, rad."""
    layout = replay.policy.metadata.observation

    def left(name: str, factor: float) -> float:
        return replay.run(Variant("", observe=_scaled(name, factor)), SEARCH_TICKS).error

    error, term, scale = min((left(name, factor), name, factor) for name in layout.names for factor in SCALES)
    return term, *_golden(lambda factor: left(term, factor), scale, error)


def _golden(error: Callable[[float], float], scale: float, before: float) -> tuple[float, float]:
    """Refine a factor by halving the step around it; (factor, error)."""
    step = 0.2 * abs(scale)
    for _ in range(5):
        tried = [(error(scale + side * step), scale + side * step) for side in (-1.0, 1.0)]
        best, where = min(tried)
        if best < before:
            before, scale = best, where
        step *= 0.5
    return scale, before
