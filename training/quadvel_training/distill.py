"""Stage 2: the recurrent student learns from the teacher, whose true state it does not need to imitate it.

The teacher acts at every tick. Its own steady-state error is taken out first: a command map, found by integral action on
held commands, says which command it has to be given to walk at the one wanted (docs/decisions/0003). The student sees the
wanted command. Some robots the teacher drives, the others the student, both under time-correlated noise, and the teacher
says everywhere what it would have done: so the student learns to get out of where its own errors lead (DAgger). Both go by
the same clock (docs/decisions/0015). Eq. 6 and 7 act on the student from the start.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description import symmetry
from quadvel_sim.terrain import Terrain

from . import student, teacher
from .command_map import CommandCorrection, CommandMap, MapFit, Tracking, fit_command_map, held_commands
from .env import TICK, CommandRange, EnvConfig, VelocityEnv
from .loop import Budget, cosine, load, set_rate
from .networks import Gaussian, Mlp, Recurrent, State, select, torch_mirror
from .randomisation import Randomisation
from .teacher import GaitState

FAR = 0.5  # of the network's unit: what the teacher asks of a robot that is about to fall must not drown all else


def load_teacher(path: Path) -> Gaussian:
    """The teacher's actor from a checkpoint of stage 1."""
    actor = Gaussian(Mlp(len(teacher.OBSERVATION_MIRROR.index), 12), 12, 0.1)
    actor.load_state_dict(load(path)["actor"])
    return actor.eval()


class Teacher:
    """The teacher in a batch of environments, evaluated at every tick.

    `own` is its command map.
    """

    def __init__(self, actor: Gaussian, env: VelocityEnv, own: CommandMap, gain: float) -> None:
        self.actor, self.env, self.own = actor, env, own
        self.gait = GaitState(env)
        self.tracking = Tracking(env.config.n, gain)
        self._past = [np.zeros((env.config.n, 12)) for _ in range(teacher.HOLD)]

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        self.gait.reset(ids)
        self.tracking.reset(ids)
        for past in self._past:
            past[ids] = 0.0

    def targets(self) -> np.ndarray:
        """Joint targets (n, 12) for the present state."""
        env = self.env
        command = self.tracking.corrected(self.own(self.gait.pace))
        base = self.gait.targets(command)
        obs = teacher.observe(env, self.gait, command, self._past[0], base)
        with torch.no_grad():
            residual = self.actor(torch.from_numpy(obs))[0].numpy().astype(float).clip(-5, 5)
        self._past = [*self._past[1:], residual]
        return base + teacher.RESIDUAL * residual

    def advance(self) -> None:
        """After the environment's tick."""
        self.gait.advance()
        self.tracking.advance(self.env, self.gait.pace[:, :3])


class Student:
    """The student at the wheel, behind its command map `own`."""

    def __init__(self, actor: Recurrent, env: VelocityEnv, own: CommandMap) -> None:
        self.actor, self.env, self.own = actor, env, own
        self.tracking = Tracking(env.config.n, gain=0.0)
        self._map = student.action_map(env)
        self._memory = actor.initial_state(env.config.n)
        self._action = np.zeros((env.config.n, 12), np.float32)

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        self.tracking.reset(ids)
        self._action[ids] = 0.0
        for memory in self._memory:
            memory[:, ids] = 0.0

    def targets(self) -> np.ndarray:
        """Joint targets (n, 12) for the present state."""
        obs = student.observe(self.env, self._action, self.own(self.env.command))
        with torch.no_grad():
            action, self._memory = self.actor(torch.from_numpy(obs[None]), self._memory)
        self._action = action[0].numpy()
        return self._map.targets(self._action)

    def advance(self) -> None:
        """After the environment's tick."""
        self.tracking.advance(self.env, self.env.command[:, :3])


def map_student(
    actor: Recurrent, own: CommandMap, commands: CommandRange, drives: ActuatorParameters
) -> tuple[MapFit, VelocityEnv]:
    """Fit a student's command map on the nominal plant with these actuators; and the environment it was measured in."""
    plain = EnvConfig(n=768, commands=commands, actuator=drives, randomisation=Randomisation.calm())
    walker = Student(actor, VelocityEnv(held_commands(plain)), own)
    return fit_command_map(walker), walker.env


def export_mapped(
    actor: student.Policy,
    own: CommandMap,
    commands: CommandRange,
    drives: ActuatorParameters,
    about: dict[str, Any],
    path: Path,
) -> None:
    """Write the policy file of `actor` behind `own`, measured anew (`map_student`); about: how it came to be."""
    fit, walks = map_student(actor, own, commands, drives)
    student.export_policy(actor, walks, path, about | {"command_map": attrs.asdict(fit)}, own)


@attrs.frozen
class DistillConfig:
    """One run of stage 2."""

    budget: Budget = Budget(samples=1.6e7, minutes=30.0)
    n: int = 512
    length: int = 32  # ticks a sequence
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-4
    noise: float = (
        0.1  # rad, stationary std of the time-correlated noise on executed targets, up to, by environment
    )
    driven: float = 0.7  # share of robots that the student drives
    takeover: float = 0.25  # part of the run in which that share grows from nothing
    noise_time: float = 0.05  # s
    mini_batches: int = 8
    epochs: int = 2  # learning costs less than walking
    symmetry: float = 0.5
    smoothness: float = 0.05
    correction_gain: float = 0.5  # 1/s, integral action of the teacher on top of the map
    seed: int = 1
    commands: CommandRange = CommandRange()
    limits: CommandRange = CommandRange()  # of the policy file, where its command map is measured
    terrain: Terrain = Terrain()


class DistillRun:
    """Teacher, student and environment of stage 2."""

    def __init__(
        self, config: DistillConfig, teacher_file: Path, start: student.Policy | None = None
    ) -> None:
        """`start`: a student to go on from."""
        self.config = config
        torch.manual_seed(config.seed)
        env_config = EnvConfig(n=config.n, seed=config.seed, commands=config.commands)
        actor = load_teacher(teacher_file)
        trial = held_commands(env_config)  # on flat ground
        own = CommandMap(mirrored=True)
        fit_command_map(Teacher(actor, VelocityEnv(trial), own, gain=0.0))
        self.env = VelocityEnv(attrs.evolve(env_config, terrain=config.terrain))
        self.teacher = Teacher(actor, self.env, own, config.correction_gain)
        self.student = start or student.Policy(self.env.stand_q)
        self.student.lead = CommandCorrection(own, student.COMMAND)
        if not start:
            self.student.take_over(actor.network.body)
        self.map = student.action_map(self.env)
        self.optimiser = torch.optim.Adam(self.student.parameters(), lr=config.learning_rate)
        self.samples = 0
        self._memory: State = self.student.initial_state(config.n)
        self._fresh_mirrored: State = self.student.initial_state(config.n, mirrored=True)
        self._mirrored = self.student.initial_state(config.n, mirrored=True)
        self._previous = np.zeros((config.n, 12), np.float32)
        self._noise = np.zeros((config.n, 12))
        self._noise_std = np.linspace(0.0, config.noise, config.n)[:, None]
        self._turn = np.random.default_rng(config.seed).random(
            config.n
        )  # at which share the student takes a robot over
        self._mirror_obs, self._mirror_action = (
            torch_mirror(symmetry.OBSERVATION),
            torch_mirror(symmetry.JOINTS),
        )

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {
            "student": self.student.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "samples": self.samples,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.student.load_state_dict(state["student"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.samples = state["samples"]

    def step(self, done: float) -> dict[str, float]:
        """One sequence and one step of the optimiser."""
        c = self.config
        set_rate(self.optimiser, cosine(c.learning_rate, c.final_learning_rate, done))
        obs, label, mask, seen = self.collect(c.driven * min(1.0, done / c.takeover))
        return seen | self.learn(obs, label, mask)

    def collect(self, share: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, dict[str, float]]:
        """One sequence: observations (T, N, 48), the teacher's actions (T, N, 12), mask (T, N).

        share: of robots that the student drives.
        """
        env, c = self.env, self.config
        decay = np.exp(-TICK / c.noise_time)
        alive = np.ones(c.n, bool)
        driven = np.flatnonzero(self._turn < share)
        memory = select(self._memory, torch.from_numpy(driven))
        observations, labels, masks, falls = [], [], [], np.zeros(c.n, bool)
        for _ in range(c.length):
            observations.append(student.observe(env, self._previous))
            labels.append((self.teacher.targets() - self.map.offset) / self.map.scale)
            masks.append(alive.copy())
            action = labels[-1].copy()
            if len(driven):
                with torch.no_grad():
                    own, memory = self.student(torch.from_numpy(observations[-1][None, driven]), memory)
                action[driven] = own[0].numpy()
            drawn = env.rng.standard_normal((c.n, 12))
            self._noise = decay * self._noise + np.sqrt(1 - decay**2) * self._noise_std * drawn
            self._previous = (action + self._noise / self.map.scale).astype(np.float32)
            env.tick(self.map.targets(self._previous))
            self.teacher.advance()
            falls |= env.fallen & alive
            alive &= ~(env.fallen | env.timed_out)
        self._over = np.flatnonzero(~alive)
        self.samples += c.length * c.n
        lag = np.hypot(*self.teacher.tracking.error[:, :2].T)
        minutes = c.n * c.length * TICK / 60
        obs, label, mask = (
            torch.from_numpy(np.array(x, dtype=np.float32)) for x in (observations, labels, masks)
        )
        return (
            obs,
            label,
            mask,
            {
                "error_xy": float(lag.mean()),
                "error_driven": float(lag[driven].mean()) if len(driven) else 0.0,
                "falls_per_minute": falls.sum() / minutes,
                "falls_driven": falls[driven].sum() / (minutes * max(share, 1 / c.n)),
            },
        )

    def learn(self, obs: torch.Tensor, label: torch.Tensor, mask: torch.Tensor) -> dict[str, float]:
        """Some epochs over one sequence; then carries the memories on and clears those of ended environments."""
        seen: dict[str, float] = {}
        own = student.Followed(self.student, obs, self._memory)
        mirrored = student.Followed(self.student, self._mirror_obs(obs), self._mirrored)
        batches = [
            b
            for _ in range(self.config.epochs)
            for b in torch.randperm(self.config.n).chunk(self.config.mini_batches)
        ]
        for ids in batches:
            some = ids % 2 == 0  # the symmetry term sees every other environment
            actions = own.actions(ids), self._mirror_action(mirrored.actions(ids[some]))
            terms = self._learn(*actions, some, label[:, ids], mask[:, ids])
            seen = {name: seen.get(name, 0.0) + value / len(batches) for name, value in terms.items()}
        self._memory, self._mirrored = own.end(), mirrored.end()
        over = self._over
        if len(over):
            self.env.reset(over)
            self.teacher.reset(over)
            self._noise[over] = self._previous[over] = 0.0
            for memory in self._memory:
                memory[:, over] = 0.0
            for memory, fresh in zip(self._mirrored, self._fresh_mirrored, strict=True):
                memory[:, over] = fresh[:, over]
        return seen

    def _learn(
        self,
        action: torch.Tensor,
        mirrored: torch.Tensor,
        some: torch.Tensor,
        label: torch.Tensor,
        mask: torch.Tensor,
    ) -> dict[str, float]:
        """One step of the optimiser. mirrored: actions of the mirror images of `some`, mirrored back."""
        c = self.config
        alive = mask.sum().clamp(min=1)
        error = torch.nn.functional.huber_loss(action, label, reduction="none", delta=FAR)
        clone = (error.sum(-1) * mask).sum() / alive
        gap = ((action[:, some] - mirrored) ** 2).sum(-1)
        symmetric = (gap * mask[:, some]).sum() / mask[:, some].sum().clamp(min=1)
        bend = (action[2:] - 2 * action[1:-1] + action[:-2]).norm(dim=-1)
        smooth = (bend * mask[2:]).sum() / mask[2:].sum().clamp(min=1)
        loss = clone + c.symmetry * symmetric + c.smoothness * smooth
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.student.parameters(), 1.0)
        self.optimiser.step()
        return {
            "clone": float(clone.detach()),
            "symmetry": float(symmetric.detach()),
            "smoothness": float(smooth.detach()),
        }
