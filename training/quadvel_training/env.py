"""Batched walking environment at 200 Hz: MuJoCo batch, actuator model, randomisation and sensing.

It has no rewards and no gait: trainers read the arrays of `VelocityEnv`. A robot whose physics has
diverged is laid down as fallen within the same tick, so trainers never see NaN.
"""

from __future__ import annotations

import os
from typing import Protocol

import attrs
import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description import mjcf
from quadvel_description.command_range import split_target
from quadvel_description.kinematics import foot_kinematics, foot_positions, roll_pitch, rotate, rotate_inverse
from quadvel_description.quadruped import GRAVITY
from quadvel_description.robot import Robot
from quadvel_policy.observation import VelocityCommandLimits
from quadvel_policy.supervisor import MIN_STEPPING_SPEED
from quadvel_sim.physics import Physics
from quadvel_sim.terrain import Terrain

from .actuator_groups import ActuatorGroups
from .randomisation import PlantSampler, Randomisation
from .similarity import Size

TICK_S = 0.005  # one sample of the policy on the robot
HEAT_LOSS_W_PER_N2M2 = 0.2  # k_r of the paper's energy term
RAMP_RANGE = (0.7, 5.0)  # m/s^2, from and to: slope of commands that ramp
RAMP_DOWN = 4.0  # factor of the slope of commands that decrease
RAMP_AXES = np.array([1.0, 0.7, 1.25])  # factors of vx, vy and, in rad/m, wz
EDGE_MARGIN_M = 0.6  # before the end of rough ground, where episodes time out
FALLEN_HEIGHT_M = 0.18  # trunks of robots of the reference size that are lower have fallen (`similarity`)
MAX_PLAUSIBLE_SPEED = 150.0  # m/s or rad/s of any body or joint; beyond it the physics diverges


def available_cores() -> int:
    """Number of cores that this process may use; torchrun's processes on one machine share them.

    Returns:
        At least 1.
    """
    return max(1, len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


@attrs.frozen
class CommandRange:
    """Range of velocity commands: a box, or the paper's ellipsoid.

    In the ellipsoid the radius is drawn with a density proportional to itself.

    Attributes:
        vx: m/s, from and to.
        vy: m/s, either way.
        wz: rad/s, either way.
        ellipsoid: draw from the ellipsoid within the box.
        curve: m/s^2, limit in curves as in `quadvel_policy.observation.VelocityCommandLimits`; None for no
            limit.
        stance: share of commands to stand.
        straight: share of the walking commands without yaw.
        hold: s, from and to, until the next command.
    """

    vx: tuple[float, float] = (-1.4, 2.0)
    vy: float = 0.7
    wz: float = 1.4
    ellipsoid: bool = False
    curve: float | None = None
    stance: float = 0.15
    straight: float = 0.2
    hold: tuple[float, float] = (2.0, 6.0)

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw commands.

        Args:
            rng: source of randomness.
            n: number of commands.

        Returns:
            (n, 4): vx, vy (m/s), wz (rad/s), 1 for stance.
        """
        unit = rng.uniform(-1, 1, (n, 3))
        if self.ellipsoid:
            unit = rng.normal(size=(n, 3))
            unit *= (np.sqrt(rng.random(n)) / np.linalg.norm(unit, axis=1))[:, None]
        centre, half = np.mean(self.vx), np.ptp(self.vx) / 2
        command = np.zeros((n, 4))
        command[:, :3] = unit * [half, self.vy, self.wz] + [centre, 0.0, 0.0]
        command[rng.random(n) < self.straight, 2] = 0.0
        if self.curve:
            limits = VelocityCommandLimits(
                (self.vx[0], -self.vy, -self.wz), (self.vx[1], self.vy, self.wz), self.curve
            )
            command[:, :3] = [limits.clamp(one) for one in command[:, :3].tolist()]
        still = rng.random(n) < self.stance
        command[still] = [0.0, 0.0, 0.0, 1.0]
        return command

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Whether velocities lie in the box.

        Args:
            command: (n, 3), m/s, m/s, rad/s.

        Returns:
            (n,) bool.
        """
        low, high = [self.vx[0], -self.vy, -self.wz], [self.vx[1], self.vy, self.wz]
        return np.asarray(((command >= low) & (command <= high)).all(axis=1))


class Commands(Protocol):
    """Source of velocity commands."""

    @property
    def hold(self) -> tuple[float, float]:
        """Time until the next command, from and to, s."""
        ...

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw commands.

        Args:
            rng: source of randomness.
            n: number of commands.

        Returns:
            (n, 4): vx, vy (m/s), wz (rad/s), 1 for stance.
        """
        ...

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Whether velocities may be drawn.

        Args:
            command: (n, 3), m/s, m/s, rad/s.

        Returns:
            (n,) bool.
        """
        ...


class NeverReversed:
    """Base of sources whose commands are not to be reversed."""

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Whether velocities may be drawn; none, as no command is to be reversed.

        Args:
            command: (n, 3), m/s, m/s, rad/s.

        Returns:
            (n,) bool.
        """
        return np.zeros(len(command), bool)


@attrs.frozen
class EnvConfig:
    """Configuration of a batch of environments.

    Attributes:
        robot: the robot.
        n: number of environments.
        threads: threads of the physics.
        seed: seed of all draws.
        period: s, one sample of the trainer, for which joint targets are held.
        timestep: s, of the physics.
        kp: N m/rad, proportional gain; the default is the robot's.
        kd: N m s/rad, derivative gain; the default is the robot's.
        episode: s, length of an episode.
        actuator: parameters of the actuators.
        others: parameters of other actuators, which an equal share of the robots has each.
        randomisation: what varies.
        commands: range of commands, unless the environment is given another source.
        ramped: share of the commands that ramp to the new velocity, as the command mux does.
        reversed: share of the new commands that reverse the one before.
        terrain: ground.
    """

    robot: Robot
    n: int = 512
    threads: int = attrs.field(factory=available_cores)
    seed: int = 0
    period: float = TICK_S
    timestep: float = 0.0025
    kp: float = attrs.field(default=attrs.Factory(lambda config: config.robot.kp, takes_self=True))
    kd: float = attrs.field(default=attrs.Factory(lambda config: config.robot.kd, takes_self=True))
    episode: float = 20.0
    actuator: ActuatorParameters = attrs.field(
        default=attrs.Factory(lambda config: ActuatorParameters.of(config.robot), takes_self=True)
    )
    others: tuple[ActuatorParameters, ...] = ()
    randomisation: Randomisation = Randomisation()
    commands: CommandRange = CommandRange()
    ramped: float = 0.3
    reversed: float = 0.0
    terrain: Terrain = Terrain()


def training_model(
    robot: Robot, timestep: float, terrain: Terrain, torsional_friction: float = 0.0
) -> mujoco.MjModel:
    """Build the MuJoCo model of training: feet and trunk collide, there are no sensors.

    Args:
        robot: the robot.
        timestep: s, of the physics.
        terrain: ground.
        torsional_friction: m, of the feet.

    Returns:
        The compiled model.
    """
    plant = mjcf.Plant(timestep=timestep, plane=False, only_feet_and_trunk=True, sensors=False)
    spec = mjcf.build_spec(robot, plant)
    terrain.add_to(spec)
    model = spec.compile()
    Physics(torsional_friction=torsional_friction).apply(model)
    return model


class VelocityEnv:
    """Batch of `n` simulated robots under velocity commands.

    After each `tick`, a sample of `config.period`, the arrays describe the new state. `reset(ids)`
    starts robots over. Vectors are in the body frame unless stated.

    Attributes:
        config: configuration.
        robot: the robot.
        size: its size, for gait and rewards.
        commands: source of commands.
        command: (n, 4), command in force; it may still ramp to the one that was drawn.
        q: (n, 12), rad.
        dq: (n, 12), rad/s.
        torque: (n, 12), N m.
        quaternion: (n, 4), w first, body to world.
        velocity: (n, 3), m/s.
        angular_velocity: (n, 3), rad/s.
        acceleration: (n, 3), m/s^2, proper acceleration of the trunk.
        roll_pitch: (n, 2), rad.
        feet: (n, 4, 3), m, world frame.
        foot_position: (n, 4, 3), m.
        foot_velocity: (n, 4, 3), m/s, world frame.
        clearance: (n, 4), m, of each foot above ground.
        ground_slope: (n, 2), drop of the ground below the feet per metre forward and per metre to the left.
        contact: (n, 4) bool.
        height: (n,), m, of the trunk above ground.
        power: (n,), W, energy term of the paper, mean of the sample.
        fastest: (n, 12), rad/s, largest speed of each joint in the sample.
        fallen: (n,) bool.
        timed_out: (n,) bool.
        broken: (n,) bool, fallen because the physics diverged.
        changed: (n,) bool, whether the command is new.
    """

    def __init__(self, config: EnvConfig, commands: Commands | None = None) -> None:
        """Create the environments and start all robots.

        Args:
            config: configuration.
            commands: source of commands in place of the configuration's range.
        """
        self.config = c = config
        self.robot = robot = c.robot
        self.size = Size.of(robot)
        self.commands: Commands = commands or c.commands
        self.model = training_model(c.robot, c.timestep, c.terrain, c.randomisation.torsional_friction[1])
        self.substeps = round(c.period / c.timestep)
        self._resend = max(1, int(TICK_S / c.timestep))  # steps between command packets
        self.rng = np.random.default_rng(c.seed)
        self.batch = Batch(self.model, c.n, c.threads)
        self.plants = PlantSampler(self.batch, c.randomisation, self.rng)
        self.actuators = ActuatorGroups((c.actuator, *c.others), c.n, c.timestep, seed=c.seed + 1)
        self._qpos, self._qvel, self._ctrl, self._clock = (
            self.batch.bind(name) for name in ("qpos", "qvel", "ctrl", "time")
        )
        self._stance = np.ptp(foot_positions(robot, robot.nominal_q)[:, :2], axis=0)  # length, width, m
        self.stand_q = robot.nominal_q + mjcf.gravity_torque(self.model) / c.kp

        n = c.n
        self.command, self.velocity = np.zeros((n, 4)), np.zeros((n, 3))
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
        self._edge = 0.5 * c.terrain.size - EDGE_MARGIN_M if rough else np.inf  # m
        self.reset(np.arange(n))

    def reset(self, ids: np.ndarray, posture: np.ndarray | None = None) -> None:
        """Start robots over: new plant, new actuators, a new command.

        Args:
            ids: their indices.
            posture: rad, (12,) or (n, 12), joint positions up to some noise; None: the stance.
        """
        if not len(ids):
            return
        n, rng = len(ids), self.rng
        self.plants.sample(ids)
        self.actuators.sample(ids, self.config.randomisation, rng)
        self.batch.reset(ids.astype(np.int32), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        qpos, qvel = np.zeros((n, 19)), rng.normal(0, 0.1, (n, 18))
        heading = rng.uniform(-np.pi, np.pi, n)
        qpos[:, :2] = rng.uniform(-1, 1, (n, 2)) * self._spawn_radius
        qpos[:, 3:7] = self._ground_attitudes(qpos[:, :2], heading)
        qpos[:, 7:] = (self.robot.nominal_q if posture is None else posture) + rng.normal(0, 0.08, (n, 12))
        feet = rotate(qpos[:, None, 3:7], foot_positions(self.robot, qpos[:, 7:])) + qpos[:, None, :3]
        qpos[:, 2] = np.max(self._ground(feet) - feet[..., 2], axis=1) + self.robot.foot_radius + 0.002
        self._qpos[ids], self._qvel[ids] = qpos, qvel
        self._clock[ids] = self.config.period  # above 0, so that MuJoCo's own resets are seen
        self.time[ids] = rng.uniform(0, 0.2, n) * self.config.episode
        self._velocity_drift[ids] = 0.0
        self.command[ids] = [0.0, 0.0, 0.0, 1.0]
        self._new_commands(ids)
        self._update_state()
        self.torque[ids] = 0.0
        self.acceleration[ids] = rotate_inverse(self.quaternion[ids], np.array([0, 0, GRAVITY]))

    def _ground_attitudes(self, place: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Attitude of trunks that stand parallel to the ground.

        Args:
            place: x, y (n, 2), m, world frame.
            heading: (n,), rad.

        Returns:
            Quaternions (n, 4), w first, body to world.
        """
        level = Rotation.from_euler("Z", heading[:, None])
        corners = foot_positions(self.robot, self.robot.nominal_q)
        feet = np.stack([level.apply(corner) for corner in corners], axis=1)
        forward, left = self._ground_drop(self._ground(feet[..., :2] + place[:, None]))
        pitch = np.arctan(forward)
        leaning = Rotation.from_euler("YX", np.stack([pitch, -np.arctan(left * np.cos(pitch))], axis=1))
        return np.roll((level * leaning).as_quat(), 1, axis=1)

    def _ground_drop(self, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Drop of the ground per metre forward and left, from its height (n, 4) at the feet."""
        forward = ground[:, 2:].mean(axis=1) - ground[:, :2].mean(axis=1)
        left = ground[:, ::2].mean(axis=1) - ground[:, 1::2].mean(axis=1)
        return forward / self._stance[0], left / self._stance[1]

    def _new_commands(self, ids: np.ndarray) -> None:
        """Draw new commands, some of them reversals of the one before, and their ramps."""
        n, (slow, quick) = len(ids), RAMP_RANGE
        before = self._goal[ids]
        self._goal[ids] = goal = self.commands.draw(self.rng, n)
        back = self.rng.random(n) < self.config.reversed
        back &= before[:, :3].any(axis=1) & self.commands.contains(-before[:, :3])
        self._goal[ids[back]] = np.where([True, True, True, False], -before, 0.0 * goal)[back]
        ramps = self.rng.random(n) < self.config.ramped
        self._ramp[ids] = np.where(ramps, slow * (quick / slow) ** self.rng.random(n), np.inf)
        self._ramp_commands(ids)
        self._next_command[ids] = self.time[ids] + self.rng.uniform(*self.commands.hold, len(ids))
        self.changed[ids] = True

    def _ramp_commands(self, ids: np.ndarray | slice) -> None:
        """Move commands a sample closer to what was drawn.

        The stance flag follows once the commanded velocity is 0 and the robot so slow that the
        supervisor lets it stop stepping.
        """
        goal, command = self._goal[ids, :3], self.command[ids, :3]
        way = goal - command
        # c <- c + d / max(1, max_i |d_i| / step_i), d = goal - c: all axes arrive together
        slower = np.abs(goal) < np.abs(command)
        step = self._ramp[ids, None] * RAMP_AXES * np.where(slower, RAMP_DOWN, 1.0) * self.config.period
        command = command + way / np.maximum(np.abs(way) / step, 1.0).max(axis=1, keepdims=True)
        self.command[ids, :3] = command
        is_slow = np.linalg.norm(self.velocity[ids], axis=1) <= MIN_STEPPING_SPEED
        self.command[ids, 3] = self._goal[ids, 3] * (command == 0.0).all(axis=1) * is_slow

    def tick(
        self,
        target: np.ndarray,
        target_speed: np.ndarray | float = 0.0,
        kp: np.ndarray | None = None,
        kd: np.ndarray | None = None,
    ) -> None:
        """Simulate one sample, with joint targets sent at its start.

        Targets beyond the range of commands are sent as the controller sends them: the excess as
        torque.

        Args:
            target: rad, (n, 12), joint targets.
            target_speed: rad/s, (n, 12) or a number.
            kp: N m/rad, (n, 12), or None for the configured gain.
            kd: N m s/rad, (n, 12), or None for the configured gain.
        """
        gains = self.config.kp if kp is None else kp, self.config.kd if kd is None else kd
        self.changed[:] = False
        self.power[:], self.fastest[:] = 0.0, 0.0
        self._push()
        end = self._clock.ravel() + self.config.period
        robot, q, dq = self.robot, self._qpos[:, 7:], self._qvel[:, 6:]
        for step in range(self.substeps):
            if step % self._resend == 0:
                sent, push = split_target(robot, target, gains[0], q)
            if step == self.substeps - 1:
                before = self._qvel[:, :3].copy()
            self.torque = self.actuators.step(q, dq, sent, *gains, target_speed, push)
            self._ctrl[:] = self.torque
            self.batch.step()
            np.maximum(self.fastest, np.abs(dq), out=self.fastest)
            # P = sum over joints of max(k_r tau^2 + tau dq, 0)
            self.power += np.maximum(HEAT_LOSS_W_PER_N2M2 * self.torque**2 + self.torque * dq, 0.0).sum(
                axis=1
            )
        self.power /= self.substeps
        self.time += self.config.period
        self._reset_broken(end, before)
        self._update_state()
        # proper acceleration a - g, in the body frame, as an IMU measures it
        proper = (self._qvel[:, :3] - before) / self.config.timestep + [0.0, 0.0, GRAVITY]
        self.acceleration = rotate_inverse(self.quaternion, proper)
        self._ramp_commands(slice(None))
        due = np.flatnonzero(self.time >= self._next_command)
        if len(due):
            self._new_commands(due)

    def _reset_broken(self, end: np.ndarray, before: np.ndarray) -> None:
        """Lay robots whose state is not finite or implausible on their backs, at rest.

        Args:
            end: (n,), s, what MuJoCo's clock should show; MuJoCo resets such simulations by itself.
            before: (n, 3), m/s, last velocities, changed in place.
        """
        state = np.concatenate([self._qpos, self._qvel, self.torque, self.power[:, None]], axis=1)
        absurd = np.abs(self._qvel).max(axis=1) > MAX_PLAUSIBLE_SPEED
        started_over = self._clock.ravel() < end - 0.5 * self.config.timestep
        self.broken = absurd | started_over | ~np.isfinite(state).all(axis=1)
        ids = np.flatnonzero(self.broken)
        if len(ids):
            self._qpos[ids, :3], self._qpos[ids, 3:7] = 0.0, [0.0, 1.0, 0.0, 0.0]
            self._qpos[ids, 7:], self._qvel[ids] = self.robot.nominal_q, 0.0
            self.torque[ids], self.power[ids], self.fastest[ids], before[ids] = 0.0, 0.0, 0.0, 0.0
            self.actuators.reset(ids)

    def _ground(self, points: np.ndarray) -> np.ndarray:
        """Height of the ground at points (..., 2), m."""
        return self.config.terrain.height(points[..., 0], points[..., 1])

    @property
    def ground_lean(self) -> np.ndarray:
        """Roll and pitch of a trunk that is parallel to the ground below the feet, (n, 2), rad."""
        forward, left = self.ground_slope.T
        return np.arctan(np.stack([-left, forward], axis=1))

    def _push(self) -> None:
        """Push some robots: a sudden change of velocity."""
        r = self.config.randomisation
        hit = np.flatnonzero(self.rng.random(self.config.n) < self.config.period / r.push_interval)
        if len(hit) and (r.push_velocity or r.push_turn):
            self._qvel[hit, :2] += self.rng.uniform(-1, 1, (len(hit), 2)) * r.push_velocity
            self._qvel[hit, 3:6] += self.rng.uniform(-1, 1, (len(hit), 3)) * r.push_turn

    def _update_state(self) -> None:
        """Compute what rewards and observations need from MuJoCo's state."""
        qpos, qvel = self._qpos, self._qvel
        self.q, self.dq = qpos[:, 7:].copy(), qvel[:, 6:].copy()
        self.quaternion, self.angular_velocity = qpos[:, 3:7].copy(), qvel[:, 3:6].copy()
        self.velocity = rotate_inverse(self.quaternion, qvel[:, :3])
        self.roll_pitch = roll_pitch(self.quaternion)
        quaternion = self.quaternion[:, None]
        local, jacobians = foot_kinematics(self.robot, self.q)
        self.foot_position = local
        self.feet = rotate(quaternion, local) + qpos[:, None, :3]
        # v_foot = R (J dq + w x r) + v_trunk
        joints = self.dq.reshape(-1, 4, 3, 1)
        swing = (jacobians @ joints)[..., 0] + np.cross(self.angular_velocity[:, None], local)
        self.foot_velocity = rotate(quaternion, swing) + qvel[:, None, :3]
        ground = self._ground(self.feet)
        self.ground_slope = np.stack(self._ground_drop(ground), axis=-1)
        self.clearance = self.feet[..., 2] - ground - self.robot.foot_radius
        self.contact = self.clearance < 0.001
        self.height = qpos[:, 2] - self._ground(qpos)
        self.fallen = (self.height < FALLEN_HEIGHT_M * self.size.length) | (
            np.abs(self.roll_pitch).max(axis=1) > 0.9
        )
        left_the_field = np.abs(qpos[:, :2]).max(axis=1) > self._edge
        self.timed_out = (self.time >= self.config.episode) | left_the_field

    @property
    def planar_velocity(self) -> np.ndarray:
        """Velocity of the trunk forward and left (m/s) and its yaw rate (rad/s), (n, 3), body frame."""
        return np.concatenate([self.velocity[:, :2], self.angular_velocity[:, 2:]], axis=1)

    def sense(self) -> dict[str, np.ndarray]:
        """Return noisy measurements.

        Returns:
            Arrays by name of the observation's terms, without previous action and command.
        """
        r, rng, n = self.config.randomisation, self.rng, self.config.n
        # Drift of the velocity: an Ornstein-Uhlenbeck process with a time constant of 0.5 s
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
