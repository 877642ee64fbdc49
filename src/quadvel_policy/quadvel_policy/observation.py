"""The observation and the action of a policy: what its network reads and what its output means.

Training, simulation and the robot all go through this module, and the policy file carries it along as
metadata, so that none of them can disagree with another. It runs no network; `policy_file` does.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.kinematics import roll_pitch as roll_pitch_of
from quadvel_description.network_input import InputLayout as ObservationSpec
from quadvel_description.network_input import InputTerm as ObservationTerm
from quadvel_description.recurrent_network import SCHEMA
from quadvel_description.robot import JOINT_NAMES, NOMINAL_Q

RATE_HZ = 200.0
JOINTS = len(JOINT_NAMES)
COMMAND_AXES = ("vx", "vy", "wz")
OBSERVATION_SIZES = {
    "command": 4,  # vx, vy (m/s), wz (rad/s), stance (0 or 1)
    "roll_pitch": 2,  # rad
    "q": JOINTS,  # rad
    "dq": JOINTS,  # rad/s
    "linear_velocity": 3,  # m/s, body frame
    "angular_velocity": 3,  # rad/s, body frame
    "previous_action": JOINTS,  # the raw network output of the tick before
}

DEFAULT_OBSERVATION = ObservationSpec(
    (
        ObservationTerm("command", 4),
        ObservationTerm("roll_pitch", 2, scale=2.0, clip=10.0),
        ObservationTerm("q", JOINTS, offset=tuple(NOMINAL_Q), scale=2.0, clip=10.0),
        ObservationTerm("dq", JOINTS, scale=0.1, clip=10.0),
        ObservationTerm("linear_velocity", 3, clip=10.0),
        ObservationTerm("angular_velocity", 3, scale=0.5, clip=10.0),
        ObservationTerm("previous_action", JOINTS, clip=10.0),
    )
)
"""The 48 numbers of the paper's Section 4.1, each of about unit size in a walk."""

Vector = tuple[float, ...]
Bounds = tuple[float, float]


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
    """The network's input clip((value - offset) * scale), (..., spec.size), float32; into `out` if given.

    command (..., 4): vx, vy (m/s), wz (rad/s), stance (0 or 1). q, dq (..., 12): rad, rad/s. linear_velocity,
    angular_velocity (..., 3): m/s, rad/s, body frame. previous_action (..., 12): the raw network output of
    the tick before. The attitude as quaternion (..., 4), (w, x, y, z), body to world, or as roll_pitch (...,
    2), rad: one of both. All leading axes are the same. NaN stays NaN; infinity may be clipped away, so check
    before.
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


class MetadataError(ValueError):
    """Metadata that does not fit. The message names the field, what was found and what was expected."""


def _refusal(field: str, found: object, expected: str) -> MetadataError:
    shown = repr(found)
    shown = shown if len(shown) <= 120 else f"{shown[:117]}..."
    return MetadataError(f"metadata field {field} is {shown}, expected {expected}")


def _numbers(value: Any) -> NDArray[np.float64]:
    """`value` as an array of finite numbers, empty where it is something else."""
    if isinstance(value, bool | str):
        return np.empty(0)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
    return array if np.isfinite(array).all() else np.empty(0)


def _per_joint(field: str, value: Any) -> Vector:
    array = _numbers(value)
    if array.shape not in ((), (JOINTS,)):
        raise _refusal(field, value, f"a finite number or {JOINTS} of them")
    return tuple(float(x) for x in np.broadcast_to(array, (JOINTS,)))


def _bounds(field: str, value: Any) -> Bounds | None:
    """None (no bound), one number b for (-b, b), or a pair (low, high)."""
    array = _numbers(value) if value is not None else None
    if array is None:
        return None
    low, high = (-array, array) if array.shape == () else array if array.shape == (2,) else (0.0, 0.0)
    if not low < high:
        raise _refusal(field, value, "a positive bound, a pair (low, high) or null")
    return (float(low), float(high))


def _joint_names(field: str, value: Any) -> tuple[str, ...]:
    names = tuple(value) if isinstance(value, list | tuple) else ()
    if len(names) != JOINTS:
        raise _refusal(field, value, f"{JOINTS} names")
    for i, (found, expected) in enumerate(zip(names, JOINT_NAMES, strict=True)):
        if found != expected:
            raise _refusal(f"{field}[{i}]", found, f"'{expected}'")
    return names


def _command_limits(field: str, value: Any) -> dict[str, Bounds]:
    if not isinstance(value, Mapping) or set(value) != set(COMMAND_AXES):
        raise _refusal(field, value, f"a pair (low, high) for each of {', '.join(COMMAND_AXES)}")
    limits = {}
    for axis in COMMAND_AXES:
        bounds = _bounds(f"{field}.{axis}", value[axis])
        if bounds is None or not bounds[0] <= 0.0 <= bounds[1]:
            raise _refusal(f"{field}.{axis}", value[axis], "a pair (low, high) with zero between")
        limits[axis] = bounds
    return limits


def _positive(field: str, value: Any, expected: str) -> float:
    array = _numbers(value)
    if array.shape != () or not array > 0.0:
        raise _refusal(field, value, expected)
    return float(array)


def _curve_limit(field: str, value: Any) -> float | None:
    return None if value is None else _positive(field, value, "an acceleration above 0 or null")


def _state_shape(field: str, value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or not value or not all(type(n) is int and n > 0 for n in value):
        raise _refusal(field, value, "the shape of h_in, whole numbers above 0")
    return tuple(value)


def _rate(field: str, value: Any) -> float:
    return _positive(field, value, "a rate above 0")


def _gains(field: str, value: Any) -> Vector:
    gains, most = _per_joint(field, value), MAX_GAINS[field]
    if not 0.0 <= min(gains) <= max(gains) <= most:
        raise _refusal(field, value, f"gains from 0 to {most:g}")
    return gains


def _schema(field: str, value: Any) -> int:
    if value != SCHEMA:
        raise _refusal(field, value, str(SCHEMA))
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
        raise _refusal(field, value, "a text")
    return value


MAX_GAINS = {"kp": 500.0, "kd": 20.0}  # N m/rad, N m s/rad: above all that drives of such robots are run with

_CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "schema": _schema,
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


@attrs.frozen(kw_only=True, eq=False)
class PolicyMetadata:
    """All that is needed to run a policy file; the JSON object under the ONNX metadata key `quadvel`.

    Where one value for each joint is asked for, one number for all of them will do.
    Raises MetadataError with the field's name, what was found and what was expected.
    """

    schema: int = SCHEMA
    joint_names: tuple[str, ...] = JOINT_NAMES
    nominal_q: Vector = tuple(NOMINAL_Q)
    """rad"""
    action_offset: Vector
    """rad; the nominal posture plus the joint torques of standing over kp, so that a zero action stands"""
    action_scale: Vector
    """rad a unit of the network's output"""
    action_clip: Bounds | None = None
    """in the unit of the network's output"""
    kp: Vector
    """N m/rad"""
    kd: Vector
    """N m s/rad"""
    rate_hz: float = RATE_HZ
    observation: ObservationSpec = DEFAULT_OBSERVATION
    command_limits: dict[str, Bounds]
    """what the policy was trained to follow: vx, vy (m/s), wz (rad/s), each (low, high)"""
    curve_limit: float | None = None
    """m/s^2, how fast it turns as it walks: `CommandLimits`; null, or not there: the limits hold one by one"""
    state_shape: tuple[int, ...]
    """of h_in and of c_in"""
    actuator: Any = None
    """the actuator model that it was trained on, as JSON"""
    recipe: Any = None
    """how it was trained, as JSON"""
    commit: str = ""

    def __attrs_post_init__(self) -> None:
        for field, check in _CHECKS.items():
            object.__setattr__(self, field, check(field, getattr(self, field)))

    @property
    def action(self) -> ActionMap:
        """What the network's output means."""
        return ActionMap(self.action_offset, self.action_scale, self.action_clip)

    @property
    def limits(self) -> CommandLimits:
        """The commands that it follows."""
        vx, vy, wz = (self.command_limits[axis] for axis in COMMAND_AXES)
        return CommandLimits((vx[0], vy[0], wz[0]), (vx[1], vy[1], wz[1]), self.curve_limit)

    def to_json(self) -> str:
        """The JSON object of the policy file."""
        data = {field: getattr(self, field) for field in METADATA_FIELDS}
        return json.dumps(data | {"observation": self.observation.to_metadata()}, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> PolicyMetadata:
        """Read `to_json`'s text."""
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise MetadataError(f"metadata is no JSON ({error}), expected an object") from None
        return cls.from_fields(data)

    @classmethod
    def from_fields(cls, data: Any) -> PolicyMetadata:
        """From the JSON object as read; every one of REQUIRED_FIELDS has to be there, and no other."""
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
        return cls(**data)


METADATA_FIELDS = tuple(field.name for field in attrs.fields(PolicyMetadata))
REQUIRED_FIELDS = tuple(field for field in METADATA_FIELDS if field != "curve_limit")


@attrs.frozen
class CommandLimits:
    """What a policy follows: the lowest and the highest (vx, vy, wz), m/s and rad/s; held together where `curve` is given.

    Then vx and vy keep to the ellipse that their limits span, and |wz| to `curve` (1 - r^2) / (|vx| + |vy|), r being how far
    out in this ellipse they are: who runs as fast as he can does not turn. curve: m/s^2.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    curve: float | None = None

    def held(self, command: Iterable[float]) -> tuple[float, float, float]:
        """The command (vx, vy, wz) held to these limits."""
        bounds = zip(command, self.low, self.high, strict=True)
        vx, vy, wz = (min(max(value, low), high) for value, low, high in bounds)
        if self.curve is None or not (vx or vy):
            return vx, vy, wz
        ends = [(self.low if v < 0 else self.high)[axis] for axis, v in enumerate((vx, vy))]
        out = math.hypot(*(v / end for v, end in zip((vx, vy), ends, strict=True) if v))
        if out > 1.0:
            vx, vy, out = vx / out, vy / out, 1.0
        turn = self.curve * (1.0 - out**2) / (abs(vx) + abs(vy))
        return vx, vy, min(max(wz, -turn), turn)


class ActionMap:
    """What an output means: target = offset + scale * clip(action), rad.

    offset, scale: a number or 12; clip: None, a bound or a pair, in the unit of the network's output. How targets
    beyond the range of commands are sent: `quadvel_description.command_range`.
    """

    def __init__(self, offset: ArrayLike, scale: ArrayLike, clip: float | Bounds | None = None) -> None:
        self.offset = np.array(_per_joint("action_offset", offset))
        self.scale = np.array(_per_joint("action_scale", scale))
        self.clip = _bounds("action_clip", clip)

    def targets(self, action: ArrayLike) -> NDArray[np.float64]:
        """Joint targets (..., 12), rad, of the raw network output (..., 12)."""
        if self.clip is not None:
            action = np.clip(action, *self.clip)
        targets: NDArray[np.float64] = self.offset + self.scale * np.asarray(action)
        return targets
