"""Training of the network that tells legs from other things in a scan, and its file for `quadvel_follow.LegDetector`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import onnx
import torch
from torch import Tensor, nn

from quadvel_follow.clusters import NUMBERS

from .leg_examples import Examples, from_file, simulated
from .onnx_file import commit


@attrs.frozen
class LegConfig:
    """One run. scenes: simulated ones; share_real: of a batch, where there are real scans."""

    scenes: int = 1000
    share_real: float = 0.7
    share_legs: float = 0.5
    steps: int = 6000
    batch: int = 1024
    learning_rate: float = 2e-3
    hidden: tuple[int, ...] = (64, 32)
    dropout: float = 0.1
    seed: int = 7


class LegNetwork(nn.Module):
    """Things (N, NUMBERS) to the probability (N,) that each is a leg or a pair of legs."""

    def __init__(self, config: LegConfig) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(NUMBERS))
        self.register_buffer("scale", torch.ones(NUMBERS))
        layers: list[nn.Module] = []
        size = NUMBERS
        for width in config.hidden:
            layers += [nn.Linear(size, width), nn.SiLU(), nn.Dropout(config.dropout)]
            size = width
        self.body = nn.Sequential(*layers, nn.Linear(size, 1))

    def logit(self, things: Tensor) -> Tensor:
        """Of that probability."""
        return self.body((things - self.mean) / self.scale)[:, 0]

    def forward(self, things: Tensor) -> Tensor:
        return self.logit(things).sigmoid()


def train(config: LegConfig, real: Sequence[Examples], made: Examples) -> LegNetwork:
    """A network from real files, each of which counts alike, and simulated scenes."""
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    network = LegNetwork(config)
    every = Examples.joined([*real, made]).things
    network.mean.copy_(torch.from_numpy(every.mean(0)))
    network.scale.copy_(torch.from_numpy(every.std(0) + 1e-3))
    optimiser = torch.optim.AdamW(network.parameters(), config.learning_rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps)
    draws = _Draws(config, real, made, rng)
    for _ in range(config.steps):
        things, legs = draws.batch()
        loss = nn.functional.binary_cross_entropy_with_logits(
            network.logit(torch.from_numpy(things)), torch.from_numpy(0.02 + 0.96 * legs.astype(np.float32))
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network.eval()


class _Draws:
    """Batches, half of them mirrored."""

    def __init__(
        self, config: LegConfig, real: Sequence[Examples], made: Examples, rng: np.random.Generator
    ) -> None:
        self._config, self._rng = config, rng
        self._made = made
        self._real = list(real)

    def batch(self) -> tuple[np.ndarray, np.ndarray]:
        size = self._config.batch
        from_real = int(size * self._config.share_real) if self._real else 0
        for_legs = int(from_real * self._config.share_legs)
        parts = [
            *self._drawn([e for e in self._real if e.legs.any()], True, for_legs),
            *self._drawn([e for e in self._real if not e.legs.all()], False, from_real - for_legs),
            *self._drawn([self._made], True, int((size - from_real) * self._config.share_legs)),
            *self._drawn([self._made], False, int((size - from_real) * (1 - self._config.share_legs))),
        ]
        things, legs = np.concatenate([p.things for p in parts]), np.concatenate([p.legs for p in parts])
        turned = self._rng.random(len(things)) < 0.5
        things[turned, : NUMBERS - 4] = things[turned, NUMBERS - 5 :: -1]
        return things, legs

    def _drawn(self, sources: list[Examples], legs: bool, count: int) -> list[Examples]:
        """Some of the sources' legs, or of what is none."""
        parts = []
        for source in sources:
            which = self._rng.choice(self._where(source, legs), count // len(sources))
            parts.append(Examples(source.things[which], source.legs[which]))
        return parts

    def _where(self, source: Examples, legs: bool) -> np.ndarray:
        if not hasattr(self, "_index"):
            self._index: dict[tuple[int, bool], np.ndarray] = {}
        key = (id(source), legs)
        if key not in self._index:
            self._index[key] = np.flatnonzero(source.legs == legs)
        return self._index[key]


def export(network: LegNetwork, path: Path, about: dict[str, Any]) -> None:
    """Write the network as ONNX, things (N, NUMBERS) to probability (N,), whole or not at all."""
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        network.eval(),
        (torch.zeros(2, NUMBERS),),
        str(part),
        input_names=["things"],
        output_names=["probability"],
        dynamic_axes={"things": {0: "n"}, "probability": {0: "n"}},
        opset_version=17,
        dynamo=False,
    )
    model = onnx.load(part)
    onnx.helper.set_model_props(model, {"quadvel": json.dumps(about | {"kind": "legs", "commit": commit()})})
    onnx.save(model, part)
    part.replace(path)
