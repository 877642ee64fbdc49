"""What every training run shares: a budget, progress, curves, where the time goes, and checkpoints, whole or absent."""

from __future__ import annotations

import math
import signal
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import attrs
import torch
from rich.progress import Progress, TextColumn
from torch.utils.tensorboard import SummaryWriter

from . import parallel

SAVE_EVERY = 60.0  # s


class CheckpointError(ValueError):
    """A checkpoint of something else."""


@attrs.frozen
class Budget:
    """A run ends when the first of the two is spent; minutes count from its start or resumption."""

    samples: float
    minutes: float


class Run(Protocol):
    """A training run: `samples` so far, one `step` given the spent share of the budget, its state for a checkpoint."""

    samples: int

    def step(self, done: float) -> dict[str, float]:
        """One update; returns what is worth plotting."""
        ...

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        ...


class Keeper:
    """Keeps and judges what a run has become, every so many samples."""

    def __init__(self, every: float) -> None:
        self._every = every
        self._asked_at: int | None = None

    def due(self, samples: int) -> bool:
        """Whether a multiple of `every` was passed since this was asked last."""
        before, self._asked_at = self._asked_at, samples
        return before is not None and samples // self._every > before // self._every

    def keep(self) -> dict[str, float]:
        """Keep the run as it is now; returns what is worth plotting."""
        raise NotImplementedError


class Interrupt:
    """Ctrl-C, to be taken up between two updates; a second one ends the process where it is."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Interrupt:
        self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _ask(self, *_: object) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, self._before)


class Shares:
    """Where the time of an update goes."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Time in the block counts as this part's."""
        start = time.perf_counter()
        yield
        self._seconds[part] += time.perf_counter() - start

    def taken(self) -> dict[str, float]:
        """The share of each part in all that was counted since the last call."""
        total = sum(self._seconds.values())
        shares = {part: seconds / total for part, seconds in self._seconds.items()}
        self._seconds.clear()
        return shares


def save(content: dict[str, Any], path: Path) -> None:
    """Write a checkpoint so that a reader finds the old one or the new one, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    torch.save(content, part)
    part.replace(path)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint, whatever device wrote it. Raises FileNotFoundError with a sentence."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    content: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
    return content


def linear(start: float, end: float, done: float) -> float:
    """From `start` to `end` in a straight line."""
    return start + (end - start) * min(done, 1.0)


def cosine(start: float, end: float, done: float) -> float:
    """From `start` to `end` along half a cosine."""
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * min(done, 1.0)))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of every group."""
    for group in optimiser.param_groups:
        group["lr"] = float(rate)


def train(run: Run, budget: Budget, checkpoint: Path, keeper: Keeper | None = None) -> bool:
    """Resume from `checkpoint` if it is there, run until the budget is spent, save on the way and at the end.

    Ctrl-C ends it after the update under way, with everything saved; returns whether the budget is spent. Of several
    processes the first one writes, and says when it is over.
    """
    known = load(checkpoint) if checkpoint.exists() else {}
    if known or parallel.size() > 1:
        run.restore(parallel.from_first(known or run.state()))
    journal = _Journal(run, checkpoint, keeper, known.get("seconds", 0.0)) if parallel.rank() == 0 else None
    started, done, stopped = time.monotonic(), 0.0, False
    try:
        with Interrupt() as interrupt:
            while True:
                minutes = (time.monotonic() - started) / 60
                done = max(run.samples / budget.samples, minutes / budget.minutes)
                done, stopped = parallel.from_first((done, interrupt.asked))
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
            print("stopped; the checkpoint holds everything so far")
    parallel.from_first(None)  # none goes on before all is written
    return bool(done >= 1.0)


class _Journal:
    """What the first process writes: progress, curves, the checkpoint."""

    def __init__(self, run: Run, checkpoint: Path, keeper: Keeper | None, seconds: float) -> None:
        self._run, self._checkpoint, self._keeper = run, checkpoint, keeper
        self._before, self._first = seconds, run.samples
        self._started = self._saved = time.monotonic()
        self._curves = SummaryWriter(str(checkpoint.parent))
        self._progress = Progress(*Progress.get_default_columns(), TextColumn("{task.fields[note]}"))
        self._task = self._progress.add_task(checkpoint.stem, total=1.0, note="")
        self._progress.start()

    def note(self, done: float, seen: dict[str, float]) -> None:
        """Tell what the last update showed; save now and then."""
        samples = self._run.samples
        if self._keeper and self._keeper.due(samples):
            seen = seen | self._keeper.keep()
        for key, value in seen.items():
            self._curves.add_scalar(f"{self._checkpoint.stem}/{key}", value, samples)
        told = {
            key: value for key, value in seen.items() if "/" not in key
        }  # parts of a figure are for the curves
        note = "  ".join(f"{key} {value:.3g}" for key, value in told.items())
        self._progress.update(self._task, completed=done, note=note)
        now = time.monotonic()
        if now - self._saved > SAVE_EVERY:
            self.save()
            self._saved = now
            rate = (samples - self._first) / (now - self._started)
            self._progress.console.print(
                f"{samples / 1e6:.2f} M samples, {rate:.0f}/s  {note}", soft_wrap=True
            )

    def save(self) -> None:
        """Write the checkpoint, with the time that it took in all (s)."""
        seconds = self._before + time.monotonic() - self._started
        save(self._run.state() | {"seconds": seconds}, self._checkpoint)

    def end(self) -> None:
        """End what is shown."""
        self._progress.stop()
        self._curves.close()
