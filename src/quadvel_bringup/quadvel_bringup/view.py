"""`quadvel view`: the operator's page, on the robot that runs or on a recording of one."""

from __future__ import annotations

from pathlib import Path

import quadvel_dds

from . import nodes
from .processes import StopSignals


def view(recording: Path | None, host: str, port: int | None, for_foxglove: bool) -> None:
    """Serve the page until Ctrl-C, or the topics for Foxglove. host: the address to listen on. port: None for the usual one.

    Raises ValueError or OSError, of which AddressError and RecordingError are kinds, where that can't be.
    """
    if for_foxglove:
        if recording is not None:
            raise ValueError(
                f"{recording}: Foxglove opens recordings itself; --foxglove serves a robot that runs"
            )
        quadvel_dds.install()
        from quadvel_view import foxglove_live

        from .foxglove import serve

        serve(host, foxglove_live.PORT if port is None else port)
        return
    if recording is None:
        given = {"host": host} | ({} if port is None else {"port": port})
        nodes.run("view", nodes.arguments("view", given))
        return
    from quadvel_view.replay import replay
    from quadvel_view.viewer import PORT

    with StopSignals() as signals:
        chosen = PORT if port is None else port
        replay(recording, host, chosen, signals.wait, lambda url: print(f"open {url}", flush=True))
