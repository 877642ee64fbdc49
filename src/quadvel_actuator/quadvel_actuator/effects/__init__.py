"""Registry of actuator effects: deviations from the empirical actuator model (EAM), by name.

Another package adds effects through entry points of the group `quadvel.effects`, each naming an
`EffectModel`.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from . import commands, dynamics, elastic, friction, gains, limits
from .base import (
    DRIVE,
    JOINT,
    AddedEffect,
    EffectModel,
    ErrorEffect,
    MemoryEffect,
    Parameter,
    Stage,
    TorqueEffect,
)

GROUP = "quadvel.effects"

__all__ = [
    "DRIVE", "JOINT", "AddedEffect", "EffectModel", "ErrorEffect", "MemoryEffect", "Parameter", "Stage", "TorqueEffect",
    "registry",
]  # fmt: skip


@cache
def registry() -> dict[str, type[EffectModel]]:
    """Return all known effects.

    Returns:
        Effect classes by name: those of this package and those of entry points.

    Raises:
        ValueError: an entry point names no `EffectModel`, or its name is already in use.
    """
    effects: dict[str, type[EffectModel]] = {}
    for module in (friction, limits, dynamics, elastic, gains, commands):
        effects |= {effect.name: effect for effect in module.EFFECTS}
    for entry in entry_points(group=GROUP):
        effect = entry.load()
        if not (isinstance(effect, type) and issubclass(effect, EffectModel)):
            raise ValueError(
                f"entry point {entry.name} of {GROUP}: found {effect!r}, expected an EffectModel"
            )
        if effect.name in effects:
            raise ValueError(f"entry point {entry.name} of {GROUP}: the name {effect.name} is taken")
        effects[effect.name] = effect
    return effects
