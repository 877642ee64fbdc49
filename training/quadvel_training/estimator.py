"""Training of the linear-velocity estimator: on walks of the policy, on flat and rough ground, with every randomisation.

The estimator reads what the robot has (IMU, encoders, torques, the targets in force). In half of the environments the policy
walks on the estimate instead of the truth, so that the estimator is trained on the walks that it causes itself.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description.robot import GRAVITY
from quadvel_estimator import features
from quadvel_sim.terrain import Terrain

from . import parallel
from .env import TICK, CommandRange
from .loop import Budget, cosine, set_rate
from .networks import Recurrent, State, select
from .onnx_file import commit, export
from .ppo import living_mean
from .randomisation import Randomisation
from .walks import Walks, both_grounds

MEMORY = 128
HIDDEN = (64,)
KEEP = 2.0  # logit of the share of inertia before training: the legs correct it within some ticks


class VelocityNetwork(Recurrent):
    """A filter whose gains an LSTM sets: network input to velocity (3) and log variance (3).

    At every tick the velocity of the tick before goes on by what the IMU says, and is mixed with what the four legs say; the
    LSTM gives the five shares, a correction and the variance. The last three numbers of the state's first part are the
    velocity, the last three of its second part are not used.
    """

    def __init__(self) -> None:
        super().__init__(features.DEFAULT_LAYOUT.size, 6 + 5, MEMORY, HIDDEN)
        with torch.no_grad():
            self.body[-1].bias[-1] = KEEP
        spin = torch.linalg.cross(*torch.broadcast_tensors(torch.eye(3)[:, None], torch.eye(3)))
        self.register_buffer(
            "spin", spin.reshape(3, 9), persistent=False
        )  # w @ spin is, as a matrix, b -> w x b for rows

    def initial_state(self, n: int) -> State:
        """Zero state of `n` environments, at rest."""
        zeros = torch.zeros(1, n, MEMORY + 3)
        return zeros, zeros.clone()

    def forward(self, x: torch.Tensor, state: State) -> tuple[torch.Tensor, State]:
        """Output (T, N, 6) and the new state from x (T, N, 69) and the state (1, N, 131); N may be missing in all."""
        h, c = (part.split([MEMORY, 3], dim=-1) for part in state)
        y, (hidden, memory) = self.lstm(x, (h[0].contiguous(), c[0].contiguous()))
        correction, log_variance, logits = self.body(torch.nn.functional.silu(y)).split([3, 3, 5], dim=-1)
        share = logits.softmax(-1)
        legs, keep = (
            (share[..., :4, None] * _read(x, "leg_velocity").unflatten(-1, (4, 3))).sum(-2),
            share[..., 4:],
        )
        gained = TICK * (_read(x, "linear_acceleration") + GRAVITY * _read(x, "gravity"))
        # for rows: v - dt w x v = v (1 - dt [w]x)
        turn = torch.eye(3) - TICK * (_read(x, "angular_velocity") @ self.spin).unflatten(-1, (3, 3))
        carried, added = keep[..., None] * turn, keep * gained + legs + correction
        velocity, track = h[1][0], []
        for k in range(x.shape[0]):
            velocity = (velocity[..., None, :] @ carried[k])[..., 0, :] + added[k]
            track.append(velocity)
        output = torch.cat([torch.stack(track), log_variance], dim=-1)
        return output, (torch.cat([hidden, velocity[None]], dim=-1), torch.cat([memory, c[1]], dim=-1))


def _read(x: torch.Tensor, name: str) -> torch.Tensor:
    """The quantity `name` in its unit from the network input (..., 69), as far as it was not clipped."""
    start = 0
    for term in features.DEFAULT_LAYOUT.terms:
        if term.name == name:
            return x[..., start : start + term.size] / term.scale
        start += term.size
    raise KeyError(name)


Sequence = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class Walk:
    """Walks, and what the network makes of them; yields features and true velocities."""

    def __init__(self, walks: Walks, network: VelocityNetwork) -> None:
        self.walks, self.network = walks, network
        n = walks.env.config.n
        self.on_estimate = np.zeros(n, bool)
        self.state = network.initial_state(n)
        self._estimate = np.zeros((n, 3))

    def sequence(self, length: int) -> Sequence:
        """`length` ticks: features (T, N, 69), true velocity (T, N, 3), mask (T, N)."""
        walks, state = self.walks, self.state
        rows = []
        with torch.no_grad():
            for _ in range(length):
                sensed = walks.sense()
                x = features.build(sensed, walks.previous_action)
                rows.append((x, walks.truth.copy(), ~walks.over))
                # the controller works with the estimate of the state before
                believed = np.where(self.on_estimate[:, None], self._estimate, walks.noisy_truth())
                output, state = self.network(torch.from_numpy(x[None]), state)
                self._estimate = output[0, :, :3].numpy()
                walks.advance(sensed, believed)
        inputs, truth, mask = (torch.from_numpy(np.array(r, np.float32)) for r in zip(*rows, strict=True))
        return inputs, truth, mask

    def remember(self, ids: torch.Tensor, state: State) -> None:
        """Take over the memory (of `ids`) from the learner's pass."""
        for kept, new in zip(self.state, state, strict=True):
            kept[:, ids] = new.detach()

    def start_over(self, forget: float) -> None:
        """Start anew where a walk ended; a share `forget` of the others loses its memory, as after a gap in the stream."""
        ended = self.walks.over.copy()
        self.walks.start_over(np.flatnonzero(ended))
        lost = ended | (self.walks.env.rng.random(len(ended)) < forget)
        self._estimate[lost] = 0.0
        for memory in self.state:
            memory[:, lost] = 0.0


@attrs.frozen
class EstimatorConfig:
    """One run; half of the `n` robots of all processes walk on flat ground, half on rough."""

    budget: Budget = Budget(samples=8e6, minutes=15.0)
    n: int = 512
    length: int = 48  # ticks a sequence
    epochs: int = 2  # learning costs less than walking
    learning_rate: float = 2e-3
    final_learning_rate: float = 1e-4
    mini_batches: int = 8
    truth_first: float = 0.4  # share of the budget before the policy walks on the estimate anywhere
    seed: int = 2
    forget: float = 0.005  # share of the memories lost a sequence, as after a gap in the stream
    commands: CommandRange = CommandRange(vx=(-1.8, 2.6), vy=0.8, wz=1.6)
    randomisation: Randomisation = Randomisation()
    rough: Terrain = Terrain(kind="rough", roughness=0.06, blend=10.0)


def loss_terms(
    output: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Squared error for the velocity, Gaussian likelihood for the variance alone; a sample each.

    Trained on the likelihood together, a velocity that is hard to see is given up for a large variance.
    """
    square = (truth - output[..., :3]) ** 2
    log_variance = output[..., 3:].clamp(-10.0, 4.0)
    likelihood = 0.5 * (square.detach() * (-log_variance).exp() + log_variance)
    return living_mean(square.sum(-1), mask), living_mean(likelihood.sum(-1), mask)


class EstimatorRun:
    """Walks on both grounds, one network, one optimiser."""

    def __init__(self, config: EstimatorConfig, actor: Recurrent) -> None:
        parallel.join("cpu")
        self.config = config = attrs.evolve(config, n=parallel.share(config.n))
        torch.manual_seed(config.seed)
        self.network = VelocityNetwork()
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.samples = 0
        self.walks = [
            Walk(walks, self.network)
            for walks in both_grounds(
                config.n,
                parallel.seed_of(config.seed),
                config.commands,
                config.randomisation,
                config.rough,
                actor,
            )
        ]

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "samples": self.samples,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.samples = state["samples"]

    def export(self, path: Path, recipe: dict[str, Any]) -> None:
        """Write the estimator file."""
        metadata = features.metadata((1, 1, MEMORY + 3), recipe, commit())
        export(self.network, features.DEFAULT_LAYOUT.size, path, list(features.OUTPUTS), json.dumps(metadata))

    def step(self, done: float) -> dict[str, float]:
        """One sequence on each ground, and steps of the optimiser for mini-batches of both."""
        c = self.config
        set_rate(self.optimiser, cosine(c.learning_rate, c.final_learning_rate, done))
        for walk in self.walks:
            walk.on_estimate[:] = done > c.truth_first
            walk.on_estimate[1::2] = False
        data = [walk.sequence(c.length) for walk in self.walks]
        seen = {"flat": 0.0, "rough": 0.0, "nll": 0.0}
        for epoch in range(c.epochs):
            for ids in torch.randperm(c.n // 2).chunk(c.mini_batches):
                for name, value in self._learn(ids, data, remember=epoch == c.epochs - 1).items():
                    seen[name] += value / (c.mini_batches * c.epochs)
        for walk in self.walks:
            walk.start_over(c.forget)
        self.samples += c.length * c.n * parallel.size()
        return {"flat": seen["flat"] ** 0.5, "rough": seen["rough"] ** 0.5, "nll": seen["nll"]}

    def _learn(self, ids: torch.Tensor, data: list[Sequence], remember: bool) -> dict[str, float]:
        """One step; returns the mean squared error an axis on each ground, and the likelihood."""
        losses, squares = [], []
        for walk, (inputs, truth, mask) in zip(self.walks, data, strict=True):
            output, state = self.network(inputs[:, ids], select(walk.state, ids))
            square, likelihood = loss_terms(output, truth[:, ids], mask[:, ids])
            losses.append(10.0 * square + 0.1 * likelihood)
            squares.append(float(square.detach()) / 3)
            if remember:
                walk.remember(ids, state)
        loss = torch.stack(losses).mean()
        self.optimiser.zero_grad()
        loss.backward()
        parallel.share_gradients(self.network)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        return {"flat": squares[0], "rough": squares[1], "nll": float(likelihood.detach())}
