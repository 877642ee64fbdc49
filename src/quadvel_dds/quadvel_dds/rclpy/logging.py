"""Loggers of ROS 2: lines on stderr, and messages on /rosout."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from enum import IntEnum
from functools import partialmethod
from typing import Any

from quadvel_dds.errors import Partial, module_getattr

__getattr__ = module_getattr(__name__)


class LoggingSeverity(IntEnum):
    """Severities of log messages, as in rclpy."""

    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


levels: dict[str, int] = {"": LoggingSeverity.INFO}  # by logger name; "" is the default
sinks: dict[str, Callable[[int, str, str, int, Any], None]] = {}
"""Further receivers by logger name: (level, name, message, time in ns, frame of the caller)."""


class RcutilsLogger(Partial):
    """Logger with a hierarchical name ("node.part"), see rclpy's RcutilsLogger.

    The methods `debug`, `info`, `warning`, `error` and `fatal` take a message and the options of
    `_log`.

    Attributes:
        name: Name of the logger.
    """

    def __init__(self, name: str = "") -> None:
        """Create a logger.

        Args:
            name: Name of the logger.
        """
        self.name = name
        self._places: dict[tuple[Any, int], float] = {}  # when each spoke last, where that counts
        self._severities: dict[tuple[Any, int], int] = {}

    def get_effective_level(self) -> int:
        """Return the level of the logger or of its nearest ancestor with one.

        Returns:
            Lowest severity that is logged.
        """
        name = self.name
        while name and not levels.get(name):
            name = name.rpartition(".")[0]
        return int(levels[name])

    def _log(
        self, severity: LoggingSeverity, message: str, *, once: bool = False, throttle_duration_sec: float = 0
    ) -> bool:
        """Log a message and return whether it was logged.

        `once` and `throttle_duration_sec` (s) limit the messages of each place in the program.
        """
        if severity < self.get_effective_level():
            return False
        frame = sys._getframe(1)
        place = (frame.f_code, frame.f_lasti)
        if self._severities.setdefault(place, severity) != severity:
            raise ValueError("Logger severity cannot be changed between calls.")
        now, last = time.monotonic(), self._places.get(place, float("-inf"))
        if now - last < throttle_duration_sec or (once and place in self._places):
            return False
        if once or throttle_duration_sec:
            self._places[place] = now
        stamp = time.time_ns()
        seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
        print(f"[{severity.name}] [{seconds}] [{self.name}]: {message}", file=sys.stderr, flush=True)
        if sink := sinks.get(self.name.partition(".")[0]) or sinks.get(self.name):
            sink(severity, self.name, str(message), stamp, frame)
        return True

    debug = partialmethod(_log, LoggingSeverity.DEBUG)
    info = partialmethod(_log, LoggingSeverity.INFO)
    warning = partialmethod(_log, LoggingSeverity.WARN)
    error = partialmethod(_log, LoggingSeverity.ERROR)
    fatal = partialmethod(_log, LoggingSeverity.FATAL)


def get_logger(name: str) -> RcutilsLogger:
    """Create a logger.

    Args:
        name: Name of the logger.

    Returns:
        The logger.

    Raises:
        ValueError: The name is empty.
    """
    if not name:
        raise ValueError("Logger name must not be empty.")
    return RcutilsLogger(name)


def set_levels(texts: dict[str, str]) -> None:
    """Set log levels.

    Args:
        texts: Level by logger name; the name "" is the default.

    Raises:
        ValueError: A level is unknown.
    """
    for name, text in texts.items():
        if text.upper() not in LoggingSeverity.__members__:
            expected = ", ".join(member.lower() for member in LoggingSeverity.__members__)
            raise ValueError(f"--log-level: found '{text}', expected one of {expected}")
        levels[name] = int(LoggingSeverity[text.upper()])
