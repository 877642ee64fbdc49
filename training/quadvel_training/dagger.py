"""Stage 2: a recurrent student learns from the privileged teacher (DAgger, Ross et al. 2011).

The student drives itself; it is the paper's plain network on the paper's 48 observations. The
teacher labels every tick with its own action.

The driver of a robot changes only with an episode: a teacher that takes over from a stumbling
student falls far more often than by itself, and its advice is worth little. Each robot has a fixed
place in the order in which the student takes over. If drivers were drawn for each episode, few
robots would stay with a student that falls soon.

The student has to remember what the teacher observes of the past, errors over a stride and over
seconds and the phase of its steps, and to infer the slope of the ground. So its sequences last for
seconds, and a linear map from its memory, which is not part of the policy, learns to recall these
numbers.

Half of the sequences are learned as their mirror images, so that the student walks alike to both
sides. Robots that stand are left out there: whoever answers left and right alike cannot choose the
foot to start with.
"""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch
from torch import Tensor

from quadvel_description import symmetry
from quadvel_description.fields import field
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_policy.observation import (
    COMMAND_AXES,
    OBSERVATION_SIZE,
    ActionMap,
    PolicyMetadata,
    VelocityCommandLimits,
    build_observation,
    default_observation,
)
from quadvel_sim.terrain import Terrain

from . import process_group
from .command_grid import CommandGrid, GridConfig
from .env import TICK_S, EnvConfig, VelocityEnv, available_cores
from .loop import Budget, CheckpointError, cosine, linear, load, set_rate
from .networks import MEMORY, Recurrent, State, follow_weights, lengthen_memory, select, torch_mirror
from .onnx_file import commit, export
from .ppo import IMITATION_HUBER_DELTA, masked_mean
from .privileged import ACTION_BOUND, ACTION_SCALE
from .randomisation import Randomisation, load_actuator
from .teacher import RECALLED_MIRROR, RECALLED_SIZE, Teacher, smooth_labels
from .walking_rewards import error_magnitudes

MIRRORS = tuple(torch_mirror(mirror) for mirror in (symmetry.OBSERVATION, symmetry.JOINTS, RECALLED_MIRROR))
"""Of observations, actions, and recalled features"""
SLOW_CELLS, LONGEST_MEMORY_S = MEMORY // 4, 4.0  # cells of a new student that forget slowly, up to this time
QUIET = 2  # every second robot does not explore


@attrs.frozen
class DaggerConfig:
    """Configuration of stage 2; a recipe file sets these fields.

    Attributes:
        robot: name of a shipped robot, or path of a robot.yaml.
        budget: when the run ends.
        n: number of robots, of all processes together.
        threads: threads of the physics.
        length: ticks per sequence; 256 are 1.28 s.
        epochs: passes over each sequence.
        mini_batches: optimiser steps per pass.
        learning_rate: learning rate of Adam at the start.
        final_learning_rate: the same at the end; it falls along a cosine.
        driven: share of robots that the student drives at the end.
        first_driven: the same at the start.
        takeover: samples from `first_driven` to `driven`.
        recall: weight of the squared error of a linear map from the memory to the recalled features.
        averaged: sequences over which the weights of the policy file are averaged; 16 are 2 million
            samples of 512 robots.
        noise: standard deviation of the noise of the actions of robots that explore, in the network's
            unit.
        noise_time: s, time constant of the noise.
        timestep: s, of the physics.
        actuator: `eam`, `limited`, `rated`, `ideal`, or an actuator file.
        others: other actuators, which an equal share of the robots has each.
        seed: seed of all draws.
        grid: commands; has to match the grid of the teacher, whose open cells are taken over.
        terrain: ground.
        randomisation: what varies between robots.
    """

    robot: str = DEFAULT_ROBOT
    budget: Budget = Budget(samples=2e7, minutes=60.0)
    n: int = field(512, at_least=1, whole=True)
    threads: int = attrs.field(factory=available_cores)
    length: int = 256
    epochs: int = 2
    mini_batches: int = 32
    learning_rate: float = 7e-4
    final_learning_rate: float = 7e-5
    driven: float = 0.8
    first_driven: float = 0.2
    takeover: float = 2e6
    recall: float = 0.1
    averaged: int = 16
    noise: float = 0.09
    noise_time: float = 0.05
    timestep: float = 0.0025
    actuator: str = "eam"
    others: tuple[str, ...] = ()
    seed: int = 1
    grid: GridConfig = GridConfig()
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()


@attrs.frozen
class Experience:
    """T ticks of N robots, time first.

    Attributes:
        obs: (T, N, 48), observations.
        label: (T, N, 12), actions of the teacher, averaged over `LABEL_BEFORE` to `LABEL_AFTER`.
        recalled: (T, N, RECALLED_SIZE), what the teacher observes and a student has to recall.
        mask: (T, N), 1 for robots that are up, and count.
    """

    obs: Tensor
    label: Tensor
    recalled: Tensor
    mask: Tensor

    def with_mirror_images(self, standing: Tensor) -> Experience:
        """Append the mirror image of each robot.

        Args:
            standing: (T, N), 1 for robots that stand, whose mirror images do not count.

        Returns:
            T ticks of 2 N robots, the mirror images last.
        """
        mirrored = [
            mirror(own) for mirror, own in zip(MIRRORS, (self.obs, self.label, self.recalled), strict=True)
        ]
        pairs = zip(
            attrs.astuple(self, recurse=False), [*mirrored, self.mask * (1.0 - standing)], strict=True
        )
        return Experience(*(torch.cat(pair, dim=1) for pair in pairs))


class DaggerRun:
    """Training run of stage 2: teacher, student and environments."""

    def __init__(self, config: DaggerConfig, teacher_file: Path) -> None:
        """Create environments and student, and load the teacher.

        Args:
            config: configuration.
            teacher_file: checkpoint of `privileged`.
        """
        process_group.join("cpu")
        self.config = c = attrs.evolve(config, n=process_group.local_share(config.n))
        torch.manual_seed(c.seed)
        checkpoint = load(teacher_file)
        self.grid = CommandGrid(c.grid)
        self.grid.restore(checkpoint["grid"])
        robot = load_robot(c.robot)
        env_config = EnvConfig(
            robot=robot,
            n=c.n,
            threads=c.threads,
            seed=process_group.process_seed(c.seed),
            timestep=c.timestep,
            actuator=load_actuator(robot, c.actuator),
            others=tuple(load_actuator(robot, name) for name in c.others),
            terrain=c.terrain,
            randomisation=c.randomisation,
        )
        self.env = VelocityEnv(env_config, self.grid)
        self.teacher = Teacher(checkpoint, self.env)
        self.student = Recurrent(OBSERVATION_SIZE, 12)
        lengthen_memory(self.student.lstm, SLOW_CELLS, LONGEST_MEMORY_S / TICK_S)
        self.average = copy.deepcopy(self.student)
        self.recall = torch.nn.Linear(MEMORY, RECALLED_SIZE)
        self.map = action_map(self.env)
        self.optimiser = torch.optim.Adam(self._learning().parameters(), lr=c.learning_rate)
        self.samples = self._sequences = 0
        self._memory: State = self.student.initial_state(2 * c.n)  # of robots, and of their mirror images
        self._previous = np.zeros((c.n, 12), np.float32)
        self._noise = np.zeros((c.n, 12), np.float32)
        self._setting_off = np.ones(c.n, bool)  # new robots that have not lifted a foot yet
        self._explores = np.arange(c.n) % QUIET > 0
        self._turn = np.random.default_rng(c.seed).permutation(c.n) / c.n  # order of takeover
        self.driven = self._turn < self._share()

    def state(self) -> dict[str, Any]:
        """Return everything that a resumed run needs.

        Returns:
            Tensors and plain values, for `restore`.
        """
        return {
            "student": self.student.state_dict(),
            "average": self.average.state_dict(),
            "sequences": self._sequences,
            "recall": self.recall.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "grid": self.grid.state(),
            "samples": self.samples,
            "random": {"learner": torch.get_rng_state(), "environments": self.env.rng.bit_generator.state},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint; robots start over.

        Args:
            state: what `state` returned.
        """
        self.student.load_state_dict(state["student"])
        self.average.load_state_dict(state["average"])
        self._sequences = state["sequences"]
        self.recall.load_state_dict(state["recall"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.samples = state["samples"]
        process_group.resume_random(state["random"], self.env.rng, self.config.seed, self.samples)
        self._start_over(np.arange(self.config.n))

    def start_from(self, checkpoint: Path) -> None:
        """Take over the weights of another run.

        Args:
            checkpoint: checkpoint of this stage.

        Raises:
            FileNotFoundError: there is no such file.
            CheckpointError: it is one of another stage.
        """
        state = load(checkpoint)
        if "recall" not in state:
            raise CheckpointError(f"{checkpoint}: expected a checkpoint of `dagger`")
        self.student.load_state_dict(state["average"])
        self.average.load_state_dict(state["average"])
        self.recall.load_state_dict(state["recall"])

    def _learning(self) -> torch.nn.ModuleList:
        """Networks that learn."""
        return torch.nn.ModuleList([self.student, self.recall])

    def _share(self) -> float:
        """Share of robots that the student drives now."""
        c = self.config
        return linear(c.first_driven, c.driven, self.samples / c.takeover)

    def _start_over(self, ids: np.ndarray) -> None:
        """Replace robots by new ones without a past."""
        if not len(ids):
            return
        self.env.reset(ids)
        self.driven[ids] = self._turn[ids] < self._share()
        self._setting_off[ids] = True
        self.teacher.reset(ids)
        self._previous[ids] = self._noise[ids] = 0.0
        self._memory = (self._memory[0].clone(), self._memory[1].clone())
        for memory in self._memory:
            memory[:, np.concatenate([ids, self.config.n + ids])] = 0.0

    def step(self, done: float) -> dict[str, float]:
        """Collect one sequence of every robot and learn from it.

        Args:
            done: share of the budget that is spent.

        Returns:
            Figures for the log.
        """
        c = self.config
        set_rate(self.optimiser, cosine(c.learning_rate, c.final_learning_rate, done))
        start = self._memory
        experience, standing, seen = self.collect()
        seen |= self.learn(experience.with_mirror_images(standing), start)
        self._sequences += 1
        follow_weights(self.average, self.student, 1.0 / min(self._sequences, c.averaged))
        handed_over = self.driven != (self._turn < self._share())
        self._start_over(np.flatnonzero((experience.mask[-1].numpy() == 0.0) | handed_over))
        return seen

    def _act(self, obs: np.ndarray) -> np.ndarray:
        """Run the student for one tick; return its actions (n, 12)."""
        own = torch.from_numpy(obs)
        with torch.no_grad():
            action, self._memory = self.student(torch.cat([own, MIRRORS[0](own)])[None], self._memory)
        return np.asarray(action[0, : len(obs)].numpy())

    def collect(self) -> tuple[Experience, Tensor, dict[str, float]]:
        """Collect one sequence of every robot.

        Returns:
            The sequences, (T, N) which robots stood, and figures for the log.
        """
        c = self.config
        alive, fell = np.ones(c.n, bool), np.zeros(c.n, bool)
        rows: dict[str, list[np.ndarray]] = {name: [] for name in attrs.fields_dict(Experience)}
        standing = []
        for _ in range(c.length):
            obs, advice = observe(self.env, self._previous), self.teacher.action()
            seen = obs, self.teacher.latest, self.teacher.recalled_features(), alive.copy()
            for values, value in zip(rows.values(), seen, strict=True):
                values.append(value)
            standing.append(self._stands())
            self._tick(obs, advice)
            fell |= self.env.fallen & alive
            alive &= ~(self.env.fallen | self.env.timed_out)
        figures = self._figures(alive, fell)
        rows["mask"][-1] = alive  # robots that end in the last tick count as ended, too
        self.samples += c.length * c.n * process_group.size()
        arrays = {name: np.array(values, dtype=np.float32) for name, values in rows.items()}
        arrays["label"] = smooth_labels(arrays["label"], arrays["mask"])
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        stood = torch.from_numpy(np.array(standing, dtype=np.float32))
        return Experience(**tensors), stood, figures

    def _tick(self, obs: np.ndarray, advice: np.ndarray) -> None:
        """Advance the robots by a tick, each with its driver's action and its exploration.

        Args:
            obs: (n, 48), observations of the student.
            advice: (n, 12), actions of the teacher, in the network's unit.
        """
        env, c = self.env, self.config
        # Ornstein-Uhlenbeck noise: n <- d n + noise sqrt(1 - d^2) w, d = exp(-dt / noise_time)
        decay = np.float32(np.exp(-TICK_S / c.noise_time))
        drawn_std = np.float32(c.noise * np.sqrt(1 - decay**2))
        own = self._act(obs)
        drawn = env.rng.standard_normal((c.n, 12), dtype=np.float32)
        self._noise = decay * self._noise + drawn_std * drawn * self._explores[:, None]
        self._previous = np.where(self.driven[:, None], own, advice) + self._noise
        command = env.command.copy()
        env.tick(self.map.targets(self._previous))
        self.teacher.advance(command, self._previous)

    def _stands(self) -> np.ndarray:
        """Whether robots (n,) stand, or have not lifted a foot since they stood."""
        past = self.teacher.past
        self._setting_off &= ~(past.air > past.clock.shortest_swing).any(axis=1)
        return np.asarray(past.standing | self._setting_off)

    def _figures(self, alive: np.ndarray, fell: np.ndarray) -> dict[str, float]:
        """Return errors over a stride (m/s, rad/s) and falls per robot-minute, by driver."""
        error = self.teacher.past.stride
        seen = {"driven": float(self.driven.mean())}
        for name, driver in (("student", self.driven), ("teacher", ~self.driven)):
            up, minutes = driver & alive, driver.sum() * self.config.length * TICK_S / 60
            if up.any():
                seen[f"{name}_xy"], seen[f"{name}_wz"] = (
                    float(size.mean()) for size in error_magnitudes(error[up])
                )
                seen[f"{name}_falls"] = float((fell & driver).sum() / minutes)
        return seen

    def learn(self, experience: Experience, start: State) -> dict[str, float]:
        """Take an optimiser step for each mini-batch of robots or their mirror images, in each pass.

        Args:
            experience: one sequence of every robot, and of its mirror image.
            start: memory of the student at the start of the sequences.

        Returns:
            Mean losses of the imitation and of the recall.
        """
        c, e = self.config, experience
        passes = [
            (torch.randperm(c.n) + c.n * torch.randint(0, 2, (c.n,))).chunk(c.mini_batches)
            for _ in range(c.epochs)
        ]
        losses = []
        for ids in itertools.chain(*passes):
            memory, _ = self.student.lstm(e.obs[:, ids], select(start, ids))
            # L = mean(Huber(action - label)) + recall mean(|A memory + b - recalled|^2)
            huber = torch.nn.functional.huber_loss(
                self.student.answer(memory), e.label[:, ids], reduction="none", delta=IMITATION_HUBER_DELTA
            )
            missed = (self.recall(memory) - e.recalled[:, ids]) ** 2
            imitation, recall = (masked_mean(error.mean(-1), e.mask[:, ids]) for error in (huber, missed))
            self.optimiser.zero_grad()
            (imitation + c.recall * recall).backward()
            process_group.share_gradients(self._learning())
            torch.nn.utils.clip_grad_norm_(self._learning().parameters(), 1.0)
            self.optimiser.step()
            losses.append((float(imitation.detach()), float(recall.detach())))
        imitation_mean, recall_mean = np.mean(losses, axis=0)
        return {"imitation": float(imitation_mean), "recall": float(recall_mean)}


def load_policy(checkpoint: Path) -> Recurrent:
    """Load the policy's network from a checkpoint.

    Args:
        checkpoint: checkpoint of this stage or of `constrained`.

    Returns:
        The network, with its weights averaged.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: the checkpoint has no policy.
    """
    content, network = load(checkpoint), Recurrent(OBSERVATION_SIZE, 12)
    weights = content.get("average") or content.get("student")  # which old checkpoints have alone
    if weights is None:
        raise CheckpointError(f"{checkpoint}: expected a checkpoint of `dagger` or of `constrained`")
    network.load_state_dict(weights)
    return network


def action_map(env: VelocityEnv) -> ActionMap:
    """Return the map from actions to joint targets; action 0 stands.

    The offset is the nominal posture with the gravity torque fed forward through kp.

    Args:
        env: environments.

    Returns:
        The map.
    """
    return ActionMap(env.stand_q, ACTION_SCALE, ACTION_BOUND)


def observe(env: VelocityEnv, previous: np.ndarray) -> np.ndarray:
    """Noisy observations of the student.

    Args:
        env: environments.
        previous: (n, 12), action of the tick before.

    Returns:
        (n, 48).
    """
    return build_observation(
        default_observation(env.robot), command=env.command, previous_action=previous, **env.sense()
    )


def export_policy(
    network: Recurrent, env: VelocityEnv, limits: VelocityCommandLimits, path: Path, about: dict[str, Any]
) -> None:
    """Write a policy file.

    Args:
        network: policy.
        env: environment that it was trained in, for gains and posture.
        limits: commands that the policy accepts.
        path: ONNX file.
        about: how the policy was trained, for the metadata.
    """
    metadata = PolicyMetadata(
        robot=env.robot.name,
        action_offset=tuple(env.stand_q),
        action_scale=(ACTION_SCALE,) * 12,
        action_clip=(-ACTION_BOUND, ACTION_BOUND),
        kp=(env.config.kp,) * 12,
        kd=(env.config.kd,) * 12,
        nominal_q=tuple(env.robot.nominal_q),
        observation=default_observation(env.robot),
        command_limits=dict(zip(COMMAND_AXES, zip(limits.low, limits.high, strict=True), strict=True)),
        curve_limit=limits.curve,
        state_shape=tuple(network.initial_state(1)[0].shape),
        actuator=attrs.asdict(env.config.actuator),
        recipe=about,
        commit=commit(),
    )
    export(network, OBSERVATION_SIZE, path, ["actions"], metadata.to_json())
