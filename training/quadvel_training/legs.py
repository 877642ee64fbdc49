"""The legs' kinematics in torch, with few operations, since they end up in the policy file and run on the robot.

The same as `quadvel_description.kinematics`, which the nodes use without torch; a test holds both equal. Here a column is
a leg: vectors of the feet are (..., 3, 4).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from quadvel_description import robot
from quadvel_description.kinematics import HIPS

_THIGH, _CALF = robot.THIGH_LENGTH, robot.CALF_LENGTH
_SIDE = [[robot.THIGH_OFFSET * robot.LEFT[leg] for leg in robot.LEGS]]
_HIPS = HIPS.T.copy()
_NEAREST, _FARTHEST = abs(_THIGH - _CALF) + 1e-3, _THIGH + _CALF - 1e-4  # m, where the knee still has a slope
_KNEE = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])  # the calf turns with the thigh


def columns(joints: Tensor) -> Tensor:
    """(..., 12) in the robot's order to (..., 3, 4): hip, thigh, calf of each leg."""
    return joints.reshape(*joints.shape[:-1], 4, 3).transpose(-1, -2)


def joints(columns: Tensor) -> Tensor:
    """(..., 3, 4) to (..., 12), the way back."""
    return columns.transpose(-1, -2).reshape(*columns.shape[:-2], 12)


class Legs:
    """The four legs at joint angles (..., 3, 4) rad: `feet` in the trunk frame, (..., 3, 4) m."""

    def __init__(self, q: Tensor) -> None:
        turned = q.new_tensor(_KNEE) @ q
        lengths = q.new_tensor([[1.0], [-_THIGH], [-_CALF]])
        self._sine, thigh_forward, self._shin_forward = (lengths * turned.sin()).split(1, dim=-2)
        self._cosine, thigh_up, self._shin_up = (lengths * turned.cos()).split(1, dim=-2)
        self._forward, self._up = thigh_forward + self._shin_forward, thigh_up + self._shin_up
        side = q.new_tensor(_SIDE)
        self._left = side * self._cosine - self._up * self._sine
        self._rise = side * self._sine + self._up * self._cosine
        self.feet = torch.cat([self._forward, self._left, self._rise], dim=-2) + q.new_tensor(_HIPS)

    def torques(self, force: Tensor) -> Tensor:
        """J^T f (..., 3, 4) N m of forces (..., 3, 4) N on the feet."""
        x, y, z = force.split(1, dim=-2)
        across = self._sine * y - self._cosine * z
        hip = self._left * z - self._rise * y
        thigh = self._up * x + self._forward * across
        calf = self._shin_up * x + self._shin_forward * across
        return torch.cat([hip, thigh, calf], dim=-2)


def angles(feet: Tensor) -> Tensor:
    """Joint angles (..., 3, 4) rad that put the feet at (..., 3, 4) m in the trunk frame; hips within a right angle.

    Knees bend backward (calf negative). A foot out of reach is placed at the nearest reachable distance.
    """
    x, y, z = (feet - feet.new_tensor(_HIPS)).split(1, dim=-2)
    side = feet.new_tensor(_SIDE)
    depth = (y * y + z * z - robot.THIGH_OFFSET**2).clamp(min=1e-4).sqrt()  # below the thigh joint
    hip = ((depth * y + side * z) / (side * y - depth * z).clamp(min=1e-4)).atan()
    reach = (x * x + depth * depth).clamp(_NEAREST**2, _FARTHEST**2)
    bend = ((reach - (_THIGH**2 + _CALF**2)) / (2 * _THIGH * _CALF)).acos()
    lead = (_CALF * bend.sin() / (_THIGH + _CALF * bend.cos()).clamp(min=1e-4)).atan()
    return torch.cat([hip, lead - (x / depth).atan(), -bend], dim=-2)
