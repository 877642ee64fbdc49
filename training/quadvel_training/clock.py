"""The gait's clock: the pace that leads the robot to its command, and where in its cycle the gait is.

Teacher and student walk by the same one; the policy file carries it in its memory. It depends on the commands alone.
A clock is (..., 5) float32: pace vx, vy (m/s), wz (rad/s), phase in [0, 1), and 1 while it runs, 0 while the robot stands.
"""

from __future__ import annotations

import torch
from torch import Tensor

from . import gait
from .env import TICK

SIZE = 5
ACCELERATION = (2.5, 1.5, 4.0)  # m/s^2, m/s^2, rad/s^2; thrown at once into a run a robot falls
HALF_CYCLE = (0.0, 0.0, 0.0, 0.5, 0.0)
"""By which the clock of the mirrored robot is ahead: its other diagonal pair begins."""


def advance(clock: Tensor, command: Tensor) -> Tensor:
    """The clock (..., 5) one tick further under `command` (..., 4): it stands once it is told to and has come to rest."""
    pace, phase, _ = clock.split([3, 1, 1], dim=-1)
    step = TICK * pace.new_tensor(ACCELERATION)
    pace = pace + (command[..., :3] - pace).clamp(-step, step)
    speed = gait.speed(pace)
    runs = torch.where(speed == 0, 1 - command[..., 3:], 1.0)
    phase = phase + TICK * gait.frequency(speed)
    return torch.cat([pace, phase.fmod(1.0) * runs, runs], dim=-1)


def pace_and_phase(clock: Tensor) -> tuple[Tensor, Tensor]:
    """What the gait walks at (..., 4), a command, and where in its cycle it is (..., 1), of the clock (..., 5)."""
    pace, phase, runs = clock.split([3, 1, 1], dim=-1)
    return torch.cat([pace, 1 - runs], dim=-1), phase


def hand(pace: Tensor, phase: Tensor) -> Tensor:
    """Sine and cosine of the phase while the clock runs, (..., 2), of `pace_and_phase`."""
    angle = 2 * torch.pi * phase + phase.new_tensor([0.0, torch.pi / 2])
    return angle.sin() * (1 - pace[..., 3:])
