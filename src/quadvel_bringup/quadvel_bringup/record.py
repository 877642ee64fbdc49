"""`quadvel record`: the topics that are there, into an MCAP file, until Ctrl-C."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

import quadvel_dds
from quadvel_eval.output import output_file

from .alone import ros_domain
from .processes import StopSignals

LOOK = 0.5  # s, between two looks for new topics


def record(path: Path, topics: Sequence[str], seconds: float | None) -> int:
    """Record the topics named, or all, until Ctrl-C or for some seconds; returns the number of messages.

    Where nothing came there is no file. Raises FileExistsError if the file is there already.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists already; name another file")
    output_file(path)
    quadvel_dds.install()
    from .recorder import Recorder
    from .session import Session

    console = Console(stderr=True, soft_wrap=True)
    wanted = [topic if topic.startswith("/") else f"/{topic}" for topic in topics]
    ends = float("inf") if seconds is None else time.monotonic() + seconds
    with (
        StopSignals() as signals,
        console.status("recording; Ctrl-C stops") as status,
        Session("recorder", rights="recorder") as session,
        Recorder(session.node, path) as recorder,
    ):
        try:
            while not signals.received and (left := ends - time.monotonic()) > 0.0:
                recorder.record_all(wanted)
                recorder.serve(session.executor, min(LOOK, left))
                status.update(f"{_summary(recorder.counts)}; Ctrl-C stops")
        except OSError as error:
            written = f"after {_summary(recorder.counts)}, of which all but the last second or so can be read"
            raise OSError(f"{path}: the recording ended {written}: {error.strerror}") from error
    if not recorder.counts:
        path.unlink()
        sought = ", ".join(wanted) or "any topic"
        console.print(
            f"nothing came on {sought} on ROS domain {ros_domain()}, so there is no {path}; is a robot up?"
        )
        return 0
    for topic in wanted:
        if topic not in recorder.counts:
            console.print(f"nothing came on {topic}")
    console.print(f"{path}: {_summary(recorder.counts)}")
    return recorder.counts.total()


def _summary(counts: Counter[str]) -> str:
    return f"{counts.total()} messages on {len(counts)} topics"
