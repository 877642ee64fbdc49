"""Stage 3: constrained reinforcement learning of the paper's plain network at 200 Hz (Section 3.3).

Starts from the student of `dagger`, whose teacher pulls it back, strongly at first: what an action costs shows at once, what it
gains only after a stride. The pull fades, the constraints on symmetry and smoothness grow. Rewards are those of Table 2, and fines
for the error over a stride and for the one that lasts: steady errors are the policy's own to remove. Exploration is
correlated in time, as soft gains filter white noise away at 200 Hz.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description import symmetry
from quadvel_policy.observation import DEFAULT_OBSERVATION
from quadvel_sim.terrain import Terrain

from . import dagger, parallel, privileged
from .command_grid import CommandGrid, GridConfig
from .env import TICK, EnvConfig, VelocityEnv, cores
from .loop import Budget, Shares, linear, load
from .networks import Gaussian, Mlp, Recurrent, State, torch_mirror
from .ppo import GENTLE, Ppo, PpoConfig, Rollout, spreads
from .privileged import ACTION_BOUND, Judgement, Past, velocity_error
from .randomisation import Randomisation, actuator
from .rewards import RewardWeights, Table2
from .walking_rewards import sizes

CRITIC_SIZE = (
    privileged.SIZE + privileged.CRITIC_EXTRA + 12 + 12
)  # what the critic sees: torques, exploration under way, too
PARTS = ("physics", "sensing", "inference", "learning")  # of an update's time; rewards count as sensing


@attrs.frozen
class ConstrainedConfig:
    """One run; a recipe file sets these fields."""

    budget: Budget = Budget(samples=1e8, minutes=6e3)
    n: int = 512  # robots, of all processes together
    threads: int = attrs.field(factory=cores)
    length: int = 64  # ticks a sequence, 0.32 s
    std: float = 0.045  # of what exploration draws anew in every tick, in the network's unit, at first,
    final_std: float = (
        0.025  # in the end: steady errors without exploration are those with it, but for what it does itself
    )
    std_samples: float = 5e7  # and samples in between
    critic_first: int = 40  # updates of the critic alone
    pull: float = 1.0  # weight of the teacher's pull at first,
    final_pull: float = 0.0  # in the end,
    pull_samples: float = 3e7  # and samples in between
    constraint_samples: float = 2e7  # over which the weights of the constraints grow to their full
    stride: float = 1.0  # fine, s/m and s/rad, of the error over a stride,
    lasting: float = (
        3.0  # and of the error that lasts: under exploration steady errors hardly show over a stride
    )
    standing: float = (
        20.0  # fine, s/m and s/rad, of the error that lasts while a robot is told to stand: it may not creep
    )
    averaged: int = 150  # updates over which the weights of the policy are averaged: single steps leave steady errors behind
    keep: float = 5e6  # samples between policies that are kept and evaluated
    actuator: str = "eam"  # or limited, ideal, or an actuator file
    timestep: float = 0.0025
    seed: int = 3
    grid: GridConfig = GridConfig()  # the student's; its open cells come with it
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()
    rewards: RewardWeights = RewardWeights()
    ppo: PpoConfig = attrs.evolve(GENTLE, smoothness=3.2)


class ConstrainedRun:
    """Environment, policy, critic and learner; networks and learning on `device`, all else on the CPU."""

    def __init__(
        self,
        config: ConstrainedConfig,
        start: Path | None = None,
        teacher: Path | None = None,
        device: str = "cpu",
    ) -> None:
        """start: checkpoint of `dagger`, or of this stage, whose critic comes with it; without it, random weights.

        teacher: checkpoint of `privileged`; without it nothing pulls.
        """
        self.device = parallel.join(device)
        self.config = c = attrs.evolve(config, n=parallel.share(config.n))
        torch.manual_seed(c.seed)
        known = load(start) if start else {}
        self.grid = CommandGrid(c.grid)
        if "grid" in known:
            self.grid.restore(known["grid"])
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
        self.teacher = dagger.Teacher(load(teacher), self.env, self.past) if teacher else None
        self.rewards = Table2(self.env, c.rewards)
        self.judgement = Judgement(c.n)
        network = dagger.policy_of(start) if start else Recurrent(DEFAULT_OBSERVATION.size, 12)
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
        self.shares = Shares()
        self.samples = self.updates = 0
        self._action = np.zeros((c.n, 12), np.float32)
        self._noise = np.zeros((c.n, 12), np.float32)
        self._spread = spreads(c.n)
        self._state = self._initial_state(c.n)
        self._mirrored = self._initial_state(self.ppo.mirrored(c.n))

    def _initial_state(self, n: int) -> State:
        h, c = self.actor.network.initial_state(n)
        return h.to(self.device), c.to(self.device)

    def policy(self) -> Recurrent:
        """A copy of the averaged policy as it is now, on the CPU."""
        return copy.deepcopy(self.average).cpu()

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def _follow_weights(self) -> None:
        """Take the policy's weights into their average."""
        share = 1.0 / min(self.updates, self.config.averaged)
        for mean, now in zip(self.average.parameters(), self.actor.network.parameters(), strict=True):
            mean.lerp_(now, share)

    def write_policy(self, path: Path, about: dict[str, Any]) -> None:
        """The policy file as it is now; about: how it came to be."""
        dagger.export_policy(self.policy(), self.env, self.grid.config.answered, path, about)

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
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
        """Go on from a checkpoint; robots start over, under commands of its grid."""
        self.actor.load_state_dict(state["actor"])
        self.average.load_state_dict(state["average"])
        self.critic.load_state_dict(state["critic"])
        self.ppo.restore(state["learner"])
        self.grid.restore(state["grid"])
        self.samples, self.updates = state["samples"], state["updates"]
        parallel.go_on_drawing(state["random"], self.env.rng, self.config.seed, self.samples)
        self._start_over(np.arange(self.config.n))

    def step(self, done: float) -> dict[str, float]:
        """One rollout, one update."""
        c = self.config
        pull = linear(c.pull, c.final_pull, self.samples / c.pull_samples)
        if pull == 0.0:
            self.teacher = None
        spread = linear(c.std, c.final_std, self.samples / c.std_samples)
        self.actor.log_std.fill_(np.log(spread))
        rollout, seen = self.collect()
        self.updates += 1
        constraints = linear(0.0, 1.0, self.samples / c.constraint_samples)
        with self.shares.of("learning"):
            learned = self.ppo.update(rollout, self.updates > c.critic_first, pull, constraints)
            self._follow_weights()
        return (
            seen
            | learned
            | {"pull": pull, "constraints": constraints}
            | self.grid.reach()
            | self.shares.taken()
        )

    def _critic_obs(self) -> np.ndarray:
        env, past = self.env, self.past
        known = privileged.observe(env, past, self._action)
        seen = known, privileged.critic_extra(env, past), 0.05 * env.torque, self._noise
        return np.concatenate(seen, axis=1).astype(np.float32)

    def _act(self, obs: np.ndarray, state: State) -> tuple[np.ndarray, State]:
        with torch.no_grad():
            mean, state = self.actor(torch.from_numpy(obs[None]).to(self.device), state)
        return mean[0].cpu().numpy(), state

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """One sequence of every environment."""
        c, env, past = self.config, self.env, self.past
        names = ["obs", "critic_obs", "standing", "action", "mean", "reward", "ended", "cut", "mask"]
        names += ["label"] if self.teacher else []
        keep: dict[str, list[np.ndarray]] = {name: [] for name in names}
        std = self.actor.log_std.exp().cpu().numpy()
        alive = np.ones(c.n, bool)
        state, start, mirrored_start, before = self._state, self._state, self._mirrored, self._noise
        for _ in range(c.length):
            with self.shares.of("sensing"):
                obs, critic_obs = dagger.observe(env, self._action), self._critic_obs()
                standing = past.standing
            with self.shares.of("inference"):
                mean, state = self._act(obs, state)
                label = [self.teacher.action()] if self.teacher else []
            with self.shares.of("physics"):
                drawn = env.rng.standard_normal((c.n, 12), dtype=np.float32)
                self._noise = np.float32(c.ppo.correlation) * self._noise + std * self._spread * drawn
                action, command = mean + self._noise, env.command.copy()
                env.tick(self.map.targets(action))
            with self.shares.of("sensing"):
                past.advance(command)
                if self.teacher:
                    self.teacher.advance(action.clip(-ACTION_BOUND, ACTION_BOUND))
                reward = self.rewards(action)
                lasting = np.where(command[:, 3] > 0.5, c.standing, c.lasting)
                reward -= c.stride * sum(sizes(past.stride)) + lasting * sum(sizes(past.lasting))
            self._action = action
            fell, late = env.fallen & alive, env.timed_out & ~env.fallen & alive
            row = (obs, critic_obs, standing, action, mean, reward, fell, late, alive.copy(), *label)
            for name, value in zip(names, row, strict=True):
                keep[name].append(value)
            self.judgement.advance(velocity_error(env, command), TICK)
            self.judgement.end(command, (fell | late | env.changed) & alive, fell)
            alive &= ~(fell | late)
        self.judgement.tell(self.grid)
        self.samples += c.length * c.n * parallel.size()
        rows = {name: np.array(value, dtype=np.float32) for name, value in keep.items()}
        rows |= {"noise": before, "spread": self._spread, "last_critic_obs": self._critic_obs()}
        t = {name: torch.from_numpy(value).to(self.device) for name, value in rows.items()}
        rollout = Rollout(**t, state=start, mirrored_state=mirrored_start)
        seen = self._figures(t, alive)
        with self.shares.of("inference"):
            self._advance_memories(state, t["obs"], np.flatnonzero(~alive))
        return rollout, seen

    def _figures(self, rows: dict[str, torch.Tensor], alive: np.ndarray) -> dict[str, float]:
        """Errors over a stride of robots that are up (m/s, rad/s), falls a robot-minute."""
        xy, wz = sizes(self.past.stride[alive])
        return {
            "reward": float(rows["reward"].mean()),
            "error_xy": float(xy.mean()),
            "error_wz": float(wz.mean()),
            "falls_per_minute": float(60 * rows["ended"].sum() / (self.config.length * self.config.n * TICK)),
        }

    def _advance_memories(self, state: State, obs: torch.Tensor, over: np.ndarray) -> None:
        """Carry the memory and, for the sequences that the symmetry term may see, that of the mirrored past."""
        seen = self._mirrored[0].shape[1]
        with torch.no_grad():
            _, mirrored = self.actor(self.mirror_obs(obs[:, :seen]), self._mirrored)
        self._state, self._mirrored = state, mirrored
        if len(over):
            self._start_over(over)

    def _start_over(self, over: np.ndarray) -> None:
        """New robots in the place of `over`, without a past."""
        self.env.reset(over)
        self.rewards.reset(over)
        self.past.reset(over)
        if self.teacher:
            self.teacher.reset(over)
        self.judgement.close(over)
        self._noise = self._noise.copy()  # the rollout holds the one before
        self._action[over] = self._noise[over] = 0.0
        self._state, self._mirrored = (
            tuple(m.clone() for m in pair) for pair in (self._state, self._mirrored)
        )
        for memory in self._state:
            memory[:, over] = 0.0
        for memory in self._mirrored:
            memory[:, over[over < memory.shape[1]]] = 0.0
