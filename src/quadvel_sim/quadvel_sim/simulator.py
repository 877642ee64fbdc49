"""Simulation of one robot in MuJoCo: joint commands in, low-level state out. No ROS, no clock.

The actuator model (`ActuatorModel`) is evaluated every millisecond with the joint state of that
instant and the active command.

All quantities of a `RobotState` belong to one instant t. `q`, `dq`, orientation and angular
velocity are measured at t. `tau` is the response of the drives to them under the active command;
linear acceleration and foot forces follow from these. A command that is given at t is active from t
on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from quadvel_actuator import ActuatorModel
from quadvel_description.arrays import Array, Bools
from quadvel_description.kinematics import rotate, rotate_inverse
from quadvel_description.mjcf import Plant, build_spec
from quadvel_description.quadruped import JOINT_NAMES, LEGS, joint_index
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_sim import persons
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.laser import Scan
from quadvel_sim.surroundings import Surroundings, is_ground
from quadvel_sim.world_parts import SURFACE_PRIORITY

DT = 0.001
"""Time step, s."""
_TICK_MODULUS = 2**32
# Limit of a jammed joint: time constant of two steps (s), damping ratio; impedance that hardly yields.
_JAM_SOLREF, _JAM_SOLIMP = (2.0 * DT, 1.0), (0.999, 0.9999, 1e-3, 0.5, 2.0)
_PAYLOAD_RADIUS_M = 0.05  # the payload is a solid sphere: I = 2/5 m r^2
# q, kp, kd, dq, tau: arguments of ActuatorModel.step
_CommandArrays = tuple[Array, Array, Array, Array | float, Array | float]


@attrs.define
class Truth:
    """Ground truth of the trunk's motion and of the contacts at one instant.

    Attributes:
        time: Simulated time since the reset, s.
        tick: The same in ms; wraps at 2^32.
        position: Trunk origin in the world frame, (3,), m.
        quaternion: Orientation, body to world, (4,), (w, x, y, z).
        linear_velocity: Velocity of the trunk origin in the body frame, (3,), m/s.
        angular_velocity: Angular velocity in the body frame, (3,), rad/s.
        contact: Whether each foot touches the ground, (4,).
        contact_force: Force of the ground on each foot in the world frame, (4, 3), N.
    """

    time: float
    tick: int
    position: Array
    quaternion: Array
    linear_velocity: Array
    angular_velocity: Array
    contact: Bools
    contact_force: Array


MAX_PUSH_WEIGHTS = 10.0
"""Largest force of all pushes together, in weights of the robot; some 50 make the physics diverge."""
MAX_PUSH_ARM_M = 0.2
"""Lever arm of the robot's weight, m, that gives the largest torque of all pushes; with 0.5 m it diverges."""
MAX_START_DEPTH_M = 0.01
"""Depth to which the lying robot may start inside an obstacle, m; a touch is no mistake of a world."""


@attrs.define
class _Push:
    """A push that is under way."""

    body: int
    wrench: Array  # (6,) force and torque, world
    steps_left: int


def build_model(config: SimulatorConfig) -> mujoco.MjModel:
    """Compile robot, ground, world and payload.

    Args:
        config: Configuration of the simulation.

    Returns:
        The compiled model.
    """
    plant = Plant(
        timestep=DT,
        armature=config.armature,
        joint_friction=config.joint_friction,
        joint_damping=config.joint_damping,
        plane=False,
        suspended=config.suspended,
    )
    spec = build_spec(config.robot, plant)
    if config.world is None:
        config.terrain.add_to(spec)
    else:
        config.world.add_to(spec)
        persons.add_persons(spec, config.world.persons)
    if config.payload > 0.0:
        spec.body("trunk").add_body(
            name="payload",
            pos=config.payload_position,
            mass=config.payload,
            ipos=np.zeros(3),
            inertia=np.full(3, 0.4 * config.payload * _PAYLOAD_RADIUS_M**2),
            explicitinertial=True,
        )
    if config.payload < 0.0:
        trunk = spec.body("trunk")
        share = 1.0 + config.payload / trunk.mass
        trunk.mass *= share
        trunk.fullinertia *= share
    model = spec.compile()
    for leg, friction in zip(LEGS, config.friction, strict=True):
        model.geom(f"{leg}_foot").friction[0] = friction
    config.physics.apply(model)
    # A surface has a friction of its own, and otherwise behaves like a foot.
    foot, is_surface = model.geom(f"{LEGS[0]}_foot"), model.geom_priority == SURFACE_PRIORITY
    model.geom_solref[is_surface], model.geom_condim[is_surface] = foot.solref, foot.condim
    disable = mujoco.mjtDisableBit
    model.opt.disableflags |= disable.mjDSBL_AUTORESET  # a diverged run is an error, not a restart
    model.opt.disableflags |= disable.mjDSBL_ISLAND  # one island always; the search costs 10 %
    return model


def _check_start(model: mujoco.MjModel, ground: Bools, world: str) -> None:
    """Refuse an obstacle inside which the lying robot would start.

    `ground`: whether each geom is ground; `world`: name of the world, for the message.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("lie").id)
    mujoco.mj_fwdPosition(model, data)
    moves = model.body_weldid[model.geom_bodyid] != 0
    for contact in data.contact:
        robot, other = sorted(contact.geom, key=lambda geom: not moves[geom])
        if contact.dist < -MAX_START_DEPTH_M and moves[robot] and not moves[other] and not ground[other]:
            raise ValueError(
                f"world {world}: {model.geom(other).name} stands where the robot starts, "
                "expected room around the origin"
            )


class Simulator:
    """Simulated robot on its ground with a step of 1 ms.

    Deterministic: equal configurations, seeds and calls give bitwise equal runs.

    Reading (`state`, `truth`, `fallen`) does not change the run, except for the noise of later
    samples. The first reading at an instant fixes it: a later command or push shows from the next
    step on.

    Attributes:
        config: Configuration of the simulation.
        model: MuJoCo's model, to be drawn and measured, not changed.
        data: MuJoCo's state, to be drawn and measured, not changed.
        steps: Simulated time since the reset, ms.
        actuator: Model of the drives.
    """

    def __init__(self, config: SimulatorConfig) -> None:
        """Compile the model and reset the robot.

        Args:
            config: Configuration.
        """
        self.config = config
        self.model = build_model(self.config)
        self.data = mujoco.MjData(self.model)
        self._q, self._dq = self.data.qpos[7:], self.data.qvel[6:]  # views of the live arrays
        self._foot_of_geom = {self.model.geom(f"{leg}_foot").id: i for i, leg in enumerate(LEGS)}
        self._orientation, self._gyro, self._accelerometer = (
            slice(adr := self.model.sensor(name).adr.item(), adr + self.model.sensor(name).dim.item())
            for name in ("orientation", "gyro", "accelerometer")
        )
        self._trunk_geom = self.model.geom("trunk").id
        self._ground = np.array([is_ground(self.model.geom(i).name) for i in range(self.model.ngeom)])
        self._fall_cosine = np.cos(self.config.fall_tilt)
        self._watchdog_steps = round(self.config.watchdog / DT)
        self._brake_command = _command_arrays(JointCommand.damping(self.config.watchdog_kd))
        world = self.config.world
        self._surroundings = None if world is None else Surroundings(self.model, world)
        self._noise = np.repeat(attrs.astuple(self.config.noise), (12, 12, 3, 3, 3))
        limits = self.model.jnt_range, self.model.jnt_solref, self.model.jnt_solimp
        self._joint_limits = [(field, field.copy()) for field in limits]
        self.reset()
        if world is not None:
            _check_start(self.model, self._ground, world.name)

    def reset(self, keyframe: str = "lie", seed: int | None = None) -> None:
        """Put the robot at the origin, at rest, with time zero and braking drives.

        Args:
            keyframe: Posture, `lie` or `stand`.
            seed: Seed of the noise; None: the seed of the configuration, which repeats the run.

        Raises:
            ValueError: The keyframe is unknown.
        """
        keyframes = [self.model.key(i).name for i in range(self.model.nkey)]
        if keyframe not in keyframes:
            raise ValueError(f"keyframe: found {keyframe!r}, expected one of {', '.join(keyframes)}")
        seed = self.config.seed if seed is None else seed
        seeds = np.random.SeedSequence(seed).generate_state(2)
        self.actuator = self._make_actuator(int(seeds[0]))
        self._rng = np.random.default_rng(seeds[1])
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key(keyframe).id)
        if not self.config.suspended:
            tilt = self.config.terrain.tilt
            self.data.qpos[:3] = rotate(tilt, self.data.qpos[:3])
            self.data.qpos[3:7] = tilt
        if self._surroundings is not None:
            self._surroundings.reset(self.data, seed)
        for field, nominal in self._joint_limits:
            field[:] = nominal
        self._failed_joints: list[int] = []
        self._pushes: list[_Push] = []
        self.steps = 0
        self._is_derived_current = False
        self._active_command = self._brake_command
        self._watchdog_left = 0

    def set_state(
        self,
        truth: Truth,
        q: ArrayLike,
        dq: ArrayLike,
        past: Iterable[tuple[ArrayLike, ArrayLike, JointCommand]] = (),
    ) -> None:
        """Put the robot into a given state; time and noise continue.

        Args:
            truth: Pose and velocity of the trunk.
            q: Joint positions, (12,), rad.
            dq: Joint velocities, (12,), rad/s.
            past: Joint positions, velocities and command of the preceding ms, the newest last. They
                restore the internal state of the actuator model, such as delayed commands.
        """
        self.data.qpos[:] = np.concatenate([truth.position, truth.quaternion, q])
        self.data.qvel[:3] = rotate(truth.quaternion, truth.linear_velocity)
        self.data.qvel[3:6], self.data.qvel[6:] = truth.angular_velocity, dq
        self.data.qacc_warmstart[:] = 0.0
        self.actuator.reset()
        for former_q, former_dq, command in past:
            self.actuator.step(np.asarray(former_q), np.asarray(former_dq), *_command_arrays(command))
            self.command(command)
        self._is_derived_current = False

    def _make_actuator(self, seed: int) -> ActuatorModel:
        """Create the actuator model; a subclass with other drives overrides this."""
        return ActuatorModel(self.config.actuator, dt=DT, seed=seed)

    @property
    def time(self) -> float:
        """Simulated time since the reset, s."""
        return self.steps * DT

    @property
    def tick(self) -> int:
        """Simulated time since the reset in ms, as the board's counter: it wraps at 2^32."""
        return self.steps % _TICK_MODULUS

    @property
    def braking(self) -> bool:
        """Whether the drives brake because no command arrives."""
        return self._watchdog_left <= 0

    def command(self, command: JointCommand) -> None:
        """Set the active command; it stays active until the next one or the watchdog.

        Args:
            command: Joint command.

        Raises:
            ValueError: A field has a wrong length or is not finite, or the mode is unknown.
        """
        if command.mode not in (MODE_DAMPING, MODE_SERVO):
            modes = f"{MODE_DAMPING} or {MODE_SERVO}"
            raise ValueError(f"JointCommand.mode: found {command.mode}, expected {modes}")
        self._active_command = _command_arrays(command)
        self._watchdog_left = self._watchdog_steps

    def step(self, n: int = 1) -> None:
        """Advance the simulation.

        Args:
            n: Number of ms.

        Raises:
            FloatingPointError: The physics diverged.
        """
        model, data, q, dq = self.model, self.data, self._q, self._dq
        torque, actuator_step = data.ctrl, self.actuator.step
        further_substeps = self.config.physics.substeps - 1
        surroundings, failed = self._surroundings, self._failed_joints
        for _ in range(n):
            torque[:] = actuator_step(q, dq, *self._active_command)
            if failed:
                torque[failed] = 0.0
            if self._is_derived_current:  # mj_forward has done the first half, mj_step1
                mujoco.mj_step2(model, data)
                self._is_derived_current = False
            else:
                mujoco.mj_step(model, data)
            if further_substeps:
                mujoco.mj_step(model, data, further_substeps)
            self._watchdog_left -= 1
            if self._watchdog_left == 0:
                self._active_command = self._brake_command
            if self._pushes:
                self._end_pushes()
            if surroundings is not None:
                surroundings.step(data)
        self.steps += n
        if not np.isfinite(data.qpos).all():
            raise FloatingPointError(f"simulation: the robot's state is not finite at {self.time:.3f} s")

    def push(
        self, body: str, force: ArrayLike, torque: ArrayLike = (0.0, 0.0, 0.0), duration: float = 0.1
    ) -> None:
        """Push a body at its centre of mass; pushes add up.

        Args:
            body: Name of the body.
            force: Force, (3,), N, world frame.
            torque: Torque, (3,), N m, world frame.
            duration: Duration, s.

        Raises:
            ValueError: The body is unknown, the wrench is not finite, the duration is below 1 ms, or
                all present pushes together exceed MAX_PUSH_WEIGHTS or MAX_PUSH_ARM_M.
        """
        bodies = [self.model.body(i).name for i in range(1, self.model.nbody) if self.model.body_weldid[i]]
        if body not in bodies:
            raise ValueError(f"push: body: found {body!r}, expected one of {', '.join(bodies)}")
        wrench = np.concatenate([np.ravel(force), np.ravel(torque)]).astype(float)
        if wrench.shape != (6,) or not np.isfinite(wrench).all():
            raise ValueError(f"push: wrench: found {wrench.tolist()}, expected 3 and 3 finite numbers")
        if not (np.isfinite(duration) and duration >= DT):
            raise ValueError(f"push: duration: found {duration} s, expected at least {DT} s")
        self._check_size(wrench)
        self._pushes.append(_Push(self.model.body(body).id, wrench, max(1, round(duration / DT))))
        self._apply_pushes()

    def _check_size(self, wrench: Array) -> None:
        """Refuse a push with which all present ones are so large that the physics could diverge."""
        wrenches = np.array([wrench, *(push.wrench for push in self._pushes)]).reshape(-1, 2, 3)
        force, torque = np.linalg.norm(wrenches, axis=2).sum(axis=0)
        weight = float(self.model.body_subtreemass[1] * np.linalg.norm(self.model.opt.gravity))
        for name, total, unit, share, by in (
            ("force", force, "N", MAX_PUSH_WEIGHTS, "times the robot's weight"),
            ("torque", torque, "N m", MAX_PUSH_ARM_M, "m times the robot's weight"),
        ):
            limit = share * weight
            if total > limit:
                found = f"found {total:.4g} {unit} of all pushes together"
                raise ValueError(f"push: {name}: {found}, expected at most {limit:.4g}, {share:g} {by}")

    def fail_joint(self, name: str) -> None:
        """Switch off a drive until the next reset: its torque, also the measured one, is zero.

        Args:
            name: Name of the joint.

        Raises:
            ValueError: The joint is unknown.
        """
        self._failed_joints += joint_index([name])

    def jam_joint(self, name: str) -> None:
        """Jam a joint at its present angle until the next reset.

        Args:
            name: Name of the joint.

        Raises:
            ValueError: The joint is unknown.
        """
        (joint,) = joint_index([name])
        jammed = self.model.joint(JOINT_NAMES[joint]).id
        self.model.jnt_range[jammed] = self._q[joint]
        self.model.jnt_solref[jammed], self.model.jnt_solimp[jammed] = _JAM_SOLREF, _JAM_SOLIMP

    def _apply_pushes(self) -> None:
        """Write the sum of all pushes into MuJoCo's state."""
        self.data.xfrc_applied[:] = 0.0
        for push in self._pushes:
            self.data.xfrc_applied[push.body] += push.wrench

    def _end_pushes(self) -> None:
        """Count down the pushes and remove the finished ones."""
        for push in self._pushes:
            push.steps_left -= 1
        if any(push.steps_left == 0 for push in self._pushes):
            self._pushes = [push for push in self._pushes if push.steps_left > 0]
            self._apply_pushes()

    def state(self) -> RobotState:
        """Simulate the measurements of the board at this instant, with sensor noise.

        Returns:
            State with new arrays.
        """
        self._update_derived()
        foot_force, wrench = np.zeros(4), np.zeros(6)
        for foot, i, _ in self._foot_contacts():
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            foot_force[foot] += wrench[0]
        noise, sensors = self._noise * self._rng.standard_normal(33), self.data.sensordata
        return RobotState(
            time=self.time,
            tick=self.tick,
            q=self._q + noise[:12],
            dq=self._dq + noise[12:24],
            tau=self.data.ctrl.copy(),
            quaternion=_rotated(sensors[self._orientation], noise[30:]),
            angular_velocity=sensors[self._gyro] + noise[24:27],
            linear_acceleration=sensors[self._accelerometer] + noise[27:30],
            foot_force=foot_force,
        )

    def truth(self) -> Truth:
        """Return the true motion of the trunk and the contacts at this instant.

        Returns:
            Ground truth with new arrays.
        """
        self._update_derived()
        contact, force, wrench = np.zeros(4, dtype=bool), np.zeros((4, 3)), np.zeros(6)
        for foot, i, sign in self._foot_contacts():
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            contact[foot] = True
            force[foot] += sign * wrench[:3] @ self.data.contact.frame[i].reshape(3, 3)
        # MuJoCo: linear velocities of a free joint are in the world frame, angular ones in the body frame.
        quaternion = self.data.qpos[3:7].copy()
        return Truth(
            time=self.time,
            tick=self.tick,
            position=self.data.qpos[:3].copy(),
            quaternion=quaternion,
            linear_velocity=rotate_inverse(quaternion, self.data.qvel[:3]),
            angular_velocity=self.data.qvel[3:6].copy(),
            contact=contact,
            contact_force=force,
        )

    @property
    def fallen(self) -> bool:
        """Whether the trunk touches the ground or tilts beyond `fall_tilt` now.

        A robot that lies on its belly counts as fallen, too.
        """
        self._update_derived()
        _, x, y, _ = self.data.qpos[3:7]
        upright = 1.0 - 2.0 * (x * x + y * y)  # z component of the trunk's z axis
        if upright < self._fall_cosine:
            return True
        geoms = self.data.contact.geom
        return bool(((geoms == self._trunk_geom).any(1) & self._ground[geoms].any(1)).any())

    @property
    def touch_counts(self) -> Mapping[str, int]:
        """Number of touches since the reset between robot and objects or people, by name."""
        return MappingProxyType({} if self._surroundings is None else self._surroundings.touch_counts)

    def scan(self) -> Scan | None:
        """Return the laser scan of this instant.

        Returns:
            The scan; None if no scan is due since the last one.

        Raises:
            ValueError: There is no world, and so no laser.
        """
        if self._surroundings is None:
            raise ValueError("scan: found no world, expected SimulatorConfig.world, which has the laser")
        self._update_derived()
        return self._surroundings.scan(self.data)

    def persons(self) -> Array:
        """Return position and heading of the people in the world frame.

        Returns:
            (n, 3): x, y in m, yaw in rad; the followed person first.
        """
        return np.zeros((0, 3)) if self._surroundings is None else self._surroundings.persons.poses

    def _foot_contacts(self) -> list[tuple[int, int, float]]:
        """Return (foot index, contact index, sign) of each foot contact.

        The sign is -1 if the contact frame points away from the foot.
        """
        found, feet = [], self._foot_of_geom
        for i, (first, second) in enumerate(self.data.contact.geom.tolist()):
            if second in feet:
                found.append((feet[second], i, 1.0))
            elif first in feet:
                found.append((feet[first], i, -1.0))
        return found

    def _update_derived(self) -> None:
        """Update what MuJoCo derives from positions, velocities and torques to the present instant.

        After mj_step these quantities lag one step behind the integrated positions and velocities.
        """
        if self._is_derived_current:
            return
        self.data.ctrl[:] = self.actuator.peek(self._q, self._dq, *self._active_command)
        self.data.ctrl[self._failed_joints] = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._is_derived_current = True


def _command_arrays(command: JointCommand) -> _CommandArrays:
    """Return checked copies of a command's arrays; all-zero `dq` and `tau` become the number 0.

    The number 0 is faster in the actuator model. Raises ValueError with the name of a field that
    does not have 12 finite numbers.
    """
    rows = (command.q, command.kp, command.kd, command.dq, command.tau)
    try:
        numbers = np.array(rows, dtype=float)
    except ValueError:  # of different lengths
        numbers = np.array(np.nan)
    if numbers.shape != (len(rows), 12) or not np.isfinite(numbers).all():
        for field, row in zip(("q", "kp", "kd", "dq", "tau"), rows, strict=True):
            if np.shape(row) != (12,) or not np.isfinite(row).all():
                raise ValueError(f"JointCommand.{field}: found {row}, expected 12 finite numbers")
    q, kp, kd, dq, tau = numbers
    if command.mode == MODE_DAMPING:
        kp[:] = tau[:] = 0.0
    return q, kp, kd, dq if np.count_nonzero(dq) else 0.0, tau if np.count_nonzero(tau) else 0.0


def _rotated(quaternion: Array, rotation: Array) -> Array:
    """Rotate `quaternion` (w, x, y, z) by a small `rotation` vector (rad) about body axes."""
    w, x, y, z = quaternion.tolist()
    a, b, c = (0.5 * rotation).tolist()
    turned = (
        w - x * a - y * b - z * c,
        x + w * a + y * c - z * b,
        y + w * b + z * a - x * c,
        z + w * c + x * b - y * a,
    )
    return np.array(turned) / math.hypot(*turned)
