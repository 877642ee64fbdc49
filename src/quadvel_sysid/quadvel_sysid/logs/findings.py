"""One thing that was found in a log, as a record and a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import attrs

Kind = Literal["note", "warning", "refusal"]


@attrs.frozen
class Finding:
    """`text` begins with the field; `joints` are those that it is about, none where it is about all."""

    kind: Kind
    field: str
    joints: tuple[str, ...]
    text: str


def some(names: Sequence[str], most: int = 4) -> str:
    """The first of the names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
