"""Registry of actuator effects: deviations from the empirical actuator model (EAM), by name.

Another package adds effects through entry points of the group `quadvel.effects`, each naming an
`EffectLaw`.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from . import commands, dynamics, elastic, friction, gains, limits
from .base import DRIVE, JOINT, AddedLaw, EffectLaw, ErrorLaw, MemoryLaw, Parameter, Stage, TorqueLaw

GROUP = "quadvel.effects"

__all__ = [
    "DRIVE", "JOINT", "AddedLaw", "EffectLaw", "ErrorLaw", "MemoryLaw", "Parameter", "Stage", "TorqueLaw", "registry",
]  # fmt: skip


@cache
def registry() -> dict[str, type[EffectLaw]]:
    """Return all known effects.

    Returns:
        Effect classes by name: those of this package and those of entry points.

    Raises:
        ValueError: an entry point names no `EffectLaw`, or its name is already in use.
    """
    laws: dict[str, type[EffectLaw]] = {}
    for module in (friction, limits, dynamics, elastic, gains, commands):
        laws |= {law.name: law for law in module.LAWS}
    for entry in entry_points(group=GROUP):
        law = entry.load()
        if not (isinstance(law, type) and issubclass(law, EffectLaw)):
            raise ValueError(f"entry point {entry.name} of {GROUP}: found {law!r}, expected an EffectLaw")
        if law.name in laws:
            raise ValueError(f"entry point {entry.name} of {GROUP}: the name {law.name} is taken")
        laws[law.name] = law
    return laws
