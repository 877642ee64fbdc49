"""Diagnostics messages for /diagnostics. For node files only: this module needs diagnostic_msgs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

LOG_THROTTLE_S = 5.0
"""s, shortest interval between two log lines about a lasting condition, such as refused messages.
"""


def diagnostics(
    stamp: Any, name: str, level: bytes, summary: str, values: Mapping[str, object]
) -> DiagnosticArray:
    """Build a DiagnosticArray that holds one status.

    Args:
        stamp: Time of the report, a builtin_interfaces/Time.
        name: Name of the node.
        level: A level constant of DiagnosticStatus.
        summary: One sentence that states the problem and what the operator can do.
        values: Values by name; each is converted with `str`.

    Returns:
        The message, ready to publish on /diagnostics.
    """
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=level, name=name, message=summary, hardware_id="quadvel", values=pairs)
    message = DiagnosticArray(status=[status])
    message.header.stamp = stamp
    return message
