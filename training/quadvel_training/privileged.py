"""Stage 1: a memoryless teacher that sees the true state finds a gait from random weights, by rewards alone.

No reference motion. It acts 50 times a second, learns by PPO with a mirror loss, and
its commands grow with what it follows (`command_grid`). What it sees of the past, errors over a stride and over some
seconds, a recurrent student can keep for itself.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch

from quadvel_description import robot, symmetry
from quadvel_description.symmetry import Mirror
from quadvel_sim.terrain import Terrain

from . import loop, parallel
from .command_grid import CommandGrid, GridConfig
from .env import EnvConfig, VelocityEnv, cores
from .loop import Budget
from .networks import Gaussian, Mlp, torch_mirror
from .ppo import Ppo, PpoConfig, Rollout, spreads
from .randomisation import Randomisation, actuator
from .walking_rewards import (
    SAMPLE,
    WalkingRewards,
    WalkingWeights,
    lifting,
    one_diagonal_in_the_air,
    sizes,
)

ACTION_SCALE = 0.4  # rad a unit of the network's output
ACTION_BOUND = 4.0  # of the network's unit
STRIDE = 0.35  # s, over which errors are low-passed: about a stride
LONG = 1.5  # s, the same for what lasts
TRANSIENT = 1.0  # s after a new command that what lasts, and the judgement of the command, leave out
PAIRING = 0.7  # s, over which `Past.paired` is low-passed: about two strides
HIPS_AHEAD = robot.HIP_OFFSET[0] * np.array([robot.FRONT[leg] for leg in robot.LEGS])  # m, body frame
AIRBORNE = 0.05  # weight of a rollout's share of feet in the air in the run's mean, about 20 rollouts
STOOD = 0.2  # s on four feet, after which a robot that sets off has to begin with a side
TALL = 0.38  # m, about the height of a walking trunk


def _signs(*signs: float) -> Mirror:
    return Mirror(np.arange(len(signs)), np.array(signs, float))


_PLANAR = _signs(1, -1, -1)
MIRROR = symmetry.concatenate_mirrors(
    [
        symmetry.OBSERVATION,
        symmetry.FEET,  # contact
        symmetry.FEET,  # clearance
        _signs(1),  # height
        _PLANAR,  # error over a stride
        _PLANAR,  # lasting error
        _signs(1, -1),  # slope of the ground
        symmetry.FEET,  # friction
        _signs(1),  # payload
        _signs(1, -1, 1),  # shift of the centre of mass
    ]
)
SIZE = len(MIRROR.index)
CRITIC_EXTRA = 4 + 4 + 1
GAIT_EXTRA = 2  # more that this stage's critic alone sees: `Past.paired`, and `lifting`


class Past:
    """What `n` robots have done: errors, low-passed, and how long each foot has been in the air or down.

    stride, lasting (n, 3): command minus velocity in vx, vy (m/s) and yaw rate (rad/s) over STRIDE and LONG; the latter
    starts at zero with every new command, TRANSIENT after it. air, down (n, 4): s since the foot left the ground or touched it.
    paired (n,): share of the time that one diagonal pair of feet alone was in the air, low-passed over PAIRING. off_hip (n, 4): of
    a foot that has just left the ground, how far ahead of its hip the middle of its stance was, m, body frame; else 0.
    """

    def __init__(self, env: VelocityEnv) -> None:
        n = env.config.n
        self.env = env
        self.stride, self.lasting = np.zeros((n, 3)), np.zeros((n, 3))
        self.air, self.down = np.zeros((n, 4)), np.zeros((n, 4))
        self.paired, self.off_hip = np.zeros(n), np.zeros((n, 4))
        self._age = np.zeros(n)  # s, of the command
        self._landed, self._last = (
            np.zeros((n, 4)),
            np.zeros((n, 4)),
        )  # m ahead of the hip: at touchdown, last on the ground

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        for array in (self.stride, self.lasting, self.air, self.down, self.paired, self.off_hip, self._age):
            array[ids] = 0.0

    def advance(self, command: np.ndarray) -> None:
        """After a tick of the environment under `command` (n, 4)."""
        env, period = self.env, self.env.config.period
        error = velocity_error(env, command)
        self.stride += (error - self.stride) * period / STRIDE
        self._age += period
        settled = (self._age > TRANSIENT)[:, None]
        self.lasting += (error - self.lasting) * settled * period / LONG
        self.lasting[env.changed] = self._age[env.changed] = 0.0
        self._advance_stances()
        self.air = np.where(env.contact, 0.0, self.air + period)
        self.down = np.where(env.contact, self.down + period, 0.0)
        paired = one_diagonal_in_the_air(env.contact)
        self.paired += (paired - self.paired) * period / PAIRING

    def _advance_stances(self) -> None:
        """Note where feet touch down and leave the ground; `down` is still that of the sample before."""
        contact, ahead = self.env.contact, self.env.foot_position[..., 0] - HIPS_AHEAD
        was_down = self.down > 0.0
        self._landed = np.where(contact & ~was_down, ahead, self._landed)
        self.off_hip = np.where(was_down & ~contact, 0.5 * (self._landed + self._last), 0.0)
        self._last = np.where(contact, ahead, self._last)

    @property
    def standing(self) -> np.ndarray:
        """Which robots have stood on four feet for so long that setting off means to choose a side, (n,) bool."""
        return np.asarray((self.down > STOOD).all(axis=1))


def velocity_error(env: VelocityEnv, command: np.ndarray) -> np.ndarray:
    """Command minus velocity, (n, 3): vx, vy in m/s, yaw rate in rad/s."""
    velocity = np.concatenate([env.velocity[:, :2], env.angular_velocity[:, 2:]], axis=1)
    return np.asarray(command[:, :3] - velocity)


def observe(env: VelocityEnv, past: Past, previous: np.ndarray) -> np.ndarray:
    """The teacher's input (n, SIZE): the paper's 48 numbers from the true state, feet, height, past errors, ground, plant.

    previous (n, 12): its action SAMPLE ago.
    """
    return np.concatenate(
        [
            env.command,
            2 * env.roll_pitch,
            2 * (env.q - robot.NOMINAL_Q),
            0.1 * env.dq,
            env.velocity,
            0.5 * env.angular_velocity,
            previous,
            env.contact,
            np.clip(5 * env.clearance, -1, 2),
            5 * (env.height[:, None] - TALL),
            2 * past.stride,
            2 * past.lasting,
            3 * env.ground_slope,
            env.plants.drawn[:, :4],
            0.2 * env.plants.drawn[:, 4:5],
            env.plants.drawn[:, 5:],
        ],
        axis=1,
    ).astype(np.float32)


def critic_extra(env: VelocityEnv, past: Past) -> np.ndarray:
    """What the critic alone sees: how long each foot has been where it is, and the time left, (n, CRITIC_EXTRA)."""
    time = env.time[:, None] / env.config.episode
    return np.concatenate([2 * past.air, 2 * np.minimum(past.down, 1.0), time], axis=1).astype(np.float32)


@attrs.frozen
class PrivilegedConfig:
    """One run of stage 1."""

    budget: Budget = Budget(samples=2e8, minutes=6e3)
    n: int = 512  # robots, of all processes together
    threads: int = attrs.field(factory=cores)
    length: int = 24  # samples of 20 ms a sequence, 0.48 s
    timestep: float = 0.004  # s, of physics
    std: float = 0.7  # of the exploration at first, in the network's unit; an upper bound for it that falls
    final_std: float = 0.22  # to this
    std_samples: float = 2.5e7  # with so many samples
    formed: float = (
        6e6  # samples after which a gait has formed, if feet lift (`walking_rewards.lifting`) then;
    )
    forming_std: float = (
        0.45  # until then exploration is no less: robots that stand have to stumble upon steps,
    )
    ramped: float = (
        0.6  # share of the commands that are led up to their velocity; the others come in one step
    )
    reversed: float = 0.0  # share of the commands that reverse the one before
    formed_rate: float = 5e-4  # and from then on the learning rate is no more
    keep: float = 1e6  # samples between numbered checkpoints
    actuator: str = "eam"
    seed: int = 0
    grid: GridConfig = GridConfig()
    terrain: Terrain = Terrain()
    randomisation: Randomisation = Randomisation()
    rewards: WalkingWeights = WalkingWeights()
    ppo: PpoConfig = PpoConfig(target_kl=0.012, entropy=0.002, symmetry=0.3)


Judged = tuple[np.ndarray, np.ndarray, np.ndarray]
"""What `CommandGrid.note` takes: commands, mean errors, falls"""


class Judgement:
    """How the command that each robot has now has been followed so far, from TRANSIENT after its start on."""

    def __init__(self, n: int) -> None:
        self._sum, self._age = np.zeros((n, 3)), np.zeros(n)
        self._over: list[Judged] = []

    def advance(self, error: np.ndarray, period: float) -> None:
        """Note the errors (n, 3) of one sample."""
        self._age += period
        self._sum += error * period * (self._age > TRANSIENT)[:, None]

    def close(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the commands of `ids` that end: mean errors (len, 2) in xy and yaw, and for how long they were judged, s."""
        judged = np.maximum(self._age[ids] - TRANSIENT, 0.0)
        mean = self._sum[ids] / np.maximum(judged, 1e-6)[:, None]
        self._sum[ids], self._age[ids] = 0.0, 0.0
        return np.stack(sizes(mean), axis=1), judged

    def end(self, command: np.ndarray, over: np.ndarray, fell: np.ndarray) -> None:
        """Judge the commands (n, 4) that are `over` (n,); too short ones say nothing, falls always."""
        ids = np.flatnonzero(over)
        error, judged = self.close(ids)
        tells = (fell[ids] | (judged > 0.5 * TRANSIENT)) & (command[ids, 3] < 0.5)
        if tells.any():
            self._over.append((command[ids][tells], error[tells], fell[ids][tells]))

    def tell(self, grid: CommandGrid) -> None:
        """Tell the grid what was judged since the last time, by all processes: all their grids are one."""
        for judged in itertools.chain(*parallel.gather(self._over)):
            grid.note(*judged)
        self._over = []


class PrivilegedRun:
    """Environment and learner of stage 1."""

    def __init__(self, config: PrivilegedConfig) -> None:
        parallel.join("cpu")
        self.config = c = attrs.evolve(config, n=parallel.share(config.n))
        torch.manual_seed(c.seed)
        self.grid = CommandGrid(c.grid)
        env_config = EnvConfig(
            n=c.n,
            threads=c.threads,
            seed=parallel.seed_of(c.seed),
            period=SAMPLE,
            timestep=c.timestep,
            actuator=actuator(c.actuator),
            terrain=c.terrain,
            randomisation=c.randomisation,
            ramped=c.ramped,
            reversed=c.reversed,
        )
        self.env = VelocityEnv(env_config, self.grid)
        self.past = Past(self.env)
        self.rewards = WalkingRewards(self.env, c.rewards)
        self.judgement = Judgement(c.n)
        self.actor = Gaussian(Mlp(SIZE, 12), 12, c.std)
        self.critic = Mlp(SIZE + CRITIC_EXTRA + GAIT_EXTRA, 1)
        mirrors = (torch_mirror(mirror) for mirror in (MIRROR, symmetry.JOINTS))
        self.ppo = Ppo(self.actor, self.critic, c.ppo, *mirrors)
        self.samples = 0
        self._airborne = (
            0.0  # share of the time that feet of walking robots are in the air, of the last rollouts
        )
        self._spread = spreads(c.n)
        self._actions = np.zeros((2, c.n, 12), np.float32)  # the last ones, the newest first

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "learner": self.ppo.state(),
            "grid": self.grid.state(),
            "samples": self.samples,
            "airborne": self._airborne,
            "random": {"learner": torch.get_rng_state(), "environments": self.env.rng.bit_generator.state},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; robots start over, under commands of its grid.

        Raises:
            CheckpointError: the checkpoint is of another grid, or of a version whose critic saw less.
        """
        if "airborne" not in state:
            raise loop.CheckpointError(
                "checkpoint: found no field 'airborne', expected one of this version's stage 1"
            )
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.ppo.restore(state["learner"])
        self.grid.restore(state["grid"])
        self.samples = state["samples"]
        self._note_airborne(state["airborne"], 1.0)
        parallel.go_on_drawing(state["random"], self.env.rng, self.config.seed, self.samples)
        self._start_over(np.arange(self.config.n))

    def step(self, done: float) -> dict[str, float]:
        """One rollout, one update."""
        rollout, seen = self.collect()
        self._bound_exploration()
        seen |= self.ppo.update(rollout)
        if self.formed:
            self.ppo.learning_rate = min(self.ppo.learning_rate, self.config.formed_rate)
            loop.set_rate(self.ppo.actor_optimiser, self.ppo.learning_rate)
        return seen | self.grid.reach() | {"std": float(self.actor.log_std.detach().exp().mean())}

    @property
    def formed(self) -> bool:
        """Whether a gait has formed: feet lift, and the first samples are over."""
        return self.samples >= self.config.formed and self.rewards.lifting > 0.5

    def _note_airborne(self, share: float, weight: float = AIRBORNE) -> None:
        """Take up the share of the time in the air of walking robots' feet in the last rollout."""
        self._airborne += weight * (share - self._airborne)
        self.rewards.lifting = lifting(self._airborne)

    def _bound_exploration(self) -> None:
        c = self.config
        most = loop.linear(c.std, c.final_std, self.samples / c.std_samples)
        least = 0.5 * c.final_std if self.formed else c.forming_std
        with torch.no_grad():
            self.actor.log_std.clamp_(min=float(np.log(least)), max=float(np.log(max(most, least))))

    def _start_over(self, ids: np.ndarray) -> None:
        if len(ids):
            self.env.reset(ids)
            self.past.reset(ids)
            self.rewards.reset(ids)
            self.judgement.close(ids)
            self._actions[:, ids] = 0.0

    def _critic_obs(self, obs: np.ndarray) -> np.ndarray:
        gait = np.stack([self.past.paired, np.full(len(obs), self.rewards.lifting)], axis=1)
        return np.concatenate([obs, critic_extra(self.env, self.past), gait.astype(np.float32)], axis=1)

    def collect(self) -> tuple[Rollout, dict[str, float]]:
        """One sequence of every environment with exploration noise."""
        env, c = self.env, self.config
        names = ("obs", "critic_obs", "standing", "action", "mean", "reward", "ended", "cut")
        keep: dict[str, list[np.ndarray]] = {name: [] for name in names}
        std = self.actor.log_std.exp().detach().numpy()
        terms: dict[str, float] = {}
        seen, walking = np.zeros(6), 0
        for _ in range(c.length):
            obs = observe(env, self.past, self._actions[0])
            critic_obs, standing = self._critic_obs(obs), self.past.standing
            with torch.no_grad():
                mean = self.actor(torch.from_numpy(obs))[0].numpy()
            drawn = mean + std * self._spread * env.rng.standard_normal(mean.shape, dtype=np.float32)
            action = drawn.clip(-ACTION_BOUND, ACTION_BOUND)
            command = env.command.copy()
            touched = self.past.air.copy()
            env.tick(env.stand_q + ACTION_SCALE * action)
            self.past.advance(command)
            self.judgement.advance(velocity_error(env, command), SAMPLE)
            parts = self.rewards.terms(command, self.past, touched, np.stack([action, *self._actions]))
            reward = self.rewards.total(parts, env.fallen)
            self._actions = np.concatenate([action[None], self._actions[:-1]])
            fell, late = env.fallen.copy(), env.timed_out & ~env.fallen
            row = (obs, critic_obs, standing, drawn, mean, reward, fell, late)
            for name, value in zip(names, row, strict=True):
                keep[name].append(value)
            for name, value in parts.items():
                terms[name] = terms.get(name, 0.0) + float(value.mean()) / c.length
            errors = [size.mean() for size in sizes(self.past.stride)]
            on_the_way = command[:, 3] < 0.5
            walking += on_the_way.sum()
            lifted = (~env.contact[on_the_way]).mean(axis=1).sum()
            seen += [*errors, fell.mean(), env.broken.sum(), env.contact.mean(), lifted]
            self.judgement.end(command, fell | late | env.changed, fell)
            self._start_over(np.flatnonzero(fell | late))
        self.judgement.tell(self.grid)
        airborne = float(np.mean(parallel.gather(seen[5] / max(walking, 1))))
        self._note_airborne(airborne)
        self.samples += c.length * c.n * parallel.size()
        t = {name: torch.from_numpy(np.array(value, dtype=np.float32)) for name, value in keep.items()}
        last = self._critic_obs(observe(env, self.past, self._actions[0]))
        rollout = Rollout(
            **t,
            noise=torch.zeros(c.n, 12),
            spread=torch.from_numpy(self._spread),
            mask=torch.ones_like(t["reward"]),
            last_critic_obs=torch.from_numpy(last),
        )
        xy, wz, falls, broken, contact, _ = seen / c.length
        return rollout, {
            "error_xy": xy,
            "error_wz": wz,
            "falls_per_minute": 60 * falls / SAMPLE,
            "broken": broken * c.length,
            "contact_ratio": contact,
            "airborne": airborne,
            "reward": float(t["reward"].mean()),
        } | {f"reward/{name}": value for name, value in terms.items()}


class Numbered(loop.Keeper):
    """Keeps a numbered checkpoint in FOLDER/kept every so many samples, the configuration's `keep`."""

    def __init__(self, run: PrivilegedRun, folder: Path) -> None:
        super().__init__(run.config.keep)
        self._run, self._folder = run, folder

    def keep(self) -> dict[str, float]:
        """Write the checkpoint, named by its thousands of samples."""
        loop.save(self._run.state(), self._folder / "kept" / f"{self._run.samples // 1000:06}k.pt")
        return {}
