"""What an imported policy needs in addition to its weights: the JSON object in its ONNX file.

The readers of the formats create it, `ImportedPolicy` runs it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import attrs

from quadvel_description.fields import field, refusal
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.records import structure_record

from ..observation import (
    COMMAND_AXES,
    FIELD_CHECKS,
    JOINTS,
    RATE_HZ,
    Bounds,
    Vector,
    VelocityCommandLimits,
    ticks_per_step,
)
from .observation import ImportedAction, ImportedObserver, ImportedTerm

IMPORTED_KEY = "quadvel_imported"
"""Key of the JSON object in the metadata of the ONNX file."""
SCHEMA = 1
UNBOUNDED = 100.0
"""rad, bound of the joint targets of a format without one; the controller limits them anyway."""


@attrs.frozen(kw_only=True, eq=False)
class ImportedMetadata:
    """Everything needed to run an imported policy. Joints are in our order, except within the terms.

    Attributes:
        schema: Version of this record.
        robot: Name of the robot.
        source: Format and files that it was read from.
        joint_map: Index in `JOINT_NAMES` of each joint of the network, a permutation, 12.
        terms: Terms of the observation, in order.
        history_by: "term": all steps of a term, then the next term; "step": all terms of a step,
            then the next step.
        nominal_q: Default posture, (12,), rad.
        action_offset: Joint targets of a zero action, (12,), rad.
        action_scale: rad per unit of the network's output, (12,).
        target_low: Lower bounds of the joint targets, (12,), rad.
        target_high: Upper bounds of the joint targets, (12,), rad.
        kp: Stiffness, (12,), N m/rad.
        kd: Damping, (12,), N m s/rad.
        rate_hz: Rate of the policy, Hz; RATE_HZ divided by a whole number.
        command_limits: Commands of the training, (low, high) of vx, vy (m/s) and wz (rad/s).
        output: Name of the network's output with the action.

    Raises:
        ValueError: A field is malformed; raised by the constructor.
    """

    schema: int = field(SCHEMA, one_of=(SCHEMA,))
    robot: str
    source: str
    joint_map: tuple[int, ...]
    terms: tuple[ImportedTerm, ...]
    history_by: str = field("term", one_of=("term", "step"))
    nominal_q: Vector
    action_offset: Vector
    action_scale: Vector
    target_low: Vector
    target_high: Vector
    kp: Vector
    kd: Vector
    rate_hz: float
    command_limits: dict[str, Bounds]
    output: str

    def __attrs_post_init__(self) -> None:
        """Check the fields alone and together."""
        for name in ("nominal_q", "action_offset", "action_scale", "kp", "kd", "rate_hz", "command_limits"):
            object.__setattr__(self, name, FIELD_CHECKS[name](name, getattr(self, name)))
        for name in ("target_low", "target_high"):
            object.__setattr__(self, name, FIELD_CHECKS["action_offset"](name, getattr(self, name)))
        if sorted(self.joint_map) != list(range(JOINTS)):
            raise refusal(self, "joint_map", self.joint_map, f"each of 0 to {JOINTS - 1} once")
        if not self.terms:
            raise refusal(self, "terms", self.terms, "at least one term")
        if self.history_by == "step" and len({term.ages for term in self.terms}) > 1:
            raise refusal(
                self, "terms", [term.ages for term in self.terms], "equal ages with history by step"
            )
        if not math.isclose(self.ticks_per_step * self.rate_hz, RATE_HZ):
            raise refusal(self, "rate_hz", self.rate_hz, f"{RATE_HZ:g} divided by a whole number")

    @property
    def ticks_per_step(self) -> int:
        """Ticks of the control loop for which an action is held."""
        return ticks_per_step(self.rate_hz)

    @property
    def size(self) -> int:
        """Length of the observation."""
        return sum(term.size for term in self.terms)

    @property
    def observer(self) -> ImportedObserver:
        """A new observer; each has its own history."""
        return ImportedObserver(self.terms, self.history_by == "step", self.joint_map)

    @property
    def action(self) -> ImportedAction:
        """Conversion of the network's output to joint targets."""
        bounds = self.target_low, self.target_high
        return ImportedAction(self.action_offset, self.action_scale, bounds, self.joint_map)

    @property
    def limits(self) -> VelocityCommandLimits:
        """Velocity commands that the policy can follow."""
        vx, vy, wz = (self.command_limits[axis] for axis in COMMAND_AXES)
        return VelocityCommandLimits((vx[0], vy[0], wz[0]), (vx[1], vy[1], wz[1]))

    def joint_names(self) -> list[str]:
        """Return the names of the joints in the network's order.

        Returns:
            The names, 12.
        """
        return [JOINT_NAMES[i] for i in self.joint_map]

    def to_json(self) -> str:
        """Return the JSON object of the policy file.

        Returns:
            JSON text.
        """
        return json.dumps(attrs.asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str, path: Path) -> ImportedMetadata:
        """Parse the JSON object of a policy file.

        Args:
            text: JSON text, as `to_json` writes it.
            path: The file, for the error message.

        Returns:
            The metadata.

        Raises:
            ValueError: The text is not JSON, or a field is missing, unknown or malformed.
        """
        try:
            data: Any = json.loads(text)
        except (ValueError, RecursionError):
            raise ValueError(f"{path}: metadata {IMPORTED_KEY!r} is {text[:40]!r}, expected JSON") from None
        return structure_record(cls, data, path)
