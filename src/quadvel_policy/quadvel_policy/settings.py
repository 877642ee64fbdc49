"""Fields of configurations that become node parameters."""

from __future__ import annotations

from typing import Any

import attrs


def setting(default: Any, description: str, positive: bool = True) -> Any:
    """A field of a configuration that becomes a node parameter with this description."""
    validator = attrs.validators.gt(0.0) if positive else None
    return attrs.field(default=default, validator=validator, metadata={"description": description})
