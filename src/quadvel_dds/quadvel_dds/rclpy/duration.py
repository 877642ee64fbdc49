"""A span of time in nanoseconds."""

from __future__ import annotations

from functools import total_ordering

from quadvel_dds.errors import Partial

S_TO_NS = 10**9


@total_ordering
class Duration(Partial):
    def __init__(self, *, seconds: int | float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = int(seconds * S_TO_NS) + int(nanoseconds)

    def __repr__(self) -> str:
        return f"Duration(nanoseconds={self.nanoseconds})"

    def __eq__(self, other: object) -> bool:
        return self.nanoseconds == other.nanoseconds if isinstance(other, Duration) else NotImplemented

    def __lt__(self, other: object) -> bool:
        return self.nanoseconds < other.nanoseconds if isinstance(other, Duration) else NotImplemented

    __hash__ = None  # type: ignore[assignment]
