"""Replay of a recording on the operator page, without ROS.

It connects `playback` (the state at a time) to `viewer` (the page). `view_node` shows a live robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from .operator import Operator
from .order_queue import OrderQueue
from .page_protocol import Pace, PageMessage, Play, Seek
from .playback import Playback
from .viewer import FRAME_PERIOD_S, Viewer


def replay(
    path: Path,
    robot: str | None,
    host: str,
    port: int,
    is_over: Callable[[float], bool],
    announce: Callable[[str], None],
) -> None:
    """Serve the page and play the recording while a page is open.

    Errors of what it uses pass through: RecordingError, OSError, and AddressError if the address
    is unavailable.

    Args:
        path: A recording of a robot.
        robot: Name or file of the robot; None for the one that the recording names.
        host: Address to listen on.
        port: TCP port, 0 for a free one.
        is_over: Waits for the given time (s) and returns whether to end.
        announce: Receives the address of the page.
    """
    playback = Playback(path, robot)
    # The web server's thread fills the queue; this thread executes the orders between two frames.
    orders = OrderQueue()
    viewer = Viewer(playback.picture.robot, host, port, orders.put, lambda page: None)
    idle = Operator()  # the page needs one; a recorded robot is not driven
    try:
        announce(viewer.url)
        then = time.monotonic()
        while not is_over(FRAME_PERIOD_S):
            now = time.monotonic()
            if viewer.is_watched:
                playback.advance(now - then)
            then = now
            for _, order in orders.take_all():
                execute(playback, order)
            viewer.show(
                playback.picture,
                idle,
                playback.time,
                said="",
                recording=None,
                notices=[],
                playback=playback.status(),
            )
    finally:
        viewer.close()


def execute(playback: Playback, order: PageMessage) -> None:
    """Execute an order of the page on the playback; orders to a robot are ignored.

    The page's buttons offer the paces; `Playback` limits them.

    Args:
        playback: The playback.
        order: The order.
    """
    match order:
        case Play():
            playback.toggle()
        case Seek(time=moment):
            playback.seek(moment)
        case Pace(pace=pace):
            playback.set_pace(pace)
