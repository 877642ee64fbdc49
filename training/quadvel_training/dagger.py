"""Stage 2: a recurrent student learns from the privileged teacher while it drives itself (DAgger).

The student is the paper's plain network on the paper's 48 observations, nothing in front of it and nothing in its memory but
what it learns. The teacher says everywhere what it would do, at every tick. Who drives a robot changes with an episode alone:
a teacher that takes over from a stumbling student falls far more often than by itself, and its advice is worth little. Who
drives is a matter of the robot, not drawn anew: else few are left to a student that falls soon.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch
from torch import Tensor

from quadvel_description import robot
from quadvel_policy.observation import (
    COMMAND_AXES,
    DEFAULT_OBSERVATION,
    ActionMap,
    CommandLimits,
    PolicyMetadata,
    build_observation,
)
from quadvel_sim.terrain import Terrain

from . import parallel, privileged
from .command_grid import CommandGrid, GridConfig
from .env import TICK, EnvConfig, VelocityEnv, cores
from .loop import Budget, CheckpointError, cosine, linear, load, set_rate
from .networks import Gaussian, Mlp, Recurrent, State, select
from .onnx_file import commit, export
from .ppo import FAR, living_mean
from .privileged import ACTION_BOUND, ACTION_SCALE, Past
from .randomisation import Randomisation, actuator
from .walking_rewards import SAMPLE, sizes

AGO = round(SAMPLE / TICK)  # ticks between the teacher's actions as it learned them
SPREAD = 3
"""Ticks over which what it says is averaged: it learned with actions that are held, which come so much later than at once"""


@attrs.frozen
class DaggerConfig:
    """One run of stage 2."""

    budget: Budget = Budget(samples=2e7, minutes=60.0)
    n: int = 512  # robots, of all processes together
    threads: int = attrs.field(factory=cores)
    length: int = 64  # ticks a sequence, 0.32 s
    mini_batches: int = 8  # steps of the optimiser a sequence
    learning_rate: float = 7e-4
    final_learning_rate: float = 7e-5
    driven: float = 0.9  # share of robots that the student drives in the end,
    first_driven: float = 0.2  # at first,
    takeover: float = 2e6  # and ticks in between
    noise: float = 0.09  # of every action, in the network's unit: standard deviation,
    noise_time: float = 0.05  # s, and how long it lasts
    timestep: float = 0.0025  # s, of physics
    actuator: str = "eam"
    seed: int = 1
    grid: GridConfig = GridConfig()  # the teacher's; its open cells come with it
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()


class Teacher:
    """The teacher of a checkpoint in a batch of environments, evaluated at every tick, its actions averaged over SPREAD of them.

    Asked at every tick and not averaged, a teacher that learned with actions held for 20 ms falls where it does not fall held
    (decision 43).
    """

    def __init__(self, checkpoint: dict[str, Any], env: VelocityEnv, past: Past) -> None:
        """past: what the robots of `env` have done, which whoever drives them keeps."""
        self.actor = Gaussian(Mlp(privileged.SIZE, 12), 12, 1.0)
        self.actor.load_state_dict(checkpoint["actor"])
        self.env, self._past = env, past
        n = env.config.n
        self._executed = deque([np.zeros((n, 12), np.float32) for _ in range(AGO)], AGO)
        self._said = np.zeros((SPREAD, n, 12), np.float32)  # the newest first
        self._starts = np.ones(n, bool)

    def reset(self, ids: np.ndarray) -> None:
        """Forget what `ids` did."""
        for action in self._executed:
            action[ids] = 0.0
        self._starts[ids] = True

    def action(self) -> np.ndarray:
        """What it would do now, (n, 12); asked once a tick."""
        obs = privileged.observe(self.env, self._past, self._executed[0])
        with torch.no_grad():
            now: np.ndarray = self.actor(torch.from_numpy(obs))[0].numpy().clip(-ACTION_BOUND, ACTION_BOUND)
        self._said = np.concatenate([now[None], self._said[:-1]])
        self._said[:, self._starts] = now[self._starts]
        self._starts[:] = False
        mean: np.ndarray = self._said.mean(axis=0)
        return mean

    def advance(self, executed: np.ndarray) -> None:
        """After a tick in which the actions `executed` (n, 12) were taken."""
        self._executed.append(executed.copy())


class DaggerRun:
    """Teacher, student and environment of stage 2."""

    def __init__(self, config: DaggerConfig, teacher_file: Path) -> None:
        parallel.join("cpu")
        self.config = c = attrs.evolve(config, n=parallel.share(config.n))
        torch.manual_seed(c.seed)
        checkpoint = load(teacher_file)
        self.grid = CommandGrid(c.grid)
        self.grid.restore(checkpoint["grid"])
        env_config = EnvConfig(
            n=c.n,
            threads=c.threads,
            seed=parallel.seed_of(c.seed),
            timestep=c.timestep,
            actuator=actuator(c.actuator),
            terrain=c.terrain,
            randomisation=c.randomisation,
        )
        self.env = VelocityEnv(env_config, self.grid)
        self.past = Past(self.env)
        self.teacher = Teacher(checkpoint, self.env, self.past)
        self.student = Recurrent(DEFAULT_OBSERVATION.size, 12)
        self.map = action_map(self.env)
        self.optimiser = torch.optim.Adam(self.student.parameters(), lr=c.learning_rate)
        self.samples = 0
        self._memory: State = self.student.initial_state(c.n)
        self._previous = np.zeros((c.n, 12), np.float32)
        self._noise = np.zeros((c.n, 12), np.float32)
        self._turn = (
            np.random.default_rng(c.seed).permutation(c.n) / c.n
        )  # share at which the student takes a robot
        self.driven = self._turn < self._share()

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {
            "student": self.student.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "grid": self.grid.state(),
            "samples": self.samples,
            "random": {"learner": torch.get_rng_state(), "environments": self.env.rng.bit_generator.state},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; robots start over, under commands of the teacher's grid as it is now."""
        self.student.load_state_dict(state["student"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.samples = state["samples"]
        parallel.go_on_drawing(state["random"], self.env.rng, self.config.seed, self.samples)
        self._start_over(np.arange(self.config.n))

    def _share(self) -> float:
        c = self.config
        return linear(c.first_driven, c.driven, self.samples / c.takeover)

    def _start_over(self, ids: np.ndarray) -> None:
        if not len(ids):
            return
        self.env.reset(ids)
        self.past.reset(ids)
        self.teacher.reset(ids)
        self.driven[ids] = self._turn[ids] < self._share()
        self._previous[ids] = self._noise[ids] = 0.0
        self._memory = (self._memory[0].clone(), self._memory[1].clone())
        for memory in self._memory:
            memory[:, ids] = 0.0

    def step(self, done: float) -> dict[str, float]:
        """One sequence of every robot, some steps of the optimiser."""
        c = self.config
        set_rate(self.optimiser, cosine(c.learning_rate, c.final_learning_rate, done))
        start = self._memory
        obs, label, mask, seen = self.collect()
        loss = self.learn(obs, label, mask, start)
        handed_over = self.driven != (self._turn < self._share())
        self._start_over(np.flatnonzero((mask[-1].numpy() == 0.0) | handed_over))
        return {"imitation": loss} | seen

    def _act(self, obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            action, self._memory = self.student(torch.from_numpy(obs[None]), self._memory)
        own: np.ndarray = action[0].numpy()
        return own

    def collect(self) -> tuple[Tensor, Tensor, Tensor, dict[str, float]]:
        """One sequence: observations (T, N, 48), the teacher's actions (T, N, 12), mask (T, N) of robots that are up."""
        env, c = self.env, self.config
        decay = np.float32(np.exp(-TICK / c.noise_time))
        drawn_std = np.float32(c.noise * np.sqrt(1 - decay**2))
        alive, fell = np.ones(c.n, bool), np.zeros(c.n, bool)
        observations: list[np.ndarray] = []
        labels: list[np.ndarray] = []
        masks: list[np.ndarray] = []
        for _ in range(c.length):
            obs, label = observe(env, self._previous), self.teacher.action()
            own = self._act(obs)
            drawn = env.rng.standard_normal((c.n, 12), dtype=np.float32)
            self._noise = decay * self._noise + drawn_std * drawn
            self._previous = np.where(self.driven[:, None], own, label) + self._noise
            observations.append(obs)
            labels.append(label)
            masks.append(alive.copy())
            command = env.command.copy()
            env.tick(self.map.targets(self._previous))
            self.past.advance(command)
            self.teacher.advance(self._previous.clip(-ACTION_BOUND, ACTION_BOUND))
            fell |= env.fallen & alive
            alive &= ~(env.fallen | env.timed_out)
        masks[-1] = alive  # robots that end in the last tick count as ended, too
        self.samples += c.length * c.n * parallel.size()
        obs_t, label_t, mask_t = (
            torch.from_numpy(np.array(x, dtype=np.float32)) for x in (observations, labels, masks)
        )
        return obs_t, label_t, mask_t, self._figures(alive, fell)

    def _figures(self, alive: np.ndarray, fell: np.ndarray) -> dict[str, float]:
        """Errors over a stride (m/s, rad/s) and falls a robot-minute, of robots driven by the student and by the teacher."""
        error = self.past.stride
        seen = {"driven": float(self.driven.mean())}
        for name, driver in (("student", self.driven), ("teacher", ~self.driven)):
            up, minutes = driver & alive, driver.sum() * self.config.length * TICK / 60
            if up.any():
                seen[f"{name}_xy"], seen[f"{name}_wz"] = (float(size.mean()) for size in sizes(error[up]))
                seen[f"{name}_falls"] = float((fell & driver).sum() / minutes)
        return seen

    def learn(self, obs: Tensor, label: Tensor, mask: Tensor, start: State) -> float:
        """A step for each mini-batch of robots, from the memory at the start of the sequence; the mean loss."""
        total = 0.0
        for ids in torch.randperm(self.config.n).chunk(self.config.mini_batches):
            action, _ = self.student(obs[:, ids], select(start, ids))
            error = torch.nn.functional.huber_loss(action, label[:, ids], reduction="none", delta=FAR)
            loss = living_mean(error.mean(-1), mask[:, ids])
            self.optimiser.zero_grad()
            loss.backward()
            parallel.share_gradients(self.student)
            torch.nn.utils.clip_grad_norm_(self.student.parameters(), 1.0)
            self.optimiser.step()
            total += float(loss.detach())
        return total / self.config.mini_batches


def policy_of(checkpoint: Path) -> Recurrent:
    """The policy's network in a checkpoint of this stage or of `constrained`. Raises FileNotFoundError, CheckpointError."""
    content, network = load(checkpoint), Recurrent(DEFAULT_OBSERVATION.size, 12)
    weights = content.get("average") or content.get("student")
    if weights is None:
        raise CheckpointError(f"{checkpoint}: expected a checkpoint of `dagger` or of `constrained`")
    network.load_state_dict(weights)
    return network


def action_map(env: VelocityEnv) -> ActionMap:
    """Zero stands: the offset is the nominal posture with the gravity torque fed forward through kp."""
    return ActionMap(env.stand_q, ACTION_SCALE, ACTION_BOUND)


def observe(env: VelocityEnv, previous: np.ndarray) -> np.ndarray:
    """The student's noisy observation (n, 48); previous (n, 12): its action of the tick before."""
    return build_observation(
        DEFAULT_OBSERVATION, command=env.command, previous_action=previous, **env.sense()
    )


def export_policy(
    network: Recurrent, env: VelocityEnv, limits: CommandLimits, path: Path, about: dict[str, Any]
) -> None:
    """Write the policy file: the network as it is. limits: the commands that it answers; about: how it came to be."""
    metadata = PolicyMetadata(
        action_offset=tuple(env.stand_q),
        action_scale=(ACTION_SCALE,) * 12,
        action_clip=(-ACTION_BOUND, ACTION_BOUND),
        kp=(env.config.kp,) * 12,
        kd=(env.config.kd,) * 12,
        nominal_q=tuple(robot.NOMINAL_Q),
        command_limits=dict(zip(COMMAND_AXES, zip(limits.low, limits.high, strict=True), strict=True)),
        curve_limit=limits.curve,
        state_shape=tuple(network.initial_state(1)[0].shape),
        actuator=attrs.asdict(env.config.actuator),
        recipe=about,
        commit=commit(),
    )
    export(network, DEFAULT_OBSERVATION.size, path, ["actions"], metadata.to_json())
