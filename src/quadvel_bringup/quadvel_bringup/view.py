"""`quadvel view`: the operator page for a running robot or a recording."""

from __future__ import annotations

from pathlib import Path

import quadvel_dds

from . import nodes
from .processes import StopSignals


def view(recording: Path | None, robot: str | None, host: str, port: int | None, for_foxglove: bool) -> None:
    """Serve the page, or the topics for Foxglove, until Ctrl-C.

    Args:
        recording: A recording to play, or None for the running robot.
        robot: Name or file of the robot; None for that of the recording, or the default one.
        host: Address to listen on.
        port: TCP port, or None for the default one.
        for_foxglove: Whether to serve Foxglove instead of the page.

    Raises:
        ValueError: The arguments contradict each other. AddressError, RecordingError and OSError
            pass through.
    """
    if for_foxglove:
        if recording is not None:
            raise ValueError(
                f"{recording}: Foxglove opens recordings itself; --foxglove serves a running robot"
            )
        quadvel_dds.install()
        from quadvel_view import foxglove_live

        from .foxglove import serve

        serve(host, foxglove_live.DEFAULT_PORT if port is None else port)
        return
    if recording is None:
        given = (
            {"host": host}
            | ({} if port is None else {"port": port})
            | ({} if robot is None else {"robot": robot})
        )
        nodes.run("view", nodes.ros_arguments("view", given))
        return
    from quadvel_view.replay import replay
    from quadvel_view.viewer import DEFAULT_PORT

    with StopSignals() as signals:
        chosen = DEFAULT_PORT if port is None else port
        replay(recording, robot, host, chosen, signals.wait, lambda url: print(f"open {url}", flush=True))
