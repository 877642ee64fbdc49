"""Actuator effects that the search may add to a model, each with its `EffectCandidate`.

The registry of `quadvel_actuator` holds the physics of an effect. A subclass of `EffectCandidate`
holds what the search needs to find it in a log: forms (settings) to try and starting values.

Another package names the subclass for its effect in an entry point of the group
`quadvel.effect_candidates`: the name of the effect, and the class. Without one, the defaults of
`EffectCandidate` apply.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cache
from importlib.metadata import entry_points

from quadvel_actuator.effects import registry

from ...model.effect_candidate import EffectCandidate, FormContext
from . import commands, dynamics, elastic, friction, gains, limits

GROUP = "quadvel.effect_candidates"


@cache
def candidate_classes() -> dict[str, type[EffectCandidate]]:
    """Return the candidate class of each effect.

    Returns:
        Candidate classes by the name of the effect, in the order of the registry.

    Raises:
        ValueError: An entry point names no `EffectCandidate`, an unknown effect, or an effect that
            has a candidate class in quadvel.
    """
    own = {
        effect.name: candidate
        for module in (friction, limits, dynamics, elastic, gains, commands)
        for effect, candidate in module.CANDIDATES.items()
    }
    found: dict[str, type[EffectCandidate]] = dict.fromkeys(registry(), EffectCandidate) | own
    for entry in entry_points(group=GROUP):
        candidate = entry.load()
        if not (isinstance(candidate, type) and issubclass(candidate, EffectCandidate)):
            raise ValueError(
                f"entry point {entry.name} of {GROUP}: found {candidate!r}, expected an EffectCandidate"
            )
        if entry.name not in found or entry.name in own:
            raise ValueError(f"entry point {entry.name} of {GROUP}: expected an effect of another package")
        found[entry.name] = candidate
    return found


def effect_candidates(context: FormContext, without: Collection[str]) -> Iterator[EffectCandidate]:
    """Iterate over the forms of all effects that a model lacks.

    Args:
        context: Samples and signals of the logs, from which an effect chooses its forms.
        without: Names of the effects that the model has already.

    Yields:
        One candidate for each form of each effect.
    """
    for name, candidate in candidate_classes().items():
        if name not in without:
            yield from candidate.forms(registry()[name], context)
