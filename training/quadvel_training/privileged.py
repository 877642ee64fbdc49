"""Stage 1: a memoryless teacher that sees the true state learns to correct a scripted trot.

It starts from random weights and learns by rewards alone. It acts 50 times a second and learns by
PPO with a mirror loss. The range of commands grows with what it follows (`command_grid`). What it
sees of the past, errors over a stride and over seconds and the phase of its steps, a recurrent
student can keep itself.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch
from typing_extensions import override

from quadvel_description import symmetry
from quadvel_description.fields import field
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_description.symmetry import sign_mirror
from quadvel_sim.terrain import Terrain

from . import loop, process_group
from .command_grid import CommandGrid, GridConfig
from .env import EnvConfig, VelocityEnv, available_cores
from .loop import Budget
from .networks import Gaussian, Mlp, torch_mirror
from .past import TRANSIENT_S, Past, velocity_error
from .ppo import Ppo, PpoConfig, Rollout, exploration_scales
from .randomisation import Randomisation, load_actuator
from .scripted_trot import joint_offsets
from .walking_rewards import (
    SAMPLE_S,
    WalkingRewards,
    WalkingWeights,
    error_magnitudes,
)

ACTION_SCALE = 0.4  # rad per unit of the network's output
ACTION_BOUND = 4.0  # in the network's unit
WALKING_HEIGHT_M = 0.38  # typical height of the trunk of a robot of the reference size


PLANAR = sign_mirror(1, -1, -1)
"""Mirror of vx, vy and yaw rate"""
MIRROR = symmetry.concatenate_mirrors(
    [
        symmetry.OBSERVATION,
        symmetry.FEET,  # contact
        symmetry.FEET,  # clearance
        sign_mirror(1),  # height
        PLANAR,  # error over a stride
        PLANAR,  # lasting error
        sign_mirror(1, -1),  # slope of the ground
        symmetry.FEET,  # friction
        sign_mirror(1),  # payload
        sign_mirror(1, -1, 1),  # shift of the centre of mass
        sign_mirror(-1, -1),  # phase of the steps
        PLANAR,  # planned velocity
    ]
)
OBSERVATION_SIZE = len(MIRROR.index)
STATE_SIZE = OBSERVATION_SIZE - 5  # without the plan
CRITIC_EXTRA_SIZE = 4 + 4 + 1


def observe_state(env: VelocityEnv, past: Past, previous: np.ndarray) -> np.ndarray:
    """Observations of the true state, for the critics of all stages.

    They are the paper's 48 numbers, feet, height, past errors, ground and plant. Lengths, times and
    speeds are those of a robot of the reference size that moves alike.

    Args:
        env: environments.
        past: their past.
        previous: (n, 12), action of the teacher `SAMPLE_S` ago.

    Returns:
        (n, STATE_SIZE), scaled to about 1.
    """
    size, command = env.size, env.command
    return np.concatenate(
        [
            size.as_reference(command[:, :3]),
            command[:, 3:],
            2 * env.roll_pitch,
            2 * (env.q - env.robot.nominal_q),
            0.1 * size.time * env.dq,
            env.velocity / size.speed,
            0.5 * size.time * env.angular_velocity,
            previous,
            env.contact,
            np.clip(5 * env.clearance / size.length, -1, 2),
            5 * (env.height[:, None] / size.length - WALKING_HEIGHT_M),
            2 * size.as_reference(past.stride),
            2 * size.as_reference(past.lasting),
            3 * env.ground_slope,
            env.plants.drawn[:, :4],
            0.2 * env.plants.drawn[:, 4:5],
            env.plants.drawn[:, 5:],
        ],
        axis=1,
    ).astype(np.float32)


def observe(env: VelocityEnv, past: Past, previous: np.ndarray) -> np.ndarray:
    """Observations of the teacher: the true state and the clock.

    Args:
        env: environments.
        past: their past.
        previous: (n, 12), action of the teacher `SAMPLE_S` ago.

    Returns:
        (n, OBSERVATION_SIZE), scaled to about 1.
    """
    seen = np.concatenate([observe_state(env, past, previous), past.clock.observation()], axis=1)
    # Correct the yaw rate: the third number of the command, and the last of the plan.
    seen[:, [2, -1]] += (past.turn_correction * env.size.time)[:, None]
    return seen.astype(np.float32)


def total_action(env: VelocityEnv, past: Past, correction: np.ndarray) -> np.ndarray:
    """Add the network's correction to the scripted trot.

    Args:
        env: environments.
        past: their past.
        correction: (n, 12), output of the teacher's network.

    Returns:
        (n, 12), action in the network's unit, within `ACTION_BOUND`.
    """
    scripted = joint_offsets(env, past) / ACTION_SCALE
    return np.clip(scripted + correction, -ACTION_BOUND, ACTION_BOUND).astype(np.float32)


def load_teacher(checkpoint: dict[str, Any]) -> Gaussian:
    """Load the teacher's network, which corrects the scripted trot.

    Args:
        checkpoint: content of a checkpoint of this stage.

    Returns:
        The network; its exploration is that of the checkpoint.
    """
    actor = Gaussian(Mlp(OBSERVATION_SIZE, 12), 12, 1.0)
    actor.load_state_dict(checkpoint["actor"])
    return actor


def critic_extra(env: VelocityEnv, past: Past) -> np.ndarray:
    """Further observations of the critic: foot timing and elapsed share of the episode.

    Args:
        env: environments.
        past: their past.

    Returns:
        (n, CRITIC_EXTRA_SIZE).
    """
    time = env.time[:, None] / env.config.episode
    return np.concatenate([2 * past.air, 2 * np.minimum(past.down, 1.0), time], axis=1).astype(np.float32)


@attrs.frozen
class PrivilegedConfig:
    """Configuration of stage 1; a recipe file sets these fields.

    Attributes:
        robot: name of a shipped robot, or path of a robot.yaml.
        budget: when the run ends.
        n: number of robots, of all processes together.
        threads: threads of the physics.
        length: samples of 20 ms per sequence; 24 are 0.48 s.
        timestep: s, of the physics.
        std: standard deviation of the exploration at the start, in the network's unit; an upper
            bound that falls.
        final_std: the upper bound at the end.
        std_samples: samples from `std` to `final_std`.
        ramped: share of the commands that ramp to their velocity; the others are steps.
        reversed: share of the commands that reverse the one before.
        keep: samples between numbered checkpoints.
        actuator: `eam`, `limited`, `rated`, `ideal`, or an actuator file.
        seed: seed of all draws.
        grid: commands.
        terrain: ground.
        randomisation: what varies between robots.
        rewards: weights of the rewards.
        ppo: hyperparameters of the learner.
    """

    robot: str = DEFAULT_ROBOT
    budget: Budget = Budget(samples=2e8, minutes=6e3)
    n: int = field(512, at_least=1, whole=True)
    threads: int = attrs.field(factory=available_cores)
    length: int = 24
    timestep: float = 0.004
    std: float = 0.2
    final_std: float = 0.12
    std_samples: float = 2.5e7
    ramped: float = 0.6
    reversed: float = 0.0
    keep: float = 1e6
    actuator: str = "eam"
    seed: int = 0
    grid: GridConfig = GridConfig()
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()
    rewards: WalkingWeights = WalkingWeights()
    ppo: PpoConfig = PpoConfig(target_kl=0.012, entropy=0.002, symmetry=0.3)


ScoredCommands = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Arguments of `CommandGrid.record`: commands, mean errors, falls"""


class CommandScorer:
    """Mean error of each robot under its present command, while it is `Past.settled`."""

    def __init__(self, n: int) -> None:
        """Create a scorer of commands that start now.

        Args:
            n: number of robots.
        """
        self._sum, self._judged = np.zeros((n, 3)), np.zeros(n)  # of the error, s
        self._over: list[ScoredCommands] = []

    def advance(self, error: np.ndarray, settled: np.ndarray, period: float) -> None:
        """Add the errors of one sample.

        Args:
            error: (n, 3), m/s and rad/s.
            settled: (n,) bool, robots whose error counts.
            period: s, duration of the sample.
        """
        self._judged += period * settled
        self._sum += error * period * settled[:, None]

    def take(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the scores of commands that end, and start new ones.

        Args:
            ids: indices of the robots.

        Returns:
            Mean errors (len, 2) in xy (m/s) and yaw (rad/s), and the scored time, s.
        """
        judged = self._judged[ids]
        mean = self._sum[ids] / np.maximum(judged, 1e-6)[:, None]
        self._sum[ids], self._judged[ids] = 0.0, 0.0
        return np.stack(error_magnitudes(mean), axis=1), judged

    def finish(self, command: np.ndarray, over: np.ndarray, fell: np.ndarray) -> None:
        """Score commands that end; short ones without a fall are dropped.

        Args:
            command: (n, 4).
            over: (n,) bool, commands that end.
            fell: (n,) bool, robots that fell.
        """
        ids = np.flatnonzero(over)
        error, judged = self.take(ids)
        counts = (fell[ids] | (judged > 0.5 * TRANSIENT_S)) & (command[ids, 3] < 0.5)
        if counts.any():
            self._over.append((command[ids][counts], error[counts], fell[ids][counts]))

    def report_to(self, grid: CommandGrid) -> None:
        """Pass the scores of all processes since the last call to the command grid.

        Args:
            grid: command grid of this process.
        """
        for judged in itertools.chain(*process_group.gather(self._over)):
            grid.record(*judged)
        self._over = []


class PrivilegedRun:
    """Training run of stage 1."""

    def __init__(self, config: PrivilegedConfig) -> None:
        """Create environments, teacher, critic and learner.

        Args:
            config: configuration.
        """
        process_group.join("cpu")
        self.config = c = attrs.evolve(config, n=process_group.local_share(config.n))
        torch.manual_seed(c.seed)
        self.grid = CommandGrid(c.grid)
        robot = load_robot(c.robot)
        env_config = EnvConfig(
            robot=robot,
            n=c.n,
            threads=c.threads,
            seed=process_group.process_seed(c.seed),
            period=SAMPLE_S,
            timestep=c.timestep,
            actuator=load_actuator(robot, c.actuator),
            terrain=c.terrain,
            randomisation=c.randomisation,
            ramped=c.ramped,
            reversed=c.reversed,
        )
        self.env = VelocityEnv(env_config, self.grid)
        self.past = Past(self.env)
        self.rewards = WalkingRewards(self.env, c.rewards)
        self.scorer = CommandScorer(c.n)
        self.actor = Gaussian(Mlp(OBSERVATION_SIZE, 12), 12, c.std)
        self.critic = Mlp(OBSERVATION_SIZE + CRITIC_EXTRA_SIZE, 1)
        mirrors = (torch_mirror(mirror) for mirror in (MIRROR, symmetry.JOINTS))
        self.ppo = Ppo(self.actor, self.critic, c.ppo, *mirrors)
        self.samples = 0
        self._spread = exploration_scales(c.n)
        self._actions = np.zeros((2, c.n, 12), np.float32)  # newest first

    def state(self) -> dict[str, Any]:
        """Return everything that a resumed run needs.

        Returns:
            Tensors and plain values, for `restore`.
        """
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "learner": self.ppo.state(),
            "grid": self.grid.state(),
            "samples": self.samples,
            "random": {"learner": torch.get_rng_state(), "environments": self.env.rng.bit_generator.state},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint; robots start over, under commands of its grid.

        Args:
            state: what `state` returned.

        Raises:
            CheckpointError: the checkpoint has another grid.
        """
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.ppo.restore(state["learner"])
        self.grid.restore(state["grid"])
        self.samples = state["samples"]
        process_group.resume_random(state["random"], self.env.rng, self.config.seed, self.samples)
        self._start_over(np.arange(self.config.n))

    def step(self, done: float) -> dict[str, float]:
        """Collect one rollout and learn from it.

        Args:
            done: share of the budget that is spent; not used, schedules follow samples.

        Returns:
            Figures for the log.
        """
        rollout, seen = self.collect()
        self._bound_exploration()
        seen |= self.ppo.update(rollout)
        return seen | self.grid.summary() | {"std": float(self.actor.log_std.detach().exp().mean())}

    def _bound_exploration(self) -> None:
        """Clamp the standard deviation of the exploration to its present bounds."""
        c = self.config
        most = loop.linear(c.std, c.final_std, self.samples / c.std_samples)
        with torch.no_grad():
            self.actor.log_std.clamp_(min=float(np.log(0.5 * c.final_std)), max=float(np.log(most)))

    def _start_over(self, ids: np.ndarray) -> None:
        """Replace robots by new ones without a past."""
        if len(ids):
            self.env.reset(ids)
            self.past.reset(ids)
            self.rewards.reset(ids)
            self.scorer.take(ids)
            self._actions[:, ids] = 0.0

    def _critic_obs(self, obs: np.ndarray) -> np.ndarray:
        """Return the critic's observations."""
        return np.concatenate([obs, critic_extra(self.env, self.past)], axis=1)

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """Collect one sequence of every environment with exploration noise.

        Returns:
            The rollout, and figures for the log.
        """
        env, c = self.env, self.config
        names = ("obs", "critic_obs", "standing", "action", "mean", "reward", "ended", "cut")
        keep: dict[str, list[np.ndarray]] = {name: [] for name in names}
        std = self.actor.log_std.exp().detach().numpy()
        terms: dict[str, float] = {}
        seen = np.zeros(5)
        for _ in range(c.length):
            obs = observe(env, self.past, self._actions[0])
            critic_obs, standing = self._critic_obs(obs), self.past.standing
            with torch.no_grad():
                mean = self.actor(torch.from_numpy(obs))[0].numpy()
            drawn = mean + std * self._spread * env.rng.standard_normal(mean.shape, dtype=np.float32)
            action = total_action(env, self.past, drawn)
            command = env.command.copy()
            env.tick(env.stand_q + ACTION_SCALE * action)
            self.past.advance(command)
            self.scorer.advance(velocity_error(env, command), self.past.settled, SAMPLE_S)
            parts = self.rewards.terms(command, self.past, np.stack([action, *self._actions]))
            reward = self.rewards.total(parts, env.fallen)
            self._actions = np.concatenate([action[None], self._actions[:-1]])
            fell, late = env.fallen.copy(), env.timed_out & ~env.fallen
            row = (obs, critic_obs, standing, drawn, mean, reward, fell, late)
            for name, value in zip(names, row, strict=True):
                keep[name].append(value)
            for name, value in parts.items():
                terms[name] = terms.get(name, 0.0) + float(value.mean()) / c.length
            errors = [size.mean() for size in error_magnitudes(self.past.stride)]
            seen += [*errors, fell.mean(), env.broken.sum(), env.contact.mean()]
            self.scorer.finish(command, fell | late | env.changed, fell)
            self._start_over(np.flatnonzero(fell | late))
        self.scorer.report_to(self.grid)
        self.samples += c.length * c.n * process_group.size()
        t = {name: torch.from_numpy(np.array(value, dtype=np.float32)) for name, value in keep.items()}
        last = self._critic_obs(observe(env, self.past, self._actions[0]))
        rollout = Rollout(
            **t,
            noise=torch.zeros(c.n, 12),
            spread=torch.from_numpy(self._spread),
            mask=torch.ones_like(t["reward"]),
            last_critic_obs=torch.from_numpy(last),
        )
        xy, wz, falls, broken, contact = seen / c.length
        return rollout, {
            "error_xy": xy,
            "error_wz": wz,
            "falls_per_minute": 60 * falls / SAMPLE_S,
            "broken": broken * c.length,
            "contact_ratio": contact,
            "reward": float(t["reward"].mean()),
        } | {f"reward/{name}": value for name, value in terms.items()}


class NumberedCheckpoints(loop.Keeper):
    """Keeper of numbered checkpoints in FOLDER/kept, at intervals of the configuration's `keep`."""

    def __init__(self, run: PrivilegedRun, folder: Path) -> None:
        """Keep the checkpoints of a run.

        Args:
            run: training run.
            folder: run directory.
        """
        super().__init__(run.config.keep)
        self._run, self._folder = run, folder

    @override
    def keep(self) -> dict[str, float]:
        """Write the checkpoint, named by its thousands of samples."""
        loop.save(self._run.state(), self._folder / "kept" / f"{self._run.samples // 1000:06}k.pt")
        return {}
