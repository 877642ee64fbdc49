"""What one robot's sensors show where everything is at zero: the file, and how states and commands are set right by it.

How the numbers are found is `find_calibration`'s matter.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml
from numpy.typing import NDArray

from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.kinematics import rotate, rotate_inverse
from quadvel_description.robot import JOINT_NAMES
from quadvel_description.state import JointCommand, RobotState

SCHEMA = 1
LARGEST = 0.35  # rad; beyond that a sensor is not off but broken, or in the wrong place
Array = NDArray[np.float64]


class CalibrationError(ValueError):
    """A file that is no calibration; one sentence that names file and field."""


@attrs.frozen(eq=False)
class Calibration:
    """joint_zeros: (12,) rad, what each encoder shows at its joint's zero. imu_mounting: (2,) rad, by how much the IMU leans
    against the trunk, to the right (about x) and forward (about y)."""

    joint_zeros: Array = attrs.field(factory=lambda: np.zeros(12))
    imu_mounting: Array = attrs.field(factory=lambda: np.zeros(2))

    def __attrs_post_init__(self) -> None:
        for field, size in (("joint_zeros", 12), ("imu_mounting", 2)):
            value = getattr(self, field)
            if np.shape(value) != (size,) or not (np.abs(value) <= LARGEST).all():
                found = np.asarray(value).tolist()
                raise CalibrationError(f"{field} is {found}, expected {size} angles within {LARGEST} rad")

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a file that `save` wrote. Raises CalibrationError."""
        try:
            content = read_yaml(Path(path), "a YAML file of a calibration")
        except OSError as error:
            raise CalibrationError(f"cannot read {path}: {error.strerror}") from error
        except ValueError as error:
            raise CalibrationError(str(error)) from None
        try:
            if not isinstance(content, Mapping) or content.get("schema") != SCHEMA:
                raise CalibrationError(f"expected the fields of a calibration with schema: {SCHEMA}")
            zeros, mounting = content["joint_zeros"], content["imu_mounting"]
            if set(zeros) != {*JOINT_NAMES} or set(mounting) != {"roll", "pitch"}:
                raise CalibrationError(
                    "joint_zeros or imu_mounting has other names than the twelve joints, roll and pitch"
                )
            return cls(_numbers(zeros, JOINT_NAMES), _numbers(mounting, ("roll", "pitch")))
        except Exception as error:  # of the file's content, whatever it may be
            raise CalibrationError(
                f"{path}: {type(error).__name__}: {' '.join(str(error).split())}"
            ) from None

    def text(self) -> str:
        """The file."""
        zeros = {
            name: round(zero, 5) for name, zero in zip(JOINT_NAMES, self.joint_zeros.tolist(), strict=True)
        }
        roll, pitch = self.imu_mounting.round(5).tolist()
        content = {"schema": SCHEMA, "joint_zeros": zeros, "imu_mounting": {"roll": roll, "pitch": pitch}}
        head = "# What encoders and IMU of one robot show at zero, rad; `quadvel calibrate` wrote it, the driver applies it.\n"
        return head + yaml.safe_dump(content, sort_keys=False)

    @property
    def mounting(self) -> Array:
        """The turn from trunk to IMU as a quaternion, (4,) w, x, y, z."""
        angle = float(np.hypot(*self.imu_mounting))
        share = 0.5 * np.sinc(0.5 * angle / np.pi)
        return np.array([np.cos(0.5 * angle), *(share * self.imu_mounting), 0.0])

    def apply(self, reported: RobotState) -> RobotState:
        """The state that a robot is in which reports this one."""
        turn = self.mounting
        return attrs.evolve(
            reported,
            q=reported.q - self.joint_zeros,
            quaternion=_product(reported.quaternion, turn * [1.0, -1.0, -1.0, -1.0]),
            angular_velocity=rotate(turn, reported.angular_velocity),
            linear_acceleration=rotate(turn, reported.linear_acceleration),
        )

    def reported(self, true: RobotState) -> RobotState:
        """What a robot reports that is in this state."""
        turn = self.mounting
        return attrs.evolve(
            true,
            q=true.q + self.joint_zeros,
            quaternion=_product(true.quaternion, turn),
            angular_velocity=rotate_inverse(turn, true.angular_velocity),
            linear_acceleration=rotate_inverse(turn, true.linear_acceleration),
        )

    def invert(self, wanted: JointCommand) -> JointCommand:
        """What the drives have to be told so that they do what is wanted."""
        return attrs.evolve(wanted, q=wanted.q + self.joint_zeros)

    def carried_out(self, sent: JointCommand) -> JointCommand:
        """What drives do that are told this."""
        return attrs.evolve(sent, q=sent.q - self.joint_zeros)


def _numbers(values: Mapping[str, Any], names: tuple[str, ...]) -> Array:
    return np.array([float(values[name]) for name in names])


def _product(a: Array, b: Array) -> Array:
    """Of two quaternions, w first."""
    w, x, y, z = a
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: Array = left @ b
    return product
