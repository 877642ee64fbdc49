"""Numbers of the AlienGo: joints, limits, postures, inertias; all models derive from them.

Sources. Kinematics and inertias: Unitree's `aliengo_description` (xacro of November 2022, BSD-3),
inertias about each link's centre of mass. Command limits: Unitree's SDK (`aliengo_const.h`).
Armature and joint friction: rounded mean of the two public identifications of a real, suspended
AlienGo by IIT's DLS lab (chirps).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import attrs
import numpy as np

LEGS = ("FR", "FL", "RR", "RL")
KINDS = ("hip", "thigh", "calf")
JOINT_NAMES = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in KINDS)
FRONT = {"FR": 1, "FL": 1, "RR": -1, "RL": -1}  # sign of x
LEFT = {"FR": -1, "FL": 1, "RR": -1, "RL": 1}  # sign of y

HIP_OFFSET = (0.2407, 0.051)  # trunk to hip joint, |x| and |y|, m
THIGH_OFFSET = 0.0868  # hip to thigh joint, |y|, m
THIGH_LENGTH = 0.25  # m
CALF_LENGTH = 0.25  # to the centre of the foot sphere, m
FOOT_RADIUS = 0.0265  # m

KP = 30.0  # N m/rad, Section 4.1 of the paper
KD = 0.5  # N m s/rad

GRAVITY = 9.81  # m/s^2


def _per_leg(hip: float, thigh: float, calf: float) -> np.ndarray:
    """Return the same three values for every leg, (12,), read-only."""
    values = np.tile([hip, thigh, calf], 4).astype(float)
    values.flags.writeable = False
    return values


def _hip_range(inward: float, outward: float) -> tuple[list[float], list[float]]:
    """Return lower and upper hip limits per leg.

    Positive hip angles move a left foot outward and a right foot inward.
    """
    lower = [-inward if LEFT[leg] > 0 else -outward for leg in LEGS]
    upper = [outward if LEFT[leg] > 0 else inward for leg in LEGS]
    return lower, upper


def _with_hips(hips: list[float], thigh: float, calf: float) -> np.ndarray:
    """Return joint values, (12,), read-only; hips differ, thighs and calves are equal."""
    values = np.array([angle for hip in hips for angle in (hip, thigh, calf)])
    values.flags.writeable = False
    return values


NOMINAL_Q = _per_leg(0.0, 0.6435, -1.287)  # rad, stance: feet 0.4 m below the hips
LIE_Q = _per_leg(0.0, 1.343, -2.696)  # rad
NOMINAL_HEIGHT = 0.4265  # m, trunk above ground in NOMINAL_Q
LIE_HEIGHT = 0.137  # m
SUSPENDED_HEIGHT = 1.0  # m, trunk above ground if the robot is held in the air

# mechanical range
LOWER = _per_leg(-1.2217305, -2.0943951, -2.7750735)
UPPER = _per_leg(1.2217305, 4.1887902, -0.6457718)
# command range: intersection of the mechanical range and the limits of the SDK
_HIP_LOWER, _HIP_UPPER = _hip_range(inward=0.873, outward=1.047)
COMMAND_LOWER = _with_hips(_HIP_LOWER, -0.524, -2.775)
COMMAND_UPPER = _with_hips(_HIP_UPPER, 3.927, -0.646)

TORQUE_LIMIT = _per_leg(35.278, 35.278, 44.4)  # N m
VELOCITY_LIMIT = _per_leg(20.0, 20.0, 15.89)  # rad/s

ARMATURE = _per_leg(0.015, 0.015, 0.023)  # kg m^2, reflected rotor inertia
FRICTION = _per_leg(0.45, 0.30, 0.37)  # N m, Coulomb
DAMPING = _per_leg(0.2, 0.2, 0.27)  # N m s/rad

IMU_POSITION = (0.0, 0.0, 0.0)  # in the trunk frame


@attrs.frozen
class Inertial:
    """Inertia of a rigid body.

    Attributes:
        mass: Mass, kg.
        com: Centre of mass, (3,), m, link frame.
        tensor: Inertia tensor about the centre of mass, (3, 3), kg m^2, link axes.
    """

    mass: float
    com: np.ndarray
    tensor: np.ndarray

    def translated(self, offset: Sequence[float]) -> Inertial:
        """Return the same body in a frame in which the link's origin lies at an offset.

        Args:
            offset: Position of the link's origin, (3,), m.

        Returns:
            The inertia in that frame.
        """
        return attrs.evolve(self, com=self.com + np.asarray(offset, float))

    def fullinertia(self) -> list[float]:
        """Return the tensor as MuJoCo's `fullinertia`.

        Returns:
            [ixx, iyy, izz, ixy, ixz, iyz], kg m^2.
        """
        t = self.tensor
        return [t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]]


def combine_inertials(parts: Iterable[Inertial]) -> Inertial:
    """Combine rigid bodies that are fixed to each other.

    Args:
        parts: Inertias in a common frame.

    Returns:
        Inertia of the combined body.
    """
    parts = list(parts)
    # Parallel-axis theorem: I = sum of I_i + m_i (d.d 1 - d d^T), d from the common centre of mass.
    mass = sum(p.mass for p in parts)
    com = sum((p.mass * p.com for p in parts), np.zeros(3)) / mass
    tensor = np.zeros((3, 3))
    for p in parts:
        d = p.com - com
        tensor += p.tensor + p.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Inertial(mass, com, tensor)


def _inertial(mass: float, com: Sequence[float], full: Sequence[float]) -> Inertial:
    """Return an inertia from MuJoCo's `fullinertia` order."""
    ixx, iyy, izz, ixy, ixz, iyz = full
    return Inertial(mass, np.array(com), np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]))


_TRUNK = _inertial(
    11.644,
    (0.008811, 0.003839, 0.000273),
    (0.051944892, 0.24693924, 0.270948307, 0.001703617, 0.000235941, 0.000119783),
)
_IMU = _inertial(0.001, (0, 0, 0), (1e-4, 1e-4, 1e-4, 0, 0, 0))
_CALF = _inertial(
    0.207,
    (0.002781, 0.000063, -0.142518),
    (0.002129279, 0.002141463, 0.000037583, 0.000000039, 0.000005757, -0.000000516),
)
_FOOT = _inertial(0.060, (0, 0, 0), (1.6854e-5, 1.6854e-5, 1.6854e-5, 0, 0, 0))
_HIP_ROTOR = _inertial(0.146, (0, 0, 0), (0.000138702, 0.000083352, 0.000083352, 0, 0, 0))
_THIGH_ROTOR = _inertial(0.146, (0, 0, 0), (0.000083352, 0.000138702, 0.000083352, 0, 0, 0))
_CALF_ROTOR = _inertial(0.132, (0, 0, 0), (0.000145463, 0.000133031, 0.000145463, 0, 0, 0))


@attrs.frozen
class Link:
    """A link of the robot.

    Attributes:
        name: Name of the link.
        parent: Name of its parent; None for the trunk.
        axis: Axis of its joint, `x` or `y`; None: fixed.
        origin: Origin of the joint in the parent frame, (3,), m.
        inertial: Inertia of the link.
    """

    name: str
    parent: str | None
    axis: str | None
    origin: tuple[float, float, float]
    inertial: Inertial


def _leg_links(leg: str) -> list[Link]:
    """Return the links of a leg."""
    sx, sy = FRONT[leg], LEFT[leg]
    hip = _inertial(
        1.993,
        (-0.022191 * sx, 0.015144 * sy, -0.000015),
        (0.002446735, 0.003925876, 0.004148145, -0.00059805 * sx * sy, 0.000001945 * sx, 0.000001284 * sy),
    )
    thigh = _inertial(
        0.639,
        (-0.005607, -0.003877 * sy, -0.048199),
        (0.004173855, 0.004343802, 0.000340136, 0.000010284 * sy, -0.000318874, 0.000109233 * sy),
    )
    hip_x, hip_y = HIP_OFFSET[0] * sx, HIP_OFFSET[1] * sy
    return [
        Link(f"{leg}_hip", "trunk", "x", (hip_x, hip_y, 0.0), hip),
        Link(f"{leg}_hip_rotor", "trunk", None, (0.139985 * sx, hip_y, 0.0), _HIP_ROTOR),
        Link(f"{leg}_thigh", f"{leg}_hip", "y", (0.0, THIGH_OFFSET * sy, 0.0), thigh),
        Link(f"{leg}_thigh_rotor", f"{leg}_hip", None, (0.0, 0.0298 * sy, 0.0), _THIGH_ROTOR),
        Link(f"{leg}_calf", f"{leg}_thigh", "y", (0.0, 0.0, -THIGH_LENGTH), _CALF),
        Link(f"{leg}_calf_rotor", f"{leg}_thigh", None, (0.0, -0.0997 * sy, 0.0), _CALF_ROTOR),
        Link(f"{leg}_foot", f"{leg}_calf", None, (0.0, 0.0, -CALF_LENGTH), _FOOT),
    ]


LINKS: tuple[Link, ...] = (
    Link("trunk", None, None, (0.0, 0.0, 0.0), _TRUNK),
    Link("imu_link", "trunk", None, IMU_POSITION, _IMU),
    *(link for leg in LEGS for link in _leg_links(leg)),
)
MASS = sum(link.inertial.mass for link in LINKS)  # kg


def combined_inertial(name: str) -> Inertial:
    """Return the inertia of a moving link together with everything that is fixed to it.

    Args:
        name: Name of the link.

    Returns:
        Inertia in the link's frame.
    """
    own = next(link for link in LINKS if link.name == name)
    fixed = [link for link in LINKS if link.parent == name and link.axis is None]
    return combine_inertials([own.inertial, *(link.inertial.translated(link.origin) for link in fixed)])


def joint_index(names: Sequence[str]) -> list[int]:
    """Find joints in JOINT_NAMES.

    Args:
        names: Joint names, with or without `_joint`.

    Returns:
        Index of each joint.

    Raises:
        ValueError: A name is unknown; the message names it.
    """
    index = {name: i for i, name in enumerate(JOINT_NAMES)}
    found = []
    for name in names:
        full = name if name.endswith("_joint") else f"{name}_joint"
        if full not in index:
            raise ValueError(f"joint names: found {name!r}, expected one of {', '.join(JOINT_NAMES)}")
        found.append(index[full])
    return found
