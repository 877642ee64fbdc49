"""The batched walking environment: MuJoCo's batch, the actuator model, randomisation and sensing, at 200 Hz.

It knows no reward and no gait: trainers read `VelocityEnv`'s arrays. Frames and joint order as everywhere in quadvel.
A robot whose physics has blown up is put down as fallen at once, so that no trainer ever sees a number that is none.
"""

from __future__ import annotations

import os
from typing import Protocol

import attrs
import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description import mjcf, robot
from quadvel_description.command_range import split_target
from quadvel_description.kinematics import foot_kinematics, foot_positions, roll_pitch, rotate, rotate_inverse
from quadvel_policy.observation import CommandLimits
from quadvel_sim.physics import Physics
from quadvel_sim.terrain import Terrain

from .randomisation import PlantSampler, Randomisation, sample_actuators

TICK = 0.005  # s, one sample of the policy on the robot
HEAT = 0.2  # W/(N m)^2, k_r of the paper's energy
RAMP = (
    0.7,
    5.0,
)  # m/s^2, from and to: how fast commands that are led grow; they fall RAMP_DOWN times as fast,
RAMP_DOWN = 4.0
RAMP_AXES = np.array([1.0, 0.7, 1.25])  # and on the axes vx, vy (m/s^2), wz (rad/s^2) in these proportions
EDGE = 0.6  # m, before the end of rough ground, at which an episode ends as if its time was over
ABSURD_SPEED = 150.0  # m/s or rad/s of any body or joint: physics that has blown up, or is about to
STANCE_LENGTH, STANCE_WIDTH = np.ptp(
    foot_positions(robot.NOMINAL_Q)[:, :2], axis=0
)  # m, between nominal feet


def cores() -> int:
    """How many this process may use; torchrun's processes on this machine share them."""
    return max(1, len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


@attrs.frozen
class CommandRange:
    """How velocity commands are drawn: from a box, or from the paper's ellipsoid, there the radius in proportion to itself."""

    vx: tuple[float, float] = (-1.4, 2.0)
    vy: float = 0.7
    wz: float = 1.4
    ellipsoid: bool = False
    curve: float | None = None  # m/s^2, held together as by `quadvel_policy.observation.CommandLimits`
    stance: float = 0.15  # share of stance commands
    straight: float = 0.2  # share of the walking commands without turning
    hold: tuple[float, float] = (2.0, 6.0)  # s until the next command

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n, 4): vx, vy (m/s), wz (rad/s), stance."""
        unit = rng.uniform(-1, 1, (n, 3))
        if self.ellipsoid:
            unit = rng.normal(size=(n, 3))
            unit *= (np.sqrt(rng.random(n)) / np.linalg.norm(unit, axis=1))[:, None]
        centre, half = np.mean(self.vx), np.ptp(self.vx) / 2
        command = np.zeros((n, 4))
        command[:, :3] = unit * [half, self.vy, self.wz] + [centre, 0.0, 0.0]
        command[rng.random(n) < self.straight, 2] = 0.0
        if self.curve:
            limits = CommandLimits(
                (self.vx[0], -self.vy, -self.wz), (self.vx[1], self.vy, self.wz), self.curve
            )
            command[:, :3] = [limits.held(one) for one in command[:, :3].tolist()]
        still = rng.random(n) < self.stance
        command[still] = [0.0, 0.0, 0.0, 1.0]
        return command

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Which of the velocities (n, 3) lie in the box, (n,) bool."""
        low, high = [self.vx[0], -self.vy, -self.wz], [self.vx[1], self.vy, self.wz]
        return np.asarray(((command >= low) & (command <= high)).all(axis=1))


class Commands(Protocol):
    """Where velocity commands come from."""

    @property
    def hold(self) -> tuple[float, float]:
        """For how long a command lasts, from and to, s."""
        ...

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n, 4): vx, vy (m/s), wz (rad/s), stance."""
        ...

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Which of the velocities (n, 3) may be drawn, (n,) bool."""
        ...


@attrs.frozen
class EnvConfig:
    """One batch of environments."""

    n: int = 512
    threads: int = attrs.field(factory=cores)
    seed: int = 0
    period: float = TICK  # s, one sample of the trainer: how long joint targets are held
    timestep: float = 0.0025  # s, of physics
    kp: float = robot.KP
    kd: float = robot.KD
    episode: float = 20.0  # s
    actuator: ActuatorParameters = attrs.field(factory=ActuatorParameters.default)
    randomisation: Randomisation = Randomisation()
    commands: CommandRange = CommandRange()
    ramped: float = 0.6  # share of the commands that are led to the new velocity as the command mux does it
    reversed: float = 0.0  # share of the new commands that reverse the one before
    terrain: Terrain = Terrain()


def training_model(timestep: float, terrain: Terrain, torsional_friction: float = 0.0) -> mujoco.MjModel:
    """The AlienGo as it is trained on: feet and trunk collide, no sensors. torsional_friction: of the feet, m."""
    plant = mjcf.Plant(timestep=timestep, plane=False, only_feet_and_trunk=True, sensors=False)
    spec = mjcf.build_spec(plant)
    terrain.add_to(spec)
    model = spec.compile()
    Physics(torsional_friction=torsional_friction).apply(model)
    return model


class VelocityEnv:
    """`n` robots. After every `tick`, a sample of `config.period`, the arrays below describe the new state; `reset(ids)`
    starts some over.

    command (n, 4); q, dq, torque (n, 12); quaternion (n, 4); velocity, angular_velocity, acceleration (n, 3) in the body
    frame; feet, foot_velocity (n, 4, 3) in the world frame (m, m/s); clearance (n, 4) of each foot above ground (m);
    contact (n, 4) bool; height (n,) of the trunk above ground; power (n,) of the joints by the paper's energy term, mean of
    the sample, W; fastest (n, 12) of each joint's speeds in the sample, rad/s; foot_position (n, 4, 3) in the body frame, m;
    fallen, timed_out (n,) bool; broken (n,) bool: fallen because physics has blown up; changed (n,) bool:
    command is new. `command` may be on its way yet to the velocity that was drawn.
    """

    def __init__(self, config: EnvConfig, commands: Commands | None = None) -> None:
        """`commands`: where they are drawn instead of the configuration's range."""
        self.config = c = config
        self.commands: Commands = commands or c.commands
        self.model = training_model(c.timestep, c.terrain, c.randomisation.torsional_friction[1])
        self.substeps = round(c.period / c.timestep)
        self._resend = max(
            1, int(TICK / c.timestep)
        )  # steps between packets: the controller sends every TICK
        self.rng = np.random.default_rng(c.seed)
        self.batch = Batch(self.model, c.n, c.threads)
        self.plants = PlantSampler(self.batch, c.randomisation, self.rng)
        self.actuators = ActuatorModel(c.actuator, (c.n, 12), c.timestep, seed=c.seed + 1)
        self._qpos, self._qvel, self._ctrl, self._clock = (
            self.batch.bind(name) for name in ("qpos", "qvel", "ctrl", "time")
        )
        self.stand_q = robot.NOMINAL_Q + mjcf.gravity_torque(self.model) / c.kp

        n = c.n
        self.command = np.zeros((n, 4))
        self._goal, self._ramp = np.zeros((n, 4)), np.full(n, np.inf)
        self.changed = np.zeros(n, bool)
        self.broken = np.zeros(n, bool)
        self.power = np.zeros(n)
        self.fastest = np.zeros((n, 12))
        self.torque = np.zeros((n, 12))
        self.acceleration = np.zeros((n, 3))
        self.time = np.zeros(n)
        self._next_command = np.zeros(n)
        self._velocity_drift = np.zeros((n, 3))
        rough = c.terrain.kind == "rough"
        self._spawn_radius = 0.4 * c.terrain.size if rough else 0.0  # m
        self._edge = 0.5 * c.terrain.size - EDGE if rough else np.inf  # m
        self.reset(np.arange(n))

    def reset(self, ids: np.ndarray, posture: np.ndarray = robot.NOMINAL_Q) -> None:
        """Start the environments `ids` over: new plant, new actuators, near `posture` (12,) or (n, 12), a new command."""
        if not len(ids):
            return
        n, rng = len(ids), self.rng
        self.plants.sample(ids)
        sample_actuators(self.actuators, ids, self.config.randomisation, rng)
        self.batch.reset(ids.astype(np.int32), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        qpos, qvel = np.zeros((n, 19)), rng.normal(0, 0.1, (n, 18))
        heading = rng.uniform(-np.pi, np.pi, n)
        qpos[:, :2] = rng.uniform(-1, 1, (n, 2)) * self._spawn_radius
        qpos[:, 3:7] = self._along_the_ground(qpos[:, :2], heading)
        qpos[:, 7:] = posture + rng.normal(0, 0.08, (n, 12))
        feet = rotate(qpos[:, None, 3:7], foot_positions(qpos[:, 7:])) + qpos[:, None, :3]
        qpos[:, 2] = np.max(self._ground(feet) - feet[..., 2], axis=1) + robot.FOOT_RADIUS + 0.002
        self._qpos[ids], self._qvel[ids] = qpos, qvel
        self._clock[ids] = self.config.period  # not 0, which MuJoCo's own starting over would not differ from
        self.time[ids] = rng.uniform(0, 0.2, n) * self.config.episode
        self._velocity_drift[ids] = 0.0
        self.command[ids] = [0.0, 0.0, 0.0, 1.0]
        self._new_commands(ids)
        self._read()
        self.torque[ids] = 0.0
        self.acceleration[ids] = rotate_inverse(self.quaternion[ids], np.array([0, 0, robot.GRAVITY]))

    def _along_the_ground(self, place: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Attitudes of trunks that stand on the ground as it slopes there.

        Args:
            place: x, y (n, 2), m, world.
            heading: (n,) rad.

        Returns:
            Quaternions (n, 4), w first, body to world.
        """
        level = Rotation.from_euler("Z", heading[:, None])
        corners = foot_positions(robot.NOMINAL_Q)
        feet = np.stack([level.apply(corner) for corner in corners], axis=1)
        forward, left = self._falls(self._ground(feet[..., :2] + place[:, None]))
        pitch = np.arctan(forward)
        leaning = Rotation.from_euler("YX", np.stack([pitch, -np.arctan(left * np.cos(pitch))], axis=1))
        return np.roll((level * leaning).as_quat(), 1, axis=1)

    @staticmethod
    def _falls(ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By how much ground of heights (n, 4) below the four feet falls away, for 1 m forward and for 1 m to the left."""
        forward = ground[:, 2:].mean(axis=1) - ground[:, :2].mean(axis=1)
        left = ground[:, ::2].mean(axis=1) - ground[:, 1::2].mean(axis=1)
        return forward / STANCE_LENGTH, left / STANCE_WIDTH

    def _new_commands(self, ids: np.ndarray) -> None:
        n, (slow, quick) = len(ids), RAMP
        before = self._goal[ids]
        self._goal[ids] = goal = self.commands.draw(self.rng, n)
        back = self.rng.random(n) < self.config.reversed
        back &= before[:, :3].any(axis=1) & self.commands.contains(-before[:, :3])
        self._goal[ids[back]] = np.where([True, True, True, False], -before, 0.0 * goal)[back]
        led = self.rng.random(n) < self.config.ramped
        self._ramp[ids] = np.where(led, slow * (quick / slow) ** self.rng.random(n), np.inf)
        self._lead_commands(ids)
        self._next_command[ids] = self.time[ids] + self.rng.uniform(*self.commands.hold, len(ids))
        self.changed[ids] = True

    def _lead_commands(self, ids: np.ndarray | slice) -> None:
        """Take the commands a sample nearer to what was drawn; a robot is told to stand once its command is at rest."""
        goal, command = self._goal[ids, :3], self.command[ids, :3]
        way = goal - command
        slower = np.abs(goal) < np.abs(command)
        step = self._ramp[ids, None] * RAMP_AXES * np.where(slower, RAMP_DOWN, 1.0) * self.config.period
        command = command + way / np.maximum(np.abs(way) / step, 1.0).max(axis=1, keepdims=True)
        self.command[ids, :3] = command
        self.command[ids, 3] = self._goal[ids, 3] * (command == 0.0).all(axis=1)

    def tick(
        self,
        target: np.ndarray,
        target_speed: np.ndarray | float = 0.0,
        kp: np.ndarray | None = None,
        kd: np.ndarray | None = None,
    ) -> None:
        """One sample with the joint targets (n, 12) sent from its start on; other gains (n, 12) if given.

        Targets beyond the range of commands are sent as the controller sends them.
        """
        gains = self.config.kp if kp is None else kp, self.config.kd if kd is None else kd
        self.changed[:] = False
        self.power[:], self.fastest[:] = 0.0, 0.0
        self._push()
        end = self._clock.ravel() + self.config.period
        q, dq = self._qpos[:, 7:], self._qvel[:, 6:]
        for step in range(self.substeps):
            if step % self._resend == 0:
                sent, push = split_target(target, gains[0], q)
            if step == self.substeps - 1:
                before = self._qvel[:, :3].copy()
            self.torque = self.actuators.step(q, dq, sent, *gains, target_speed, push)
            self._ctrl[:] = self.torque
            self.batch.step()
            np.maximum(self.fastest, np.abs(dq), out=self.fastest)
            self.power += np.maximum(HEAT * self.torque**2 + self.torque * dq, 0.0).sum(axis=1)
        self.power /= self.substeps
        self.time += self.config.period
        self._put_down_broken(end, before)
        self._read()
        proper = (self._qvel[:, :3] - before) / self.config.timestep + [0.0, 0.0, robot.GRAVITY]
        self.acceleration = rotate_inverse(self.quaternion, proper)
        self._lead_commands(slice(None))
        due = np.flatnonzero(self.time >= self._next_command)
        if len(due):
            self._new_commands(due)

    def _put_down_broken(self, end: np.ndarray, before: np.ndarray) -> None:
        """Lay robots with states that are no numbers, or absurd, on their backs at rest.

        end (n,): MuJoCo's clock as it should be; it starts such simulations over by itself. before (n, 3): the last velocities.
        """
        state = np.concatenate([self._qpos, self._qvel, self.torque, self.power[:, None]], axis=1)
        absurd = np.abs(self._qvel).max(axis=1) > ABSURD_SPEED
        started_over = self._clock.ravel() < end - 0.5 * self.config.timestep
        self.broken = absurd | started_over | ~np.isfinite(state).all(axis=1)
        ids = np.flatnonzero(self.broken)
        if len(ids):
            self._qpos[ids, :3], self._qpos[ids, 3:7] = 0.0, [0.0, 1.0, 0.0, 0.0]
            self._qpos[ids, 7:], self._qvel[ids] = robot.NOMINAL_Q, 0.0
            self.torque[ids], self.power[ids], self.fastest[ids], before[ids] = 0.0, 0.0, 0.0, 0.0
            self.actuators.reset(ids)

    def _ground(self, points: np.ndarray) -> np.ndarray:
        return self.config.terrain.height(points[..., 0], points[..., 1])

    @property
    def ground_slope(self) -> np.ndarray:
        """By how much (n, 2) the ground falls away below the four feet, for 1 m forward and for 1 m to the left."""
        return np.stack(self._falls(self._ground(self.feet)), axis=-1)

    def _push(self) -> None:
        r = self.config.randomisation
        hit = np.flatnonzero(self.rng.random(self.config.n) < self.config.period / r.push_interval)
        if len(hit) and (r.push_velocity or r.push_turn):
            self._qvel[hit, :2] += self.rng.uniform(-1, 1, (len(hit), 2)) * r.push_velocity
            self._qvel[hit, 3:6] += self.rng.uniform(-1, 1, (len(hit), 3)) * r.push_turn

    def _read(self) -> None:
        """Derive what rewards and observations need from the state rows."""
        qpos, qvel = self._qpos, self._qvel
        self.q, self.dq = qpos[:, 7:].copy(), qvel[:, 6:].copy()
        self.quaternion, self.angular_velocity = qpos[:, 3:7].copy(), qvel[:, 3:6].copy()
        self.velocity = rotate_inverse(self.quaternion, qvel[:, :3])
        self.roll_pitch = roll_pitch(self.quaternion)
        quaternion = self.quaternion[:, None]
        local, jacobians = foot_kinematics(self.q)
        self.foot_position = local
        self.feet = rotate(quaternion, local) + qpos[:, None, :3]
        joints = self.dq.reshape(-1, 4, 3, 1)
        swing = (jacobians @ joints)[..., 0] + np.cross(self.angular_velocity[:, None], local)
        self.foot_velocity = rotate(quaternion, swing) + qvel[:, None, :3]
        self.clearance = self.feet[..., 2] - self._ground(self.feet) - robot.FOOT_RADIUS
        self.contact = self.clearance < 0.001
        self.height = qpos[:, 2] - self._ground(qpos)
        self.fallen = (self.height < 0.18) | (np.abs(self.roll_pitch).max(axis=1) > 0.9)
        left_the_field = np.abs(qpos[:, :2]).max(axis=1) > self._edge
        self.timed_out = (self.time >= self.config.episode) | left_the_field

    def sense(self) -> dict[str, np.ndarray]:
        """Noisy readings under the names of the observation's terms (previous action and command apart)."""
        r, rng, n = self.config.randomisation, self.rng, self.config.n
        decay = np.exp(-self.config.period / 0.5)
        self._velocity_drift *= decay
        self._velocity_drift += rng.normal(0, r.drift_velocity * np.sqrt(1 - decay**2), (n, 3))
        noise = rng.standard_normal((n, 32), dtype=np.float32)
        return {
            "q": self.q + r.noise_q * noise[:, :12],
            "dq": self.dq + r.noise_dq * noise[:, 12:24],
            "roll_pitch": self.roll_pitch + r.noise_roll_pitch * noise[:, 24:26],
            "angular_velocity": self.angular_velocity + r.noise_angular_velocity * noise[:, 26:29],
            "linear_velocity": self.velocity + self._velocity_drift + r.noise_velocity * noise[:, 29:32],
        }
