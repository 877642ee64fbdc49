"""Calibration of one robot's encoders and IMU: the file, and the correction of states and commands.

`find_calibration` computes the numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml

from quadvel_description.arrays import Array
from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.kinematics import rotation_matrix
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot_name import UNNAMED_ROBOT
from quadvel_description.state import JointCommand, RobotState

SCHEMA = 1
MAX_OFFSET_RAD = 0.35  # a sensor with a larger offset is broken or mounted wrongly


class CalibrationError(ValueError):
    """A file is not a calibration; the text is one sentence with file and field."""


@attrs.frozen(eq=False)
class Calibration:
    """Offsets of one robot's sensors.

    Attributes:
        joint_zeros: Encoder readings at the joints' zero angles, (12,), rad.
        imu_mounting: Tilt of the IMU against the trunk, (2,), rad: roll (about x) and pitch (about
            y).
        robot: Name of the robot.

    Raises:
        CalibrationError: An offset is not finite, too large, or of the wrong shape; raised by the
            constructor.
    """

    joint_zeros: Array = attrs.field(factory=lambda: np.zeros(12))
    imu_mounting: Array = attrs.field(factory=lambda: np.zeros(2))
    robot: str = UNNAMED_ROBOT

    def __attrs_post_init__(self) -> None:
        for field, names in (("joint_zeros", JOINT_NAMES), ("imu_mounting", ("roll", "pitch"))):
            value = np.asarray(getattr(self, field))
            expected = f"expected {len(names)} angles within {MAX_OFFSET_RAD} rad"
            if value.shape != (len(names),):
                raise CalibrationError(f"{field} has the shape {value.shape}, {expected}")
            wrong = [
                f"{name} {angle:.3g}"
                for name, angle in zip(names, value, strict=True)
                if not abs(angle) <= MAX_OFFSET_RAD
            ]
            if wrong:
                raise CalibrationError(f"{field}: {', '.join(wrong)} rad, {expected}")

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration file.

        Args:
            path: The YAML file.

        Returns:
            The calibration.

        Raises:
            CalibrationError: The file cannot be read or is malformed.
        """
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
            robot = str(content.get("robot", UNNAMED_ROBOT))
            return cls(_numbers(zeros, JOINT_NAMES), _numbers(mounting, ("roll", "pitch")), robot)
        except Exception as error:  # the content is arbitrary, and so is the error
            raise CalibrationError(
                f"{path}: {type(error).__name__}: {' '.join(str(error).split())}"
            ) from None

    def to_yaml(self) -> str:
        """Return the content of the calibration file.

        Returns:
            YAML, with a comment line at the top.
        """
        zeros = {
            name: round(zero, 5) for name, zero in zip(JOINT_NAMES, self.joint_zeros.tolist(), strict=True)
        }
        roll, pitch = self.imu_mounting.round(5).tolist()
        content = {
            "schema": SCHEMA,
            "robot": self.robot,
            "joint_zeros": zeros,
            "imu_mounting": {"roll": roll, "pitch": pitch},
        }
        head = "# What encoders and IMU of one robot show at zero, rad; `quadvel calibrate` wrote it, the driver applies it.\n"
        return head + yaml.safe_dump(content, sort_keys=False)

    @property
    def mounting(self) -> Array:
        """Rotation from trunk to IMU as a quaternion (w, x, y, z), (4,)."""
        angle = float(np.hypot(*self.imu_mounting))
        share = 0.5 * np.sinc(0.5 * angle / np.pi)
        return np.array([np.cos(0.5 * angle), *(share * self.imu_mounting), 0.0])

    @cached_property
    def _turn(self) -> tuple[Array, Array]:
        """Rotation matrix of the mounting, (3, 3), and the matrix of quaternion * mounting, (4, 4)."""
        w, x, y, z = self.mounting.tolist()
        product = np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])
        return rotation_matrix(self.mounting), product

    def apply(self, reported: RobotState) -> RobotState:
        """Correct a measured state: remove the encoder offsets and the tilt of the IMU.

            q = q_reported - joint_zeros,   R = R_reported R_mounting^T

        Args:
            reported: The state as the robot reports it.

        Returns:
            The true state.
        """
        turn, product = self._turn
        return attrs.evolve(
            reported,
            q=reported.q - self.joint_zeros,
            quaternion=reported.quaternion @ product,  # a transposed product is that with the inverse
            angular_velocity=turn @ reported.angular_velocity,
            linear_acceleration=turn @ reported.linear_acceleration,
        )

    def as_reported(self, true: RobotState) -> RobotState:
        """Add the sensor offsets to a true state; the inverse of `apply`.

        Args:
            true: The true state.

        Returns:
            The state as this robot would report it.
        """
        turn, product = self._turn
        return attrs.evolve(
            true,
            q=true.q + self.joint_zeros,
            quaternion=product @ true.quaternion,
            angular_velocity=true.angular_velocity @ turn,
            linear_acceleration=true.linear_acceleration @ turn,
        )

    def invert(self, wanted: JointCommand) -> JointCommand:
        """Convert a desired command to the command that the drives need: q + joint_zeros.

        Args:
            wanted: The desired command.

        Returns:
            The command to send.
        """
        return attrs.evolve(wanted, q=wanted.q + self.joint_zeros)

    def as_executed(self, sent: JointCommand) -> JointCommand:
        """Convert a sent command to the motion that the drives execute; the inverse of `invert`.

        Args:
            sent: The command that was sent.

        Returns:
            The command in true joint angles.
        """
        return attrs.evolve(sent, q=sent.q - self.joint_zeros)


def _numbers(values: Mapping[str, Any], names: tuple[str, ...]) -> Array:
    return np.array([float(values[name]) for name in names])
