"""`quadvel record`: record topics to an MCAP file, or record the time around each fault."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from rich.console import Console

import quadvel_dds
from quadvel_recordings.output import created_folder, output_folder, output_recording
from quadvel_recordings.reading import DESCRIPTION_TOPIC

from .exclusivity import ros_domain
from .processes import StopSignals

DISCOVERY_PERIOD_S = 0.5
"""Time between two searches for new topics."""
AFTER_FAULT_S = 3.0
"""Time that a recording of a fault continues after it."""


def record(path: Path, topics: Sequence[str], seconds: float | None) -> bool:
    """Record topics, and the robot's description, until Ctrl-C or for a duration.

    Without any message no file is written.

    Args:
        path: The file to write.
        topics: Topics to record; empty for all.
        seconds: Duration, s, or None. It starts when every given topic has brought a message (any
            topic, if none is given), at the latest after session.DISCOVERY_TIMEOUT_S.

    Returns:
        Whether there is a message on every given topic, or on any if none is given.

    Raises:
        ValueError: The suffix of the file is not .mcap.
        FileExistsError: The file exists already.
        OSError: The disk is full.
    """
    output_recording(path)
    console, wanted = Console(markup=False, stderr=True, soft_wrap=True), _absolute(topics)
    with created_folder(path.parent):
        counts, present = _record_until(path, wanted, seconds, console)
        is_empty = not counts.keys() - ({DESCRIPTION_TOPIC} - set(wanted))
        if is_empty:
            path.unlink()
    if is_empty:
        sought = ", ".join(wanted) or "any topic"
        advice = _spelling(wanted, present) or "is a robot running, and its simulator not paused?"
        console.print(
            f"no message on {sought} on ROS domain {ros_domain()}; {path} was not written; {advice}"
        )
        return False
    silent = sorted(set(wanted) - counts.keys())
    for topic in silent:
        console.print(_silence(topic, present))
    console.print(f"{path}: {_summary(counts)}")
    return not silent


def _record_until(
    path: Path, wanted: Sequence[str], seconds: float | None, console: Console
) -> tuple[Counter[str], list[str]]:
    """Record `wanted` topics; return the number of messages by topic, and the topics that there were."""
    quadvel_dds.install()
    from .recorder import Recorder
    from .recording_file import RecordingFile
    from .session import DISCOVERY_TIMEOUT_S, Session

    discovered_by = time.monotonic() + DISCOVERY_TIMEOUT_S
    has_begun, ends, present = False, float("inf"), list[str]()
    with (
        StopSignals() as signals,
        console.status("recording; Ctrl-C stops") as status,
        Session("recorder", rights="recorder") as session,
        Recorder(session.node, RecordingFile(path)) as recorder,
    ):
        try:
            while not signals.received and (left := ends - time.monotonic()) > 0.0:
                recorder.record_all(_with_description(wanted))
                recorder.serve(session.executor, min(DISCOVERY_PERIOD_S, left))
                status.update(f"{_summary(recorder.counts)}; Ctrl-C stops")
                silent = set(wanted) - recorder.counts.keys()
                is_heard = recorder.counts and not silent
                present = [topic for topic, _ in session.node.get_topic_names_and_types()]
                if not has_begun and (is_heard or time.monotonic() > discovered_by):
                    has_begun, ends = True, _end(seconds)
                    for topic in sorted(silent) if recorder.counts else ():
                        console.print(f"{_silence(topic, present)}; the recording goes on")
            return recorder.counts, present
        except OSError as error:
            written = f"after {_summary(recorder.counts)}; about the last second of them is unreadable"
            raise OSError(f"{path}: the recording ended {written}: {error.strerror}") from error


def record_faults(folder: Path, topics: Sequence[str], before: float, seconds: float | None) -> bool:
    """Record the time around each fault, to a file named after time and fault.

    Args:
        folder: Folder for the files.
        topics: Topics to record; empty for all.
        before: Time to keep before a fault, s.
        seconds: Duration, s, or None for until Ctrl-C.

    Returns:
        Whether a controller was heard; without one no fault can be recorded.
    """
    output_folder(folder)
    quadvel_dds.install()
    from quadvel_msgs.msg import ControllerState

    from .recorder import Recorder
    from .recording_file import RingBuffer
    from .session import Session

    console, ring = Console(markup=False, stderr=True, soft_wrap=True), RingBuffer(before + AFTER_FAULT_S)
    wanted = _absolute(topics)
    ends = _end(seconds)
    faults = FaultTrigger(ControllerState.FAULT)

    def save() -> None:
        path = folder / faults.file_name(datetime.now())
        console.print(f"{path}: {ring.save(path)} messages; {faults.reason}")
        faults.mark_saved()

    with (
        StopSignals() as signals,
        console.status("no controller is heard yet; Ctrl-C stops") as shown,
        Session("recorder", rights="recorder") as session,
        Recorder(session.node, ring) as recorder,
    ):
        session.node.create_subscription(ControllerState, "controller/state", faults.on_state, 10)
        while not signals.received and (left := ends - time.monotonic()) > 0.0:
            recorder.record_all(_with_description(wanted))
            recorder.serve(session.executor, min(DISCOVERY_PERIOD_S, left))
            if faults.has_heard:
                shown.update(f"keeping the last {before:g} s for a fault; Ctrl-C stops")
            if faults.is_due:
                save()
        if faults.is_open:
            save()
    if not faults.has_heard:
        console.print(f"no controller was heard on ROS domain {ros_domain()}, so no fault could be recorded")
        return False
    console.print(f"{faults.count} {'fault' if faults.count == 1 else 'faults'} recorded in {folder}")
    return True


class FaultTrigger:
    """Detects faults in the controller's state, and determines when to save them.

    Args:
        mode: Number of the fault mode.

    Attributes:
        reason: Reason of the last fault.
        count: Number of saved faults.
        has_heard: Whether any state has arrived.
    """

    def __init__(self, mode: int) -> None:
        self._mode, self._was = mode, False
        self._due = float("inf")
        self._name = self.reason = ""
        self.count = 0
        self.has_heard = False

    def on_state(self, state: Any) -> None:
        """Process a state of the controller.

        Args:
            state: A ControllerState.
        """
        self.has_heard = True
        is_fault = state.mode == self._mode
        if is_fault and not self._was and not self.is_open:
            self._name, self.reason = state.fault, state.reason
            self._due = time.monotonic() + AFTER_FAULT_S
        self._was = is_fault

    @property
    def is_open(self) -> bool:
        """Whether there is an unsaved fault."""
        return self._due < float("inf")

    @property
    def is_due(self) -> bool:
        """Whether it is time to save the fault."""
        return time.monotonic() >= self._due

    def file_name(self, now: datetime) -> str:
        """Return the name of the file for the fault.

        Args:
            now: Local time.

        Returns:
            Name with time and fault.
        """
        return f"{now:%Y-%m-%d_%H-%M-%S}_{self._name or 'fault'}.mcap"

    def mark_saved(self) -> None:
        """Mark the fault as saved."""
        self._due = float("inf")
        self.count += 1


def _absolute(topics: Sequence[str]) -> list[str]:
    """Return topics with a leading slash, as the graph names them."""
    return [topic if topic.startswith("/") else f"/{topic}" for topic in topics]


def _spelling(topics: Sequence[str], present: Sequence[str]) -> str:
    """Suggest present topics for those that do not exist; "" if there are none with a similar name."""
    unknown = [topic for topic in topics if topic not in present]
    near = [name for topic in unknown for name in get_close_matches(topic, present, 1)]
    return f"did you mean {', '.join(near)}?" if near else ""


def _silence(topic: str, present: Sequence[str]) -> str:
    """Say that a topic has brought nothing, and what it may be called."""
    return "; ".join(filter(None, [f"no message on {topic}", _spelling([topic], present)]))


def _with_description(topics: Sequence[str]) -> list[str]:
    """Return the topics and that of the robot's description; all topics if none are given."""
    return [*topics, DESCRIPTION_TOPIC] if topics else []


def _end(seconds: float | None) -> float:
    """Return the end of a duration on the monotonic clock, s; infinity for None."""
    return float("inf") if seconds is None else time.monotonic() + seconds


def _summary(counts: Counter[str]) -> str:
    """Summarise counts of messages."""
    return f"{counts.total()} messages on {len(counts)} topics"
