"""Fields of configurations that become node parameters."""

from __future__ import annotations

from typing import Any

import attrs


def setting(default: Any, description: str, at_most: float | None = None) -> Any:
    """A field of a configuration that becomes a node parameter.

    Args:
        default: The value where none is given; it decides the type.
        description: What the parameter means, with its unit behind the last comma.
        at_most: The largest value of a number, which is above 0: a limit beyond this protects nothing. None where the
            parameter is no number.

    Returns:
        The attrs field. A number beyond these bounds raises ValueError, which names field, value and bounds.
    """

    def check(_: object, field: attrs.Attribute[Any], value: Any) -> None:
        if at_most is not None and not 0.0 < value <= at_most:
            raise ValueError(f"{field.name} is {value}, expected above 0 and at most {at_most:.4g}")

    return attrs.field(default=default, validator=check, metadata={"description": description})
