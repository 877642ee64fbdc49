"""A logger that writes lines as ROS 2 does, to stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

NAMES = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
levels: dict[str, int] = {"": 20}  # by logger name; "" is the default
sinks: dict[
    str, Callable[[int, str, str, int, Any], None]
] = {}  # by logger name: who else is told (topic /rosout)


class RcutilsLogger:
    """Logger with names in a hierarchy ("node.part").

    Every method takes, as keyword options, `once`, `skip_first` and `throttle_duration_sec`; they count for
    each place in the program that calls.
    """

    def __init__(self, name: str = "") -> None:
        self.name = name
        self._places: dict[tuple[str, int], float] = {}

    def get_child(self, name: str) -> RcutilsLogger:
        if not name:
            raise ValueError("Child logger name must not be empty.")
        return RcutilsLogger(f"{self.name}.{name}" if self.name else name)

    def set_level(self, level: int) -> None:
        levels[self.name] = int(level)

    def get_effective_level(self) -> int:
        name = self.name
        while name and not levels.get(name):
            name = name.rpartition(".")[0]
        return levels[name]

    def is_enabled_for(self, severity: int) -> bool:
        return severity >= self.get_effective_level()

    def debug(self, message: str, **kwargs: Any) -> bool:
        return self._log(message, 10, **kwargs)

    def info(self, message: str, **kwargs: Any) -> bool:
        return self._log(message, 20, **kwargs)

    def warning(self, message: str, **kwargs: Any) -> bool:
        return self._log(message, 30, **kwargs)

    def warn(self, message: str, **kwargs: Any) -> bool:
        return self._log(message, 30, **kwargs)

    def error(self, message: str, **kwargs: Any) -> bool:
        return self._log(message, 40, **kwargs)

    def fatal(self, message: str, **kwargs: Any) -> bool:
        return self._log(message, 50, **kwargs)

    def log(self, message: str, severity: int, **kwargs: Any) -> bool:
        return self._log(message, int(severity), **kwargs)

    def _log(
        self,
        message: str,
        severity: int,
        *,
        name: str | None = None,
        once: bool = False,
        skip_first: bool = False,
        throttle_duration_sec: float = 0.0,
    ) -> bool:
        if not self.is_enabled_for(severity):
            return False
        frame = sys._getframe(2)
        place = (frame.f_code.co_filename, frame.f_lineno)
        now = time.monotonic()
        last = self._places.get(place)
        if last is None and skip_first:
            self._places[place] = float("-inf")
            return False
        if last is not None and now - last < (float("inf") if once else throttle_duration_sec):
            return False
        if once or throttle_duration_sec:
            self._places[place] = now
        stamp = time.time_ns()
        name = name or self.name
        seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
        print(
            f"[{NAMES.get(severity, severity)}] [{seconds}] [{name}]: {message}", file=sys.stderr, flush=True
        )
        if sink := sinks.get(self.name.partition(".")[0]) or sinks.get(self.name):
            sink(severity, name, str(message), stamp, frame)
        return True
