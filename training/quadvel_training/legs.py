"""The legs' kinematics in torch, with few operations, since they end up in the policy file and run on the robot.

The same as `quadvel_description.kinematics`, which the nodes use without torch; a test holds both equal.
"""

from __future__ import annotations

import torch
from torch import Tensor

from quadvel_description import robot
from quadvel_description.kinematics import HIPS

_THIGH, _CALF = robot.THIGH_LENGTH, robot.CALF_LENGTH
_SIDE = [robot.THIGH_OFFSET * robot.LEFT[leg] for leg in robot.LEGS]
_NEAREST, _FARTHEST = abs(_THIGH - _CALF) + 1e-3, _THIGH + _CALF - 1e-4  # m, where the knee still has a slope


class Legs:
    """The four legs at joint angles (..., 12) rad: `feet` in the trunk frame (..., 4, 3) m."""

    def __init__(self, q: Tensor) -> None:
        hip, thigh, calf = q.reshape(*q.shape[:-1], 4, 3).unbind(-1)
        knee = thigh + calf
        self._sine, self._cosine = hip.sin(), hip.cos()
        self._shin = -_CALF * knee.sin(), -_CALF * knee.cos()  # of its own plane: forward and up
        self._forward, self._up = self._shin[0] - _THIGH * thigh.sin(), self._shin[1] - _THIGH * thigh.cos()
        side = q.new_tensor(_SIDE)
        self._left = side * self._cosine - self._up * self._sine
        self._rise = side * self._sine + self._up * self._cosine
        self.feet = torch.stack([self._forward, self._left, self._rise], dim=-1) + q.new_tensor(HIPS)

    def torques(self, force: Tensor) -> Tensor:
        """Joint torques (..., 4, 3) N m that balance forces (..., 4, 3) N which the ground exerts on the feet, negated: J^T f."""
        x, y, z = force.unbind(-1)
        across = self._sine * y - self._cosine * z
        hip = self._left * z - self._rise * y
        thigh = self._up * x + self._forward * across
        calf = self._shin[1] * x + self._shin[0] * across
        return torch.stack([hip, thigh, calf], dim=-1)


def angles(feet: Tensor) -> Tensor:
    """Joint angles (..., 4, 3) rad that put the feet at (..., 4, 3) m in the trunk frame; hips within a right angle.

    Knees bend backward (calf negative). A foot out of reach is placed at the nearest reachable distance.
    """
    x, y, z = (feet - feet.new_tensor(HIPS)).unbind(-1)
    side = feet.new_tensor(_SIDE)
    depth = (y * y + z * z - robot.THIGH_OFFSET**2).clamp(min=1e-4).sqrt()  # of the foot below the thigh joint
    hip = ((depth * y + side * z) / (side * y - depth * z).clamp(min=1e-4)).atan()
    reach = (x * x + depth * depth).clamp(_NEAREST**2, _FARTHEST**2)
    bend = ((reach - _THIGH**2 - _CALF**2) / (2 * _THIGH * _CALF)).acos()
    lead = (_CALF * bend.sin() / (_THIGH + _CALF * bend.cos()).clamp(min=1e-4)).atan()
    return torch.stack([hip, lead - (x / depth).atan(), -bend], dim=-1)
