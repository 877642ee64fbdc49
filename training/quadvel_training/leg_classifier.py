"""Training of the leg classifier for laser scans, and its file for `quadvel_follow.LegDetector`.

`leg_examples` makes the examples, and `quadvel_eval.people.measure` scores the result.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import attrs
import numpy as np
import onnx
import torch
from torch import Tensor, nn

from quadvel_eval.people.measure import ScanRecording, detection_scores, identity_scores
from quadvel_follow.clusters import FEATURE_COUNT, WINDOW_OFFSETS_M
from quadvel_follow.leg_detector import LegDetector

from .leg_examples import Examples, read_examples_file, simulate_examples
from .onnx_file import commit


@attrs.frozen
class LegConfig:
    """Configuration of the leg classifier.

    Attributes:
        scenes: number of simulated scenes.
        share_real: share of real examples in a batch, if there are real scans.
        share_legs: share of legs in a batch.
        steps: optimiser steps.
        batch: examples per step.
        learning_rate: learning rate of AdamW at the start; it falls along a cosine.
        hidden: sizes of the hidden layers.
        dropout: dropout probability.
        seed: seed of all draws.
    """

    scenes: int = 1000
    share_real: float = 0.7
    share_legs: float = 0.5
    steps: int = 2500
    batch: int = 1024
    learning_rate: float = 2e-3
    hidden: tuple[int, ...] = (64, 32)
    dropout: float = 0.1
    seed: int = 7


class LegNetwork(nn.Module):
    """Probability (N,) that each object (N, NUMBERS) is a leg or a pair of legs."""

    def __init__(self, config: LegConfig) -> None:
        """Create the network.

        Args:
            config: configuration.
        """
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURE_COUNT))
        self.register_buffer("scale", torch.ones(FEATURE_COUNT))
        layers: list[nn.Module] = []
        size = FEATURE_COUNT
        for width in config.hidden:
            layers += [nn.Linear(size, width), nn.SiLU(), nn.Dropout(config.dropout)]
            size = width
        self.body = nn.Sequential(*layers, nn.Linear(size, 1))

    def logit(self, things: Tensor) -> Tensor:
        """Logit of the probability.

        Args:
            things: (N, NUMBERS).

        Returns:
            (N,).
        """
        return self.body((things - self.mean) / self.scale)[:, 0]

    def forward(self, things: Tensor) -> Tensor:
        """Evaluate the probability.

        Args:
            things: (N, NUMBERS).

        Returns:
            (N,), 0 to 1.
        """
        return self.logit(things).sigmoid()


def train(config: LegConfig, real: Sequence[Examples], made: Examples) -> LegNetwork:
    """Train a network on real files, each with equal weight, and simulated scenes.

    Args:
        config: configuration.
        real: examples of each file.
        made: simulated examples.

    Returns:
        The network.
    """
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    network = LegNetwork(config)
    every = Examples.concatenate([*real, made]).things
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
    """Random batches with equal shares of the sources, half of the examples mirrored."""

    def __init__(
        self, config: LegConfig, real: Sequence[Examples], made: Examples, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        share = config.share_real if real else 0.0
        # Source, indices and number of draws: legs, then others; of the real files, then simulated.
        self._pools: list[tuple[Examples, np.ndarray, int]] = []
        for legs, part in ((True, config.share_legs), (False, 1.0 - config.share_legs)):
            having = [source for source in real if (source.legs == legs).any()]
            for source, size in [(source, share / len(having)) for source in having] + [(made, 1.0 - share)]:
                self._pools.append(
                    (source, np.flatnonzero(source.legs == legs), int(config.batch * part * size))
                )

    def batch(self) -> tuple[np.ndarray, np.ndarray]:
        """Draw objects and whether they are legs."""
        drawn = [(source, self._rng.choice(which, count)) for source, which, count in self._pools]
        things = np.concatenate([source.things[which] for source, which in drawn])
        legs = np.concatenate([source.legs[which] for source, which in drawn])
        turned = self._rng.random(len(things)) < 0.5
        things[turned, : WINDOW_OFFSETS_M.size] = things[turned, WINDOW_OFFSETS_M.size - 1 :: -1]
        return things, legs


def read_examples(config: LegConfig, folder: Path) -> tuple[dict[Path, Examples], Examples]:
    """Read real scans and simulate others.

    Args:
        config: configuration.
        folder: folder with files legs_*.npz.

    Returns:
        Examples of each file, and simulated ones.

    Raises:
        FileNotFoundError: there is no such file in the folder.
    """
    files = sorted(folder.glob("legs_*.npz"))
    if not files:
        raise FileNotFoundError(f"{folder}: has no file legs_*.npz, expected scans with and without people")
    rng = np.random.default_rng(config.seed)
    return {file: read_examples_file(file, rng) for file in files}, simulate_examples(config.scenes, rng)


def cross_validate(
    config: LegConfig, real: Mapping[Path, Examples], made: Examples
) -> Iterator[tuple[str, dict[str, float]]]:
    """Evaluate each file with a network that was trained on the others.

    Args:
        config: configuration.
        real: examples of each file.
        made: simulated examples.

    Yields:
        Name of the file, and its figures as in `quadvel people`.
    """
    for left_out in real:
        network = train(config, [examples for file, examples in real.items() if file != left_out], made)
        with TemporaryDirectory() as folder:
            export(network, Path(folder) / "legs.onnx", {})
            detector = LegDetector(Path(folder) / "legs.onnx")
        recording = ScanRecording.load(left_out)
        yield (
            left_out.stem,
            (identity_scores if recording.legs is None else detection_scores)(recording, detector),
        )


def export(network: LegNetwork, path: Path, about: dict[str, Any]) -> None:
    """Write the network as ONNX, objects (N, NUMBERS) to probability (N,), atomically.

    Args:
        network: the network.
        path: file.
        about: how it was trained, for the metadata.
    """
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        network.eval(),
        (torch.zeros(2, FEATURE_COUNT),),
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
