"""Converters and validators for attrs fields; errors name field, value and expectation.

Each function returns keyword arguments for `attrs.field`. Validators raise ValueError.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array


def numbers(count: int, low: float = -np.inf) -> dict[str, Any]:
    """Return field arguments for `count` finite numbers, stored as a read-only array (count,).

    Args:
        count: Length of the array; a single number is repeated.
        low: Lower bound of every number.

    Returns:
        Converter and validator.
    """

    def convert(value: Any) -> Any:
        try:
            values = np.array(value, dtype=float)
        except (TypeError, ValueError):  # refused below
            return value
        if values.size == 1:
            values = np.full(count, values.item())
        values.flags.writeable = False
        return values

    def check(instance: object, attribute: attrs.Attribute[Any], value: Any) -> None:
        field = f"{type(instance).__name__}.{attribute.name}"
        if not isinstance(value, np.ndarray):
            raise ValueError(f"{field}: found {value!r}, expected one number or {count}")
        if value.shape != (count,):
            raise ValueError(f"{field}: found shape {value.shape}, expected one number or {count}")
        if not (np.isfinite(value).all() and (value >= low).all()):
            bound = "" if low == -np.inf else f" of at least {low:g}"
            raise ValueError(f"{field}: found {value.tolist()}, expected finite numbers{bound}")

    return {"converter": convert, "validator": check}


def number(low: float, high: float = np.inf) -> dict[str, Any]:
    """Return field arguments for one finite number.

    Args:
        low: Lower bound.
        high: Upper bound.

    Returns:
        Converter and validator.
    """

    def convert(value: Any) -> Any:
        try:
            return float(value)
        except (TypeError, ValueError):  # refused below
            return value

    def check(instance: object, attribute: attrs.Attribute[Any], value: Any) -> None:
        if not (isinstance(value, float) and np.isfinite(value) and low <= value <= high):
            bound = f"at least {low:g}" if high == np.inf else f"{low:g} to {high:g}"
            raise ValueError(f"{type(instance).__name__}.{attribute.name}: found {value}, expected {bound}")

    return {"converter": convert, "validator": check}


def whole_number(low: int = 0) -> dict[str, Any]:
    """Return field arguments for an integer, such as a seed or a count.

    Args:
        low: Lower bound.

    Returns:
        Validator.
    """

    def check(instance: object, attribute: attrs.Attribute[Any], value: int) -> None:
        if not isinstance(value, int) or value < low:
            field = f"{type(instance).__name__}.{attribute.name}"
            raise ValueError(f"{field}: found {value!r}, expected a whole number of {low} or more")

    return {"validator": check}


def or_none(field: dict[str, Any]) -> dict[str, Any]:
    """Return field arguments for an optional value.

    Args:
        field: Converter and validator of the value.

    Returns:
        Converter and validator that also accept None.
    """
    return {
        "converter": attrs.converters.optional(field["converter"]),
        "validator": attrs.validators.optional(field["validator"]),
    }


def points(minimum: int) -> dict[str, Any]:
    """Return field arguments for a list of points, stored as a read-only array (n, 2).

    Args:
        minimum: Smallest number of points.

    Returns:
        Converter and validator; coordinates are finite, and no point is repeated directly.
    """

    def convert(value: Any) -> Array:
        try:
            values = np.array(value, dtype=float)
        except (TypeError, ValueError):
            values = np.array(np.nan)
        values.flags.writeable = False
        return values

    def check(instance: object, attribute: attrs.Attribute[Any], value: Array) -> None:
        if value.ndim != 2 or value.shape[1:] != (2,) or len(value) < minimum or not np.isfinite(value).all():
            found = f"shape {value.shape}" if value.ndim else "no list of pairs of numbers"
            raise ValueError(
                f"{type(instance).__name__}.{attribute.name}: found {found}, expected {minimum} or more points [x, y]"
            )
        if minimum > 1 and not np.hypot(*np.diff(value, axis=0).T).all():
            raise ValueError(
                f"{type(instance).__name__}.{attribute.name}: found a point twice in a row, expected it once"
            )

    return {"converter": convert, "validator": check}


def one_of(choices: Sequence[str]) -> dict[str, Any]:
    """Return field arguments for one of several strings.

    Args:
        choices: Allowed values.

    Returns:
        Validator.
    """

    def check(instance: object, attribute: attrs.Attribute[Any], value: object) -> None:
        if value not in choices:
            raise ValueError(
                f"{type(instance).__name__}.{attribute.name}: found {value!r}, expected one of {', '.join(choices)}"
            )

    return {"validator": check}


def truth_value() -> dict[str, Any]:
    """Return field arguments for a boolean.

    Returns:
        Validator.
    """

    def check(instance: object, attribute: attrs.Attribute[Any], value: object) -> None:
        if not isinstance(value, bool):
            raise ValueError(
                f"{type(instance).__name__}.{attribute.name}: found {value!r}, expected true or false"
            )

    return {"validator": check}
