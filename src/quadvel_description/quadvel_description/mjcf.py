"""MuJoCo model (MJCF) of the AlienGo from geometric primitives and the numbers in `robot`.

The caller adds any terrain other than a plane.
"""

from __future__ import annotations

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from . import robot
from .quadruped import GRAVITY, JOINT_NAMES, KINDS, LEFT, LEGS
from .robot import FOOT_RADIUS


def _text(values: ArrayLike) -> str:
    """Return numbers as an attribute value."""
    return " ".join(repr(float(v)) for v in np.ravel(np.asarray(values, float)))


@attrs.frozen(eq=False)
class Plant:
    """Properties of the robot's model that may vary; the defaults are the nominal AlienGo.

    Attributes:
        timestep: Time step of the simulation, s.
        armature: Reflected rotor inertia, (12,), kg m^2.
        joint_friction: Coulomb friction, (12,), N m.
        joint_damping: Viscous friction, (12,), N m s/rad.
        foot_friction: Sliding friction coefficient of the feet.
        plane: Whether the model has a flat ground; False if the caller adds a terrain.
        only_feet_and_trunk: Whether only feet and trunk collide, which is faster (training).
        sensors: Whether the model has IMU sensors.
        suspended: Whether the trunk is held at `SUSPENDED_HEIGHT` with the feet in the air, as on a
            stand.
    """

    timestep: float = 0.001
    armature: np.ndarray = attrs.field(factory=lambda: robot.ARMATURE)
    joint_friction: np.ndarray = attrs.field(factory=lambda: robot.FRICTION)
    joint_damping: np.ndarray = attrs.field(factory=lambda: robot.DAMPING)
    foot_friction: float = 0.8
    plane: bool = True
    only_feet_and_trunk: bool = False
    sensors: bool = True
    suspended: bool = False


def _leg_xml(leg: str, plant: Plant) -> str:
    """Return the bodies of a leg."""
    sy = LEFT[leg]
    first = 3 * LEGS.index(leg)
    shells = {
        "hip": f'<geom class="shell" type="cylinder" size="0.046 0.0209" pos="0 {0.083 * sy!r} 0" euler="{np.pi / 2!r} 0 0"/>',
        "thigh": '<geom class="shell" type="box" size="0.0215 0.0187 0.125" pos="0 0 -0.125"/>',
        "calf": '<geom class="shell" type="box" size="0.008 0.0104 0.125" pos="0 0 -0.125"/>',
    }
    foot = (
        f'<geom class="foot" name="{leg}_foot" pos="0 0 {-robot.ALIENGO.legs.calf!r}"/>'
        f'<site name="{leg}_foot" pos="0 0 {-robot.ALIENGO.legs.calf!r}" size="{FOOT_RADIUS!r}"/>'
    )
    inner = foot
    for k in reversed(range(3)):
        kind = KINDS[k]
        link = next(item for item in robot.LINKS if item.name == f"{leg}_{kind}")
        inertial = robot.combined_inertial(link.name)
        i = first + k
        axis = "1 0 0" if link.axis == "x" else "0 1 0"
        shell = (
            shells[kind].replace('class="shell"', 'class="visual"')
            if plant.only_feet_and_trunk
            else shells[kind]
        )
        inner = (
            f'<body name="{link.name}" pos="{_text(link.origin)}">'
            f'<inertial mass="{_text(inertial.mass)}" pos="{_text(inertial.com)}" fullinertia="{_text(inertial.fullinertia())}"/>'
            f'<joint name="{leg}_{kind}_joint" axis="{axis}" range="{_text([robot.LOWER[i], robot.UPPER[i]])}"'
            f' armature="{_text(plant.armature[i])}" frictionloss="{_text(plant.joint_friction[i])}"'
            f' damping="{_text(plant.joint_damping[i])}"/>'
            f"{shell}{inner}</body>"
        )
    return inner


def _keyframe_xml(name: str, height: float, q: np.ndarray) -> str:
    """Return a keyframe with the trunk at a height (m) and joints `q`."""
    return f'<key name="{name}" qpos="0 0 {height!r} 1 0 0 0 {_text(q)}"/>'


def mjcf(plant: Plant | None = None) -> str:
    """Create the model as MJCF text.

    Motors take joint torques in N m in the order of `JOINT_NAMES`.

    Args:
        plant: Variable properties; None: the nominal robot.

    Returns:
        MJCF text.
    """
    plant = plant or Plant()
    trunk = robot.combined_inertial("trunk")
    ground = (
        '<geom name="ground" type="plane" size="0 0 0.1" contype="1" conaffinity="0" material="ground"/>'
        if plant.plane
        else ""
    )
    sensors = (
        """<sensor>
    <accelerometer name="accelerometer" site="imu"/>
    <gyro name="gyro" site="imu"/>
    <framequat name="orientation" objtype="site" objname="imu"/>
  </sensor>"""
        if plant.sensors
        else ""
    )
    motors = "\n    ".join(
        f'<motor name="{name}" joint="{name}" ctrlrange="{-limit!r} {limit!r}"/>'
        for name, limit in zip(JOINT_NAMES, robot.TORQUE_LIMIT.tolist(), strict=True)
    )
    legs = "\n      ".join(_leg_xml(leg, plant) for leg in LEGS)
    # relpose: where the world is, seen from the trunk
    stand = (
        f"""<equality>
    <weld name="hung" body1="trunk" relpose="0 0 {-robot.SUSPENDED_HEIGHT!r} 1 0 0 0" solref="0.004 1"/>
  </equality>"""
        if plant.suspended
        else ""
    )
    heights = [robot.SUSPENDED_HEIGHT] * 2 if plant.suspended else [robot.NOMINAL_HEIGHT, robot.LIE_HEIGHT]
    return f"""<mujoco model="aliengo">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{plant.timestep!r}" integrator="implicitfast" cone="elliptic" impratio="10"
          iterations="20" ls_iterations="20" gravity="0 0 {-GRAVITY!r}"/>
  <default>
    <geom contype="0" conaffinity="1" condim="3" solref="0.01 1" friction="{plant.foot_friction!r} 0.02 0.01"/>
    <default class="visual"><geom contype="0" conaffinity="0" group="1" rgba="0.25 0.27 0.3 1"/></default>
    <default class="shell"><geom friction="0.4 0.02 0.01" priority="1" rgba="0.25 0.27 0.3 1"/></default>
    <default class="foot">
      <geom type="sphere" size="{FOOT_RADIUS!r}" priority="1" rgba="0.9 0.45 0.1 1"/>
    </default>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.75 0.85 0.95" rgb2="0.3 0.4 0.55" width="64" height="64"/>
    <texture name="ground" type="2d" builtin="checker" rgb1="0.42 0.46 0.44" rgb2="0.36 0.4 0.38" width="256" height="256"/>
    <material name="ground" texture="ground" texrepeat="1 1" texuniform="true" reflectance="0.05"/>
  </asset>
  <visual>
    <headlight diffuse="0.5 0.5 0.5" ambient="0.35 0.35 0.35"/>
    <global offwidth="1280" offheight="720"/>
  </visual>
  <worldbody>
    <light pos="0 0 4" dir="0.2 0.1 -1" type="directional" diffuse="0.6 0.6 0.6"/>
    {ground}
    <body name="trunk" pos="0 0 {robot.NOMINAL_HEIGHT!r}">
      <freejoint name="root"/>
      <inertial mass="{_text(trunk.mass)}" pos="{_text(trunk.com)}" fullinertia="{_text(trunk.fullinertia())}"/>
      <geom name="trunk" class="shell" type="box" size="0.3235 0.075 0.056" rgba="0.8 0.82 0.85 1"/>
      <site name="imu" pos="{"0.0 0.0 0.0"}" size="0.01"/>
      {legs}
    </body>
  </worldbody>
  <actuator>
    {motors}
  </actuator>
  {sensors}
  {stand}
  <keyframe>
    {_keyframe_xml("stand", heights[0], robot.NOMINAL_Q)}
    {_keyframe_xml("lie", heights[1], robot.LIE_Q)}
  </keyframe>
</mujoco>
"""


def build_spec(plant: Plant | None = None) -> mujoco.MjSpec:
    """Create the model as an editable specification.

    Args:
        plant: Variable properties; None: the nominal robot.

    Returns:
        MuJoCo specification.
    """
    return mujoco.MjSpec.from_string(mjcf(plant))


def load_model(plant: Plant | None = None) -> mujoco.MjModel:
    """Create the compiled model.

    Args:
        plant: Variable properties; None: the nominal robot.

    Returns:
        Compiled MuJoCo model.
    """
    return mujoco.MjModel.from_xml_string(mjcf(plant))


def gravity_torque(model: mujoco.MjModel) -> np.ndarray:
    """Compute the joint torques that hold NOMINAL_Q while the four feet share the weight equally.

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
        body = model.body(f"{leg}_calf").id
        mujoco.mj_jac(model, data, jacobian, None, data.geom(f"{leg}_foot").xpos, body)
        torque -= jacobian[:, 6:].T @ [0.0, 0.0, weight / 4]
    return torque
