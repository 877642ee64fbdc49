"""Training loop of every stage: budget, progress, curves, time shares and atomic checkpoints.

The stages (`privileged`, `constrained`, `dagger`, `estimator`) supply what is learned in one step.
"""

from __future__ import annotations

import math
import pickle
import signal
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any, Protocol

import attrs
import torch
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from quadvel_description.fields import positive

from . import process_group

SAVE_INTERVAL_S = 60.0
HEADLINES = ("followed", "error_xy", "error_wz", "falls_per_minute")
"""Figures that the progress line shows first, because it has room for a few only."""
BAR_WIDTH = 10
PROGRESS_WIDTH = BAR_WIDTH + len(" 100%") + len(" -:--:--") + 2
"""Characters of the progress line apart from the run's name and its figures."""


class CheckpointError(ValueError):
    """Checkpoint that does not fit."""


@attrs.frozen
class Budget:
    """Budget of a run, which ends when the first of the two is spent.

    Attributes:
        samples: number of samples, from the first start.
        minutes: duration from the start or the latest resumption, minutes.
    """

    samples: float = positive()
    minutes: float = positive()


class Run(Protocol):
    """Interface of a training run.

    Attributes:
        samples: number of samples so far.
    """

    samples: int

    def step(self, done: float) -> dict[str, float]:
        """Take one update.

        Args:
            done: share of the budget that is spent, 0 to 1.

        Returns:
            Figures for the log.
        """
        ...

    def state(self) -> dict[str, Any]:
        """Return everything that a resumed run needs.

        Returns:
            Tensors and plain values.
        """
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a state.

        Args:
            state: what `state` returned.
        """
        ...


class Keeper:
    """Base class of what keeps and evaluates a run at intervals of samples."""

    def __init__(self, every: float) -> None:
        """Set the interval.

        Args:
            every: number of samples.
        """
        self._every = every
        self._asked_at: int | None = None

    def due(self, samples: int) -> bool:
        """Whether a multiple of the interval was passed since the last call.

        Args:
            samples: number of samples so far.

        Returns:
            False at the first call.
        """
        before, self._asked_at = self._asked_at, samples
        return before is not None and samples // self._every > before // self._every

    def keep(self) -> dict[str, float]:
        """Keep the run as it is now.

        Returns:
            Figures for the curves.

        Raises:
            NotImplementedError: in the base class.
        """
        raise NotImplementedError


class Interrupt:
    """Context in which Ctrl-C only sets `requested`; a second one interrupts the process at once.

    Attributes:
        requested: whether Ctrl-C was pressed.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> Interrupt:
        """Install the signal handler.

        Returns:
            The context.
        """
        self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the signal handler."""
        signal.signal(signal.SIGINT, self._before)

    def _ask(self, *_: object) -> None:
        """Note the request, and restore the handler for a second one."""
        self.requested = True
        if process_group.rank() == 0:
            print("\nends after this update, and writes its checkpoint; a second Ctrl-C ends at once")
        signal.signal(signal.SIGINT, self._before)


class TimeShares:
    """Shares of the parts of an update in its time."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Count the time of a `with` block.

        Args:
            part: name that the time counts for.

        Yields:
            Nothing.
        """
        start = time.perf_counter()
        yield
        self._seconds[part] += time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """Return the shares since the last call.

        Returns:
            Share by part, 0 to 1.
        """
        total = sum(self._seconds.values())
        shares = {part: seconds / total for part, seconds in self._seconds.items()}
        self._seconds.clear()
        return shares


def save(content: dict[str, Any], path: Path) -> None:
    """Write a checkpoint atomically: a reader finds the old one or the new one.

    Args:
        content: tensors and plain values.
        path: file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    torch.save(content, part)
    part.replace(path)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint of any device to the CPU.

    Args:
        path: file.

    Returns:
        Its content.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: the file is no checkpoint.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
    except (pickle.UnpicklingError, RuntimeError, EOFError):
        raise CheckpointError(f"{path}: no checkpoint, expected one of quadvel_training (.pt)") from None
    return content


def linear(start: float, end: float, done: float) -> float:
    """Interpolate linearly.

    Args:
        start: value at 0.
        end: value from 1 on.
        done: progress, 0 to 1; larger values count as 1.

    Returns:
        The value at `done`.
    """
    return start + (end - start) * min(done, 1.0)


def cosine(start: float, end: float, done: float) -> float:
    """Interpolate along half a cosine.

    Args:
        start: value at 0.
        end: value from 1 on.
        done: progress, 0 to 1; larger values count as 1.

    Returns:
        The value at `done`.
    """
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * min(done, 1.0)))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of every parameter group.

    Args:
        optimiser: optimiser, changed in place.
        rate: learning rate.
    """
    for group in optimiser.param_groups:
        group["lr"] = float(rate)


def train(run: Run, budget: Budget, checkpoint: Path, keeper: Keeper | None = None) -> bool:
    """Run until the budget is spent; resume from the checkpoint, save at intervals and at the end.

    Ctrl-C stops the run after the present update, with everything saved. Of several processes the
    first one writes and decides when to stop.

    Args:
        run: training run.
        budget: when to stop.
        checkpoint: file to resume from, if it exists, and to write.
        keeper: what keeps and evaluates the run on the way.

    Returns:
        Whether the budget is spent.
    """
    known = load(checkpoint) if checkpoint.exists() else {}
    if known or process_group.size() > 1:
        run.restore(process_group.broadcast(known or run.state()))
    journal = (
        _Journal(run, checkpoint, keeper, known.get("seconds", 0.0)) if process_group.rank() == 0 else None
    )
    started, done, stopped = time.monotonic(), 0.0, False
    try:
        with Interrupt() as interrupt:
            while True:
                minutes = (time.monotonic() - started) / 60
                done = max(run.samples / budget.samples, minutes / budget.minutes)
                done, stopped = process_group.broadcast((done, interrupt.requested))
                if stopped or done >= 1.0:
                    break
                seen = run.step(done)
                if journal:
                    journal.note(done, seen)
    finally:
        if journal:
            journal.end()
    if journal:
        journal.save()
        if stopped:
            print("stopped; everything so far is in the checkpoint")
    process_group.broadcast(None)  # wait until everything is written
    return bool(done >= 1.0)


class _Journal:
    """Progress, curves and checkpoint, written by the first process."""

    def __init__(self, run: Run, checkpoint: Path, keeper: Keeper | None, seconds: float) -> None:
        self._run, self._checkpoint, self._keeper = run, checkpoint, keeper
        self._before, self._first = seconds, run.samples
        self._started = self._saved = time.monotonic()
        self._curves = SummaryWriter(str(checkpoint.parent))
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(BAR_WIDTH),
            TaskProgressColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self._task = self._progress.add_task(checkpoint.stem, total=1.0, note="")
        self._progress.start()

    def note(self, done: float, seen: dict[str, float]) -> None:
        """Show and plot the figures of an update; save at intervals."""
        samples = self._run.samples
        if self._keeper and self._keeper.due(samples):
            seen = seen | self._keeper.keep()
        for key, value in seen.items():
            self._curves.add_scalar(f"{self._checkpoint.stem}/{key}", value, samples)
        shown = _figures(seen)
        width = self._progress.console.width - PROGRESS_WIDTH - len(self._checkpoint.stem)
        self._progress.update(self._task, completed=done, note=_first_that_fit(shown, width))
        now = time.monotonic()
        if now - self._saved > SAVE_INTERVAL_S:
            self.save()
            self._saved = now
            rate = (samples - self._first) / (now - self._started)
            self._progress.console.print(
                f"{samples / 1e6:.2f} M samples, {rate:.0f}/s  {'  '.join(shown)}", soft_wrap=True
            )

    def save(self) -> None:
        """Write the checkpoint, with the total training time, s."""
        seconds = self._before + time.monotonic() - self._started
        save(self._run.state() | {"seconds": seconds}, self._checkpoint)

    def end(self) -> None:
        """Close progress bar and curves."""
        self._progress.stop()
        self._curves.close()


def _figures(seen: dict[str, float]) -> list[str]:
    """Return the figures of an update with their names, HEADLINES first; those with a "/" are only plotted."""
    names = [*(name for name in HEADLINES if name in seen), *(name for name in seen if name not in HEADLINES)]
    return [f"{name} {seen[name]:.3g}" for name in names if "/" not in name]


def _first_that_fit(figures: list[str], width: int) -> str:
    """Join the first figures that fit into a width, characters."""
    lengths = accumulate(len(figure) + 2 for figure in figures)
    return "  ".join(figure for figure, length in zip(figures, lengths, strict=True) if length - 2 <= width)
