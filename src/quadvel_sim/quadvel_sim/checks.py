"""Field arguments for the attrs records of this package: conversion, bounds, the sentence that refuses."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np


def numbers(count: int, low: float = -np.inf) -> dict[str, Any]:
    """Field arguments: one number or `count`, finite, at least `low`; kept as a read-only array (count,)."""

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
    """Field arguments: a finite number from `low` to `high`."""

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
    """Field arguments: a whole number of `low` or more, such as a seed."""

    def check(instance: object, attribute: attrs.Attribute[Any], value: int) -> None:
        if not isinstance(value, int) or value < low:
            field = f"{type(instance).__name__}.{attribute.name}"
            raise ValueError(f"{field}: found {value!r}, expected a whole number of {low} or more")

    return {"validator": check}


def or_none(field: dict[str, Any]) -> dict[str, Any]:
    """Field arguments: as `field`, or None."""
    return {
        "converter": attrs.converters.optional(field["converter"]),
        "validator": attrs.validators.optional(field["validator"]),
    }
