"""MuJoCo model of a robot on its ground: its MJCF and the numbers of its `Robot`, joined by MjSpec.

    scene.xml              ground, light, solver, contacts in general
    robots/NAME/robot.xml  bodies, inertias, joints, shapes

The caller adds any terrain other than a plane.
"""

from __future__ import annotations

from pathlib import Path

import attrs
import mujoco
import numpy as np

from .arrays import Array
from .quadruped import GRAVITY, JOINT_NAMES, LEGS
from .robot import Robot

_SCENE = Path(__file__).parent / "scene.xml"
_SHELL_FRICTION = (0.4, 0.02, 0.01)  # of trunk and legs: sliding, torsional (m), rolling (m)
_SUSPENSION_SOLREF = (0.004, 1.0)  # time constant, s, and damping ratio of the stand


@attrs.frozen(eq=False)
class Plant:
    """Properties of a robot's model that may vary.

    Attributes:
        timestep: Time step of the simulation, s.
        armature: Reflected rotor inertia, (12,), kg m^2; None: the robot's.
        joint_friction: Coulomb friction, (12,), N m; None: the robot's.
        joint_damping: Viscous friction, (12,), N m s/rad; None: the robot's.
        plane: Whether the model has a flat ground; False if the caller adds a terrain.
        only_feet_and_trunk: Whether only feet and trunk collide, which is faster (training).
        sensors: Whether the model has IMU sensors.
        suspended: Whether the trunk is held at the robot's `suspended_height` with the feet in the
            air, as on a stand.
    """

    timestep: float = 0.001
    armature: Array | None = None
    joint_friction: Array | None = None
    joint_damping: Array | None = None
    plane: bool = True
    only_feet_and_trunk: bool = False
    sensors: bool = True
    suspended: bool = False


def build_spec(robot: Robot, plant: Plant | None = None) -> mujoco.MjSpec:
    """Create the model as an editable specification.

    Motors take joint torques in N m in the order of JOINT_NAMES.

    Args:
        robot: The robot.
        plant: Variable properties; None: the nominal robot.

    Returns:
        MuJoCo specification.
    """
    plant = plant or Plant()
    files = f'<include file="{_SCENE}"/><include file="{robot.mjcf_file.resolve()}"/>'
    spec = mujoco.MjSpec.from_string(f'<mujoco model="{robot.name}">{files}</mujoco>')
    spec.option.timestep, spec.option.gravity = plant.timestep, [0.0, 0.0, -GRAVITY]
    if not plant.plane:
        spec.delete(spec.geom("ground"))
    spec.body("trunk").pos = [0.0, 0.0, robot.nominal_height]
    _set_contacts(spec.body("trunk"), plant)
    _set_joints(spec, robot, plant)
    if plant.sensors:
        _add_imu(spec)
    _add_postures(spec, robot, plant)
    return spec


def _set_contacts(trunk: mujoco.MjsBody, plant: Plant) -> None:
    """Let the robot's shapes collide with its surroundings, not with each other."""
    feet = {f"{leg}_foot" for leg in LEGS}
    for geom in trunk.find_all("geom"):
        collides = geom.contype or geom.conaffinity
        if plant.only_feet_and_trunk:
            collides = geom.name in feet or geom.name == "trunk"
        geom.contype, geom.conaffinity, geom.condim = 0, int(bool(collides)), 3
        geom.solref, geom.priority = [0.01, 1.0], 1
        geom.friction = [0.8, 0.02, 0.01] if geom.name in feet else _SHELL_FRICTION


def _set_joints(spec: mujoco.MjSpec, robot: Robot, plant: Plant) -> None:
    """Give the joints their friction and a motor each."""
    armature = robot.armature if plant.armature is None else plant.armature
    friction = robot.joint_friction if plant.joint_friction is None else plant.joint_friction
    damping = robot.joint_damping if plant.joint_damping is None else plant.joint_damping
    for i, name in enumerate(JOINT_NAMES):
        joint = spec.joint(name)
        joint.armature, joint.frictionloss, joint.damping[0] = armature[i], friction[i], damping[i]
        limit = robot.torque_limit[i]
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrlrange, motor.ctrllimited = [-limit, limit], True


def _add_imu(spec: mujoco.MjSpec) -> None:
    """Add accelerometer, gyroscope and orientation at the site `imu`."""
    site, sensor = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor
    kinds = {
        "accelerometer": sensor.mjSENS_ACCELEROMETER,
        "gyro": sensor.mjSENS_GYRO,
        "orientation": sensor.mjSENS_FRAMEQUAT,
    }
    for name, kind in kinds.items():
        spec.add_sensor(name=name, type=kind, objtype=site, objname="imu")


def _add_postures(spec: mujoco.MjSpec, robot: Robot, plant: Plant) -> None:
    """Add the keyframes `stand` and `lie`, and the stand that holds a suspended trunk."""
    heights = robot.nominal_height, robot.lie_height
    if plant.suspended:
        heights = robot.suspended_height, robot.suspended_height
        stand = spec.add_equality(
            name="suspended",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1="trunk",
            name2="world",
        )
        stand.solref = _SUSPENSION_SOLREF
        # where the world is, seen from the trunk: anchor, position, quaternion, torque scale
        stand.data[:11] = [0.0, 0.0, 0.0, 0.0, 0.0, -robot.suspended_height, 1.0, 0.0, 0.0, 0.0, 1.0]
    for name, height, q in zip(("stand", "lie"), heights, (robot.nominal_q, robot.lie_q), strict=True):
        spec.add_key(name=name, qpos=[0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *q])


def load_model(robot: Robot, plant: Plant | None = None) -> mujoco.MjModel:
    """Create the compiled model.

    Args:
        robot: The robot.
        plant: Variable properties; None: the nominal robot.

    Returns:
        Compiled MuJoCo model.
    """
    return build_spec(robot, plant).compile()


def gravity_torque(model: mujoco.MjModel) -> np.ndarray:
    """Compute the joint torques that hold the stance while the four feet share the weight equally.

    Args:
        model: Model of the robot.

    Returns:
        Torques, (12,), N m.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_forward(model, data)
    # Static equilibrium: tau = bias(q) - sum over feet of J^T (0, 0, weight / 4).
    weight = float(model.body_subtreemass[1]) * GRAVITY
    torque = data.qfrc_bias[6:].copy()
    jacobian = np.zeros((3, model.nv))
    for leg in LEGS:
        foot = model.geom(f"{leg}_foot")
        mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[foot.id], foot.bodyid.item())
        torque -= jacobian[:, 6:].T @ [0.0, 0.0, weight / 4]
    return torque
