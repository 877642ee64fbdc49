"""`quadvel view`: the operator's page, on the robot that runs or on a recording of one."""

from __future__ import annotations

from pathlib import Path

from . import nodes
from .processes import StopSignals


def view(recording: Path | None, host: str, port: int | None) -> None:
    """Serve the page until Ctrl-C. host: the address to listen on. port: None for the node's own.

    Raises ValueError or OSError, of which AddressError and RecordingError are kinds, where that can't be.
    """
    if recording is None:
        given = {"host": host} | ({} if port is None else {"port": port})
        nodes.run("view", nodes.parameters(given))
        return
    from quadvel_view.replay import replay
    from quadvel_view.viewer import PORT

    with StopSignals() as signals:
        chosen = PORT if port is None else port
        replay(recording, host, chosen, signals.wait, lambda url: print(f"open {url}", flush=True))
