"""Stage 1: a teacher that knows the true state and a gait clock, and corrects the trotting gait of `gait` 50 times a second.

Why not the recurrent student at once: see docs/decisions/0003-teacher-then-student.md.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description import robot, symmetry
from quadvel_description.symmetry import Mirror
from quadvel_sim.terrain import Terrain

from . import clock, gait
from .command_map import Tracking
from .env import TICK, CommandRange, EnvConfig, VelocityEnv
from .legs import columns
from .loop import Budget
from .networks import Gaussian, Mlp, torch_mirror
from .ppo import Ppo, PpoConfig, Rollout

HOLD = 4  # ticks a residual is held
RESIDUAL = 0.2  # rad a unit of the network's output
LEVELLING = 0.2  # s, in which the trunk follows the ground's slope


def _signs(*signs: float) -> Mirror:
    return Mirror(np.arange(len(signs)), np.array(signs, float))


OBSERVATION_MIRROR = symmetry.stack(
    [symmetry.OBSERVATION, _signs(-1, -1), symmetry.JOINTS, symmetry.FEET, _signs(1)]
)
CRITIC_MIRROR_FREE = 8 + 6  # plant draws, low-passed errors: seen by the critic alone


class GaitState:
    """The clock, the residual and the ground's slope of `n` environments.

    pace (n, 4): the command that the gait walks at. It follows the wanted one, and stands once it has come to rest.
    """

    def __init__(self, env: VelocityEnv) -> None:
        n = env.config.n
        self.env = env
        self.residual = np.zeros((n, 12))
        self.residual_before = np.zeros((n, 12))
        self.slope = np.zeros((n, 2))
        self._clock = torch.zeros(n, clock.SIZE)
        self._wanted = np.zeros((n, 4))
        self.reset(np.arange(n))

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`, whose environments have just started over."""
        for array in (self.residual, self.residual_before):
            array[ids] = 0.0
        self._clock[ids] = clock.advance(torch.zeros(clock.SIZE), torch.zeros(4))
        self.slope[ids] = self.env.ground_slope[ids]
        self._note()

    def advance(self) -> None:
        """After the environment's tick: one tick further under the command that was in force in it."""
        self.slope += (self.env.ground_slope - self.slope) * TICK / LEVELLING
        self._clock = clock.advance(self._clock, torch.from_numpy(self._wanted.astype(np.float32)))
        self._note()

    def _note(self) -> None:
        self._wanted = self.env.command.copy()
        pace, phase = clock.pace_and_phase(self._clock)
        self.pace, self.phase = pace.numpy().astype(float), phase.numpy()

    def targets(self, command: np.ndarray | None = None) -> np.ndarray:
        """The gait's joint targets (n, 12) in the true state, at another command (n, 4) than `pace` if given."""
        env = self.env
        seen = (env.q, env.velocity, env.angular_velocity, env.roll_pitch, self.slope, env.height[:, None])
        q, *others = (torch.from_numpy(x.astype(np.float32)) for x in seen)
        return gait.targets(self.cycle(command), gait.Body(columns(q), *others)).numpy().astype(float)

    def cycle(self, command: np.ndarray | None = None) -> gait.Cycle:
        """Where in its cycle the gait is."""
        given = self.pace if command is None else command
        return gait.Cycle(torch.from_numpy(self.phase), torch.from_numpy(given.astype(np.float32)))


def observe(
    env: VelocityEnv, g: GaitState, command: np.ndarray, previous: np.ndarray, base: np.ndarray
) -> np.ndarray:
    """The teacher's input (n, 67): the paper's 48 numbers from the true state, the clock, the gait's targets, contacts."""
    angle = 2 * np.pi * g.phase
    moving = command[:, 3:] < 0.5
    return np.concatenate(
        [
            command,
            2 * env.roll_pitch,
            2 * (env.q - robot.NOMINAL_Q),
            0.1 * env.dq,
            env.velocity,
            0.5 * env.angular_velocity,
            previous,
            np.sin(angle) * moving,
            np.cos(angle) * moving,
            2 * np.clip(base - env.q, -1, 1),
            env.contact,
            5 * (env.height[:, None] - 0.4),
        ],
        axis=1,
    ).astype(np.float32)


def critic_extra(env: VelocityEnv, tracking: Tracking) -> np.ndarray:
    """What only the critic sees: the drawn plant and the low-passed errors, (n, 14)."""
    return np.concatenate([env.plants.drawn, tracking.error, tracking.velocity], axis=1).astype(np.float32)


def reward(env: VelocityEnv, g: GaitState, lag: np.ndarray) -> np.ndarray:
    """Reward of one tick, (n,): tracking (`lag`: its error over a stride), attitude, effort, smooth residuals, feet on time."""
    c = g.pace
    ev = np.sum((c[:, :2] - env.velocity[:, :2]) ** 2, axis=1)
    ew = (c[:, 2] - env.angular_velocity[:, 2]) ** 2
    tracking = (
        1.0 * np.exp(-ev / 0.25)
        + 0.5 * np.exp(-ev / 0.02)
        + 0.5 * np.exp(-ew / 0.25)
        + 0.25 * np.exp(-ew / 0.05)
    )
    tracking -= 1.5 * np.hypot(lag[:, 0], lag[:, 1]) + 0.5 * np.abs(lag[:, 2])
    lean = gait.lean(torch.from_numpy(g.slope)).numpy()
    body = (
        -0.5 * np.abs(env.roll_pitch - lean).sum(1)
        - 0.3 * np.abs(env.velocity[:, 2])
        - 0.08 * np.hypot(env.angular_velocity[:, 0], env.angular_velocity[:, 1])
        - 3.0 * np.abs(env.height - gait.HEIGHT)
    )
    power = np.maximum(0.2 * env.torque**2 + env.torque * env.dq, 0).sum(1)
    effort = -6e-4 * power - 3e-4 * np.sum(env.dq**2, axis=1) * (1 + 20 * c[:, 3])
    cycle = g.cycle()
    wanted = cycle.down.numpy()
    slide = np.hypot(env.foot_velocity[..., 0], env.foot_velocity[..., 1])
    lift = cycle.lift(cycle.swing()).numpy()
    feet = (
        -0.15 * (wanted != env.contact).sum(1)
        - 0.15 * (slide * env.contact).sum(1)
        - 2.0 * np.maximum(0.7 * lift - env.clearance, 0).sum(1)
    )
    step = g.residual - g.residual_before
    smooth = -0.03 * np.sum(step**2, axis=1) - 0.01 * np.sum(g.residual**2, axis=1)
    return 0.6 + tracking + body + effort + feet + smooth


@attrs.frozen
class TeacherConfig:
    """One run of stage 1."""

    budget: Budget = Budget(samples=2e7, minutes=45.0)
    n: int = 512
    length: int = 24  # samples a sequence
    std: float = 0.5
    final_std: float = 0.15
    seed: int = 0
    commands: CommandRange = CommandRange()
    terrain: Terrain = Terrain()
    ppo: PpoConfig = PpoConfig()


class TeacherRun:
    """Environment and learner of stage 1."""

    def __init__(self, config: TeacherConfig) -> None:
        self.config = config
        torch.manual_seed(config.seed)
        self.env = VelocityEnv(
            EnvConfig(n=config.n, seed=config.seed, commands=config.commands, terrain=config.terrain)
        )
        self.gait = GaitState(self.env)
        self.tracking = Tracking(config.n, gain=0.0)
        size = len(OBSERVATION_MIRROR.index)
        self.actor = Gaussian(Mlp(size, 12), 12, config.std)
        self.critic = Mlp(size + CRITIC_MIRROR_FREE, 1)
        self.ppo = Ppo(
            self.actor,
            self.critic,
            config.ppo,
            torch_mirror(OBSERVATION_MIRROR),
            torch_mirror(symmetry.JOINTS),
        )
        self.samples = 0

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "learner": self.ppo.state(),
            "samples": self.samples,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.ppo.restore(state["learner"])
        self.samples = state["samples"]

    def step(self, done: float) -> dict[str, float]:
        """Collect one rollout and learn from it; the exploration noise falls as the budget is spent."""
        rollout, seen = self.collect()
        with torch.no_grad():
            bound = np.log(self.config.std + (self.config.final_std - self.config.std) * min(1.0, 1.3 * done))
            self.actor.log_std.clamp_(max=float(bound))
        return seen | self.ppo.update(rollout)

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """One rollout of `length` samples with exploration noise."""
        env, g, c = self.env, self.gait, self.config
        keep: dict[str, list[np.ndarray]] = {
            name: [] for name in ("obs", "extra", "action", "mean", "reward", "ended", "cut")
        }
        std = self.actor.log_std.exp().detach().numpy()
        errors, falls = [], 0
        base = g.targets()
        for _ in range(c.length):
            obs = observe(env, g, g.pace, g.residual, base)
            with torch.no_grad():
                mean = self.actor(torch.from_numpy(obs))[0].numpy()
            action = (mean + std * env.rng.standard_normal(mean.shape)).astype(np.float32)
            extra = critic_extra(env, self.tracking)
            g.residual_before, g.residual = g.residual, np.clip(action, -5, 5).astype(float)
            total = np.zeros(c.n)
            for _ in range(HOLD):
                env.tick(base + RESIDUAL * g.residual)
                g.advance()
                base = g.targets()
                self.tracking.advance(env, g.pace[:, :3])
                total += reward(env, g, self.tracking.error)
            fell, late = env.fallen.copy(), env.timed_out & ~env.fallen
            lag = self.tracking.error
            errors.append([np.hypot(lag[:, 0], lag[:, 1]).mean(), np.abs(lag[:, 2]).mean()])
            falls += int(fell.sum())
            for name, value in zip(
                keep, (obs, extra, action, mean, total / HOLD - 4.0 * fell, fell, late), strict=True
            ):
                keep[name].append(value)
            over = np.flatnonzero(fell | late)
            if len(over):
                env.reset(over)
                g.reset(over)
                self.tracking.reset(over)
                base[over] = g.targets()[over]
        self.samples += c.length * c.n
        last = np.concatenate(
            [observe(env, g, g.pace, g.residual, base), critic_extra(env, self.tracking)], axis=1
        )
        t = {name: torch.from_numpy(np.array(value, dtype=np.float32)) for name, value in keep.items()}
        rollout = Rollout(
            obs=t["obs"],
            critic_obs=torch.cat([t["obs"], t["extra"]], dim=-1),
            action=t["action"],
            mean=t["mean"],
            noise=torch.zeros_like(t["mean"][0]),
            reward=t["reward"],
            ended=t["ended"],
            cut=t["cut"],
            mask=torch.ones_like(t["reward"]),
            last_critic_obs=torch.from_numpy(last),
        )
        xy, wz = np.mean(errors, axis=0)
        seconds = c.length * c.n * HOLD * TICK
        return rollout, {
            "error_xy": xy,
            "error_wz": wz,
            "falls_per_minute": 60 * falls / seconds,
            "reward": float(t["reward"].mean()),
        }
