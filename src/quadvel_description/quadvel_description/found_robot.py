"""A quadruped found in an MJCF or URDF file: its twelve joints, matched to our names by place and chain.

Everything is stated in our convention: the frame of the trunk, x forward, y left, z up; hips turn
about +x, thighs and calves about +y. For the checks of what was found see `found_robot_checks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import attrs
import mujoco
import numpy as np

from .arrays import Array
from .inertia import Inertial, combine_inertials
from .quadruped import FRONT, JOINT_NAMES, KINDS, LEFT, LEGS

_AXES = {"hip": 0, "thigh": 1, "calf": 1}  # index of the axis in the trunk frame
_AXIS_TOLERANCE = 0.999  # cosine of the largest angle between an axis and x or y, 2.6 degrees
_HINGE, _FREE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)
_SPHERE, _MESH = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_MESH)


class UnsupportedRobotError(ValueError):
    """The file is not that of a quadruped with twelve joints.

    Attributes:
        code: Kind of the refusal, such as `arm`.
    """

    def __init__(self, path: Path, code: str, sentence: str) -> None:
        """Create the error.

        Args:
            path: The file.
            code: Kind of the refusal.
            sentence: What was found and what was expected.
        """
        super().__init__(f"{path}: {code}: {sentence}")
        self.code = code


SUFFIXES = (".xml", ".urdf", ".mjcf")
"""Suffixes of files that may describe a robot."""


@attrs.frozen(eq=False, kw_only=True)
class FoundJoint:
    """A joint of the file. A number that the file does not state is NaN.

    Attributes:
        name: Our name.
        source: Name in the file.
        number: Place among the hinges of the file, from 0.
        sign: 1, or -1 if the file turns it against our convention.
        anchor: Place of the joint at zero angles, (3,), m, trunk frame.
        lower: Mechanical range in our convention, rad.
        upper: Mechanical range in our convention, rad.
        torque: Largest torque, N m.
        speed: Largest speed, rad/s.
        armature: Reflected rotor inertia, kg m^2; 0: not stated.
        friction: Coulomb friction, N m.
        damping: Viscous friction, N m s/rad.
        inertial: Inertia of what it moves up to the next joint; relative to `anchor`, trunk axes.
    """

    name: str
    source: str
    number: int
    sign: int
    anchor: Array
    lower: float
    upper: float
    torque: float
    speed: float
    armature: float
    friction: float
    damping: float
    inertial: Inertial


@attrs.frozen(eq=False, kw_only=True)
class FoundRobot:
    """A quadruped of a file.

    Attributes:
        path: The file.
        name: Name of its model.
        joints: Joints in the order of JOINT_NAMES.
        trunk: Inertia of the trunk and all that is fixed to it, trunk frame.
        trunk_box: Corners of the trunk's shapes, (2, 3), m; None: the file has no simple shapes.
        feet: Centres of the foot spheres at zero angles, (4, 3), m, trunk frame; NaN: none found.
        foot_radii: Radii of the foot spheres, (4,), m; NaN: none found.
        imu: Place of the IMU, (3,), m, trunk frame; None: none found.
    """

    path: Path
    name: str
    joints: tuple[FoundJoint, ...]
    trunk: Inertial
    trunk_box: Array | None
    feet: Array
    foot_radii: Array
    imu: Array | None

    @property
    def mass(self) -> float:
        """Mass of all links, kg."""
        return self.trunk.mass + sum(joint.inertial.mass for joint in self.joints)

    @property
    def anchors(self) -> Array:
        """Joints at zero angles, (4, 3, 3), m: leg, kind, place in the trunk frame."""
        return np.array([joint.anchor for joint in self.joints]).reshape(len(LEGS), len(KINDS), 3)


def find_robot(path: Path) -> FoundRobot:
    """Find the quadruped in a file.

    Args:
        path: MJCF or URDF.

    Returns:
        What was found.

    Raises:
        FileNotFoundError: There is no such file.
        IsADirectoryError: It is a folder.
        UnsupportedRobotError: The file cannot be read, or its robot is no quadruped with twelve joints.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected an MJCF or URDF file")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: found no such file, expected an MJCF or URDF")
    if path.suffix.lower() not in SUFFIXES:
        raise UnsupportedRobotError(
            path, "suffix", f"found '{path.suffix}', expected {' or '.join(SUFFIXES)}"
        )
    return _Finder(path, _compile(path)).find()


def _compile(path: Path) -> mujoco.MjModel:
    """Compile a file without its meshes; the root of a URDF moves freely as that of an MJCF."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise UnsupportedRobotError(path, "file", f"no MJCF or URDF that MuJoCo can read: {error}") from None
    spec.compiler.fusestatic = False
    for geom in [geom for geom in spec.geoms if geom.type == _MESH]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for body in spec.bodies[1:]:
        _refuse_impossible_inertia(path, body)
    roots = spec.worldbody.bodies
    if roots and not roots[0].joints and not any(joint.type == _FREE for joint in spec.joints):
        roots[0].add_freejoint()
    try:
        return spec.compile()
    except ValueError as error:
        raise UnsupportedRobotError(path, "file", f"MuJoCo cannot compile it: {error}") from None


def _refuse_impossible_inertia(path: Path, body: mujoco.MjsBody) -> None:
    """Refuse an inertia that no rigid body has: A + B >= C > 0 for its principal moments."""
    if not body.explicitinertial:
        return
    if np.isfinite(body.fullinertia[0]):
        xx, yy, zz, xy, xz, yz = body.fullinertia
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        moments = np.sort(body.inertia)
    massless = body.mass == 0 and not moments.any()  # a frame, such as that of a sensor
    if massless or (body.mass > 0 and moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - 1e-6)):
        return
    found = f"mass {body.mass:g} kg and principal moments {np.array2string(moments, precision=3)} kg m^2"
    raise UnsupportedRobotError(
        path, "inertia", f"body {body.name}: found {found}, expected positive ones with A + B >= C"
    )


class _Finder:
    """Finds the parts of a quadruped in a compiled model at zero angles."""

    def __init__(self, path: Path, model: mujoco.MjModel) -> None:
        """Compute the places of all parts."""
        self.path, self.model = path, model
        self.hinges = [j for j in range(model.njnt) if model.jnt_type[j] == _HINGE]
        self._data = mujoco.MjData(model)
        self._data.qpos[model.jnt_qposadr[self.hinges]] = 0.0
        mujoco.mj_forward(model, self._data)

    def find(self) -> FoundRobot:
        """Return the quadruped."""
        legs = self._match_legs(self._chains())
        joints = tuple(
            self._joint(leg, kind, j) for leg in LEGS for kind, j in zip(KINDS, legs[leg], strict=True)
        )
        feet = [self._foot(legs[leg][-1]) for leg in LEGS]
        return FoundRobot(
            path=self.path,
            name=self.model.names[: self.model.names.index(b"\0")].decode(),
            joints=joints,
            trunk=self._inertial(self._trunk, np.zeros(3)),
            trunk_box=self._trunk_box(),
            feet=np.array([foot[:3] for foot in feet]),
            foot_radii=np.array([foot[3] for foot in feet]),
            imu=self._imu(),
        )

    def refusal(self, code: str, sentence: str) -> UnsupportedRobotError:
        """Create a refusal of the file."""
        return UnsupportedRobotError(self.path, code, sentence)

    def _names(self, joints: Sequence[int]) -> str:
        """Return the names of joints in the file."""
        return ", ".join(self.model.joint(j).name or f"joint {j} without a name" for j in joints)

    def _parent(self, joint: int) -> int | None:
        """Return the next hinge on the way to the trunk."""
        body = self.model.body_weldid[self.model.jnt_bodyid[joint]]
        above = self.model.body_weldid[self.model.body_parentid[body]]
        return next((j for j in self.hinges if self.model.jnt_bodyid[j] == above), None)

    def _chains(self) -> list[list[int]]:
        """Return the four chains of three hinges; anything else is refused."""
        others = [j for j in range(self.model.njnt) if self.model.jnt_type[j] not in (_HINGE, _FREE)]
        if others:
            raise self.refusal("joint_type", f"found no hinge at {self._names(others)}, expected hinges only")
        children: dict[int | None, list[int]] = {}
        for joint in self.hinges:
            children.setdefault(self._parent(joint), []).append(joint)
        chains = []
        for root in children.get(None, []):
            chain = [root]
            while below := children.get(chain[-1]):
                if len(below) > 1:
                    raise self.refusal("branch", f"found {len(below)} joints after {self._names(chain[-1:])}")
                chain += below
            chains.append(chain)
        self._refuse_other_robots(chains)
        return chains

    def _refuse_other_robots(self, chains: list[list[int]]) -> None:
        """Refuse wheels, an arm, and other numbers of joints."""
        limited = self.model.jnt_limited
        wheels = [chain[-1] for chain in chains if len(chain) == len(KINDS) + 1 and not limited[chain[-1]]]
        if wheels:
            raise self.refusal("wheels", f"found {self._names(wheels)} without end, expected feet")
        legs = [chain for chain in chains if len(chain) == len(KINDS)]
        extra = [joint for chain in chains if chain not in legs for joint in chain]
        if len(legs) == len(LEGS) and extra:
            raise self.refusal("arm", f"found {self._names(extra)} besides four legs, expected legs only")
        if len(self.hinges) != len(JOINT_NAMES) or len(legs) != len(LEGS):
            found = (
                f"{len(self.hinges)} in chains of {', '.join(str(len(chain)) for chain in chains) or 'none'}"
            )
            raise self.refusal("joint_count", f"found {found}, expected 12 in four chains of 3")
        self._trunk = self.model.body_weldid[
            self.model.body_parentid[self.model.body_weldid[self.model.jnt_bodyid[chains[0][0]]]]
        ]
        if self._trunk == 0:
            raise self.refusal("fixed_base", "found legs on the world, expected a trunk that moves freely")

    def _match_legs(self, chains: list[list[int]]) -> dict[str, list[int]]:
        """Match chains to legs by the places of their knees."""
        knees = np.array([self._place(self._data.xanchor[chain[-1]]) for chain in chains])
        signs = np.sign(knees - knees.mean(axis=0))[:, :2].astype(int).tolist()
        wanted = {leg: [FRONT[leg], LEFT[leg]] for leg in LEGS}
        if sorted(signs) != sorted(wanted.values()):
            raise self.refusal(
                "legs", f"found knees at {knees.round(3).tolist()} m, expected one in each quarter"
            )
        return {leg: chains[signs.index(wanted[leg])] for leg in LEGS}

    def _place(self, point: Array) -> Array:
        """Return a place of the world in the frame of the trunk."""
        return self._rotation.T @ (point - self._data.xpos[self._trunk])

    @property
    def _rotation(self) -> Array:
        """Axes of the trunk in the world, (3, 3)."""
        return self._data.xmat[self._trunk].reshape(3, 3)

    def _joint(self, leg: str, kind: str, j: int) -> FoundJoint:
        """Return a joint in our convention."""
        model, address = self.model, self.model.jnt_dofadr[j]
        axis = self._rotation.T @ self._data.xaxis[j]
        if abs(axis[_AXES[kind]]) < _AXIS_TOLERANCE:
            raise self.refusal(
                "axis",
                f"{self._names([j])} ({leg} {kind}): found {axis.round(3).tolist()} at zero angles, "
                f"expected {'xyz'[_AXES[kind]]} of the trunk",
            )
        sign = int(np.sign(axis[_AXES[kind]]))
        limits = sorted(sign * model.jnt_range[j]) if model.jnt_limited[j] else (np.nan, np.nan)
        anchor = self._place(self._data.xanchor[j])
        torque, speed = self._limits(j)
        return FoundJoint(
            name=f"{leg}_{kind}_joint",
            source=model.joint(j).name,
            number=self.hinges.index(j),
            sign=sign,
            anchor=anchor,
            lower=float(limits[0]),
            upper=float(limits[1]),
            torque=torque,
            speed=speed,
            armature=float(model.dof_armature[address]),
            friction=float(model.dof_frictionloss[address]),
            damping=float(model.dof_damping[address]),
            inertial=self._inertial(model.body_weldid[model.jnt_bodyid[j]], anchor),
        )

    def _limits(self, j: int) -> tuple[float, float]:
        """Return the largest torque, N m, and speed, rad/s, of a joint; NaN: not stated."""
        model = self.model
        if self.path.suffix == ".urdf":
            tree = ElementTree.parse(self.path).getroot()
            limit = tree.find(f"./joint[@name='{model.joint(j).name}']/limit")
            effort, velocity = (
                float(0 if limit is None else limit.get(name, 0)) for name in ("effort", "velocity")
            )
            return effort or np.nan, velocity or np.nan
        torques = [model.jnt_actfrcrange[j, 1]] if model.jnt_actfrclimited[j] else []
        for i in np.flatnonzero(model.actuator_trnid[:, 0] == j):
            gear = abs(model.actuator_gear[i, 0])
            if model.actuator_forcelimited[i]:
                torques.append(gear * model.actuator_forcerange[i, 1])
            elif model.actuator_ctrllimited[i] and not model.actuator_biastype[i]:  # a motor
                torques.append(gear * model.actuator_gainprm[i, 0] * model.actuator_ctrlrange[i, 1])
        return (float(min(torques)) if torques else np.nan), np.nan

    def _inertial(self, moving: int, origin: Array) -> Inertial:
        """Return the inertia of a moving body and all that is fixed to it, about a place, trunk axes."""
        parts = []
        for body in np.flatnonzero(self.model.body_weldid == moving):
            rotation = self._rotation.T @ self._data.ximat[body].reshape(3, 3)
            tensor = rotation @ np.diag(self.model.body_inertia[body]) @ rotation.T
            place = self._place(self._data.xipos[body]) - origin
            if self.model.body_mass[body] > 0:
                parts.append(Inertial(float(self.model.body_mass[body]), place, tensor))
        if not parts:
            name = self.model.body(moving).name
            raise self.refusal("inertia", f"body {name}: found no mass, expected one")
        return combine_inertials(parts)

    def _geoms(self, moving: int) -> list[int]:
        """Return the shapes of a moving body and all that is fixed to it."""
        return np.flatnonzero(self.model.body_weldid[self.model.geom_bodyid] == moving).tolist()

    def _foot(self, calf: int) -> tuple[float, float, float, float]:
        """Return centre and radius of the lowest sphere on a calf; NaN: it has none."""
        geoms = self._geoms(self.model.body_weldid[self.model.jnt_bodyid[calf]])
        spheres = [geom for geom in geoms if self.model.geom_type[geom] == _SPHERE]
        if not spheres:
            return (np.nan,) * 4
        foot = min(spheres, key=lambda geom: self._data.geom_xpos[geom, 2])
        x, y, z = self._place(self._data.geom_xpos[foot])
        return x, y, z, float(self.model.geom_size[foot, 0])

    def _trunk_box(self) -> Array | None:
        """Return the corners of a box about the trunk's shapes, trunk axes."""
        corners = []
        for geom in self._geoms(self._trunk):
            centre, half = self.model.geom_aabb[geom].reshape(2, 3)
            rotation = self._data.geom_xmat[geom].reshape(3, 3)
            middle = self._place(self._data.geom_xpos[geom] + rotation @ centre)
            reach = np.abs(self._rotation.T @ rotation) @ half
            corners.append((middle - reach, middle + reach))
        if not corners:
            return None
        low, high = np.swapaxes(corners, 0, 1)
        return np.array([low.min(axis=0), high.max(axis=0)])

    def _imu(self) -> Array | None:
        """Return the place of a site or body with `imu` in its name."""
        for i in range(self.model.nsite):
            if "imu" in self.model.site(i).name.lower():
                return self._place(self._data.site_xpos[i])
        for i in range(self.model.nbody):
            if "imu" in self.model.body(i).name.lower():
                return self._place(self._data.xpos[i])
        return None
