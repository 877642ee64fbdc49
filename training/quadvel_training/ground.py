"""The ground below the robot as its legs feel it: height of the trunk and slope, without any sensor for them.

A ground is (..., 3) float32: trunk height above it, along the vertical, less `gait.HEIGHT` (m), and by how much it falls
away for 1 m forward and for 1 m to the left, level ways told in the trunk's axes. It moves on with the measured velocity;
feet put it right. A foot below it shows at once that the ground is deeper; one above it may be late or lifted, and counts
less, and only where the gait has it down.
"""

from __future__ import annotations

import torch
from torch import Tensor

from quadvel_description import robot

from . import gait
from .env import TICK

SIZE = 3
_BELOW, _ABOVE = TICK / 0.03, TICK / 0.06  # of what a foot tells, in a tick
_LEVELLING = 0.8  # 1/m^2, of the slope by a foot's tilting; 1 over the squares of two feet's ways from the trunk is 6.5


def advance(ground: Tensor, feet: Tensor, up: Tensor, velocity: Tensor, down: Tensor) -> Tensor:
    """The ground (..., 3) one tick further.

    feet (..., 3, 4) m, up (..., 3), the world's vertical, and velocity (..., 3) m/s in the trunk frame; down (..., 4) bool:
    which feet the gait has on the ground.
    """
    height, slope = ground.split([1, 2], dim=-1)
    ways = torch.cat([feet, velocity[..., None]], dim=-1)
    rise = (ways * up[..., None]).sum(-2, keepdim=True)
    level = ways[..., :2, :] - rise * up[..., :2, None]
    over_ground = (rise + (level * slope[..., None]).sum(-2, keepdim=True))[..., 0, :]
    height = height + TICK * over_ground[..., 4:]
    off = robot.FOOT_RADIUS - gait.HEIGHT - over_ground[..., :4] - height
    off = off * torch.where(off > 0, _BELOW, _ABOVE * down)
    tilt = (off[..., None, :] * level[..., :4]).sum(-1)
    return torch.cat([height + 0.5 * off.sum(-1, keepdim=True), slope + _LEVELLING * tilt], dim=-1)
