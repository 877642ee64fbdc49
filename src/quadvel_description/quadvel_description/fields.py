"""Fields of configuration records: default, description with unit, and bounds, declared in one way.

    friction: float = field(0.8, "sliding friction of a foot", at_least=0.0, at_most=3.0)

A wrong value raises a ValueError that names record, field, value found and expectation. Node
parameters are such fields, too; there the description becomes that of the ROS parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import attrs
import numpy as np

Numbers = float | tuple[float, ...]
"""One number, or several."""


def field(
    default: Any = attrs.NOTHING,
    description: str = "",
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    whole: bool = False,
    one_of: Collection[Any] = (),
    size: int = 0,
    **metadata: Any,
) -> Any:
    """Declare a field of an attrs class.

    With a bound, the value is a finite number or several; -inf is a bound, too. Whole numbers become
    floats unless `whole` is set, and lists become tuples.

    Args:
        default: Default value, or `attrs.Factory`; without it, the field is required. If it is
            None, None is allowed.
        description: Meaning, with the unit after the last comma.
        at_least: Lower bound.
        above: Lower bound that is excluded itself.
        at_most: Upper bound.
        whole: Whether numbers must be integers.
        one_of: Allowed values; empty: any.
        size: Length of a read-only array to which the value is converted; a single number is
            repeated. 0: no array.
        metadata: Further metadata.

    Returns:
        The field; its metadata are `description` and `bounds`, (low, high) or None.
    """
    checks: list[Any] = []
    converter: Callable[[Any], Any] | None = None
    bounded = size > 0 or whole or not (at_least is above is at_most is None)
    low, high = (-np.inf if at_least is None else at_least), (np.inf if at_most is None else at_most)
    if one_of:
        checks.append(partial(_check_choice, tuple(one_of)))
    if size:
        converter = partial(to_array, size)
        checks.append(partial(_check_size, size))
    if bounded:
        checks.append(partial(_check_bounds, low, -np.inf if above is None else above, high, whole))
        converter = converter or (None if whole else _to_float)
    if default is None:
        converter = attrs.converters.optional(converter) if converter else None
        checks = [attrs.validators.optional(checks)]
    return attrs.field(
        default=default,
        converter=converter,
        validator=checks or None,
        metadata={"description": description, "bounds": (low, high) if bounded else None, **metadata},
    )


positive = partial(field, above=0.0)
"""Declare a field of a positive number, or of several."""


def refusal(record: object, name: str, found: object, expected: str) -> ValueError:
    """Create the error of a wrong value.

    Args:
        record: The record, or its class.
        name: Name of the field.
        found: The value.
        expected: What was expected.

    Returns:
        The error.
    """
    kind = record if isinstance(record, type) else type(record)
    value = found.tolist() if isinstance(found, np.ndarray) else found
    return ValueError(f"{kind.__name__}.{name}: found {value!r}, expected {expected}")


def to_array(size: int | None, value: Any) -> Any:
    """Convert numbers to a read-only array.

    Args:
        size: Length to which a single number is repeated; None: no repetition.
        value: The numbers.

    Returns:
        The array, float; anything else than numbers unchanged, for a validator to refuse.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return value
    if size and array.size == 1:
        array = np.full(size, array.item())
    array.flags.writeable = False
    return array


def _to_float(value: Any) -> Any:
    """Convert an integer to a float, a list to a tuple, and leave anything else for the validator."""
    if isinstance(value, list):
        return tuple(value)
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _check_bounds(
    low: float,
    above: float,
    high: float,
    whole: bool,
    record: object,
    attribute: attrs.Attribute[Any],
    value: Any,
) -> None:
    """Refuse anything but finite numbers within bounds."""
    numbers = np.asarray(value)
    if numbers.dtype.kind not in ("iu" if whole else "iuf") or not bool(
        (np.isfinite(numbers) & (low <= numbers) & (above < numbers) & (numbers <= high)).all()
    ):
        noun = "a whole number" if whole else "finite numbers" if numbers.ndim else ""
        parts = [one for one in (noun, _describe(low, above, high)) if one]
        raise refusal(record, attribute.name, value, ", ".join(parts) or "a finite number")


def _describe(low: float, above: float, high: float) -> str:
    """Describe bounds in words; empty without bounds."""
    if -np.inf < low and high < np.inf:
        return f"{low:g} to {high:g}"
    parts = [f"at least {low:g}"] if low > -np.inf else [f"above {above:g}"] if above > -np.inf else []
    return " and ".join([*parts, f"at most {high:g}"] if high < np.inf else parts)


def _check_choice(
    choices: tuple[Any, ...], record: object, attribute: attrs.Attribute[Any], value: Any
) -> None:
    """Refuse a value that is not one of several."""
    if value not in choices:
        raise refusal(record, attribute.name, value, f"one of {', '.join(map(str, choices))}")


def _check_size(size: int, record: object, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Refuse anything but an array of the right length."""
    if not isinstance(value, np.ndarray):
        raise refusal(record, attribute.name, value, f"one number or a list of {size}")
    if value.shape != (size,):
        found = f"shape {value.shape}"
        raise ValueError(
            f"{type(record).__name__}.{attribute.name}: found {found}, expected one number or a list of {size}"
        )
