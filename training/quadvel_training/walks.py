"""Walks to learn an estimator from: a policy's, with all that comes before and after, on randomised robots and sensors.

The robots lie, stand up, stand in stance (with its stiff gains), walk, stop and lie down, as the controller's modes have them
do, for times drawn at random. What an estimator makes of the readings is the caller's matter.
"""

from __future__ import annotations

from enum import IntEnum

import attrs
import numpy as np
import torch

from quadvel_description import robot
from quadvel_description.command_range import clip_to_command_range
from quadvel_description.state import RobotState
from quadvel_policy.observation import DEFAULT_OBSERVATION, build_observation
from quadvel_policy.supervisor import SupervisorConfig
from quadvel_sim.config import SensorNoise
from quadvel_sim.terrain import Terrain

from . import dagger
from .env import TICK, CommandRange, EnvConfig, VelocityEnv
from .networks import Recurrent
from .randomisation import Randomisation

NOISE = np.repeat(attrs.astuple(SensorNoise()), (12, 12, 3, 3, 3))
NOISE_SCALE = (0.5, 3.0)  # of a walk's noise, times NOISE: no robot's sensors are the simulator's
BIAS_ACCELERATION = 0.1  # m/s^2, constant a walk
BIAS_ANGULAR_VELOCITY = 0.01  # rad/s
BIAS_TILT = 0.005  # rad
FALL_TILT = 0.9  # rad
EPISODE = 30.0  # s


class Mode(IntEnum):
    """What a robot does; the controller's modes, standing up in its two parts, and walking on a command to stand."""

    DAMPING = 0
    FOLD = 1
    RISE = 2
    STANCE = 3
    WALK = 4
    STOP = 5
    LOWER = 6


_C = SupervisorConfig()
UP, DOWN = robot.NOMINAL_Q, robot.LIE_Q
GOAL = np.array([DOWN, DOWN, UP, UP, UP, UP, DOWN])
MOVE = np.array(
    [1.0, _C.fold_time, _C.rise_time, _C.settle_time, 1.0, 1.0, _C.lie_down_time]
)  # s, to the goal
SHORTEST = np.array([0.2, _C.fold_time, _C.rise_time, 0.4, 3.0, 0.7, _C.lie_down_time])  # s, in a mode
LONGEST = np.array([2.0, _C.fold_time, _C.rise_time, 10.0, 12.0, 2.0, _C.lie_down_time])
STAND_GAINS = np.array([_C.stand_kp, _C.stand_kd])
AFTER = np.array([Mode.FOLD, Mode.RISE, Mode.STANCE, Mode.WALK, Mode.STOP, Mode.STANCE, Mode.DAMPING])
LOWER_SHARE = 0.2  # of the stances that end in lying down
FIRST = np.array([0.3, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0])  # share of each mode at the start of a walk


class Modes:
    """The modes of `n` robots and what each asks of the joints, vectorised (one robot's: `quadvel_policy.modes`)."""

    def __init__(self, n: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self.mode = np.full(n, Mode.WALK)
        self.elapsed = np.zeros(n)
        self._until = np.zeros(n)
        self._from = np.tile(UP, (n, 1))  # targets at which the mode began
        self.target = np.tile(UP, (n, 1))
        self.kp, self.kd = np.zeros((n, 12)), np.zeros((n, 12))

    @property
    def driven(self) -> np.ndarray:
        """(n,) whether the policy drives."""
        return (self.mode == Mode.WALK) | (self.mode == Mode.STOP)

    @property
    def previous_action(self) -> np.ndarray:
        """The estimator's input (n, 12), rad: targets in force minus the nominal posture, zeros while damping."""
        return np.where((self.mode == Mode.DAMPING)[:, None], 0.0, clip_to_command_range(self.target) - UP)

    def begin(self, ids: np.ndarray) -> np.ndarray:
        """Draw a first mode for `ids`; returns the posture (n, 12) in which each is to start."""
        self.mode[ids] = self._rng.choice(len(FIRST), len(ids), p=FIRST)
        self._enter(ids, GOAL[self.mode[ids]])
        self.elapsed[ids] = np.where(self.mode[ids] == Mode.WALK, _C.blend_time, 0.0)
        self.target[ids] = GOAL[self.mode[ids]]
        return GOAL[self.mode[ids]]

    def _enter(self, ids: np.ndarray, start: np.ndarray) -> None:
        m = self.mode[ids]
        self._from[ids], self.elapsed[ids] = start, 0.0
        self._until[ids] = SHORTEST[m] * (LONGEST[m] / SHORTEST[m]) ** self._rng.random(len(ids))

    def ask(self, policy_target: np.ndarray, kp: float, kd: float) -> np.ndarray:
        """Set `target` (n, 12), `kp` and `kd` where the policy asks for `policy_target`; returns the target's speed."""
        s = np.clip(self.elapsed / MOVE[self.mode], 0.0, 1.0)[:, None]
        way = GOAL[self.mode] - self._from
        self.target = self._from + s**3 * (10 - 15 * s + 6 * s**2) * way
        speed = 30 * s**2 * (1 - s) ** 2 / MOVE[self.mode][:, None] * way
        self.kp[:], self.kd[:] = STAND_GAINS
        braking, driven = self.mode == Mode.DAMPING, self.driven
        self.kp[braking], self.kd[braking] = 0.0, _C.damping_kd
        share = np.where(self.mode == Mode.WALK, np.minimum(self.elapsed / _C.blend_time, 1.0), 1.0)[
            driven, None
        ]
        stiff, soft = (1 - share) * STAND_GAINS, share * [kp, kd]
        both = stiff + soft
        mixed = stiff[:, :1] * self._from[driven] + soft[:, :1] * policy_target[driven]
        self.target[driven] = mixed / both[:, :1]
        self.kp[driven], self.kd[driven] = both[:, :1], both[:, 1:]
        speed[braking | driven] = 0.0
        return speed

    def advance(self, q: np.ndarray) -> np.ndarray:
        """One tick further at the joint angles `q` (n, 12); returns the ids of those that begin to walk."""
        self.elapsed += TICK
        due = np.flatnonzero(self.elapsed >= self._until)
        if not len(due):
            return due
        before, stand_kp = self.mode[due], STAND_GAINS[0]
        lower = (before == Mode.STANCE) & (self._rng.random(len(due)) < LOWER_SHARE)
        self.mode[due] = np.where(lower, Mode.LOWER, AFTER[before])
        # where the new gains ask for the torque that the old ones asked for
        start = q[due] + self.kp[due] * (self.target[due] - q[due]) / stand_kp
        self._enter(due, start)
        return due[before == Mode.STANCE]


class Walks:
    """A batch of environments under a frozen policy. A tick is `sense`, then `advance` with what the policy is to believe.

    `truth` (n, 3): velocity at the time of the readings, m/s, body frame; `over` (n,): fell or timed out, for `start_over`.
    """

    def __init__(self, env: VelocityEnv, actor: Recurrent) -> None:
        self.env, self._actor = env, actor
        n = env.config.n
        self.over = np.zeros(n, bool)
        self._map = dagger.action_map(env)
        self._modes = Modes(n, env.rng)
        self._action = np.zeros((n, 12), np.float32)
        self._memory = actor.initial_state(n)
        self._biases, self._noise = np.zeros((n, 8)), np.zeros((n, 1))
        self.start_over(np.arange(n))

    @property
    def truth(self) -> np.ndarray:
        """True velocity now."""
        return self.env.velocity

    def noisy_truth(self) -> np.ndarray:
        """The velocity (n, 3) as the policy was trained to see it."""
        return self.env.sense()["linear_velocity"]

    @property
    def previous_action(self) -> np.ndarray:
        """The targets in force, as `features.build` takes them."""
        return self._modes.previous_action

    def start_over(self, ids: np.ndarray) -> None:
        """New robots, sensors and first modes."""
        if not len(ids):
            return
        rng = self.env.rng
        self.env.reset(ids, self._modes.begin(ids))
        self._biases[ids] = rng.normal(size=(len(ids), 8)) * (
            [BIAS_ACCELERATION] * 3 + [BIAS_ANGULAR_VELOCITY] * 3 + [BIAS_TILT] * 2
        )
        self._noise[ids] = rng.uniform(*NOISE_SCALE, (len(ids), 1))
        self._forget(ids)
        self.over[ids] = False

    def _forget(self, ids: np.ndarray) -> None:
        """The policy begins anew."""
        self._action[ids] = 0.0
        for memory in self._memory:
            memory[:, ids] = 0.0

    def sense(self) -> RobotState:
        """What the robots report now, (n, ...), with noise and the sensors' biases."""
        env, b = self.env, self._biases
        n = len(b)
        noise = self._noise * NOISE * env.rng.standard_normal((n, len(NOISE)))
        turn = noise[:, 30:].copy()
        turn[:, :2] += b[:, 6:]
        quaternion = _multiply(env.quaternion, np.concatenate([np.ones((n, 1)), turn / 2], axis=1))
        return RobotState(
            time=0.0,
            tick=0,
            q=env.q + noise[:, :12],
            dq=env.dq + noise[:, 12:24],
            tau=env.torque,
            quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
            angular_velocity=env.angular_velocity + noise[:, 24:27] + b[:, 3:6],
            linear_acceleration=env.acceleration + noise[:, 27:30] + b[:, :3],
            foot_force=np.zeros((n, 4)),
        )

    def advance(self, state: RobotState, velocity: np.ndarray) -> None:
        """One tick under the policy that sees `state` and believes in `velocity` (n, 3)."""
        env, modes = self.env, self._modes
        command = env.command.copy()
        command[modes.mode == Mode.STOP] = [0.0, 0.0, 0.0, 1.0]
        obs = build_observation(
            DEFAULT_OBSERVATION,
            command=command,
            quaternion=state.quaternion,
            q=state.q,
            dq=state.dq,
            linear_velocity=velocity,
            angular_velocity=state.angular_velocity,
            previous_action=self._action,
        )
        with torch.no_grad():
            action, self._memory = self._actor(torch.from_numpy(obs[None]), self._memory)
        self._action = action[0].numpy()
        speed = modes.ask(self._map.targets(self._action), env.config.kp, env.config.kd)
        env.tick(modes.target, speed, modes.kp, modes.kd)
        self._forget(modes.advance(env.q))
        tilted = np.abs(env.roll_pitch).max(axis=1) > FALL_TILT
        self.over |= tilted | (env.fallen & modes.driven) | ~np.isfinite(env.height) | env.timed_out


def both_grounds(
    n: int, seed: int, commands: CommandRange, randomisation: Randomisation, rough: Terrain, actor: Recurrent
) -> tuple[Walks, Walks]:
    """Walks of `n` robots in all, half on flat ground, half on `rough`."""
    config = EnvConfig(n=n // 2, seed=seed, commands=commands, randomisation=randomisation, episode=EPISODE)
    flat, uneven = (VelocityEnv(attrs.evolve(config, terrain=terrain)) for terrain in (Terrain(), rough))
    return Walks(flat, actor), Walks(uneven, actor)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product, wxyz, (n, 4)."""
    scalar = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([scalar, vector], axis=1)
