"""Layout of a network's input: order, offset, scale and clipping of named quantities.

The policy's observation and the velocity estimator's features use this layout in training, in
simulation and on the robot. The ONNX file carries it as metadata.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import Array


def _floats(value: float | Iterable[float]) -> float | tuple[float, ...]:
    """Return a number or a tuple of numbers, as JSON stores them."""
    return tuple(float(x) for x in value) if isinstance(value, Iterable) else float(value)


@attrs.frozen
class InputTerm:
    """One named quantity; the network receives clip((value - offset) * scale, -clip, clip).

    Raises:
        ValueError: The size is below 1, a length is wrong, or a number is not finite.

    Attributes:
        name: Name of the quantity.
        size: Number of values.
        offset: Offset in the quantity's unit, a number or `size` numbers.
        scale: Scale in the inverse of the quantity's unit, a number or `size` numbers.
        clip: Bound of the scaled value; None: unbounded.
    """

    name: str
    size: int
    offset: float | tuple[float, ...] = attrs.field(default=0.0, converter=_floats)
    scale: float | tuple[float, ...] = attrs.field(default=1.0, converter=_floats)
    clip: float | None = None

    def __attrs_post_init__(self) -> None:
        if self.size < 1:
            raise ValueError(f"{self.name}: size is {self.size}, expected at least 1")
        for field in ("offset", "scale"):
            value = np.asarray(getattr(self, field))
            if value.ndim and value.shape != (self.size,):
                raise ValueError(f"{self.name}: {field} has {value.size} numbers, expected 1 or {self.size}")
            if not np.isfinite(value).all():
                raise ValueError(f"{self.name}: {field} is {getattr(self, field)}, expected finite numbers")
        if self.clip is not None and not self.clip > 0.0:
            raise ValueError(f"{self.name}: clip is {self.clip}, expected a bound above 0 or null")


class InputLayout:
    """Concatenation of terms to one vector of `size` float32 numbers.

    Attributes:
        terms: Terms in their order.
        size: Length of the input.
        names: Names of the terms in their order.
        offset: Offset of each number of the input, (size,).
        scale: Scale of each number of the input, (size,).
    """

    def __init__(self, terms: Sequence[InputTerm]) -> None:
        """Combine terms.

        Args:
            terms: Terms in their order.
        """
        self.terms = tuple(terms)
        self.size = sum(term.size for term in self.terms)
        self.names = tuple(term.name for term in self.terms)

        def spread(values: Iterable[Any]) -> Array:
            return np.concatenate(
                [np.broadcast_to(v, t.size) for t, v in zip(self.terms, values, strict=True)]
            )

        self.offset = spread(t.offset for t in self.terms)
        self.scale = spread(t.scale for t in self.terms)
        self._high = spread(np.inf if t.clip is None else t.clip for t in self.terms)
        self._low = -self._high

    def build(self, values: Mapping[str, ArrayLike]) -> NDArray[np.float32]:
        """Compute the network's input.

        Args:
            values: Value of each term, (..., term.size), with equal leading axes.

        Returns:
            Input, (..., size).
        """
        built = np.concatenate([values[name] for name in self.names], axis=-1, dtype=np.float64)
        built -= self.offset
        built *= self.scale
        np.maximum(built, self._low, out=built)
        return np.minimum(built, self._high, out=built).astype(np.float32)

    def to_metadata(self) -> list[dict[str, Any]]:
        """Return the layout for the metadata of a network file.

        Returns:
            A mapping per term.
        """
        return [attrs.asdict(term) for term in self.terms]

    @classmethod
    def from_metadata(cls, entries: Any, known: Mapping[str, int]) -> InputLayout:
        """Read a layout from the metadata of a network file.

        Args:
            entries: List that `to_metadata` returned.
            known: Size of each quantity that the reader can supply, by name.

        Returns:
            The layout.

        Raises:
            ValueError: An entry is malformed or unknown; the message names it.
        """
        fields = [field.name for field in attrs.fields(InputTerm)]
        if not isinstance(entries, list) or not entries:
            raise ValueError(f"is {entries!r}, expected a list of inputs")
        terms = []
        for entry in entries:
            if not isinstance(entry, dict) or sorted(entry) != sorted(fields):
                raise ValueError(f"holds {entry!r}, expected the fields {', '.join(fields)}")
            if known.get(entry["name"]) != entry["size"]:
                sizes = ", ".join(f"{name} ({size})" for name, size in known.items())
                raise ValueError(
                    f"holds {entry['name']!r} with size {entry['size']}, expected one of {sizes}"
                )
            try:
                terms.append(InputTerm(**entry))
            except TypeError as error:
                raise ValueError(f"holds {entry['name']!r}: {error}") from error
        return cls(terms)
