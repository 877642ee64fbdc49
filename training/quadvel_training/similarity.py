"""Dynamic similarity: how the lengths, times and speeds of a gait grow with the robot.

Robots of different size move alike if lengths grow with their height h, times with sqrt(h / g) and
speeds with sqrt(g h); the Froude number v^2 / (g h) is then the same. Source: Alexander and Jayes,
A dynamic similarity hypothesis for the gaits of quadrupedal mammals (1983).

So gait and rewards hold their numbers once, for a robot whose hips are `REFERENCE_HEIGHT_M` above
its feet, and robots of another size use the same ones.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.kinematics import foot_positions
from quadvel_description.robot import Robot

REFERENCE_HEIGHT_M = 0.4  # hips above the feet, in the nominal posture


@attrs.frozen
class Size:
    """Size of a robot relative to the reference.

    Attributes:
        length: ratio of the lengths, 1 for hips `REFERENCE_HEIGHT_M` above the feet.
    """

    length: float = 1.0

    @classmethod
    def of(cls, robot: Robot) -> Size:
        """Return the size of a robot.

        Args:
            robot: the robot.

        Returns:
            Its size, from its nominal posture.
        """
        hips = robot.legs.hips[:, 2] - foot_positions(robot, robot.nominal_q)[:, 2]  # m
        return cls(float(hips.mean()) / REFERENCE_HEIGHT_M)

    @property
    def time(self) -> float:
        """Ratio of the times; also that of the speeds, as both grow with the root of the length."""
        return float(np.sqrt(self.length))

    def as_reference(self, velocity: np.ndarray) -> np.ndarray:
        """Return the velocity at which a reference robot moves alike.

        Args:
            velocity: (..., 3), vx, vy (m/s), yaw rate (rad/s).

        Returns:
            (..., 3), the same.
        """
        # v_reference = v / sqrt(length), w_reference = w sqrt(length)
        return velocity * np.array([1.0 / self.time, 1.0 / self.time, self.time])


REFERENCE = Size()
