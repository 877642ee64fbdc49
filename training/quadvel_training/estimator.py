"""Training of the linear-velocity estimator: on walks of the policy, on flat and rough ground, with every randomisation.

The estimator reads what the robot has (IMU, encoders, the targets in force). In half of the environments the policy walks
on the estimate instead of the truth, so that the estimator is trained on the walks that it causes itself.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description.robot import NOMINAL_Q
from quadvel_description.state import RobotState
from quadvel_estimator import features
from quadvel_policy.observation import DEFAULT_OBSERVATION, build_observation
from quadvel_sim.terrain import Terrain

from . import student
from .env import CommandRange, EnvConfig, VelocityEnv
from .loop import Budget, cosine, set_rate
from .networks import Recurrent, State
from .ppo import select

MEMORY = 128
HIDDEN = (64,)
NOISE_ACCELERATION = 0.3  # m/s^2
BIAS_ACCELERATION = 0.15  # m/s^2, constant a walk
BIAS_ANGULAR_VELOCITY = 0.01  # rad/s
BIAS_TILT = 0.01  # rad


def new_network() -> Recurrent:
    """45 numbers in; velocity (3) and log variance (3) out."""
    return Recurrent(features.DEFAULT_LAYOUT.size, 6, MEMORY, HIDDEN)


Sequence = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class Walk:
    """A batch of environments that a frozen policy drives; yields features and true velocities."""

    def __init__(self, env: VelocityEnv, actor: Recurrent, estimator: Recurrent) -> None:
        self.env, self.actor, self.estimator = env, actor, estimator
        n = env.config.n
        self.map = student.action_map(env)
        self.action = np.zeros((n, 12), np.float32)
        self.target = np.tile(env.stand_q, (n, 1))
        self.on_estimate = np.arange(n) % 2 == 0
        self._policy_state = actor.initial_state(n)
        self.state = estimator.initial_state(n)
        self._biases = np.zeros((n, 8))
        self._start(np.arange(n))

    def _start(self, ids: np.ndarray) -> None:
        self._biases[ids] = self.env.rng.normal(size=(len(ids), 8)) * (
            [BIAS_ACCELERATION] * 3 + [BIAS_ANGULAR_VELOCITY] * 3 + [BIAS_TILT] * 2
        )
        self.action[ids] = 0.0
        self.target[ids] = self.env.stand_q
        for memory in (*self._policy_state, *self.state):
            memory[:, ids] = 0.0

    def sequence(self, length: int) -> Sequence:
        """`length` ticks: features (T, N, 45), true velocity (T, N, 3), mask (T, N)."""
        env, n = self.env, self.env.config.n
        alive = np.ones(n, bool)
        inputs, truths, masks = [], [], []
        state = self.state
        with torch.no_grad():
            for _ in range(length):
                sensed = env.sense()
                x = features.build(self._robot_state(sensed), self.target - NOMINAL_Q)
                estimate, state = self.estimator(torch.from_numpy(x[None]), state)
                inputs.append(x)
                truths.append(env.velocity.copy())
                masks.append(alive.copy())
                sensed["linear_velocity"][self.on_estimate] = estimate[0, self.on_estimate, :3].numpy()
                obs = build_observation(
                    DEFAULT_OBSERVATION, command=env.command, previous_action=self.action, **sensed
                )
                action, self._policy_state = self.actor(torch.from_numpy(obs[None]), self._policy_state)
                self.action = action[0].numpy()
                self.target = self.map.targets(self.action)
                env.tick(self.target)
                alive &= ~(env.fallen | env.timed_out)
        self._over = np.flatnonzero(~alive)
        tensors = (torch.from_numpy(np.array(x, dtype=np.float32)) for x in (inputs, truths, masks))
        return tuple(tensors)

    def _robot_state(self, sensed: dict[str, np.ndarray]) -> RobotState:
        """What the robot would report, with the sensors' biases."""
        env, b = self.env, self._biases
        n = len(b)
        tilt = np.concatenate([np.ones((n, 1)), b[:, 6:] / 2, np.zeros((n, 1))], axis=1)
        noise = NOISE_ACCELERATION * env.rng.standard_normal((n, 3))
        return RobotState(
            time=0.0,
            tick=0,
            q=sensed["q"],
            dq=sensed["dq"],
            tau=env.torque,
            quaternion=_multiply(env.quaternion, tilt / np.linalg.norm(tilt, axis=1, keepdims=True)),
            angular_velocity=sensed["angular_velocity"] + b[:, 3:6],
            linear_acceleration=env.acceleration + noise + b[:, :3],
            foot_force=np.zeros((n, 4)),
        )

    def remember(self, ids: torch.Tensor, state: State) -> None:
        """Take over the memory (of `ids`) from the learner's pass."""
        for kept, new in zip(self.state, state, strict=True):
            kept[:, ids] = new.detach()

    def start_over(self) -> None:
        """Put the environments that ended in the last sequence back to a start."""
        if len(self._over):
            self.env.reset(self._over)
            self._start(self._over)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product, wxyz, (n, 4)."""
    scalar = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([scalar, vector], axis=1)


@attrs.frozen
class EstimatorConfig:
    """One run; half of the `n` environments walk on flat ground, half on rough."""

    budget: Budget = Budget(samples=6e6, minutes=15.0)
    n: int = 512
    length: int = 32
    learning_rate: float = 2e-3
    final_learning_rate: float = 1e-4
    mini_batches: int = 4
    truth_first: float = 0.4  # share of the budget before the policy walks on the estimate anywhere
    seed: int = 2
    commands: CommandRange = CommandRange()
    rough: Terrain = Terrain(kind="rough", roughness=0.04, size=30.0)


def loss_terms(
    output: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Squared error for the velocity, Gaussian likelihood for the variance alone; a sample each.

    Trained on the likelihood together, a velocity that is hard to see is given up for a large variance.
    """
    alive = mask.sum().clamp(min=1)
    square = (truth - output[..., :3]) ** 2
    log_variance = output[..., 3:].clamp(-10.0, 4.0)
    likelihood = 0.5 * (square.detach() * (-log_variance).exp() + log_variance)
    return (square.sum(-1) * mask).sum() / alive, (likelihood.sum(-1) * mask).sum() / alive


class EstimatorRun:
    """Walks on both grounds, one network, one optimiser."""

    def __init__(self, config: EstimatorConfig, actor: Recurrent) -> None:
        self.config = config
        torch.manual_seed(config.seed)
        self.network = new_network()
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.samples = 0
        env = EnvConfig(n=config.n // 2, seed=config.seed, commands=config.commands)
        self.walks = [
            Walk(VelocityEnv(attrs.evolve(env, terrain=terrain)), actor, self.network)
            for terrain in (Terrain(), config.rough)
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
        metadata = features.metadata((1, 1, MEMORY), recipe, student.commit())
        student.export(self.network, path, list(features.OUTPUTS), json.dumps(metadata))

    def step(self, done: float) -> dict[str, float]:
        """One sequence on each ground, and a step of the optimiser for each mini-batch of both."""
        c = self.config
        set_rate(self.optimiser, cosine(c.learning_rate, c.final_learning_rate, done))
        for walk in self.walks:
            walk.on_estimate[:] = done > c.truth_first
            walk.on_estimate[1::2] = False
        data = [walk.sequence(c.length) for walk in self.walks]
        seen = {"flat": 0.0, "rough": 0.0, "nll": 0.0}
        for ids in torch.randperm(c.n // 2).chunk(c.mini_batches):
            for name, value in self._learn(ids, data).items():
                seen[name] += value / c.mini_batches
        for walk in self.walks:
            walk.start_over()
        self.samples += c.length * c.n
        return {"flat": seen["flat"] ** 0.5, "rough": seen["rough"] ** 0.5, "nll": seen["nll"]}

    def _learn(self, ids: torch.Tensor, data: list[Sequence]) -> dict[str, float]:
        """One step; returns the mean squared error an axis on each ground, and the likelihood."""
        losses, squares = [], []
        for walk, (inputs, truth, mask) in zip(self.walks, data, strict=True):
            output, state = self.network(inputs[:, ids], select(walk.state, ids))
            square, likelihood = loss_terms(output, truth[:, ids], mask[:, ids])
            losses.append(10.0 * square + 0.1 * likelihood)
            squares.append(float(square.detach()) / 3)
            walk.remember(ids, state)
        loss = torch.stack(losses).mean()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        return {"flat": squares[0], "rough": squares[1], "nll": float(likelihood.detach())}
