"""Observation and action of a policy: the input of its network and the meaning of its output.

Training, simulation and the robot all use this module, and the policy file contains its parameters
as metadata, so they cannot disagree. The module runs no network; `policy_file` does.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.arrays import Array
from quadvel_description.kinematics import roll_pitch as roll_pitch_of
from quadvel_description.network_input import InputLayout as ObservationSpec
from quadvel_description.network_input import InputTerm as ObservationTerm
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.recurrent_network import SCHEMA
from quadvel_description.robot import Robot
from quadvel_description.robot_name import UNNAMED_ROBOT
from quadvel_description.state import RobotState

RATE_HZ = 200.0
CONTROL_PERIOD_S = 1.0 / RATE_HZ
"""Time between two ticks of the controller, s."""
JOINTS = len(JOINT_NAMES)
COMMAND_AXES = ("vx", "vy", "wz")
OBSERVATION_SIZES = {
    "command": 4,  # vx, vy (m/s), wz (rad/s), stance (0 or 1)
    "roll_pitch": 2,  # rad
    "q": JOINTS,  # rad
    "dq": JOINTS,  # rad/s
    "linear_velocity": 3,  # m/s, body frame
    "angular_velocity": 3,  # rad/s, body frame
    "previous_action": JOINTS,  # raw network output of the previous tick
}

OBSERVATION_SIZE = sum(OBSERVATION_SIZES.values())
"""Length of the observation of the paper's Section 4.1, 48."""

Vector = tuple[float, ...]
Bounds = tuple[float, float]


@cache
def default_observation(robot: Robot) -> ObservationSpec:
    """Create the observation of the paper's Section 4.1, each number with a magnitude of about 1 in a walk.

    Args:
        robot: The robot, whose nominal posture is the offset of the joint positions.

    Returns:
        The terms, OBSERVATION_SIZE numbers.
    """
    return ObservationSpec(
        (
            ObservationTerm("command", 4),
            ObservationTerm("roll_pitch", 2, scale=2.0, clip=10.0),
            ObservationTerm("q", JOINTS, offset=tuple(robot.nominal_q), scale=2.0, clip=10.0),
            ObservationTerm("dq", JOINTS, scale=0.1, clip=10.0),
            ObservationTerm("linear_velocity", 3, clip=10.0),
            ObservationTerm("angular_velocity", 3, scale=0.5, clip=10.0),
            ObservationTerm("previous_action", JOINTS, clip=10.0),
        )
    )


def build_observation(
    spec: ObservationSpec,
    *,
    command: ArrayLike,
    q: ArrayLike,
    dq: ArrayLike,
    linear_velocity: ArrayLike,
    angular_velocity: ArrayLike,
    previous_action: ArrayLike,
    quaternion: ArrayLike | None = None,
    roll_pitch: ArrayLike | None = None,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Build the network input, clip((value - offset) * scale) of each term.

    All arrays have the same leading axes (...). The orientation is either `quaternion` or
    `roll_pitch`. NaN stays NaN, but clipping hides infinity, so check for it before.

    Args:
        spec: Terms of the observation.
        command: vx, vy (m/s), wz (rad/s), stance (0 or 1), (..., 4).
        q: Joint angles, (..., 12), rad.
        dq: Joint speeds, (..., 12), rad/s.
        linear_velocity: Velocity of the trunk, body frame, (..., 3), m/s.
        angular_velocity: Angular velocity of the trunk, body frame, (..., 3), rad/s.
        previous_action: Raw network output of the previous tick, (..., 12).
        quaternion: Orientation (w, x, y, z), body to world, (..., 4).
        roll_pitch: Roll and pitch, (..., 2), rad.
        out: Array to write to, (..., spec.size).

    Returns:
        The observation, (..., spec.size), float32; `out` if given.

    Raises:
        TypeError: Not exactly one of `quaternion` and `roll_pitch` is given.
    """
    if (quaternion is None) == (roll_pitch is None):
        raise TypeError("build_observation() needs exactly one of quaternion and roll_pitch")
    observation = spec.build(
        {
            "command": command,
            "roll_pitch": roll_pitch_of(np.asarray(quaternion)) if roll_pitch is None else roll_pitch,
            "q": q,
            "dq": dq,
            "linear_velocity": linear_velocity,
            "angular_velocity": angular_velocity,
            "previous_action": previous_action,
        }
    )
    if out is None:
        return observation
    out[...] = observation
    return out


def ticks_per_step(rate_hz: float) -> int:
    """Return for how many ticks of the control loop an action of a policy is held.

    Args:
        rate_hz: Rate of the policy, Hz.

    Returns:
        Whole number of ticks, at least 1.
    """
    return max(round(RATE_HZ / rate_hz), 1)


class Observer:
    """Builds the input of a policy's network from what is measured."""

    def __init__(self, spec: ObservationSpec) -> None:
        """Create an observer.

        Args:
            spec: Terms of the observation.
        """
        self._spec = spec

    def reset(self) -> None:
        """Forget past observations."""

    def observe(
        self, state: RobotState, velocity: ArrayLike, command: ArrayLike, previous_action: ArrayLike
    ) -> NDArray[np.float32]:
        """Build the observation of one step.

        Args:
            state: The measured state.
            velocity: Velocity of the trunk, body frame, (3,), m/s.
            command: vx, vy (m/s), wz (rad/s), stance (0 or 1), (4,).
            previous_action: Output of the network at its previous step, (12,).

        Returns:
            The network input, (n,).
        """
        return build_observation(
            self._spec,
            command=command,
            quaternion=state.quaternion,
            q=state.q,
            dq=state.dq,
            linear_velocity=velocity,
            angular_velocity=state.angular_velocity,
            previous_action=previous_action,
        )


class MetadataError(ValueError):
    """Invalid metadata of a policy; the text names the field, the value found and the value expected."""


def _metadata_error(field: str, found: object, expected: str) -> MetadataError:
    shown = repr(found)
    shown = shown if len(shown) <= 120 else f"{shown[:117]}..."
    return MetadataError(f"metadata field {field} is {shown}, expected {expected}")


def _finite_array(value: Any) -> Array:
    """Return `value` as an array of finite numbers, empty if it is something else."""
    if isinstance(value, bool | str):
        return np.empty(0)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
    return array if np.isfinite(array).all() else np.empty(0)


def _per_joint(field: str, value: Any) -> Vector:
    array = _finite_array(value)
    if array.shape not in ((), (JOINTS,)):
        raise _metadata_error(field, value, f"a finite number or {JOINTS} of them")
    return tuple(float(x) for x in np.broadcast_to(array, (JOINTS,)))


def _bounds(field: str, value: Any) -> Bounds | None:
    """Parse a bound: None (no bound), a number b for (-b, b), or a pair (low, high)."""
    array = _finite_array(value) if value is not None else None
    if array is None:
        return None
    low, high = (-array, array) if array.shape == () else array if array.shape == (2,) else (0.0, 0.0)
    if not low < high:
        raise _metadata_error(field, value, "a positive bound, a pair (low, high) or null")
    return (float(low), float(high))


def _joint_names(field: str, value: Any) -> tuple[str, ...]:
    names = tuple(value) if isinstance(value, list | tuple) else ()
    if len(names) != JOINTS:
        raise _metadata_error(field, value, f"{JOINTS} names")
    for i, (found, expected) in enumerate(zip(names, JOINT_NAMES, strict=True)):
        if found != expected:
            raise _metadata_error(f"{field}[{i}]", found, f"'{expected}'")
    return names


def _command_limits(field: str, value: Any) -> dict[str, Bounds]:
    if not isinstance(value, Mapping) or set(value) != set(COMMAND_AXES):
        raise _metadata_error(field, value, f"a pair (low, high) for each of {', '.join(COMMAND_AXES)}")
    limits = {}
    for axis in COMMAND_AXES:
        bounds = _bounds(f"{field}.{axis}", value[axis])
        if bounds is None or not bounds[0] <= 0.0 <= bounds[1]:
            raise _metadata_error(f"{field}.{axis}", value[axis], "a pair (low, high) with zero between")
        limits[axis] = bounds
    return limits


def _positive(field: str, value: Any, expected: str) -> float:
    array = _finite_array(value)
    if array.shape != () or not array > 0.0:
        raise _metadata_error(field, value, expected)
    return float(array)


def _curve_limit(field: str, value: Any) -> float | None:
    return None if value is None else _positive(field, value, "an acceleration above 0 or null")


def _state_shape(field: str, value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or not value or not all(type(n) is int and n > 0 for n in value):
        raise _metadata_error(field, value, "the shape of h_in, whole numbers above 0")
    return tuple(value)


def _rate(field: str, value: Any) -> float:
    return _positive(field, value, "a rate above 0")


def _gains(field: str, value: Any) -> Vector:
    gains, most = _per_joint(field, value), MAX_GAINS[field]
    if not 0.0 <= min(gains) <= max(gains) <= most:
        raise _metadata_error(field, value, f"gains from 0 to {most:g}")
    return gains


def _schema(field: str, value: Any) -> int:
    if value != SCHEMA:
        raise _metadata_error(field, value, str(SCHEMA))
    return SCHEMA


def _observation(field: str, value: Any) -> ObservationSpec:
    if isinstance(value, ObservationSpec):
        return value
    try:
        return ObservationSpec.from_metadata(value, OBSERVATION_SIZES)
    except ValueError as error:
        raise MetadataError(f"metadata field {field} {error}") from None


def _text(field: str, value: Any) -> str:
    if not isinstance(value, str):
        raise _metadata_error(field, value, "a text")
    return value


MAX_GAINS = {"kp": 500.0, "kd": 20.0}  # N m/rad, N m s/rad; larger than usual gains of such robots

FIELD_CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "schema": _schema,
    "robot": _text,
    "joint_names": _joint_names,
    "nominal_q": _per_joint,
    "action_offset": _per_joint,
    "action_scale": _per_joint,
    "action_clip": _bounds,
    "kp": _gains,
    "kd": _gains,
    "rate_hz": _rate,
    "observation": _observation,
    "command_limits": _command_limits,
    "curve_limit": _curve_limit,
    "state_shape": _state_shape,
    "commit": _text,
}
"""Check of each field of the metadata: field and value to the value in its final form."""


@attrs.frozen(kw_only=True, eq=False)
class PolicyMetadata:
    """Everything needed to run a policy file: the JSON object under the ONNX metadata key `quadvel`.

    Fields with one value per joint also accept one number for all joints.

    Attributes:
        schema: Version of the format.
        robot: Name of the robot; UNNAMED_ROBOT if a file has none.
        joint_names: Names of the joints, in order.
        nominal_q: Nominal posture, (12,), rad.
        action_offset: Joint targets of a zero action, (12,), rad: the nominal posture plus the
            joint torques of standing divided by kp.
        action_scale: rad per unit of the network's output, (12,).
        action_clip: Bounds of the network's output, or None.
        kp: Stiffness, (12,), N m/rad.
        kd: Damping, (12,), N m s/rad.
        rate_hz: Rate of the policy, Hz.
        observation: Terms of the observation.
        command_limits: Commands of the training, (low, high) of vx, vy (m/s) and wz (rad/s).
        curve_limit: Largest lateral acceleration in curves, m/s^2, see `VelocityCommandLimits`; None if the
            limits of the axes are independent.
        state_shape: Shape of h_in and of c_in.
        actuator: Actuator model of the training, as JSON.
        recipe: How the policy was trained, as JSON.
        commit: Commit of the training code.

    Raises:
        MetadataError: A field is malformed; raised by the constructor.
    """

    schema: int = SCHEMA
    robot: str
    joint_names: tuple[str, ...] = JOINT_NAMES
    nominal_q: Vector
    action_offset: Vector
    action_scale: Vector
    action_clip: Bounds | None = None
    kp: Vector
    kd: Vector
    rate_hz: float = RATE_HZ
    observation: ObservationSpec
    command_limits: dict[str, Bounds]
    curve_limit: float | None = None
    state_shape: tuple[int, ...]
    actuator: Any = None
    recipe: Any = None
    commit: str = ""

    def __attrs_post_init__(self) -> None:
        for field, check in FIELD_CHECKS.items():
            object.__setattr__(self, field, check(field, getattr(self, field)))

    @property
    def ticks_per_step(self) -> int:
        """Ticks of the control loop for which an action is held."""
        return ticks_per_step(self.rate_hz)

    @property
    def observer(self) -> Observer:
        """A new observer of the network's input."""
        return Observer(self.observation)

    @property
    def action(self) -> ActionMap:
        """Conversion of the network's output to joint targets."""
        return ActionMap(self.action_offset, self.action_scale, self.action_clip)

    @property
    def limits(self) -> VelocityCommandLimits:
        """Velocity commands that the policy can follow."""
        vx, vy, wz = (self.command_limits[axis] for axis in COMMAND_AXES)
        return VelocityCommandLimits((vx[0], vy[0], wz[0]), (vx[1], vy[1], wz[1]), self.curve_limit)

    def to_json(self) -> str:
        """Return the JSON object of the policy file.

        Returns:
            JSON text.
        """
        data = {field: getattr(self, field) for field in METADATA_FIELDS}
        return json.dumps(data | {"observation": self.observation.to_metadata()}, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> PolicyMetadata:
        """Parse the JSON object of a policy file.

        Args:
            text: JSON text, as `to_json` writes it.

        Returns:
            The metadata.

        Raises:
            MetadataError: The text is not JSON, or a field is missing, unknown or malformed.
        """
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise MetadataError(f"metadata is no JSON ({error}), expected an object") from None
        return cls.from_fields(data)

    @classmethod
    def from_fields(cls, data: Any) -> PolicyMetadata:
        """Create metadata from a parsed JSON object with all REQUIRED_FIELDS and no unknown field.

        Args:
            data: The JSON object.

        Returns:
            The metadata.

        Raises:
            MetadataError: A field is missing, unknown or malformed.
        """
        if not isinstance(data, dict):
            raise MetadataError(f"metadata is {data!r}, expected an object")
        for field in REQUIRED_FIELDS:
            if field not in data:
                raise MetadataError(f"metadata field {field} is missing")
        for field in data:
            if field not in METADATA_FIELDS:
                raise MetadataError(
                    f"metadata field {field} is unknown, expected {', '.join(METADATA_FIELDS)}"
                )
        return cls(**{"robot": UNNAMED_ROBOT, **data})


METADATA_FIELDS = tuple(field.name for field in attrs.fields(PolicyMetadata))
REQUIRED_FIELDS = tuple(field for field in METADATA_FIELDS if field not in ("robot", "curve_limit"))


@attrs.frozen
class VelocityCommandLimits:
    """Limits of velocity commands (vx, vy, wz), m/s and rad/s; coupled if `curve` is given.

    With `curve`, velocity and lateral acceleration of a curve stay in one ellipsoid, so the largest
    turn rate decreases with speed:

        (vx / limit)^2 + (vy / limit)^2 + (v wz / curve)^2 <= 1,  v = hypot(vx, vy)

    Attributes:
        low: Lower limits.
        high: Upper limits.
        curve: Largest lateral acceleration at low speed, m/s^2; None for independent limits.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    curve: float | None = None

    def clamp(self, command: Iterable[float]) -> tuple[float, float, float]:
        """Clamp a command to the limits.

        Args:
            command: vx, vy (m/s), wz (rad/s).

        Returns:
            The clamped command.
        """
        bounds = zip(command, self.low, self.high, strict=True)
        vx, vy, wz = (min(max(value, low), high) for value, low, high in bounds)
        if self.curve is None or not (vx or vy):
            return vx, vy, wz
        ends = [(self.low if v < 0 else self.high)[axis] for axis, v in enumerate((vx, vy))]
        out = math.hypot(*(v / end for v, end in zip((vx, vy), ends, strict=True) if v))
        if out > 1.0:
            vx, vy, out = vx / out, vy / out, 1.0
        turn = self.curve * math.sqrt(1.0 - out**2) / math.hypot(vx, vy)
        return vx, vy, min(max(wz, -turn), turn)


class ActionMap:
    """Conversion of the network's output to joint targets: target = offset + scale * clip(action), rad.

    `quadvel_description.command_range` defines how targets outside the command range are sent.
    """

    def __init__(self, offset: ArrayLike, scale: ArrayLike, clip: float | Bounds | None = None) -> None:
        """Create a map.

        Args:
            offset: Joint targets of a zero action, a number or (12,), rad.
            scale: rad per unit of the output, a number or (12,).
            clip: Bounds of the output: None, a number b for (-b, b), or a pair (low, high).
        """
        self.offset = np.array(_per_joint("action_offset", offset))
        self.scale = np.array(_per_joint("action_scale", scale))
        self.clip = _bounds("action_clip", clip)

    def targets(self, action: ArrayLike) -> Array:
        """Convert a network output to joint targets.

        Args:
            action: Raw network output, (..., 12).

        Returns:
            Joint targets, (..., 12), rad.
        """
        if self.clip is not None:
            low, high = self.clip
            action = np.minimum(np.maximum(action, low), high)
        targets: Array = self.offset + self.scale * np.asarray(action)
        return targets
