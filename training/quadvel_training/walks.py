"""Walks of a policy that an estimator learns from, on randomised robots and sensors.

The robots stand up, stand, walk, stop and lie down at random times, as in the modes of the
controller, with the stiff gains of stance. The caller runs the estimator on the readings.
"""

from __future__ import annotations

from enum import IntEnum

import attrs
import numpy as np
import torch

from quadvel_description.command_range import clip_to_command_range
from quadvel_description.robot import Robot
from quadvel_description.state import RobotState
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.observation import build_observation, default_observation
from quadvel_sim.config import SensorNoise
from quadvel_sim.terrain import Terrain

from . import dagger
from .env import TICK_S, CommandRange, EnvConfig, VelocityEnv
from .networks import Recurrent
from .randomisation import Randomisation

NOISE = np.repeat(attrs.astuple(SensorNoise()), (12, 12, 3, 3, 3))
NOISE_SCALE = (0.5, 3.0)  # factor of NOISE, drawn per walk
BIAS_ACCELERATION = 0.1  # m/s^2, constant per walk
BIAS_ANGULAR_VELOCITY = 0.01  # rad/s
BIAS_TILT = 0.005  # rad
FALL_TILT = 0.9  # rad
EPISODE = 30.0  # s


class Mode(IntEnum):
    """Mode of a robot: the controller's modes, standing up in two parts, and stopping."""

    DAMPING = 0
    FOLD = 1
    RISE = 2
    STANCE = 3
    WALK = 4
    STOP = 5
    LOWER = 6


_C = SupervisorConfig()
MOVE_S = np.array(
    [1.0, _C.fold_time, _C.rise_time, _C.settle_time, 1.0, 1.0, _C.lie_down_time]
)  # duration of the way to the goal
MIN_MODE_S = np.array(
    [0.2, _C.fold_time, _C.rise_time, 0.4, 3.0, 0.7, _C.lie_down_time]
)  # duration of a mode
MAX_MODE_S = np.array([2.0, _C.fold_time, _C.rise_time, 10.0, 12.0, 2.0, _C.lie_down_time])
STAND_GAINS = np.array([_C.stand_kp, _C.stand_kd])
NEXT_MODE = np.array([Mode.FOLD, Mode.RISE, Mode.STANCE, Mode.WALK, Mode.STOP, Mode.STANCE, Mode.DAMPING])
LOWER_SHARE = 0.2  # of the stances, followed by lying down
FIRST_MODE_SHARES = np.array([0.3, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0])  # probability of each mode at the start


class Modes:
    """Modes of `n` robots and their joint commands (one robot's: `quadvel_policy.modes`).

    Attributes:
        mode: (n,), `Mode` of each robot.
        elapsed: (n,), s since the mode began.
        target: (n, 12), rad, joint targets.
        kp: (n, 12), N m/rad.
        kd: (n, 12), N m s/rad.
    """

    def __init__(self, robot: Robot, n: int, rng: np.random.Generator) -> None:
        """Create robots that walk.

        Args:
            robot: the robot.
            n: number of robots.
            rng: source of randomness.
        """
        self._rng, self._robot = rng, robot
        up, down = robot.nominal_q, robot.lie_q
        self._goals = np.array([down, down, up, up, up, up, down])  # by mode, rad
        self.mode = np.full(n, Mode.WALK)
        self.elapsed = np.zeros(n)
        self._until = np.zeros(n)
        self._from = np.tile(up, (n, 1))  # targets when the mode began
        self.target = np.tile(up, (n, 1))
        self.kp, self.kd = np.zeros((n, 12)), np.zeros((n, 12))

    @property
    def driven(self) -> np.ndarray:
        """Whether the policy drives, (n,) bool."""
        return (self.mode == Mode.WALK) | (self.mode == Mode.STOP)

    @property
    def previous_action(self) -> np.ndarray:
        """Targets minus the nominal posture (n, 12), rad; zeros while damping."""
        targets = clip_to_command_range(self._robot, self.target) - self._robot.nominal_q
        return np.where((self.mode == Mode.DAMPING)[:, None], 0.0, targets)

    def begin(self, ids: np.ndarray) -> np.ndarray:
        """Draw a first mode for some robots.

        Args:
            ids: their indices.

        Returns:
            rad, (len, 12), posture to start each of them in.
        """
        self.mode[ids] = self._rng.choice(len(FIRST_MODE_SHARES), len(ids), p=FIRST_MODE_SHARES)
        self._enter(ids, self._goals[self.mode[ids]])
        self.elapsed[ids] = np.where(self.mode[ids] == Mode.WALK, _C.blend_time, 0.0)
        self.target[ids] = self._goals[self.mode[ids]]
        return self._goals[self.mode[ids]]

    def _enter(self, ids: np.ndarray, start: np.ndarray) -> None:
        """Start the present mode of some robots at the targets `start`, and draw its duration."""
        m = self.mode[ids]
        self._from[ids], self.elapsed[ids] = start, 0.0
        # log-uniform between MIN_MODE_S and MAX_MODE_S
        self._until[ids] = MIN_MODE_S[m] * (MAX_MODE_S[m] / MIN_MODE_S[m]) ** self._rng.random(len(ids))

    def set_targets(self, policy_target: np.ndarray, kp: float, kd: float) -> np.ndarray:
        """Set `target`, `kp` and `kd` for the present modes.

        Args:
            policy_target: rad, (n, 12), targets of the policy.
            kp: N m/rad, the policy's proportional gain.
            kd: N m s/rad, the policy's derivative gain.

        Returns:
            rad/s, (n, 12), velocity of the targets.
        """
        # Quintic from start to goal with zero velocity and acceleration at both ends:
        #     x(s) = x_0 + (10 s^3 - 15 s^4 + 6 s^5) (x_1 - x_0), s = t / T in [0, 1]
        #     dx/dt = 30 s^2 (1 - s)^2 (x_1 - x_0) / T
        s = np.clip(self.elapsed / MOVE_S[self.mode], 0.0, 1.0)[:, None]
        way = self._goals[self.mode] - self._from
        self.target = self._from + s**3 * (10 - 15 * s + 6 * s**2) * way
        speed = 30 * s**2 * (1 - s) ** 2 / MOVE_S[self.mode][:, None] * way
        self.kp[:], self.kd[:] = STAND_GAINS
        braking, driven = self.mode == Mode.DAMPING, self.driven
        self.kp[braking], self.kd[braking] = 0.0, _C.damping_kd
        share = np.where(self.mode == Mode.WALK, np.minimum(self.elapsed / _C.blend_time, 1.0), 1.0)[
            driven, None
        ]
        # Blend from stance to policy: the sum of both PD laws, as one PD law
        #     kp = (1 - b) kp_s + b kp_p, kp q_des = (1 - b) kp_s q_s + b kp_p q_p
        stiff, soft = (1 - share) * STAND_GAINS, share * [kp, kd]
        both = stiff + soft
        mixed = stiff[:, :1] * self._from[driven] + soft[:, :1] * policy_target[driven]
        self.target[driven] = mixed / both[:, :1]
        self.kp[driven], self.kd[driven] = both[:, :1], both[:, 1:]
        speed[braking | driven] = 0.0
        return speed

    def advance(self, q: np.ndarray) -> np.ndarray:
        """Advance by one tick; switch modes that are over.

        Args:
            q: rad, (n, 12), joint positions.

        Returns:
            Indices of the robots that begin to walk.
        """
        self.elapsed += TICK_S
        due = np.flatnonzero(self.elapsed >= self._until)
        if not len(due):
            return due
        before, stand_kp = self.mode[due], STAND_GAINS[0]
        lower = (before == Mode.STANCE) & (self._rng.random(len(due)) < LOWER_SHARE)
        self.mode[due] = np.where(lower, Mode.LOWER, NEXT_MODE[before])
        # where the new gains give the torque of the old ones
        start = q[due] + self.kp[due] * (self.target[due] - q[due]) / stand_kp
        self._enter(due, start)
        return due[before == Mode.STANCE]


class Walks:
    """Batch of environments under a frozen policy.

    In each tick call `sense`, then `advance` with the velocity that the policy gets.

    Attributes:
        env: environments.
        over: (n,) bool, whether the robot fell or timed out; pass these to `start_over`.
    """

    def __init__(self, env: VelocityEnv, actor: Recurrent) -> None:
        """Create walks that start now.

        Args:
            env: environments.
            actor: policy.
        """
        self.env, self._actor = env, actor
        n = env.config.n
        self.over = np.zeros(n, bool)
        self._map = dagger.action_map(env)
        self._modes = Modes(env.robot, n, env.rng)
        self._action = np.zeros((n, 12), np.float32)
        self._memory = actor.initial_state(n)
        self._biases, self._noise = np.zeros((n, 8)), np.zeros((n, 1))
        self.start_over(np.arange(n))

    @property
    def truth(self) -> np.ndarray:
        """True velocity at the time of the readings, (n, 3), m/s, body frame."""
        return self.env.velocity

    def noisy_truth(self) -> np.ndarray:
        """Return the velocity as the policy saw it in training.

        Returns:
            (n, 3), m/s, body frame.
        """
        return self.env.sense()["linear_velocity"]

    @property
    def previous_action(self) -> np.ndarray:
        """Targets in force, as `features.build` takes them, (n, 12), rad."""
        return self._modes.previous_action

    def start_over(self, ids: np.ndarray) -> None:
        """Replace robots, with new sensors and first modes.

        Args:
            ids: their indices.
        """
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
        """Reset the policy's memory and previous action."""
        self._action[ids] = 0.0
        for memory in self._memory:
            memory[:, ids] = 0.0

    def sense(self) -> RobotState:
        """Return the readings of all robots, with noise and biases of the sensors.

        Returns:
            A state with arrays (n, ...).
        """
        env, b = self.env, self._biases
        n = len(b)
        noise = self._noise * NOISE * env.rng.standard_normal((n, len(NOISE)))
        turn = noise[:, 30:].copy()
        turn[:, :2] += b[:, 6:]
        # small rotation by the vector `turn`: q (1, turn / 2)
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
        """Advance by one tick under the policy.

        Args:
            state: readings that the policy sees.
            velocity: (n, 3), m/s, velocity that the policy gets.
        """
        env, modes = self.env, self._modes
        command = env.command.copy()
        command[modes.mode == Mode.STOP] = [0.0, 0.0, 0.0, 1.0]
        obs = build_observation(
            default_observation(env.robot),
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
        speed = modes.set_targets(self._map.targets(self._action), env.config.kp, env.config.kd)
        env.tick(modes.target, speed, modes.kp, modes.kd)
        self._forget(modes.advance(env.q))
        tilted = np.abs(env.roll_pitch).max(axis=1) > FALL_TILT
        self.over |= tilted | (env.fallen & modes.driven) | ~np.isfinite(env.height) | env.timed_out


def walks_on_both_grounds(
    robot: Robot,
    n: int,
    seed: int,
    commands: CommandRange,
    randomisation: Randomisation,
    rough: Terrain,
    actor: Recurrent,
) -> tuple[Walks, Walks]:
    """Create walks on flat and on rough ground.

    Args:
        robot: the robot.
        n: number of robots, of both together.
        seed: seed of all draws.
        commands: range of commands.
        randomisation: what varies.
        rough: the rough ground.
        actor: policy.

    Returns:
        Walks on flat and on rough ground.
    """
    config = EnvConfig(
        robot=robot, n=n // 2, seed=seed, commands=commands, randomisation=randomisation, episode=EPISODE
    )
    flat, uneven = (VelocityEnv(attrs.evolve(config, terrain=terrain)) for terrain in (Terrain(), rough))
    return Walks(flat, actor), Walks(uneven, actor)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product, wxyz, (n, 4)."""
    scalar = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([scalar, vector], axis=1)
