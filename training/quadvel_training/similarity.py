"""Dynamic similarity: how the lengths, times and speeds of a gait grow with the robot.

Robots of different size move alike if lengths grow with their height h, times with sqrt(h / g) and
speeds with sqrt(g h); the Froude number v^2 / (g h) is then the same. Source: Alexander and Jayes,
A dynamic similarity hypothesis for the gaits of quadrupedal mammals (1983).

So the script, its clock, what the teacher observes and the heights in the rewards hold their numbers
once, for a robot whose hips are `REFERENCE_HEIGHT_M` above its feet.
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
        """Ratio of the times."""
        return float(np.sqrt(self.length))

    @property
    def speed(self) -> float:
        """Ratio of the speeds: that of the lengths over that of the times."""
        return self.length / self.time

    def as_reference(self, velocity: np.ndarray) -> np.ndarray:
        """Return the velocity at which a reference robot moves alike.

        Args:
            velocity: (..., 3), vx, vy (m/s), yaw rate (rad/s).

        Returns:
            (..., 3), the same.
        """
        return velocity * np.array([1.0 / self.speed, 1.0 / self.speed, self.time])


REFERENCE = Size()
