"""What every training run shares: a budget, progress, curves, and checkpoints that are whole or absent."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, Protocol

import attrs
import torch
from rich.progress import Progress, TextColumn
from torch.utils.tensorboard import SummaryWriter

SAVE_EVERY = 60.0  # s


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


def save(content: dict[str, Any], path: Path) -> None:
    """Write a checkpoint so that a reader finds the old one or the new one, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    torch.save(content, part)
    part.replace(path)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint. Raises FileNotFoundError with a sentence."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def cosine(start: float, end: float, done: float) -> float:
    """From `start` to `end` along half a cosine."""
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * min(done, 1.0)))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of every group."""
    for group in optimiser.param_groups:
        group["lr"] = float(rate)


def train(run: Run, budget: Budget, checkpoint: Path) -> None:
    """Resume from `checkpoint` if it is there, run until the budget is spent, save on the way and at the end.

    Ctrl-C ends it early with everything saved.
    """
    if checkpoint.exists():
        run.restore(load(checkpoint))
    started = saved = time.monotonic()
    first = run.samples
    name = checkpoint.stem
    columns = [*Progress.get_default_columns(), TextColumn("{task.fields[note]}")]
    with SummaryWriter(str(checkpoint.parent)) as writer, Progress(*columns) as progress:
        task = progress.add_task(name, total=1.0, note="")
        try:
            while True:
                now = time.monotonic()
                done = max(run.samples / budget.samples, (now - started) / (60 * budget.minutes))
                if done >= 1.0:
                    break
                seen = run.step(done)
                for key, value in seen.items():
                    writer.add_scalar(f"{name}/{key}", value, run.samples)
                rate = (run.samples - first) / (time.monotonic() - started)
                note = "  ".join(f"{key} {value:.3g}" for key, value in seen.items())
                progress.update(task, completed=done, note=note)
                if now - saved > SAVE_EVERY:
                    save(run.state(), checkpoint)
                    saved = now
                    progress.console.print(
                        f"{run.samples / 1e6:.2f} M samples, {rate:.0f}/s  {note}", soft_wrap=True
                    )
        except KeyboardInterrupt:
            progress.console.print("stopped; the checkpoint holds everything so far")
    save(run.state(), checkpoint)
