"""How named quantities become one network input: order, offset, scale and clip of each.

The policy's observation and the velocity estimator's features are both described this way, in training,
in simulation and on the robot, and the description travels inside the ONNX file. What the quantities mean
is said where they are named.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray


def _floats(value: float | Iterable[float]) -> float | tuple[float, ...]:
    """A number, or a tuple of numbers, as JSON keeps them."""
    return tuple(float(x) for x in value) if isinstance(value, Iterable) else float(value)


@attrs.frozen
class InputTerm:
    """One named quantity of `size` numbers; the network sees clip((value - offset) * scale, -clip, clip).

    `offset` and `scale` are one number or `size` numbers, in the quantity's unit and its inverse; `clip` is a
    bound or None.
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
    """The terms of a network's input in their order, as one vector of `size` float32 numbers."""

    def __init__(self, terms: Sequence[InputTerm]) -> None:
        self.terms = tuple(terms)
        self.size = sum(term.size for term in self.terms)
        self.names = tuple(term.name for term in self.terms)
        """The names of the terms in their order."""

        def spread(values: Iterable[Any]) -> NDArray[np.float64]:
            return np.concatenate(
                [np.broadcast_to(v, t.size) for t, v in zip(self.terms, values, strict=True)]
            )

        self.offset = spread(t.offset for t in self.terms)
        self.scale = spread(t.scale for t in self.terms)
        """Of each number of the input, (size,)."""
        self._high = spread(np.inf if t.clip is None else t.clip for t in self.terms)
        self._low = -self._high

    def build(self, values: Mapping[str, ArrayLike]) -> NDArray[np.float32]:
        """The input (..., size) from each term's value (..., term.size); all leading axes are the same."""
        built = np.concatenate([values[name] for name in self.names], axis=-1, dtype=np.float64)
        built -= self.offset
        built *= self.scale
        np.maximum(built, self._low, out=built)
        return np.minimum(built, self._high, out=built).astype(np.float32)

    def to_metadata(self) -> list[dict[str, Any]]:
        """The list that a network file's metadata carries."""
        return [attrs.asdict(term) for term in self.terms]

    @classmethod
    def from_metadata(cls, entries: Any, known: Mapping[str, int]) -> InputLayout:
        """Read `to_metadata`'s list; `known` maps each name that the reader can supply to its size.

        Raises ValueError naming the entry, what was found and what was expected.
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
