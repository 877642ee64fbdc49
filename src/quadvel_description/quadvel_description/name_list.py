"""Lists of names in sentences."""

from __future__ import annotations

from collections.abc import Sequence


def format_names(names: Sequence[str], most: int = 4) -> str:
    """Join the first names with commas and count the others.

    Args:
        names: Names to list.
        most: Number of names that are spelled out.

    Returns:
        The list, such as `a, b and 3 more`.
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
