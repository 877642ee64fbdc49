"""Field arguments for the attrs records of this package: conversion, bounds, the sentence that refuses."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray


def numbers(count: int, low: float = -np.inf) -> dict[str, Any]:
    """Field arguments: one number or `count`, finite, at least `low`; kept as a read-only array (count,)."""

    def convert(value: Any) -> NDArray[np.float64]:
        values = np.array(value, dtype=float)
        if values.size == 1:
            values = np.full(count, values.item())
        values.flags.writeable = False
        return values

    def check(instance: object, attribute: attrs.Attribute[Any], value: NDArray[np.float64]) -> None:
        field = f"{type(instance).__name__}.{attribute.name}"
        if value.shape != (count,):
            raise ValueError(f"{field}: found shape {value.shape}, expected one number or {count}")
        if not (np.isfinite(value).all() and (value >= low).all()):
            bound = "" if low == -np.inf else f" of at least {low:g}"
            raise ValueError(f"{field}: found {value.tolist()}, expected finite numbers{bound}")

    return {"converter": convert, "validator": check}


def number(low: float, high: float = np.inf) -> dict[str, Any]:
    """Field arguments: a finite number from `low` to `high`."""

    def check(instance: object, attribute: attrs.Attribute[Any], value: float) -> None:
        if not (np.isfinite(value) and low <= value <= high):
            bound = f"at least {low:g}" if high == np.inf else f"{low:g} to {high:g}"
            raise ValueError(f"{type(instance).__name__}.{attribute.name}: found {value}, expected {bound}")

    return {"converter": float, "validator": check}


def whole_number() -> dict[str, Any]:
    """Field arguments: a whole number of 0 or more, such as a seed."""

    def check(instance: object, attribute: attrs.Attribute[Any], value: int) -> None:
        if not isinstance(value, int) or value < 0:
            field = f"{type(instance).__name__}.{attribute.name}"
            raise ValueError(f"{field}: found {value!r}, expected a whole number of 0 or more")

    return {"validator": check}
