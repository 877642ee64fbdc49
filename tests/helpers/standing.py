"""Waits until the robot of `quadvel up` stands, also on a busy machine."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

READY = "ready; waiting for a velocity command"
FAULT = "| fault: "
MAX_FAULTS = 3
STAND_UP = (("reset",), ("mode", "passive"), ("mode", "stand_up"))


def wait_until_ready(said: Callable[[], str], is_running: Callable[[], bool], seconds: float = 180.0) -> None:
    """Wait until the robot stands, and put it up again as an operator would if it went into fault.

    If a busy machine gives the controller no time for 50 ms, the robot stops: rightly so, but that is
    not what these tests are about.

    Args:
        said: What `up` has written so far.
        is_running: Whether `up` runs.
        seconds: Longest wait, s.
    """
    until, faults = time.monotonic() + seconds, 0
    while READY not in (text := said()).rpartition(FAULT)[2]:
        assert is_running(), text
        assert time.monotonic() < until, f"{READY!r} is not in:\n{text}"
        if text.count(FAULT) > faults:
            faults = text.count(FAULT)
            assert faults <= MAX_FAULTS, text
            for words in STAND_UP:
                subprocess.run([sys.executable, "-m", "quadvel_bringup", *words], check=False, timeout=120.0)
        time.sleep(0.05)
