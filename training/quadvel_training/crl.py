"""Constrained reinforcement learning of the recurrent policy (Section 3.3) with the rewards of Table 2.

Starts from random weights or from a student. Exploration is time-correlated: white noise at 200 Hz is filtered away by
the soft gains. The symmetry term runs the mirrored sequence from the memory of the mirrored past.
"""

from __future__ import annotations

import copy
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description import symmetry
from quadvel_sim.terrain import Terrain

from . import parallel, student
from .command_map import CommandMap
from .distill import map_student
from .env import CommandRange, EnvConfig, VelocityEnv, cores
from .loop import Budget, Shares
from .networks import Gaussian, Mlp, Recurrent, State, torch_mirror
from .ppo import GENTLE, Ppo, PpoConfig, Rollout
from .randomisation import Randomisation, actuator
from .rewards import RewardWeights, Table2

PARTS = ("physics", "sensing", "inference", "learning")  # of an update's time; rewards count as sensing
PRIVILEGED = 8 + 3 + 4 + 1 + 12 + 12  # plant, true velocity, contacts, height, torque, exploration under way


@attrs.frozen
class CrlConfig:
    """One run; a recipe file sets these fields."""

    budget: Budget = Budget(samples=6e7, minutes=600.0)
    n: int = 512
    threads: int = attrs.field(factory=cores)
    length: int = 64  # ticks a sequence, 0.32 s
    std: float = 0.045  # of what exploration draws anew in every tick, in the network's unit
    critic_first: int = 40  # updates of the critic alone
    mapped: bool = False  # train behind a command map that takes out the steady-state error at the start
    keep: float = 5e6  # samples between policies that are kept and evaluated
    actuator: str = "eam"  # or ideal, or an actuator file
    timestep: float = 0.0025
    seed: int = 3
    commands: CommandRange = CommandRange()
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()
    rewards: RewardWeights = RewardWeights()
    ppo: PpoConfig = GENTLE


class CrlRun:
    """Environment, policy, critic and learner; networks and learning on `device`, all else on the CPU."""

    def __init__(self, config: CrlConfig, start: Recurrent | None = None, device: str = "cpu") -> None:
        self.config = c = config
        self.device = parallel.join(device)
        torch.manual_seed(c.seed)
        env_config = EnvConfig(
            n=c.n,
            threads=c.threads,
            seed=c.seed + 1000 * parallel.rank(),
            timestep=c.timestep,
            actuator=actuator(c.actuator),
            commands=c.commands,
            terrain=c.terrain,
            randomisation=c.randomisation,
        )
        self.env = VelocityEnv(env_config)
        self.rewards = Table2(self.env, c.rewards)
        self._mapped = c.mapped and start is not None
        self.actor = Gaussian(start or student.Policy(self.env.stand_q), 12, c.std).to(self.device)
        self.actor.log_std.requires_grad_(False)
        self.critic = Mlp(48 + PRIVILEGED, 1).to(self.device)
        self.mirror_obs, self.mirror_action = (
            torch_mirror(mirror, self.device) for mirror in (symmetry.OBSERVATION, symmetry.JOINTS)
        )
        self.ppo = Ppo(self.actor, self.critic, c.ppo, self.mirror_obs, self.mirror_action)
        self.map = student.action_map(self.env)
        self.shares = Shares()
        self.samples = self.updates = 0
        self._action = np.zeros((c.n, 12), np.float32)
        self._noise = np.zeros((c.n, 12), np.float32)
        self._state = self._initial_state(c.n)
        self._fresh_mirrored = self._initial_state(self.ppo.mirrored(c.n), mirrored=True)
        self._mirrored = self._fresh_mirrored

    def _initial_state(self, n: int, mirrored: bool = False) -> State:
        h, c = self.actor.network.initial_state(n, mirrored)
        return h.to(self.device), c.to(self.device)

    @cached_property
    def command_map(self) -> CommandMap:
        """What stands in front of the policy, measured on the start before the first update or taken from a checkpoint."""
        own = CommandMap()
        if self._mapped:
            map_student(self.policy(), own, self.config.commands, actuator(self.config.actuator))
        return own

    def policy(self) -> Recurrent:
        """A copy of the policy as it is now, on the CPU."""
        network: Recurrent = copy.deepcopy(self.actor.network).cpu()
        return network

    def write_policy(self, path: Path, about: dict[str, Any]) -> None:
        """The policy file as it is now; about: how it came to be."""
        student.export_policy(self.policy(), self.env, path, about, self.command_map)

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "learner": self.ppo.state(),
            "samples": self.samples,
            "updates": self.updates,
            "command_map": torch.from_numpy(self.command_map.weights),
            "random": {"learner": torch.get_rng_state(), "environments": self.env.rng.bit_generator.state},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; robots start over, with draws that go on unless there are several processes."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.ppo.restore(state["learner"])
        self.samples, self.updates = state["samples"], state["updates"]
        self.command_map = CommandMap(state["command_map"].numpy())
        if "random" in state and parallel.size() == 1:
            torch.set_rng_state(state["random"]["learner"])
            self.env.rng.bit_generator.state = state["random"]["environments"]

    def step(self, done: float) -> dict[str, float]:
        """One rollout, one update."""
        rollout, seen = self.collect()
        self.updates += 1
        with self.shares.of("learning"):
            seen |= self.ppo.update(rollout, learn_actor=self.updates > self.config.critic_first)
        return seen | self.shares.taken()

    def _observe(self) -> np.ndarray:
        return student.observe(self.env, self._action, self.command_map(self.env.command))

    def _critic_obs(self, obs: np.ndarray) -> np.ndarray:
        env = self.env
        true = [
            env.plants.drawn,
            env.velocity,
            env.contact,
            env.height[:, None],
            0.05 * env.torque,
            self._noise,
        ]
        return np.concatenate([obs, *true], axis=1).astype(np.float32)

    def _act(self, obs: np.ndarray, state: State) -> tuple[np.ndarray, State]:
        with torch.no_grad():
            mean, state = self.actor(torch.from_numpy(obs[None]).to(self.device), state)
        return mean[0].cpu().numpy(), state

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """One sequence of every environment."""
        c, env = self.config, self.env
        names = ("obs", "critic_obs", "action", "mean", "reward", "ended", "cut", "mask")
        keep: dict[str, list[np.ndarray]] = {name: [] for name in names}
        std = self.actor.log_std.exp().cpu().numpy()
        alive = np.ones(c.n, bool)
        state, start, mirrored_start = self._state, self._state, self._mirrored
        before = self._noise
        for _ in range(c.length):
            with self.shares.of("sensing"):
                obs = self._observe()
                critic_obs = self._critic_obs(obs)
            with self.shares.of("inference"):
                mean, state = self._act(obs, state)
            with self.shares.of("physics"):
                drawn = env.rng.standard_normal((c.n, 12), dtype=np.float32)
                self._noise = np.float32(c.ppo.correlation) * self._noise + std * drawn
                action = mean + self._noise
                env.tick(self.map.targets(action))
            with self.shares.of("sensing"):
                reward = self.rewards(action)
            self._action = action
            fell, late = env.fallen & alive, env.timed_out & ~env.fallen & alive
            for name, value in zip(
                names, (obs, critic_obs, action, mean, reward, fell, late, alive.copy()), strict=True
            ):
                keep[name].append(value)
            alive &= ~(fell | late)
        self.samples += c.length * c.n * parallel.size()
        rows = {name: np.array(value, dtype=np.float32) for name, value in keep.items()}
        rows |= {"noise": before, "last_critic_obs": self._critic_obs(self._observe())}
        t = {name: torch.from_numpy(value).to(self.device) for name, value in rows.items()}
        rollout = Rollout(**t, state=start, mirrored_state=mirrored_start)
        with self.shares.of("inference"):
            self._advance_memories(state, t["obs"], np.flatnonzero(~alive))
        error = env.command[:, :2] - env.velocity[:, :2]
        seconds = c.length * c.n * 0.005
        return rollout, {
            "reward": float(t["reward"].mean()),
            "error_xy": float(np.hypot(*error.T).mean()),
            "falls_per_minute": float(60 * t["ended"].sum() / seconds),
        }

    def _advance_memories(self, state: Any, obs: torch.Tensor, over: np.ndarray) -> None:
        """Carry the memory and, for the sequences that the symmetry term may see, the mirrored memory."""
        seen = self._mirrored[0].shape[1]
        with torch.no_grad():
            _, mirrored = self.actor(self.mirror_obs(obs[:, :seen]), self._mirrored)
        self._state, self._mirrored = state, mirrored
        if len(over):
            self.env.reset(over)
            self.rewards.reset(over)
            self._noise = self._noise.copy()  # the rollout holds the one before
            self._action[over] = self._noise[over] = 0.0
            self._state, self._mirrored = (tuple(m.clone() for m in pair) for pair in (state, mirrored))
            for memory in self._state:
                memory[:, over] = 0.0
            for memory, fresh in zip(self._mirrored, self._fresh_mirrored, strict=True):
                memory[:, over[over < seen]] = fresh[:, over[over < seen]]
