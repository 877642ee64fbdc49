"""A recording on the operator's page, without ROS: `Playback` behind the controls of a film."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue

from .operator import Operator
from .playback import Playback
from .viewer import FRAME, Viewer
from .words import Pace, Play, Seek, Word


def replay(
    path: Path, host: str, port: int, is_over: Callable[[float], bool], tell: Callable[[str], None]
) -> None:
    """Serve the page, where it plays while somebody watches, until `is_over(seconds)`, which waits for so long, says so.

    tell: told the address. Raises RecordingError, OSError, and AddressError where the page can't be served.
    """
    playback = Playback(path)
    words: SimpleQueue[Word] = SimpleQueue()
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
            viewer.show(
                playback.picture,
                nobody,
                playback.time,
                said="",
                recording=None,
                notices=[],
                playback=playback.words(),
            )
    finally:
        viewer.close()


def heed(playback: Playback, word: Word) -> None:
    """Do what the page asks of a recording; the orders to a robot are ignored."""
    match word:
        case Play():
            playback.toggle()
        case Seek(time=moment):
            playback.seek(moment)
        case Pace(pace=pace):
            playback.set_pace(pace)


def _next(words: SimpleQueue[Word]) -> Word | None:
    try:
        return words.get_nowait()
    except Empty:
        return None
