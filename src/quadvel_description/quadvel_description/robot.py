"""One `Robot` holds all numbers of a robot: `load_robot("aliengo")` reads its folder.

The folder of a robot, `robots/<name>` or one elsewhere, holds

    robot.yaml     numbers that no model file has: postures, gains, limits, friction, the drive
    robot.urdf     links, inertias and ranges of the joints; also shown by RViz and Foxglove
    robot.xml      MJCF with the shapes that touch the ground, for the simulation
    actuator.yaml  actuator model, read by `quadvel_actuator`; without it, a plain PD law

`quadvel robot check` writes the first three for a new robot (`robot_folder`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from .arrays import Array
from .fields import field, positive, refusal, to_array
from .inertia import Inertial, combine_inertials
from .quadruped import JOINT_NAMES, LEGS
from .records import read_document, structure_record
from .robot_name import ROBOTS, UNNAMED_ROBOT, described_robot, shipped_robots
from .symmetry import mirror_joints
from .urdf import read_links

SCHEMA = 1
UNDECIDED = "to_decide"
"""Value of a field in a `robot.yaml` that its user still has to decide."""


@cache
def load_robot(robot: str) -> Robot:
    """Load a robot. Equal arguments give the same value.

    Args:
        robot: Name of a shipped robot, or path of a folder or of its `robot.yaml`.

    Returns:
        The robot.

    Raises:
        FileNotFoundError: There is no such robot, or a file of its folder is missing.
        ValueError: The path is another kind of file, or a file of its folder is wrong; the message names
            file, field, value found and expectation.
    """
    path = Path(robot) if robot not in shipped_robots() else ROBOTS / robot
    file = path / "robot.yaml" if path.is_dir() else path
    if not file.is_file():
        names = ", ".join(shipped_robots())
        raise FileNotFoundError(
            f"robot: found {robot!r}, expected {names} or the path of a robot.yaml or of its folder"
        )
    if file.suffix not in (".yaml", ".yml"):
        raise ValueError(
            f"robot: found {robot!r}, expected a robot.yaml or its folder; `quadvel robot check` writes one "
            "from an MJCF or URDF"
        )
    fields = read_document(file, "a YAML file of a robot", SCHEMA)
    if undecided := [name for name, value in fields.items() if value == UNDECIDED]:
        raise ValueError(f"{file}: {', '.join(undecided)}: found {UNDECIDED!r}, expected your numbers")
    urdf = file.parent / "robot.urdf"
    links = read_links(urdf)
    found = structure_record(Robot, {**fields, "links": links, "folder": str(file.parent)}, file)
    described = described_robot(urdf.read_text(encoding="utf-8"))
    if described not in (None, found.name):
        raise ValueError(
            f"{file}: name: found {found.name!r}, expected {described!r} as in robot.urdf; for a new name write "
            f"robot.urdf again: python -m quadvel_description.urdf_generator {file.parent}"
        )
    return found


def is_robot(chosen: str) -> bool:
    """Return whether this names a robot, not another kind of file such as a URDF.

    Args:
        chosen: Name or path.

    Returns:
        True for a shipped robot, a folder, or a YAML file.
    """
    return chosen in shipped_robots() or Path(chosen).suffix == ".yaml" or Path(chosen).is_dir()


def robot_of_file(
    path: Path,
    named: str | None,
    asked: str | None,
    assumed: str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Robot:
    """Load the robot of a recording or another file.

    Args:
        path: The file.
        named: Name of the robot in the file, or None.
        asked: Name or file of the robot that was asked for, or None for that of the file.
        assumed: Name of the robot if the file names none and none was asked for; None: UNNAMED_ROBOT.
        notify: Called with one sentence if the robot is assumed.

    Returns:
        The robot that was asked for, else the one that the file names, else the assumed one.

    Raises:
        ValueError: The file names another robot than the one that was asked for.
        FileNotFoundError: There is no such robot.
    """
    if asked is None:
        if named and named not in shipped_robots():
            raise FileNotFoundError(
                f"{path}: its robot is {named!r}, which is not shipped: name its folder by --robot"
            )
        robot = load_robot(named or assumed or UNNAMED_ROBOT)
        if notify and not named:
            notify(f"robot: the file names none, {robot.title} is assumed: --robot chooses another")
        return robot
    robot = load_robot(asked)
    if named not in (None, robot.name):
        raise ValueError(f"{path}: robot is {named!r}, expected {robot.name!r}")
    return robot


def _per_joint(value: Any) -> Any:
    """Expand one number, three (hip, thigh, calf) or twelve to a read-only array, (12,)."""
    array = to_array(None, value)
    if isinstance(array, np.ndarray) and array.shape == (3,):
        return to_array(None, np.tile(array, len(LEGS)))
    return to_array(len(JOINT_NAMES), value)


def _joints(
    description: str,
    default: Any = attrs.NOTHING,
    *,
    at_least: float = -np.inf,
    above: float = -np.inf,
    at_most: float = np.inf,
) -> Any:
    """Declare a field with a number for each joint."""
    bounds = (("at least", at_least), ("above", above), ("at most", at_most))
    limit = "".join(f", {word} {bound:g} {description}" for word, bound in bounds if np.isfinite(bound))

    def check(robot: object, attribute: attrs.Attribute[Any], value: Any) -> None:
        """Refuse anything but twelve finite numbers within the limits."""
        is_vector = isinstance(value, np.ndarray) and value.shape == (len(JOINT_NAMES),)
        in_range = is_vector and np.isfinite(value) & (value >= at_least) & (value > above) & (
            value <= at_most
        )
        if not np.all(in_range):
            expected = f"1, 3 (hip, thigh, calf) or 12 finite numbers{limit}"
            raise refusal(robot, attribute.name, value, expected)

    return attrs.field(
        default=default, converter=_per_joint, validator=check, metadata={"description": description}
    )


@attrs.frozen(eq=False, kw_only=True)
class Link:
    """A link of the robot, with the joint to its parent.

    Attributes:
        name: Name of the link.
        parent: Name of its parent; None for the trunk.
        joint: Name of the joint if it moves, else None.
        axis: Axis of the joint, `x` or `y`; None: fixed.
        origin: Origin of the joint in the parent frame, (3,), m.
        inertial: Inertia of the link.
        lower: Mechanical range of the joint, rad.
        upper: Mechanical range of the joint, rad.
    """

    name: str
    parent: str | None
    joint: str | None
    axis: str | None
    origin: tuple[float, float, float]
    inertial: Inertial
    lower: float = 0.0
    upper: float = 0.0


@attrs.frozen(eq=False)
class LegGeometry:
    """Lengths of the legs, for `kinematics`.

    Attributes:
        hips: Hip joints in the trunk frame, (4, 3), m.
        lateral: Thigh joint to the left of the hip joint, (4,), m.
        links: z of the vectors along thigh and calf if all angles are zero, (2,), m, negative.
        thigh: Length of the thighs, m.
        calf: Length of the calves to the centre of the foot sphere, m.
        knees: Sign of the calf angle in the nominal posture, (4,); -1: the knee bends backward.
    """

    hips: Array
    lateral: Array
    links: Array
    thigh: float
    calf: float
    knees: Array


@attrs.frozen(kw_only=True)
class Drive:
    """How the robot's drives are reached.

    Attributes:
        board: Protocol of the robot's board, `unitree_udp` or `unitree_dds`; `external`: software
            outside this project publishes `low_state` and obeys `low_cmd`.
        no_state_hint: What to check if no state arrives.
        dropped_out_mode: Mode of a motor that the board has switched off; None: unknown.
    """

    board: str = field("external", one_of=("external", "unitree_udp", "unitree_dds"))
    no_state_hint: str = ""
    dropped_out_mode: int | None = None


@attrs.frozen(eq=False, kw_only=True)
class Robot:
    """All numbers of a robot. Joint order as in `quadruped.JOINT_NAMES`; all arrays are read-only.

    The largest values accepted are far above those of any such robot: they refuse other units, such as
    millimetres, degrees or turns per minute, and kg cm^2.

    Attributes:
        name: Name of the robot in files.
        title: Name of the robot in texts.
        folder: Folder of its files.
        kp: Usual proportional gain, N m/rad.
        kd: Usual derivative gain, N m s/rad.
        nominal_q: Joint positions of the stance, (12,), rad.
        lie_q: Joint positions lying, (12,), rad.
        suspended_height: Trunk above ground if the robot is held in the air, m.
        torque_limit: Largest torque, (12,), N m.
        velocity_limit: Speed at which the drive has no torque left, (12,), rad/s.
        armature: Reflected rotor inertia, (12,), kg m^2.
        joint_friction: Coulomb friction, (12,), N m.
        joint_damping: Viscous friction, (12,), N m s/rad.
        foot_radius: Radius of the foot spheres, m.
        drive: How its drives are reached.
        links: Links, parents before their children.
        joint_links: Links that a joint moves, 12.
        lower: Mechanical range, (12,), rad.
        upper: Mechanical range, (12,), rad.
        command_lower: Least joint target that the drives accept, (12,), rad; the default is `lower`.
        command_upper: Largest joint target that the drives accept, (12,), rad; the default is `upper`.
        mass: Mass of all links, kg.
        legs: Lengths of the legs.
        nominal_height: Trunk above ground in the stance, m, to 0.1 mm.
        lie_height: Trunk above ground lying, m, to 0.1 mm.
    """

    name: str
    title: str
    folder: Path = attrs.field(converter=Path)
    kp: float = positive()
    kd: float = positive()
    nominal_q: Array = _joints("stance, rad")
    lie_q: Array = _joints("lying, rad")
    suspended_height: float = positive(at_most=5.0)
    torque_limit: Array = _joints("N m", above=0.0)
    velocity_limit: Array = _joints("rad/s", above=0.0, at_most=100.0)
    armature: Array = _joints("kg m^2", at_least=0.0, at_most=1.0)
    joint_friction: Array = _joints("N m", at_least=0.0)
    joint_damping: Array = _joints("N m s/rad", at_least=0.0)
    foot_radius: float = positive(at_most=0.1)
    drive: Drive = Drive()
    links: tuple[Link, ...]
    joint_links: tuple[Link, ...] = attrs.field(init=False)
    lower: Array = attrs.field(init=False)
    upper: Array = attrs.field(init=False)
    command_lower: Array = _joints("rad", attrs.Factory(lambda robot: robot.lower, takes_self=True))
    command_upper: Array = _joints("rad", attrs.Factory(lambda robot: robot.upper, takes_self=True))
    mass: float = attrs.field(init=False)
    legs: LegGeometry = attrs.field(init=False)
    nominal_height: float = attrs.field(init=False)
    lie_height: float = attrs.field(init=False)

    @joint_links.default
    def _joint_links(self) -> tuple[Link, ...]:
        links = {link.joint: link for link in self.links}
        return tuple(links[name] for name in JOINT_NAMES)

    @lower.default
    def _lower(self) -> Array:
        return _per_joint([link.lower for link in self.joint_links])

    @upper.default
    def _upper(self) -> Array:
        return _per_joint([link.upper for link in self.joint_links])

    @mass.default
    def _mass(self) -> float:
        return sum(link.inertial.mass for link in self.links)

    @legs.default
    def _legs(self) -> LegGeometry:
        return _leg_geometry(self)

    @nominal_height.default
    def _nominal_height(self) -> float:
        return _height(self, self.nominal_q)

    @lie_height.default
    def _lie_height(self) -> float:
        return _height(self, self.lie_q)

    def __attrs_post_init__(self) -> None:
        """Refuse postures and command limits out of range, and postures that are not left-right symmetric."""
        for name in ("nominal_q", "lie_q", "command_lower", "command_upper"):
            q = getattr(self, name)
            if (outside := (q < self.lower) | (q > self.upper)).any():
                i = int(np.argmax(outside))
                expected = f"{self.lower[i]} to {self.upper[i]} at {JOINT_NAMES[i]}, its range in robot.urdf"
                raise refusal(self, name, float(q[i]), expected)
        for name in ("nominal_q", "lie_q"):
            if not np.array_equal(mirror_joints(q := getattr(self, name)), q):
                raise refusal(self, name, q, "left and right legs that are mirror images")

    @property
    def urdf_file(self) -> Path:
        """URDF: links, inertias, ranges."""
        return self.folder / "robot.urdf"

    @property
    def mjcf_file(self) -> Path:
        """MJCF: the model of the simulation."""
        return self.folder / "robot.xml"

    @property
    def actuator_file(self) -> Path:
        """Actuator model of the simulation."""
        return self.folder / "actuator.yaml"

    def require_board(self) -> str:
        """Return the protocol of the robot's board.

        Returns:
            `unitree_udp` or `unitree_dds`.

        Raises:
            ValueError: The robot is driven by software outside this project.
        """
        if self.drive.board == "external":
            raise ValueError(
                f"{self.folder}/robot.yaml: drive.board: found 'external', expected unitree_udp or "
                "unitree_dds; other robots are driven by their own software (--low-level external)"
            )
        return self.drive.board

    def combined_inertial(self, name: str) -> Inertial:
        """Compute the inertia of a moving link together with everything that is fixed to it.

        Args:
            name: Name of the link.

        Returns:
            Inertia in the link's frame.
        """
        own = next(link for link in self.links if link.name == name)
        fixed = [link for link in self.links if link.parent == name and link.axis is None]
        return combine_inertials([own.inertial, *(link.inertial.translated(link.origin) for link in fixed)])


def _leg_geometry(robot: Robot) -> LegGeometry:
    """Compute the lengths of the legs from the links; legs of another shape are refused."""
    links = {link.name: link for link in robot.links}

    def origins(kind: str) -> Array:
        """Origins of one kind of link, (4, 3)."""
        if missing := [leg for leg in LEGS if f"{leg}_{kind}" not in links]:
            raise ValueError(f"{robot.urdf_file}: link {missing[0]}_{kind}: found none, expected one")
        return np.array([links[f"{leg}_{kind}"].origin for leg in LEGS])

    def length(kind: str) -> float:
        """Distance of a joint below its parent; the same on all legs."""
        found = origins(kind)
        if found[:, :2].any() or np.ptp(found[:, 2]) or found[0, 2] >= 0:
            raise ValueError(
                f"{robot.urdf_file}: origins of the {kind} links: found {found.tolist()}, "
                "expected the same place straight below the joint before, on all legs"
            )
        return -float(found[0, 2])

    thighs = origins("thigh")
    if thighs[:, (0, 2)].any():
        raise ValueError(
            f"{robot.urdf_file}: origins of the thigh links: found {thighs.tolist()}, expected y only"
        )
    thigh, calf = length("calf"), length("foot")
    return LegGeometry(
        hips=to_array(None, origins("hip")),
        lateral=to_array(None, thighs[:, 1]),
        links=to_array(None, [-thigh, -calf]),
        thigh=thigh,
        calf=calf,
        knees=to_array(None, np.sign(robot.nominal_q[2::3])),
    )


def _height(robot: Robot, q: Array) -> float:
    """Return the trunk above level ground, m, to 0.1 mm, if the feet of a posture (12,), rad, stand on it."""
    # Foot centre below the trunk's origin: with the angles h, t, c of hip, thigh, calf,
    # z = z_hip + lateral sin(h) - (l_thigh cos(t) + l_calf cos(t + c)) cos(h).
    legs, (hip, thigh, calf) = robot.legs, q.reshape(len(LEGS), 3).T
    length = legs.thigh * np.cos(thigh) + legs.calf * np.cos(thigh + calf)
    feet = legs.hips[:, 2] + legs.lateral * np.sin(hip) - length * np.cos(hip)
    return round(robot.foot_radius - float(feet.min()), 4)
