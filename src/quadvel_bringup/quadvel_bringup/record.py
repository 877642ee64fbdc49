"""`quadvel record`: the topics that are there, into an MCAP file until Ctrl-C, or what led to a fault whenever there is one."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

import quadvel_dds
from quadvel_eval.output import output_file, output_folder

from .exclusivity import ros_domain
from .processes import StopSignals

LOOK = 0.5  # s, between two looks for new topics
AFTER = 3.0  # s, that a recording of a fault goes on behind it


def record(path: Path, topics: Sequence[str], seconds: float | None) -> int:
    """Record the topics named, or all, until Ctrl-C or for some seconds; returns the number of messages.

    Where nothing came there is no file. Raises FileExistsError if the file is there already.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists already; name another file")
    output_file(path)
    quadvel_dds.install()
    from .recorder import Recorder
    from .recording_file import RecordingFile
    from .session import Session

    console = Console(stderr=True, soft_wrap=True)
    wanted = _absolute(topics)
    ends = _end(seconds)
    with (
        StopSignals() as signals,
        console.status("recording; Ctrl-C stops") as status,
        Session("recorder", rights="recorder") as session,
        Recorder(session.node, RecordingFile(path)) as recorder,
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


def record_faults(folder: Path, topics: Sequence[str], before: float, seconds: float | None) -> int:
    """Keep what came last in memory; when the robot goes into fault, write the `before` s that led to it and AFTER s behind it.

    Until Ctrl-C or for some seconds; returns the number of files, each named after the time and the fault.
    """
    output_folder(folder)
    quadvel_dds.install()
    from quadvel_msgs.msg import ControllerState

    from .recorder import Recorder
    from .recording_file import Ring
    from .session import Session

    console, ring = Console(stderr=True, soft_wrap=True), Ring(before + AFTER)
    wanted = _absolute(topics)
    ends = _end(seconds)
    faults = Faults(ControllerState.FAULT)

    def save() -> None:
        path = folder / faults.file_name(datetime.now())
        console.print(f"{path}: {ring.save(path)} messages; {faults.reason}")
        faults.saved()

    with (
        StopSignals() as signals,
        console.status(f"keeps the last {before:g} s for a fault; Ctrl-C stops"),
        Session("recorder", rights="recorder") as session,
        Recorder(session.node, ring) as recorder,
    ):
        session.node.create_subscription(ControllerState, "controller/state", faults.hear, 10)
        while not signals.received and (left := ends - time.monotonic()) > 0.0:
            recorder.record_all(wanted)
            recorder.serve(session.executor, min(LOOK, left))
            if faults.is_due:
                save()
        if faults.is_open:
            save()
    console.print(f"{faults.count} {'fault' if faults.count == 1 else 'faults'} recorded in {folder}")
    return faults.count


class Faults:
    """Hears what the controller says of itself, and knows when a fault is to be written."""

    def __init__(self, mode: int) -> None:
        """mode: the one that is a fault."""
        self._mode, self._was = mode, False
        self._due = float("inf")
        self._name = self.reason = ""
        self.count = 0

    def hear(self, state: Any) -> None:
        """A ControllerState."""
        is_fault = state.mode == self._mode
        if is_fault and not self._was and not self.is_open:
            self._name, self.reason = state.fault, state.reason
            self._due = time.monotonic() + AFTER
        self._was = is_fault

    @property
    def is_open(self) -> bool:
        """Whether there was one that is not written yet."""
        return self._due < float("inf")

    @property
    def is_due(self) -> bool:
        """Whether it is time to write it."""
        return time.monotonic() >= self._due

    def file_name(self, now: datetime) -> str:
        """After the time and the fault."""
        return f"{now:%Y-%m-%d_%H-%M-%S}_{self._name or 'fault'}.mcap"

    def saved(self) -> None:
        """It is written."""
        self._due = float("inf")
        self.count += 1


def _absolute(topics: Sequence[str]) -> list[str]:
    """Topics of the root namespace, as the graph names them."""
    return [topic if topic.startswith("/") else f"/{topic}" for topic in topics]


def _end(seconds: float | None) -> float:
    """When so many seconds have passed, on the monotonic clock; never, for None."""
    return float("inf") if seconds is None else time.monotonic() + seconds


def _summary(counts: Counter[str]) -> str:
    return f"{counts.total()} messages on {len(counts)} topics"
