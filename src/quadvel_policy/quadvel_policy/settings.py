"""Fields of configuration classes that become node parameters."""

from __future__ import annotations

from typing import Any

import attrs


def setting(default: Any, description: str, at_most: float | None = None) -> Any:
    """Declare a field of a configuration class that becomes a node parameter.

    Args:
        default: Default value; it determines the type.
        description: Meaning of the parameter, with its unit after the last comma.
        at_most: Largest value of a positive number; a larger limit would protect nothing. None if
            the parameter is not a number.

    Returns:
        The attrs field. A value out of range raises ValueError with field, value and bounds.
    """

    def check(_: object, field: attrs.Attribute[Any], value: Any) -> None:
        if at_most is not None and not 0.0 < value <= at_most:
            raise ValueError(f"{field.name} is {value}, expected above 0 and at most {at_most:.4g}")

    return attrs.field(default=default, validator=check, metadata={"description": description})
