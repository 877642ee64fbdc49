"""Loggers of ROS 2."""

from __future__ import annotations

from enum import IntEnum

from quadvel_dds.errors import module_getattr

from .impl.rcutils_logger import RcutilsLogger, levels

__getattr__ = module_getattr(__name__)


class LoggingSeverity(IntEnum):
    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


def get_logger(name: str) -> RcutilsLogger:
    if not name:
        raise ValueError("Logger name must not be empty.")
    return RcutilsLogger(name)


def set_levels(texts: dict[str, str]) -> None:
    """Set levels given by name, by logger name ("" is the default). Raises ValueError on an unknown one."""
    for name, text in texts.items():
        if text.upper() not in LoggingSeverity.__members__:
            expected = ", ".join(member.lower() for member in LoggingSeverity.__members__)
            raise ValueError(f"--log-level: found '{text}', expected one of {expected}")
        levels[name] = int(LoggingSeverity[text.upper()])
