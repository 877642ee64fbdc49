"""Basis regressors from their entries in a parameter file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .base import DRIVE, JOINT
from .basis_regressors import MULTIPLIERS, SIGNALS, BasisRegressor
from .shapes import SHAPES


def load_regressor(entry: Any, joints: Sequence[str]) -> BasisRegressor:
    """Build a regressor from its entry in a parameter file.

    Args:
        entry: a mapping as `BasisRegressor.to_entry` returns it.
        joints: J joint names of the robot.

    Returns:
        The regressor.

    Raises:
        ValueError: the entry is wrong; the message names the field, the value found and the
            expected one.
    """
    if not isinstance(entry, Mapping):
        raise ValueError(f"found {entry!r}, expected a mapping")
    rest = dict(entry)
    rest.setdefault("at", DRIVE)
    kind, signal, times, at = (_word(rest, name) for name in ("kind", "signal", "times", "at"))
    owner, _, plain = signal.rpartition("/")
    for field, value, known in (
        ("kind", kind, SHAPES), ("times", times, MULTIPLIERS), ("at", at, (DRIVE, JOINT)), ("signal", plain, SIGNALS),
        ("signal", owner, ("", *joints)),
    ):  # fmt: skip
        if value not in known:
            raise ValueError(f"{field}: found {value!r}, expected one of {', '.join(known)}")
    named = rest.pop("joints", [])
    unknown = [name for name in named if name not in joints]
    if unknown or not named:
        raise ValueError(f"joints: found {named!r}, expected some of {', '.join(joints)}")
    on = np.array([list(joints).index(name) for name in named])
    weights, bound = (_numbers(rest.pop(name, None), name) for name in ("weights", "bound"))
    try:
        shape = SHAPES[kind](**{name: _numbers(value, name) for name, value in rest.items()})
    except TypeError as error:
        raise ValueError(f"{kind}: {error}") from None
    own = not owner and plain != "t"
    wide = len(on) if own else 1
    for name in shape.per_column_fields:
        if len(getattr(shape, name)) != wide:
            raise ValueError(f"{name}: found {len(getattr(shape, name))} numbers, expected {wide}")
    if own:
        every_joint = np.zeros(len(joints), dtype=np.intp)
        every_joint[on] = np.arange(len(on))
        shape = shape.for_columns(every_joint)
    if weights.shape != (len(on), shape.count) or bound.shape != (len(on),):
        raise ValueError(
            f"weights, bound: found shapes {weights.shape} and {bound.shape}, "
            f"expected {(len(on), shape.count)} and {(len(on),)}"
        )
    every = np.zeros((shape.count, len(joints))), np.zeros(len(joints))
    every[0][:, on], every[1][on] = weights.T, bound
    return BasisRegressor(signal, times, shape, np.isin(np.arange(len(joints)), on), *every, at)


def load_regressors(entries: Any, joints: Sequence[str]) -> list[BasisRegressor]:
    """Build the regressors of a list of entries.

    Args:
        entries: list of entries.
        joints: J joint names of the robot.

    Returns:
        The regressors.

    Raises:
        ValueError: an entry is wrong; the message names it.
    """
    if not isinstance(entries, (list, tuple)):
        raise ValueError(f"terms: found {entries!r}, expected a list")
    regressors = []
    for number, entry in enumerate(entries):
        try:
            regressors.append(load_regressor(entry, joints))
        except ValueError as error:
            raise ValueError(f"terms[{number}]/{error}") from None
    return regressors


def _word(entry: dict[str, Any], name: str) -> str:
    """Remove a string from an entry."""
    value = entry.pop(name, None)
    if not isinstance(value, str):
        raise ValueError(f"{name}: found {value!r}, expected a word")
    return value


def _numbers(value: Any, name: str) -> Any:
    """Return a number unchanged, a list as an array."""
    try:
        found = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: found {value!r}, expected numbers") from None
    if value is None or not np.isfinite(found).all():
        raise ValueError(f"{name}: found {value!r}, expected finite numbers")
    return found if found.ndim else value
