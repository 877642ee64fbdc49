"""The registry of effects: laws that the EAM lacks, by name.

Another package adds its own through an entry point of the group `quadvel.effects` that names an `EffectLaw`.
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
    """Every known law by its name; one that comes through an entry point may not take the name of another."""
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
