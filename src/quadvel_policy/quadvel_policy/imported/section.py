"""Typed access to the fields of a file in another project's format; errors name file and field.

`mjlab`, `rl_sar` and `unitree_rl_lab` read their formats through it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np

from ..observation import JOINTS, MAX_GAINS, RATE_HZ, Vector

MAX_PERIOD_S = 0.1
"""Longest period of a policy, s: a slower one does not balance a robot; a number of 20 is in ms."""


class FormatError(ValueError):
    """A field of another project's file is missing or does not fit; names file, field, found, expected."""


class Section:
    """Fields of one mapping in a file.

    Attributes:
        fields: The fields by name.
    """

    def __init__(
        self,
        path: Path,
        fields: Any,
        place: str = "",
        files: Mapping[str, Path] = MappingProxyType({}),
    ) -> None:
        """Open a mapping.

        Args:
            path: The file, for errors.
            fields: The mapping.
            place: Place of the mapping in the file, for errors; "" for the whole file.
            files: Files of those fields that come from another file, for errors.

        Raises:
            FormatError: It is no mapping.
        """
        self._path, self._place, self._files = path, place, files
        if not isinstance(fields, Mapping):
            raise FormatError(
                f"{path}: {place or 'file'}: found {fields!r}, expected fields with their values"
            )
        self.fields = fields

    def refuse(self, name: str, expected: str) -> NoReturn:
        """Refuse a field.

        Args:
            name: The field.
            expected: What was expected.

        Raises:
            FormatError: Always.
        """
        found = repr(self.fields[name]) if name in self.fields else "nothing"
        found = found if len(found) <= 120 else f"{found[:117]}..."
        path = self._files.get(name, self._path)
        raise FormatError(f"{path}: {self._name(name)}: found {found}, expected {expected}")

    def check_period(self, name: str, period: float, quantity: str = "") -> None:
        """Refuse a period that the control loop cannot keep.

        Args:
            name: The field that it comes from.
            period: Period of the policy, s.
            quantity: What must be such a period, if not the field alone, with "to be ".

        Raises:
            FormatError: It is no multiple of the control period, or longer than MAX_PERIOD_S.
        """
        ticks = max(round(period * RATE_HZ), 1)
        if not 0.0 < period <= MAX_PERIOD_S or not np.isclose(period * RATE_HZ, ticks):
            self.refuse(name, f"{quantity}a multiple of {1.0 / RATE_HZ:g} s, at most {MAX_PERIOD_S:g} s")

    def section(self, name: str) -> Section:
        """Open a mapping in this one.

        Args:
            name: Its field.

        Returns:
            Its fields.
        """
        if not isinstance(self.fields.get(name), Mapping):
            self.refuse(name, "fields with their values")
        return Section(self._path, self.fields[name], self._name(name))

    def allow_only(self, names: Iterable[str], expected: str = "") -> None:
        """Refuse every field that is not known.

        Args:
            names: Known fields.
            expected: What was expected; "" for the list of names.
        """
        known = list(names)
        for name in self.fields:
            if name not in known:
                self.refuse(name, expected or f"only {', '.join(known)}")

    def number(self, name: str) -> float:
        """Read a finite number.

        Args:
            name: The field.

        Returns:
            The number.
        """
        found = self.numbers(name, 1)
        return found[0]

    def numbers(self, name: str, size: int, default: Any = None) -> Vector:
        """Read finite numbers.

        Args:
            name: The field.
            size: How many; a single number stands for all of them.
            default: Result for a missing or empty field; None: the field is required.

        Returns:
            The numbers.
        """
        value = self.fields.get(name)
        if value is None and default is not None:
            return tuple(np.broadcast_to(np.asarray(default, float), size).tolist())
        numbers = _finite(value)
        if numbers.shape not in ((), (size,)):
            self.refuse(name, "a finite number" if size == 1 else f"a finite number or {size} of them")
        return tuple(np.broadcast_to(numbers, size).tolist())

    def gains(self, name: str, kind: str) -> Vector:
        """Read the gains of the joints.

        Args:
            name: The field.
            kind: "kp" or "kd".

        Returns:
            The gains, (12,).
        """
        gains, most = self.numbers(name, JOINTS), MAX_GAINS[kind]
        if not 0.0 <= min(gains) <= max(gains) <= most:
            self.refuse(name, f"gains from 0 to {most:g}")
        return gains

    def bounds(self, name: str, size: int) -> tuple[Vector, Vector] | None:
        """Read pairs (low, high).

        Args:
            name: The field.
            size: How many; a single pair stands for all of them.

        Returns:
            Lower and upper bounds; None if the field is missing or empty.
        """
        value = self.fields.get(name)
        if value is None:
            return None
        pairs = _finite(value)
        if pairs.shape not in ((2,), (size, 2)) or not (pairs[..., 0] < pairs[..., 1]).all():
            many = f", or {size} of them" if size > 1 else ""
            self.refuse(name, f"a pair [low, high] with low below high{many}")
        low, high = np.broadcast_to(pairs, (size, 2)).T
        return tuple(low.tolist()), tuple(high.tolist())

    def texts(self, name: str) -> tuple[str, ...]:
        """Read a list of texts.

        Args:
            name: The field.

        Returns:
            The texts.
        """
        value = self.fields.get(name)
        if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
            self.refuse(name, "a list of names")
        return tuple(value)

    def flag(self, name: str) -> bool:
        """Read true or false; a missing field is false.

        Args:
            name: The field.

        Returns:
            The value.
        """
        value = self.fields.get(name, False)
        if not isinstance(value, bool):
            self.refuse(name, "true or false")
        return value

    def joint_map(self, name: str) -> tuple[int, ...]:
        """Read the motor index (order FR, FL, RR, RL) of each joint of the network.

        Args:
            name: The field.

        Returns:
            A permutation of 0 to 11.
        """
        numbers = _finite(self.fields.get(name))
        if numbers.shape != (JOINTS,) or sorted(numbers.tolist()) != list(range(JOINTS)):
            self.refuse(name, f"each of 0 to {JOINTS - 1} once")
        return tuple(int(number) for number in numbers)

    def _name(self, name: str) -> str:
        return f"{self._place}.{name}" if self._place else str(name)


def to_our_order(values: Vector, joint_map: tuple[int, ...]) -> Vector:
    """Reorder numbers of the network's joints to ours.

    Args:
        values: One number for each joint of the network, 12.
        joint_map: Index in `JOINT_NAMES` of each joint of the network.

    Returns:
        The numbers in the order of `JOINT_NAMES`.
    """
    return tuple(np.asarray(values)[np.argsort(joint_map)].tolist())


def _finite(value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return finite numbers as an array; an array without elements for anything else."""
    nothing = np.empty((0, 0, 0))
    if isinstance(value, bool | str) or value is None:
        return nothing
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return nothing
    return array if np.isfinite(array).all() else nothing
