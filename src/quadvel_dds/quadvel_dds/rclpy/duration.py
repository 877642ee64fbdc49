"""Durations in nanoseconds."""

from __future__ import annotations

from quadvel_dds.errors import Partial, unsupported

S_TO_NS = 10**9


class Duration(Partial):
    """Duration, see rclpy's Duration; comparisons are not supported.

    Attributes:
        nanoseconds: Duration, ns.
    """

    def __init__(self, *, seconds: int | float = 0, nanoseconds: int = 0) -> None:
        """Create a duration as a sum.

        Args:
            seconds: Seconds.
            nanoseconds: Nanoseconds.
        """
        self.nanoseconds = int(seconds * S_TO_NS) + int(nanoseconds)

    __eq__ = __lt__ = __le__ = __gt__ = __ge__ = unsupported("comparing durations")
    __hash__ = None  # type: ignore[assignment]
