"""Training of the linear-velocity estimator on the policy's walks.

The walks are on flat and rough ground, with every randomisation.

The inputs are what the robot has: IMU, encoders, torques, and the targets in force. In half of the
environments the policy walks on the estimate instead of the truth, so the estimator also learns
from the walks that it causes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description.fields import field
from quadvel_description.network_input import InputLayout
from quadvel_description.quadruped import GRAVITY
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator import features
from quadvel_sim.terrain import Terrain

from . import process_group
from .env import TICK_S, CommandRange
from .loop import Budget, cosine, set_rate
from .networks import Recurrent, State, select
from .onnx_file import commit, export
from .ppo import masked_mean
from .randomisation import Randomisation
from .walks import Walks, walks_on_both_grounds

MEMORY = 128
HIDDEN = (64,)
INITIAL_INERTIA_LOGIT = 2.0  # before training; the legs correct the velocity within some ticks


class VelocityNetwork(Recurrent):
    """Velocity filter whose gains an LSTM sets: network input to velocity (3) and log variance (3).

    At every tick the velocity of the tick before, propagated by the IMU, is mixed with the
    velocities by the four legs. The LSTM gives the five shares, a correction and the variance. The
    last three numbers of the state's first part are the velocity; those of its second part are
    unused.
    """

    def __init__(self, layout: InputLayout) -> None:
        """Create the network; at first it relies on inertia.

        Args:
            layout: terms of its input.
        """
        super().__init__(features.INPUT_SIZE, 6 + 5, MEMORY, HIDDEN)
        self.layout = layout
        with torch.no_grad():
            self.body[-1].bias[-1] = INITIAL_INERTIA_LOGIT
        # Velocities and turn are linear in the input: the rows of their matrix are the images of the unit vectors.
        units = torch.eye(features.INPUT_SIZE)
        maps = torch.cat([self._velocities(units), self._turn(units)], dim=-1)
        self.register_buffer("maps", maps, persistent=False)
        self.register_buffer("offset", torch.cat([torch.zeros(15), torch.eye(3).flatten()]), persistent=False)

    def initial_state(self, n: int) -> State:
        """Return the zero memory, at rest.

        Args:
            n: number of environments.

        Returns:
            Two parts, (1, n, MEMORY + 3) each.
        """
        zeros = torch.zeros(1, n, MEMORY + 3)
        return zeros, zeros.clone()

    def forward(self, x: torch.Tensor, state: State) -> tuple[torch.Tensor, State]:
        """Filter a sequence.

        Args:
            x: (T, N, 69), network input; N may be missing in all shapes.
            state: two parts, (1, N, 131) each.

        Returns:
            Velocity (m/s, body frame) and log variance (T, N, 6), and the new state.
        """
        (hidden, velocity), (cell, unused) = (part.split([MEMORY, 3], dim=-1) for part in state)
        y, (hidden, cell) = self.lstm(x, (hidden.contiguous(), cell.contiguous()))
        correction, log_variance, logits = self.body(torch.nn.functional.silu(y)).split([3, 3, 5], dim=-1)
        share = logits.softmax(-1)
        # v[k] = sum_i s_i v_leg_i + s_4 (v[k-1] + dt (a + g - w x v[k-1])) + correction
        # with shares s = softmax(logits) of the four legs and of inertia, specific force a, gravity g
        # and angular velocity w in the body frame. For row vectors, v - dt w x v = v (1 - dt [w]x).
        known, turn = torch.nn.functional.linear(x, self.maps.T, self.offset).split([15, 9], dim=-1)
        velocities = known.reshape(*x.shape[:-1], 5, 3)
        added = share[..., None, :] @ velocities + correction[..., None, :]
        carried = share[..., 4:, None] * turn.reshape(*x.shape[:-1], 3, 3)
        row, track = velocity.transpose(0, -2), []  # row vectors: (N, 1, 3), or (1, 3) without N
        for k in range(x.shape[0]):
            row = row @ carried[k] + added[k]
            track.append(row)
        output = torch.cat([torch.stack(track).squeeze(-2), log_variance], dim=-1)
        return output, (torch.cat([hidden, row.transpose(0, -2)], dim=-1), torch.cat([cell, unused], dim=-1))

    def _velocities(self, x: torch.Tensor) -> torch.Tensor:
        """Return the velocity from each leg, and what inertia adds, dt (a + g); (..., 15), m/s."""
        felt = self._quantity(x, "linear_acceleration") + GRAVITY * self._quantity(x, "gravity")
        return torch.cat([self._quantity(x, "leg_velocity"), TICK_S * felt], dim=-1)

    def _turn(self, x: torch.Tensor) -> torch.Tensor:
        """Return -dt [w]x, row by row, (..., 9): the matrix of v -> -dt w x v for row vectors."""
        # spin[i, j] = e_i x e_j
        spin = torch.linalg.cross(*torch.broadcast_tensors(torch.eye(3)[:, None], torch.eye(3)))
        return -TICK_S * self._quantity(x, "angular_velocity") @ spin.reshape(3, 9)

    def _quantity(self, x: torch.Tensor, name: str) -> torch.Tensor:
        """Extract a quantity from the network input (..., 69), in its unit, up to clipping."""
        start = 0
        for term in self.layout.terms:
            if term.name == name:
                return x[..., start : start + term.size] / term.scale
            start += term.size
        raise KeyError(name)


Sequence = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class EstimatedWalks:
    """Walks with the memory of the network on them.

    Attributes:
        walks: the walks.
        network: the estimator.
        on_estimate: (n,) bool, robots whose policy gets the estimate instead of the truth.
        state: memory of the network.
    """

    def __init__(self, walks: Walks, network: VelocityNetwork) -> None:
        """Start without memory.

        Args:
            walks: the walks.
            network: the estimator.
        """
        self.walks, self.network = walks, network
        n = walks.env.config.n
        self.on_estimate = np.zeros(n, bool)
        self.state = network.initial_state(n)
        self._estimate = np.zeros((n, 3))

    def sequence(self, length: int) -> Sequence:
        """Collect a sequence; the memory of the network stays that of its start until `store_memory`.

        Args:
            length: number of ticks.

        Returns:
            Features (T, N, 69), true velocity (T, N, 3), m/s, and mask (T, N).
        """
        walks, state = self.walks, self.state
        rows = []
        with torch.no_grad():
            for _ in range(length):
                sensed = walks.sense()
                x = features.build(walks.env.robot, sensed, walks.previous_action, self.network.layout)
                rows.append((x, walks.truth.copy(), ~walks.over))
                # the controller has the estimate of the tick before
                believed = np.where(self.on_estimate[:, None], self._estimate, walks.noisy_truth())
                output, state = self.network(torch.from_numpy(x[None]), state)
                self._estimate = output[0, :, :3].numpy()
                walks.advance(sensed, believed)
        inputs, truth, mask = (torch.from_numpy(np.array(r, np.float32)) for r in zip(*rows, strict=True))
        return inputs, truth, mask

    def store_memory(self, ids: torch.Tensor, state: State) -> None:
        """Take over the memory from the learner's pass.

        Args:
            ids: robots of the pass.
            state: their memory.
        """
        for kept, new in zip(self.state, state, strict=True):
            kept[:, ids] = new.detach()

    def start_over(self, forget: float) -> None:
        """Start new walks where one ended; some of the others lose their memory.

        A lost memory acts like a gap in the stream.

        Args:
            forget: share of these others.
        """
        ended = self.walks.over.copy()
        self.walks.start_over(np.flatnonzero(ended))
        lost = ended | (self.walks.env.rng.random(len(ended)) < forget)
        self._estimate[lost] = 0.0
        for memory in self.state:
            memory[:, lost] = 0.0


@attrs.frozen
class EstimatorConfig:
    """Configuration of the estimator; half of the robots walk on flat ground, half on rough.

    Attributes:
        robot: name of a shipped robot, or path of a robot.yaml.
        budget: when the run ends.
        n: number of robots, of all processes together.
        length: ticks per sequence.
        epochs: passes over a sequence; learning costs less than walking.
        learning_rate: learning rate of Adam at the start.
        final_learning_rate: the same at the end; it falls along a cosine.
        mini_batches: mini-batches per epoch.
        truth_first: share of the budget before the policy walks on the estimate.
        seed: seed of all draws.
        forget: share of the memories lost per sequence, as after a gap in the stream.
        commands: range of commands.
        randomisation: what varies.
        rough: the rough ground.
    """

    robot: str = DEFAULT_ROBOT
    budget: Budget = Budget(samples=8e6, minutes=15.0)
    n: int = field(512, at_least=1, whole=True)
    length: int = 48
    epochs: int = 2
    learning_rate: float = 2e-3
    final_learning_rate: float = 1e-4
    mini_batches: int = 8
    truth_first: float = 0.4
    seed: int = 2
    forget: float = 0.005
    commands: CommandRange = CommandRange(vx=(-1.8, 2.6), vy=0.8, wz=1.6)
    randomisation: Randomisation = Randomisation()
    rough: Terrain = Terrain(kind="rough", roughness=0.06, blend=10.0)


def loss_terms(
    output: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Losses of velocity and variance.

    The likelihood trains the variance alone. If it trained the velocity, too, the network would state
    a large variance where velocities are hard to see, instead of learning them.

    Args:
        output: (T, N, 6), velocity and log variance.
        truth: (T, N, 3), m/s.
        mask: (T, N).

    Returns:
        Mean squared error, summed over axes, and negative log likelihood.
    """
    # L_v = |v - v_hat|^2
    # L_nll = sum((v - v_hat)^2 / sigma^2 + log sigma^2) / 2, without gradient to v_hat
    square = (truth - output[..., :3]) ** 2
    log_variance = output[..., 3:].clamp(-10.0, 4.0)
    likelihood = 0.5 * (square.detach() * (-log_variance).exp() + log_variance)
    return masked_mean(square.sum(-1), mask), masked_mean(likelihood.sum(-1), mask)


class EstimatorRun:
    """Training run of the estimator: walks on both grounds, a network, an optimiser."""

    def __init__(self, config: EstimatorConfig, actor: Recurrent) -> None:
        """Create walks and network.

        Args:
            config: configuration.
            actor: policy of the walks.
        """
        process_group.join("cpu")
        self.config = config = attrs.evolve(config, n=process_group.local_share(config.n))
        torch.manual_seed(config.seed)
        self.robot = load_robot(config.robot)
        self.network = VelocityNetwork(features.default_layout(self.robot))
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.samples = 0
        self.walks = [
            EstimatedWalks(walks, self.network)
            for walks in walks_on_both_grounds(
                self.robot,
                config.n,
                process_group.process_seed(config.seed),
                config.commands,
                config.randomisation,
                config.rough,
                actor,
            )
        ]

    def state(self) -> dict[str, Any]:
        """Return everything that a resumed run needs.

        Returns:
            Tensors and plain values, for `restore`.
        """
        return {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "samples": self.samples,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint.

        Args:
            state: what `state` returned.
        """
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.samples = state["samples"]

    def export(self, path: Path, recipe: dict[str, Any]) -> None:
        """Write the estimator file.

        Args:
            path: ONNX file.
            recipe: how it was trained, for the metadata.
        """
        metadata = features.metadata(self.robot, (1, 1, MEMORY + 3), recipe, commit(), self.network.layout)
        export(self.network, features.INPUT_SIZE, path, list(features.OUTPUTS), json.dumps(metadata))

    def step(self, done: float) -> dict[str, float]:
        """Collect a sequence on each ground and learn from both.

        Args:
            done: share of the budget that is spent.

        Returns:
            RMS error per axis on each ground (m/s), and the mean negative log likelihood (nll).
        """
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
        self.samples += c.length * c.n * process_group.size()
        return {"flat": seen["flat"] ** 0.5, "rough": seen["rough"] ** 0.5, "nll": seen["nll"]}

    def _learn(self, ids: torch.Tensor, data: list[Sequence], remember: bool) -> dict[str, float]:
        """Take one step; return the mean squared error per axis on each ground, and nll, the mean of both."""
        losses, squares, likelihoods = [], [], []
        for walk, (inputs, truth, mask) in zip(self.walks, data, strict=True):
            output, state = self.network(inputs[:, ids], select(walk.state, ids))
            square, likelihood = loss_terms(output, truth[:, ids], mask[:, ids])
            losses.append(10.0 * square + 0.1 * likelihood)
            squares.append(float(square.detach()) / 3)
            likelihoods.append(float(likelihood.detach()))
            if remember:
                walk.store_memory(ids, state)
        loss = torch.stack(losses).mean()
        self.optimiser.zero_grad()
        loss.backward()
        process_group.share_gradients(self.network)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        return {"flat": squares[0], "rough": squares[1], "nll": float(np.mean(likelihoods))}
