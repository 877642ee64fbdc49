"""Stage 3: constrained reinforcement learning of the paper's plain network at 200 Hz (Section 3.3).

It starts from the student of `dagger`. The teacher's actions pull the policy back, strongly at
first, because the cost of an action shows at once and its benefit only after a stride. The pull
fades, and the constraints on symmetry and smoothness grow. The rewards are those of Table 2, with
penalties of the error over a stride and of the lasting error: steady errors are the policy's own to
remove. Exploration is correlated in time, because soft gains filter white noise out at 200 Hz.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description import symmetry
from quadvel_description.fields import field
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_policy.observation import OBSERVATION_SIZE
from quadvel_sim.terrain import Terrain

from . import dagger, privileged, process_group
from .command_grid import CommandGrid, GridConfig
from .env import TICK_S, EnvConfig, VelocityEnv, available_cores
from .loop import Budget, TimeShares, linear, load
from .networks import Gaussian, Mlp, Recurrent, State, follow_weights, torch_mirror
from .past import Past, velocity_error
from .ppo import RECURRENT_PPO, Ppo, PpoConfig, Rollout, exploration_scales
from .privileged import CommandScorer
from .randomisation import Randomisation, load_actuator
from .rewards import RewardWeights, Table2
from .teacher import Teacher
from .walking_rewards import error_magnitudes

CRITIC_SIZE = (
    privileged.STATE_SIZE + privileged.CRITIC_EXTRA_SIZE + 12 + 12
)  # the last two: joint torques and exploration noise
AGREEMENT_UPDATES = 10  # from one measurement of how far the gradients of two halves agree to the next
PARTS = ("physics", "sensing", "inference", "learning")  # of the time of an update; sensing includes rewards


@attrs.frozen
class ConstrainedConfig:
    """Configuration of one run; a recipe file sets these fields.

    Attributes:
        robot: name of a shipped robot, or path of a robot.yaml.
        budget: when the run ends.
        n: number of robots, of all processes together.
        threads: threads of the physics.
        length: ticks per sequence; 64 are 0.32 s.
        std: standard deviation of the innovations of the exploration noise at the start, in the
            network's unit.
        final_std: the same at the end; it is small, so that steady errors without exploration are
            about those with it.
        std_samples: samples from `std` to `final_std`.
        critic_first: updates at the start that train the critic alone.
        pull: weight of the teacher's pull at the start.
        final_pull: the same at the end.
        pull_samples: samples from `pull` to `final_pull`.
        constraint_samples: samples over which the constraint weights grow to their full value.
        stride: penalty, s/m and s/rad, of the error over a stride.
        lasting: penalty, s/m and s/rad, of the lasting error; under exploration steady errors
            hardly show over a stride.
        standing: the same while the command is to stand, so that a robot does not creep.
        averaged: updates over which the weights of the policy are averaged; single steps leave
            steady errors.
        keep: samples between policies that are kept and evaluated.
        actuator: `eam`, `limited`, `rated`, `ideal`, or an actuator file.
        timestep: s, of the physics.
        seed: seed of all draws.
        grid: commands; has to match the grid of the student, whose open cells are taken over.
        terrain: ground.
        randomisation: what varies between robots.
        rewards: weights of Table 2.
        ppo: hyperparameters of the learner.
    """

    robot: str = DEFAULT_ROBOT
    budget: Budget = Budget(samples=1e8, minutes=6e3)
    n: int = field(512, at_least=1, whole=True)
    threads: int = attrs.field(factory=available_cores)
    length: int = 64
    std: float = 0.045
    final_std: float = 0.025
    std_samples: float = 5e7
    critic_first: int = 40
    pull: float = 1.0
    final_pull: float = 0.0
    pull_samples: float = 3e7
    constraint_samples: float = 2e7
    stride: float = 1.0
    lasting: float = 3.0
    standing: float = 20.0
    averaged: int = 150
    keep: float = 5e6
    actuator: str = "eam"
    timestep: float = 0.0025
    seed: int = 3
    grid: GridConfig = GridConfig()
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()
    rewards: RewardWeights = RewardWeights()
    ppo: PpoConfig = attrs.evolve(RECURRENT_PPO, smoothness=3.2)


class ConstrainedRun:
    """Training run of stage 3; networks and learning on `device`, physics on the CPU."""

    def __init__(
        self,
        config: ConstrainedConfig,
        start: Path | None = None,
        teacher: Path | None = None,
        device: str = "cpu",
    ) -> None:
        """Create environments, policy, critic and learner.

        Args:
            config: configuration.
            start: checkpoint of `dagger`, or of this stage, whose critic is taken over; None for
                random weights.
            teacher: checkpoint of `privileged`; None for no pull.
            device: where networks are, `cpu` or `cuda`.
        """
        self.device = process_group.join(device)
        self.config = c = attrs.evolve(config, n=process_group.local_share(config.n))
        torch.manual_seed(c.seed)
        known = load(start) if start else {}
        self.grid = CommandGrid(c.grid)
        if "grid" in known:
            self.grid.restore(known["grid"])
        robot = load_robot(c.robot)
        env_config = EnvConfig(
            robot=robot,
            n=c.n,
            threads=c.threads,
            seed=process_group.process_seed(c.seed),
            timestep=c.timestep,
            actuator=load_actuator(robot, c.actuator),
            terrain=c.terrain,
            randomisation=c.randomisation,
        )
        self.env = VelocityEnv(env_config, self.grid)
        self.past = Past(self.env)
        self.teacher = Teacher(load(teacher), self.env) if teacher else None
        self.rewards = Table2(self.env, c.rewards)
        self.scorer = CommandScorer(c.n)
        network = dagger.load_policy(start) if start else Recurrent(OBSERVATION_SIZE, 12)
        self.actor = Gaussian(network, 12, c.std).to(self.device)
        self.actor.log_std.requires_grad_(False)
        self.average: Recurrent = copy.deepcopy(self.actor.network)
        self.critic = Mlp(CRITIC_SIZE, 1).to(self.device)
        if "critic" in known:
            self.critic.load_state_dict(known["critic"])
        self.mirror_obs, mirror_action = (
            torch_mirror(mirror, self.device) for mirror in (symmetry.OBSERVATION, symmetry.JOINTS)
        )
        self.ppo = Ppo(self.actor, self.critic, c.ppo, self.mirror_obs, mirror_action)
        self.map = dagger.action_map(self.env)
        self.shares = TimeShares()
        self.samples = self.updates = 0
        self._action = np.zeros((c.n, 12), np.float32)
        self._noise = np.zeros((c.n, 12), np.float32)
        self._spread = exploration_scales(c.n)
        self._state = self._initial_state(c.n)
        self._mirrored = self._initial_state(self.ppo.mirrored_count(c.n))

    def _initial_state(self, n: int) -> State:
        """Return the zero memory of `n` robots on the device."""
        h, c = self.actor.network.initial_state(n)
        return h.to(self.device), c.to(self.device)

    def policy(self) -> Recurrent:
        """Copy the averaged policy to the CPU.

        Returns:
            The copy.
        """
        return copy.deepcopy(self.average).cpu()

    def write_policy(self, path: Path, about: dict[str, Any]) -> None:
        """Write the averaged policy as a policy file.

        Args:
            path: ONNX file.
            about: how the policy was trained, for the metadata.
        """
        dagger.export_policy(self.policy(), self.env, self.grid.config.answered, path, about)

    def state(self) -> dict[str, Any]:
        """Return everything that a resumed run needs.

        Returns:
            Tensors and plain values, for `restore`.
        """
        return {
            "actor": self.actor.state_dict(),
            "average": self.average.state_dict(),
            "critic": self.critic.state_dict(),
            "learner": self.ppo.state(),
            "grid": self.grid.state(),
            "samples": self.samples,
            "updates": self.updates,
            "random": {"learner": torch.get_rng_state(), "environments": self.env.rng.bit_generator.state},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint; robots start over, under commands of its grid.

        Args:
            state: what `state` returned.
        """
        self.actor.load_state_dict(state["actor"])
        self.average.load_state_dict(state["average"])
        self.critic.load_state_dict(state["critic"])
        self.ppo.restore(state["learner"])
        self.grid.restore(state["grid"])
        self.samples, self.updates = state["samples"], state["updates"]
        process_group.resume_random(state["random"], self.env.rng, self.config.seed, self.samples)
        self._start_over(np.arange(self.config.n))

    def step(self, done: float) -> dict[str, float]:
        """Collect one rollout and learn from it.

        Args:
            done: share of the budget that is spent; not used, schedules follow samples.

        Returns:
            Figures for the log.
        """
        c = self.config
        pull = linear(c.pull, c.final_pull, self.samples / c.pull_samples)
        if pull == 0.0:
            self.teacher = None
        spread = linear(c.std, c.final_std, self.samples / c.std_samples)
        self.actor.log_std.fill_(np.log(spread))
        rollout, seen = self.collect()
        self.updates += 1
        constraints = linear(0.0, 1.0, self.samples / c.constraint_samples)
        actor_learns, compared = self.updates > c.critic_first, self.updates % AGREEMENT_UPDATES == 0
        with self.shares.measure("learning"):
            learned = self.ppo.update(rollout, actor_learns, pull, constraints, compared)
            follow_weights(self.average, self.actor.network, 1.0 / min(self.updates, c.averaged))
        return (
            seen
            | learned
            | {"pull": pull, "constraints": constraints}
            | self.grid.summary()
            | self.shares.take()
        )

    def critic_obs(self) -> np.ndarray:
        """Compute the critic's observations.

        Returns:
            (n, CRITIC_SIZE), float32.
        """
        env, past = self.env, self.past
        known = privileged.observe_state(env, past, self._action)
        seen = known, privileged.critic_extra(env, past), 0.05 * env.torque, self._noise
        return np.concatenate(seen, axis=1).astype(np.float32)

    def _act(self, obs: np.ndarray, state: State) -> tuple[np.ndarray, State]:
        """Run the policy for one tick; return its mean actions (n, 12) and the new memory."""
        with torch.no_grad():
            mean, state = self.actor(torch.from_numpy(obs[None]).to(self.device), state)
        return mean[0].cpu().numpy(), state

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """Collect one sequence of every environment.

        Returns:
            The rollout, and figures for the log.
        """
        c, env, past = self.config, self.env, self.past
        names = ["obs", "critic_obs", "standing", "action", "mean", "reward", "ended", "cut", "mask"]
        names += ["label"] if self.teacher else []
        keep: dict[str, list[np.ndarray]] = {name: [] for name in names}
        std = self.actor.log_std.exp().cpu().numpy()
        alive = np.ones(c.n, bool)
        state, start, mirrored_start, before = self._state, self._state, self._mirrored, self._noise
        for _ in range(c.length):
            with self.shares.measure("sensing"):
                obs, critic_obs = dagger.observe(env, self._action), self.critic_obs()
                standing = past.standing
            with self.shares.measure("inference"):
                mean, state = self._act(obs, state)
                label = [self.teacher.action()] if self.teacher else []
            with self.shares.measure("physics"):
                # AR(1) exploration: n[t] = rho n[t-1] + sigma w[t], a[t] = mu(o[t]) + n[t]
                drawn = env.rng.standard_normal((c.n, 12), dtype=np.float32)
                self._noise = np.float32(c.ppo.correlation) * self._noise + std * self._spread * drawn
                action, command = mean + self._noise, env.command.copy()
                env.tick(self.map.targets(action))
            with self.shares.measure("sensing"):
                past.advance(command)
                if self.teacher:
                    self.teacher.advance(command, action)
                reward = self.rewards(action)
                # R = Table 2 - stride |e_stride| - lasting |e_lasting|, xy and yaw
                lasting = np.where(command[:, 3] > 0.5, c.standing, c.lasting)
                reward -= c.stride * sum(error_magnitudes(past.stride)) + lasting * sum(
                    error_magnitudes(past.lasting)
                )
            self._action = action
            fell, late = env.fallen & alive, env.timed_out & ~env.fallen & alive
            row = (obs, critic_obs, standing, action, mean, reward, fell, late, alive.copy(), *label)
            for name, value in zip(names, row, strict=True):
                keep[name].append(value)
            self.scorer.advance(velocity_error(env, command), past.settled, TICK_S)
            self.scorer.finish(command, (fell | late | env.changed) & alive, fell)
            alive &= ~(fell | late)
        self.scorer.report_to(self.grid)
        self.samples += c.length * c.n * process_group.size()
        rows = {name: np.array(value, dtype=np.float32) for name, value in keep.items()}
        rows |= {"noise": before, "spread": self._spread, "last_critic_obs": self.critic_obs()}
        t = {name: torch.from_numpy(value).to(self.device) for name, value in rows.items()}
        rollout = Rollout(**t, state=start, mirrored_state=mirrored_start)
        seen = self._figures(t, alive)
        with self.shares.measure("inference"):
            self._advance_memories(state, t["obs"], np.flatnonzero(~alive))
        return rollout, seen

    def _figures(self, rows: dict[str, torch.Tensor], alive: np.ndarray) -> dict[str, float]:
        """Return errors over a stride of living robots (m/s, rad/s) and falls per robot-minute."""
        xy, wz = error_magnitudes(self.past.stride[alive])
        return {
            "reward": float(rows["reward"].mean()),
            "error_xy": float(xy.mean()),
            "error_wz": float(wz.mean()),
            "falls_per_minute": float(
                60 * rows["ended"].sum() / (self.config.length * self.config.n * TICK_S)
            ),
        }

    def _advance_memories(self, state: State, obs: torch.Tensor, over: np.ndarray) -> None:
        """Advance the memory on the mirrored observations, and start over the robots `over`."""
        seen = self._mirrored[0].shape[1]
        with torch.no_grad():
            _, mirrored = self.actor(self.mirror_obs(obs[:, :seen]), self._mirrored)
        self._state, self._mirrored = state, mirrored
        if len(over):
            self._start_over(over)

    def _start_over(self, over: np.ndarray) -> None:
        """Replace the robots `over` by new ones without a past."""
        self.env.reset(over)
        self.rewards.reset(over)
        self.past.reset(over)
        if self.teacher:
            self.teacher.reset(over)
        self.scorer.take(over)
        self._noise = self._noise.copy()  # the rollout refers to the old array
        self._action[over] = self._noise[over] = 0.0
        self._state, self._mirrored = (
            tuple(m.clone() for m in pair) for pair in (self._state, self._mirrored)
        )
        for memory in self._state:
            memory[:, over] = 0.0
        for memory in self._mirrored:
            memory[:, over[over < memory.shape[1]]] = 0.0
