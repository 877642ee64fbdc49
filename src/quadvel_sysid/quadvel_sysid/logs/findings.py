"""The record of one finding about a log: its kind, its field, its joints and a sentence."""

from __future__ import annotations

from typing import Literal

import attrs

Kind = Literal["note", "warning", "refusal"]


@attrs.frozen
class Finding:
    """One finding of a check.

    Attributes:
        kind: `note`, `warning` or `refusal`. After a refusal the log is not identified.
        field: The field of the log that the finding concerns, such as `q_des`.
        joints: Names of the joints concerned; empty if it concerns all of them.
        text: One sentence that begins with the field.
    """

    kind: Kind
    field: str
    joints: tuple[str, ...]
    text: str
