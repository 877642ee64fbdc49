"""Domain randomisation (Section 3.4): bodies, friction, actuators, noise and pushes.

`env` applies the draws to each robot; `quadvel_actuator` holds the actuator model.
"""

from __future__ import annotations

import attrs
import mujoco
import numpy as np
from mujoco.batch import Batch

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters, Effect
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot

STALL_RANGE_NM, NO_LOAD_RANGE_RAD_S = (24.0, 60.0), (12.0, 30.0)  # of `limited`, drawn per robot
RATED_STALL, RATED_SPEED = (
    (1.6, 2.4),
    (1.0, 1.15),
)  # of `rated`: shares of the torque and speed limits


def limited_drives(robot: Robot) -> ActuatorParameters:
    """Actuators with torque limits that fall with speed, from weak to strong drives.

    Args:
        robot: The robot.

    Returns:
        The robot's actuator model with a speed-torque curve drawn for each robot.
    """
    middle = {"stall": float(np.mean(STALL_RANGE_NM)), "no_load": float(np.mean(NO_LOAD_RANGE_RAD_S))}
    ranges = {"stall": STALL_RANGE_NM, "no_load": NO_LOAD_RANGE_RAD_S}
    effect = Effect("torque_speed_limit", JOINT_NAMES, middle, intervals=ranges)
    return attrs.evolve(ActuatorParameters.of(robot), name=f"{robot.name}, limited", effects=(effect,))


def rated_drives(robot: Robot) -> ActuatorParameters:
    """Actuators with the rated speed-torque curve of the robot.

    The full torque is available up to about half the top speed, none at it. For each robot the
    stall torque is `RATED_STALL` times the torque limit, which clips it, and the no-load speed is
    `RATED_SPEED` times the speed limit.

    Args:
        robot: The robot.

    Returns:
        The robot's actuator model with these curves.
    """
    kinds = {kind: tuple(name for name in JOINT_NAMES if kind in name) for kind in ("hip", "thigh", "calf")}
    effects = []
    for k, joints in enumerate(kinds.values()):
        stall, no_load = (
            tuple(float(share * limit[k]) for share in shares)
            for shares, limit in ((RATED_STALL, robot.torque_limit), (RATED_SPEED, robot.velocity_limit))
        )
        middle = {"stall": float(np.mean(stall)), "no_load": float(np.mean(no_load))}
        ranges = {"stall": stall, "no_load": no_load}
        effects.append(Effect("torque_speed_limit", joints, middle, intervals=ranges))
    return attrs.evolve(
        ActuatorParameters.of(robot), name=f"{robot.name}, rated drives", effects=tuple(effects)
    )


ACTUATORS = {
    "eam": ActuatorParameters.of,
    "limited": limited_drives,
    "rated": rated_drives,
    "ideal": ActuatorParameters.ideal,
}


@attrs.frozen
class Randomisation:
    """Ranges (low, high) of uniform draws, and standard deviations of noise.

    Attributes:
        foot_friction: friction coefficient of each foot.
        payload: kg, on the trunk.
        com_shift: m, shift of the trunk's centre of mass, per axis, either way.
        mass_scale: factor of the masses of the legs.
        joint_friction_scale: factor of the dry friction of the joints.
        joint_damping_scale: factor of the damping of the joints.
        armature_scale: factor of the rotor inertia.
        contact_time: s, time constant of the feet's contact spring: stiff to soft ground.
        contact_damping: damping of the contact, ratio to critical.
        grip: MuJoCo's impratio: how little a foot creeps within the friction cone.
        torsional_friction: m, torsional friction of the feet: torque per normal force.
        pyramidal: share of robots with a pyramidal instead of an elliptic friction cone.
        transmission_delay: s, in addition to the input delay of the actuator.
        noise_q: rad.
        noise_dq: rad/s.
        noise_roll_pitch: rad.
        noise_angular_velocity: rad/s.
        noise_velocity: m/s, white.
        drift_velocity: m/s, with a time constant of 0.5 s, as an estimator errs.
        push_interval: s, mean time between pushes.
        push_velocity: m/s, sudden change of the trunk's velocity.
        push_turn: rad/s, sudden change of its angular velocity.
        gain_scale: factor of kp and of kd, drawn separately, for actuators without an identified
            model.
    """

    foot_friction: tuple[float, float] = (0.3, 1.0)
    payload: tuple[float, float] = (-1.0, 3.0)
    com_shift: float = 0.03
    mass_scale: tuple[float, float] = (0.9, 1.1)
    joint_friction_scale: tuple[float, float] = (0.2, 1.5)
    joint_damping_scale: tuple[float, float] = (0.2, 1.5)
    armature_scale: tuple[float, float] = (0.8, 1.2)
    contact_time: tuple[float, float] = (0.01, 0.01)
    contact_damping: tuple[float, float] = (1.0, 1.0)
    grip: tuple[float, float] = (
        10.0,
        10.0,
    )
    torsional_friction: tuple[float, float] = (
        0.0,
        0.0,
    )
    pyramidal: float = 0.0
    transmission_delay: tuple[float, float] = (0.0, 0.002)
    noise_q: float = 0.01
    noise_dq: float = 0.1
    noise_roll_pitch: float = 0.01
    noise_angular_velocity: float = 0.05
    noise_velocity: float = 0.05
    drift_velocity: float = 0.05
    push_interval: float = 8.0
    push_velocity: float = 0.4
    push_turn: float = 0.5
    gain_scale: tuple[float, float] = (
        1.0,
        1.0,
    )

    @classmethod
    def none(cls) -> Randomisation:
        """Return the nominal plant without noise or pushes.

        Returns:
            Ranges of width 0.
        """
        one, nil = (1.0, 1.0), (0.0, 0.0)
        return cls(
            foot_friction=(0.8, 0.8),
            payload=nil,
            com_shift=0.0,
            mass_scale=one,
            joint_friction_scale=one,
            joint_damping_scale=one,
            armature_scale=one,
            transmission_delay=nil,
            noise_q=0.0,
            noise_dq=0.0,
            noise_roll_pitch=0.0,
            noise_angular_velocity=0.0,
            noise_velocity=0.0,
            drift_velocity=0.0,
            push_velocity=0.0,
            push_turn=0.0,
        )

    @classmethod
    def calm(cls) -> Randomisation:
        """Return the nominal plant on ordinary ground, with good sensors and without pushes.

        Returns:
            Narrow ranges.
        """
        return attrs.evolve(
            cls.none(), foot_friction=(0.6, 1.0), noise_q=0.005, noise_dq=0.05, noise_velocity=0.02
        )


class PlantSampler:
    """Sampler of model fields of a MuJoCo batch, per environment.

    Attributes:
        drawn: (n, 8), what was drawn, for the critic: four friction coefficients, payload (kg),
            shift of the centre of mass (share of `com_shift`).
    """

    FIELDS = (
        "body_mass",
        "body_inertia",
        "body_ipos",
        "geom_friction",
        "geom_solref",
        "dof_frictionloss",
        "dof_damping",
        "dof_armature",
    )

    def __init__(self, batch: Batch, ranges: Randomisation, rng: np.random.Generator) -> None:
        """Prepare the fields that vary.

        Args:
            batch: MuJoCo batch.
            ranges: ranges to draw from.
            rng: source of randomness.
        """
        self._batch, self._ranges, self._rng = batch, ranges, rng
        model = batch.model
        self._nominal = {name: getattr(model, name).copy() for name in self.FIELDS}
        self._fields = {name: batch.expand(name) for name in self.FIELDS}
        self._cone, self._impratio = batch.expand("opt.cone"), batch.expand("opt.impratio")
        self._feet = np.array([i for i in range(model.ngeom) if model.geom(i).name.endswith("_foot")])
        self._trunk = model.body("trunk").id
        self.drawn = np.zeros((batch.nsim, 8))

    def sample(self, ids: np.ndarray) -> None:
        """Draw new plants.

        Args:
            ids: (n,), indices of the environments.
        """
        r, rng, n, f = self._ranges, self._rng, len(ids), self._fields
        uniform = rng.uniform
        friction = uniform(*r.foot_friction, (n, len(self._feet)))
        f["geom_friction"][ids[:, None], self._feet, 0] = friction
        f["geom_friction"][ids[:, None], self._feet, 1] = uniform(*r.torsional_friction, (n, 1))
        f["geom_solref"][ids[:, None], self._feet, 0] = uniform(*r.contact_time, (n, 1))
        f["geom_solref"][ids[:, None], self._feet, 1] = uniform(*r.contact_damping, (n, 1))
        self._impratio[ids] = uniform(*r.grip, self._impratio[ids].shape)
        cones = np.where(
            rng.random(n) < r.pyramidal, mujoco.mjtCone.mjCONE_PYRAMIDAL, mujoco.mjtCone.mjCONE_ELLIPTIC
        )
        self._cone[ids] = cones.reshape(self._cone[ids].shape)

        scale = uniform(*r.mass_scale, (n, self._batch.model.nbody))
        scale[:, : self._trunk + 1] = 1.0
        payload = uniform(*r.payload, n)
        scale[:, self._trunk] = 1.0 + payload / self._nominal["body_mass"][self._trunk]
        f["body_mass"][ids] = self._nominal["body_mass"] * scale
        f["body_inertia"][ids] = self._nominal["body_inertia"] * scale[..., None]
        shift = uniform(-r.com_shift, r.com_shift, (n, 3))
        f["body_ipos"][ids] = self._nominal["body_ipos"]
        f["body_ipos"][ids, self._trunk] += shift

        for name, limits in (
            ("dof_frictionloss", r.joint_friction_scale),
            ("dof_damping", r.joint_damping_scale),
            ("dof_armature", r.armature_scale),
        ):
            f[name][ids] = self._nominal[name] * uniform(*limits, (n, 1))
        self._batch.set_const(ids.astype(np.int32))
        self.drawn[ids] = np.concatenate([friction, payload[:, None], shift / max(r.com_shift, 1e-3)], axis=1)


def load_actuator(robot: Robot, name: str) -> ActuatorParameters:
    """Return the actuators that a recipe names.

    Args:
        robot: The robot.
        name: `eam` (the robot's file), `limited` or `rated` (with speed-torque curves), `ideal` (PD law),
            or an actuator file.

    Returns:
        Their parameters.
    """
    return ACTUATORS[name](robot) if name in ACTUATORS else ActuatorParameters.load(robot, name)


def sample_actuators(
    actuators: ActuatorModel, ids: np.ndarray, ranges: Randomisation, rng: np.random.Generator
) -> None:
    """Draw delays, gains and effects of actuators, and reset them.

    The model varies what Section 3.1 varies, and effects within their intervals; `ranges` adds
    transmission delay and gain factors.

    Args:
        actuators: actuator model, changed in place.
        ids: indices of the environments.
        ranges: ranges to draw from.
        rng: source of randomness.
    """
    actuators.sample(ids, rng)
    delay, kp_scale, kd_scale = actuators.input_delay, actuators.kp_scale, actuators.kd_scale
    delay[ids] += rng.uniform(*ranges.transmission_delay, (len(ids), 1))
    kp_scale[ids] *= rng.uniform(*ranges.gain_scale, (len(ids), 1))
    kd_scale[ids] *= rng.uniform(*ranges.gain_scale, (len(ids), 1))
    actuators.input_delay, actuators.kp_scale, actuators.kd_scale = delay, kp_scale, kd_scale
    actuators.reset(ids)
