"""A recording on the operator's page, without ROS: `Playback` behind the controls of a film."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from .operator import Operator
from .playback import Playback
from .viewer import FRAME, Viewer


def replay(
    path: Path, host: str, port: int, is_over: Callable[[float], bool], tell: Callable[[str], None]
) -> None:
    """Serve the page, where it plays while somebody watches, until `is_over(seconds)`, which waits for so long, says so.

    tell: told the address. Raises RecordingError, OSError, and AddressError where the page can't be served.
    """
    playback = Playback(path)
    words: SimpleQueue[dict[str, Any]] = SimpleQueue()
    viewer = Viewer(host, port, lambda page, word: words.put(word), lambda page: None)
    nobody = Operator()
    try:
        tell(viewer.url)
        then = time.monotonic()
        while not is_over(FRAME):
            now = time.monotonic()
            if viewer.is_watched:
                playback.advance(now - then)
            then = now
            while (word := _next(words)) is not None:
                heed(playback, word)
            more = {"said": "", "recording": None, "playback": playback.words()}
            viewer.show(playback.picture, nobody, playback.time, **more)
    finally:
        viewer.close()


def heed(playback: Playback, word: dict[str, Any]) -> None:
    """Do what the page asks for; what makes no sense is left alone."""
    match word:
        case {"do": "play"}:
            playback.toggle()
        case {"do": "seek", "time": float() | int() as moment} if math.isfinite(moment):
            playback.seek(moment)
        case {"do": "pace", "pace": float() | int() as pace} if math.isfinite(pace):
            playback.set_pace(pace)


def _next(words: SimpleQueue[dict[str, Any]]) -> dict[str, Any] | None:
    try:
        return words.get_nowait()
    except Empty:
        return None
