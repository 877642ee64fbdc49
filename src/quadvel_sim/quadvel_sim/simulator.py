"""One AlienGo in MuJoCo, driven as the real one is: joint commands in, low-level state out. No ROS, no clock.

Every millisecond the drives' law is evaluated on the joint state of that instant with the command held
(`ActuatorModel`), whenever that command came.

What one `RobotState` reports holds at one instant t: q, dq, orientation and angular velocity are those of t,
`tau` is the torque with which the drives answer them under the command they hold, and linear acceleration and
foot forces follow from all these. A command given at t counts from t on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_actuator import ActuatorModel
from quadvel_description import robot
from quadvel_description.kinematics import rotate, rotate_inverse
from quadvel_description.mjcf import Plant, build_spec
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_sim import persons
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.laser import Scan
from quadvel_sim.surroundings import Surroundings, is_ground
from quadvel_sim.world import SURFACE_PRIORITY

__all__ = ["DT", "SensorNoise", "Simulator", "SimulatorConfig", "Truth"]

DT = 0.001  # s
_TICKS = 2**32
_PAYLOAD_RADIUS = 0.05  # m, the payload is a solid ball
_Array = NDArray[np.float64]
# q, kp, kd, dq, tau, in the order of ActuatorModel.step
_Law = tuple[_Array, _Array, _Array, _Array | float, _Array | float]


@attrs.define
class Truth:
    """What no sensor tells: the trunk's motion and the contacts at `time`."""

    time: float  # s
    tick: int  # ms, wraps at 2^32
    position: _Array  # (3,) m, trunk origin, world
    quaternion: _Array  # (4,) w, x, y, z, body to world
    linear_velocity: _Array  # (3,) m/s, of the trunk origin, body frame
    angular_velocity: _Array  # (3,) rad/s, body frame
    contact: NDArray[np.bool_]  # (4,) whether the foot touches the ground
    contact_force: _Array  # (4, 3) N, ground on foot, world


@attrs.define
class _Push:
    body: int
    wrench: _Array  # (6,) force and torque, world
    steps: int  # left


def build_model(config: SimulatorConfig) -> mujoco.MjModel:
    """The robot and its ground as `config` wants them."""
    plant = Plant(
        timestep=DT,
        armature=config.armature,
        joint_friction=config.joint_friction,
        joint_damping=config.joint_damping,
        plane=False,
        hung=config.hung,
    )
    spec = build_spec(plant)
    if config.world is None:
        config.terrain.add_to(spec)
    else:
        config.world.add_to(spec)
        persons.add_to(spec, config.world.persons)
    if config.payload > 0.0:
        spec.body("trunk").add_body(
            name="payload",
            pos=config.payload_position,
            mass=config.payload,
            ipos=np.zeros(3),
            inertia=np.full(3, 0.4 * config.payload * _PAYLOAD_RADIUS**2),
            explicitinertial=True,
        )
    if config.payload < 0.0:
        trunk = spec.body("trunk")
        share = 1.0 + config.payload / trunk.mass
        trunk.mass *= share
        trunk.fullinertia *= share
    model = spec.compile()
    for leg, friction in zip(robot.LEGS, config.friction, strict=True):
        model.geom(f"{leg}_foot").friction[0] = friction
    config.physics.apply(model)
    foot, own = model.geom(f"{robot.LEGS[0]}_foot"), model.geom_priority == SURFACE_PRIORITY
    model.geom_solref[own], model.geom_condim[own] = (
        foot.solref,
        foot.condim,
    )  # friction alone is a surface's own
    disable = mujoco.mjtDisableBit
    model.opt.disableflags |= disable.mjDSBL_AUTORESET  # a diverged run is an error, not a new start
    model.opt.disableflags |= disable.mjDSBL_ISLAND  # the robot is one island; finding that out costs 10 %
    return model


class Simulator:
    """The robot on its ground, 1 ms a step. Equal configurations, seeds and calls give equal runs to the bit.

    Reading (`state`, `truth`, `fallen`) does not alter the run, the sensor noise of later samples apart. The
    first reading at an instant settles it: a command or push given after that shows from the next step on.
    `model` and `data` are MuJoCo's own, to be drawn and measured, not to be written to. `steps` counts the ms
    since the reset, `actuator` is the drives' model.
    """

    def __init__(self, config: SimulatorConfig | None = None) -> None:
        self.config = config or SimulatorConfig()
        self.model = build_model(self.config)
        self.data = mujoco.MjData(self.model)
        self._q, self._dq = self.data.qpos[7:], self.data.qvel[6:]  # views of the live arrays
        self._foot_of_geom = {self.model.geom(f"{leg}_foot").id: i for i, leg in enumerate(robot.LEGS)}
        self._orientation, self._gyro, self._accelerometer = (
            slice(adr := self.model.sensor(name).adr.item(), adr + self.model.sensor(name).dim.item())
            for name in ("orientation", "gyro", "accelerometer")
        )
        self._trunk_geom = self.model.geom("trunk").id
        self._ground = np.array([is_ground(self.model.geom(i).name) for i in range(self.model.ngeom)])
        self._fall_cosine = np.cos(self.config.fall_tilt)
        self._watchdog_steps = round(self.config.watchdog / DT)
        self._brake = _law(JointCommand.damping(self.config.watchdog_kd))
        world = self.config.world
        self._surroundings = None if world is None else Surroundings(self.model, world)
        self._noise = np.repeat(attrs.astuple(self.config.noise), (12, 12, 3, 3, 3))
        self.reset()

    def reset(self, keyframe: str = "lie", seed: int | None = None) -> None:
        """Put the robot at the origin in the posture "lie" or "stand", at rest, time zero, drives braking.

        `seed` of the noise: the configuration's where None, so that the same run comes again.
        """
        keyframes = [self.model.key(i).name for i in range(self.model.nkey)]
        if keyframe not in keyframes:
            raise ValueError(f"keyframe: found {keyframe!r}, expected one of {', '.join(keyframes)}")
        seed = self.config.seed if seed is None else seed
        seeds = np.random.SeedSequence(seed).generate_state(2)
        self.actuator = self._make_actuator(int(seeds[0]))
        self._rng = np.random.default_rng(seeds[1])
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key(keyframe).id)
        if not self.config.hung:
            tilt = self.config.terrain.tilt
            self.data.qpos[:3] = rotate(tilt, self.data.qpos[:3])
            self.data.qpos[3:7] = tilt
        if self._surroundings is not None:
            self._surroundings.reset(self.data, seed)
        self._pushes: list[_Push] = []
        self.steps = 0
        self._sampled = False
        self._law = self._brake
        self._command_left = 0

    def place(
        self,
        truth: Truth,
        q: ArrayLike,
        dq: ArrayLike,
        past: Iterable[tuple[ArrayLike, ArrayLike, JointCommand]] = (),
    ) -> None:
        """Put the robot into a state that another one had: the trunk of `truth`, joints q (12,), dq (12,).

        past: joint state and command of the ms before, the newest last; the drives live through it, so that
        what is under way in them is there. Time and noise go on.
        """
        self.data.qpos[:] = np.concatenate([truth.position, truth.quaternion, q])
        self.data.qvel[:3] = rotate(truth.quaternion, truth.linear_velocity)
        self.data.qvel[3:6], self.data.qvel[6:] = truth.angular_velocity, dq
        self.data.qacc_warmstart[:] = 0.0
        self.actuator.reset()
        for former_q, former_dq, command in past:
            self.actuator.step(np.asarray(former_q), np.asarray(former_dq), *_law(command))
            self.command(command)
        self._sampled = False

    def _make_actuator(self, seed: int) -> ActuatorModel:
        """The drives; a plant with drives of another kind makes them here."""
        return ActuatorModel(self.config.actuator, dt=DT, seed=seed)

    @property
    def time(self) -> float:
        """Simulated time since the reset, s."""
        return self.steps * DT

    @property
    def tick(self) -> int:
        """`steps` as the board's counter shows it: it wraps at 2^32."""
        return self.steps % _TICKS

    @property
    def braking(self) -> bool:
        """Whether the drives brake for want of a command."""
        return self._command_left <= 0

    def command(self, command: JointCommand) -> None:
        """Hold `command` from now on, until the next one or the watchdog.

        ValueError names the field where one has a wrong length or is not finite, or the mode is unknown.
        """
        if command.mode not in (MODE_DAMPING, MODE_SERVO):
            modes = f"{MODE_DAMPING} or {MODE_SERVO}"
            raise ValueError(f"JointCommand.mode: found {command.mode}, expected {modes}")
        self._law = _law(command)
        self._command_left = self._watchdog_steps

    def step(self, n: int = 1) -> None:
        """Advance by `n` ms. FloatingPointError where the physics diverged."""
        model, data, q, dq = self.model, self.data, self._q, self._dq
        torque, answer, more = data.ctrl, self.actuator.step, self.config.physics.substeps - 1
        surroundings = self._surroundings
        for _ in range(n):
            torque[:] = answer(q, dq, *self._law)
            if self._sampled:  # all that depends on positions and velocities alone is there
                mujoco.mj_step2(model, data)
                self._sampled = False
            else:
                mujoco.mj_step(model, data)
            if more:
                mujoco.mj_step(model, data, more)
            self._command_left -= 1
            if self._command_left == 0:
                self._law = self._brake
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
        """Push `body` at its centre of mass for `duration` (s): `force` (N), `torque` (N m), world frame.

        Pushes add up. ValueError names an unknown body, a wrench that is not finite, a duration under 1 ms.
        """
        bodies = [self.model.body(i).name for i in range(1, self.model.nbody) if self.model.body_weldid[i]]
        if body not in bodies:
            raise ValueError(f"push: body: found {body!r}, expected one of {', '.join(bodies)}")
        wrench = np.concatenate([np.ravel(force), np.ravel(torque)]).astype(float)
        if wrench.shape != (6,) or not np.isfinite(wrench).all():
            raise ValueError(f"push: wrench: found {wrench.tolist()}, expected 3 and 3 finite numbers")
        if not (np.isfinite(duration) and duration >= DT):
            raise ValueError(f"push: duration: found {duration} s, expected at least {DT} s")
        self._pushes.append(_Push(self.model.body(body).id, wrench, max(1, round(duration / DT))))
        self._apply_pushes()

    def _apply_pushes(self) -> None:
        self.data.xfrc_applied[:] = 0.0
        for push in self._pushes:
            self.data.xfrc_applied[push.body] += push.wrench

    def _end_pushes(self) -> None:
        for push in self._pushes:
            push.steps -= 1
        if any(push.steps == 0 for push in self._pushes):
            self._pushes = [push for push in self._pushes if push.steps > 0]
            self._apply_pushes()

    def state(self) -> RobotState:
        """What the board reports of this instant, with sensor noise. New arrays."""
        self._sample()
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
            quaternion=_turned(sensors[self._orientation], noise[30:]),
            angular_velocity=sensors[self._gyro] + noise[24:27],
            linear_acceleration=sensors[self._accelerometer] + noise[27:30],
            foot_force=foot_force,
        )

    def truth(self) -> Truth:
        """The trunk's true motion and the contacts of this instant. New arrays."""
        self._sample()
        contact, force, wrench = np.zeros(4, dtype=bool), np.zeros((4, 3)), np.zeros(6)
        for foot, i, sign in self._foot_contacts():
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            contact[foot] = True
            force[foot] += sign * wrench[:3] @ self.data.contact.frame[i].reshape(3, 3)
        quaternion = self.data.qpos[3:7].copy()
        return Truth(
            time=self.time,
            tick=self.tick,
            position=self.data.qpos[:3].copy(),
            quaternion=quaternion,
            linear_velocity=rotate_inverse(quaternion, self.data.qvel[:3]),  # a free joint's: world frame
            angular_velocity=self.data.qvel[3:6].copy(),  # and body frame
            contact=contact,
            contact_force=force,
        )

    @property
    def fallen(self) -> bool:
        """Whether the trunk touches the ground or tilts beyond `fall_tilt` now.

        A robot that lies on its belly counts too: who asks knows whether it should stand.
        """
        self._sample()
        _, x, y, _ = self.data.qpos[3:7]
        upright = 1.0 - 2.0 * (x * x + y * y)  # z component of the trunk's z axis
        if upright < self._fall_cosine:
            return True
        geoms = self.data.contact.geom
        return bool(((geoms == self._trunk_geom).any(1) & self._ground[geoms].any(1)).any())

    @property
    def touched(self) -> Mapping[str, int]:
        """How often since the reset the robot touched what stands or walks in its world, by name."""
        return MappingProxyType({} if self._surroundings is None else self._surroundings.touched)

    def scan(self) -> Scan | None:
        """The laser's scan of this instant, or None if none is due since the last one. ValueError without a world."""
        if self._surroundings is None:
            raise ValueError("scan: found no world, expected SimulatorConfig.world, which has the laser")
        self._sample()
        return self._surroundings.scan(self.data)

    def persons(self) -> _Array:
        """Where the world's persons are and where they walk to, (n, 3): x, y in m, yaw in rad, world; who is led first."""
        return np.zeros((0, 3)) if self._surroundings is None else self._surroundings.persons.poses

    def _foot_contacts(self) -> list[tuple[int, int, float]]:
        """The contacts of feet now: index of the foot, index of the contact, and 1, or -1 where its frame shows from the foot."""
        found, feet = [], self._foot_of_geom
        for i, (first, second) in enumerate(self.data.contact.geom.tolist()):
            if second in feet:
                found.append((feet[second], i, 1.0))
            elif first in feet:
                found.append((feet[first], i, -1.0))
        return found

    def _sample(self) -> None:
        """Bring all that MuJoCo derives from positions, velocities and torques to the present instant.

        mj_step leaves it one step behind the positions and velocities that it has just integrated.
        """
        if self._sampled:
            return
        self.data.ctrl[:] = self.actuator.peek(self._q, self._dq, *self._law)
        mujoco.mj_forward(self.model, self.data)
        self._sampled = True


def _law(command: JointCommand) -> _Law:
    """The numbers of `command`, copied and checked; where `dq` or `tau` are all zero, the number 0: faster.

    ValueError names the field that has not 12 finite numbers.
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


def _turned(quaternion: _Array, rotation: _Array) -> _Array:
    """`quaternion` (w, x, y, z) turned by a small `rotation` vector (rad) about body axes."""
    w, x, y, z = quaternion.tolist()
    a, b, c = (0.5 * rotation).tolist()
    turned = (
        w - x * a - y * b - z * c,
        x + w * a + y * c - z * b,
        y + w * b + z * a - x * c,
        z + w * c + x * b - y * a,
    )
    return np.array(turned) / math.hypot(*turned)
