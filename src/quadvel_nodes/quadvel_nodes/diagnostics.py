"""What a node reports on /diagnostics, in one message. For node files only: it needs diagnostic_msgs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

QUIET = 5.0
"""s between two lines of a node's log about what goes on and on, such as refused messages"""


def diagnostics(
    stamp: Any, name: str, level: bytes, summary: str, values: Mapping[str, object]
) -> DiagnosticArray:
    """One status: `level` is a constant of DiagnosticStatus, `summary` a sentence that a person can act on.

    `stamp` is a builtin_interfaces/Time, `name` the node's.
    """
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=level, name=name, message=summary, hardware_id="quadvel", values=pairs)
    message = DiagnosticArray(status=[status])
    message.header.stamp = stamp
    return message
