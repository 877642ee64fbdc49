"""A trotting gait with a clock: what the teacher of the first stage is built on, and the student's network as well.

Swing feet follow a trajectory towards a foothold that the velocity error corrects; stance feet push the trunk towards
the commanded velocity, height and attitude (virtual forces, least squares over the feet on the ground). All in torch,
for it is part of the policy file: tensors are float32, leading axes are free.
"""

from __future__ import annotations

import attrs
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from quadvel_description import robot
from quadvel_description.kinematics import foot_positions

from .legs import Legs, angles

HEIGHT = 0.40  # m, wanted trunk height
COM = (0.004, 0.0018, -0.03)  # m, of the whole robot in the trunk frame, roughly
OFFSET = (0.0, 0.5, 0.5, 0.0)  # of a cycle: diagonal pairs
LIFT = 0.08  # m
LEAD = 0.025  # s, by which the soft gains lag behind a swing
LEG_WEIGHT = np.tile([[-1.07, 0.34, -0.27], [1.07, 0.34, -0.27]], (2, 1))  # N m, of a lifted leg
CENTRING = 30.0  # 1/s^2, pull of the standing trunk to the middle of its feet, and to their heading
SPEED_WEIGHTS = (1.0, 1.3, 0.35)  # how fast the feet go for 1 m/s forward, 1 m/s sideways, 1 rad/s
SLOWEST, FASTEST = 2.2, 3.8  # Hz
FULL_SPEED = 2.5  # m/s, from which on the gait is at its fastest
_STAND = foot_positions(robot.NOMINAL_Q)
_CENTRE = _STAND[:, :2].mean(axis=0)
_AROUND = np.stack([-_STAND[:, 1], _STAND[:, 0]], axis=-1)  # how a foot's place moves at 1 rad/s
_FORCE_BOUND = 400.0  # N, a foot
_FRICTION = 0.6
_SINGULAR = 1e-4  # against 1/4 a foot: about the line between two feet no moment can be had


@attrs.frozen
class Body:
    """What the gait reads, in the body frame (m, m/s, rad, rad/s)."""

    q: Tensor  # (..., 12)
    velocity: Tensor  # (..., 3)
    angular_velocity: Tensor  # (..., 3)
    roll_pitch: Tensor  # (..., 2)
    slope: Tensor  # (..., 2), by how much the ground falls away for 1 m forward, 1 m to the left
    height: Tensor  # (..., 1)


def speed(command: Tensor) -> Tensor:
    """How fast the feet have to go for a command (..., 3 or more), m/s, (..., 1)."""
    return (command[..., :3] * command.new_tensor(SPEED_WEIGHTS)).norm(dim=-1, keepdim=True)


def frequency(speed: Tensor) -> Tensor:
    """Cycles a second, 2.2 Hz rising to 3.8 Hz at 2.5 m/s."""
    return SLOWEST + (FASTEST - SLOWEST) / FULL_SPEED * speed.clamp(max=FULL_SPEED)


def duty(speed: Tensor) -> Tensor:
    """Share of the cycle on the ground, 0.62 falling to 0.42 at 2.5 m/s."""
    return 0.62 - 0.2 / FULL_SPEED * speed.clamp(max=FULL_SPEED)


def leg_phase(phase: Tensor) -> Tensor:
    """Each leg's phase in [0, 1), (..., 4), from the gait's, (..., 1), which is not negative."""
    return (phase + phase.new_tensor(OFFSET)).fmod(1.0)


def wants_contact(phase: Tensor, command: Tensor) -> Tensor:
    """Which feet should be on the ground, (..., 4) bool; all of them in stance. phase (..., 1), command (..., 4)."""
    return leg_phase(phase) < duty(speed(command)) + command[..., 3:]


def swing_height(phase: Tensor, command: Tensor) -> Tensor:
    """Wanted height of each foot above ground, (..., 4) m."""
    return _lift(_swing(phase, duty(speed(command))), command)


def targets(phase: Tensor, command: Tensor, body: Body) -> Tensor:
    """Joint targets (..., 12) rad: swing feet by position, stance feet by force, through the soft gains."""
    down = wants_contact(phase, command)[..., None]
    legs, q = Legs(body.q), body.q.reshape(*body.q.shape[:-1], 4, 3)
    swing = angles(_swing_feet(phase, command, body)) + q.new_tensor(LEG_WEIGHT / robot.KP)
    push = legs.torques(_stance_forces(command, body, legs.feet, down.to(q.dtype)))
    return (torch.where(down, q, swing) - push / robot.KP).reshape(body.q.shape)


def lean(slope: Tensor) -> Tensor:
    """Roll and pitch (..., 2) rad of a trunk parallel to the ground."""
    falls = slope.atan()
    return torch.cat([-falls[..., 1:], falls[..., :1]], dim=-1)


def upward(roll_pitch: Tensor) -> Tensor:
    """The world's vertical in the body frame, (..., 3), from roll and pitch (..., 2) rad."""
    sines, cosines = roll_pitch.sin(), roll_pitch.cos()
    level = cosines[..., 1:]
    return torch.cat([-sines[..., 1:], sines[..., :1] * level, cosines[..., :1] * level], dim=-1)


def _swing(phase: Tensor, duty: Tensor) -> Tensor:
    """How far each leg's swing has come, (..., 4): 0 on the ground."""
    return ((leg_phase(phase) - duty) / (1 - duty)).clamp(0, 1)


def _lift(swing: Tensor, command: Tensor) -> Tensor:
    return LIFT * (torch.pi * swing).sin() ** 2 * (1 - command[..., 3:])


def _swing_feet(phase: Tensor, command: Tensor, body: Body) -> Tensor:
    """Where the swinging feet are to be, trunk frame (..., 4, 3) m: half a stride ahead, corrected by the velocity error.

    On a slope they go where the centre of mass would fall, not below the hips.
    """
    fast = speed(command)
    f, d = frequency(fast), duty(fast)
    swing = _swing(phase + LEAD * f, d)
    s = swing[..., None]
    wanted, turn = command[..., None, :2], command[..., None, 2:3]
    stride = (wanted + turn * command.new_tensor(_AROUND)) * (d / f)[..., None]  # below the trunk, on the ground
    along = s * s * (3 - 2 * s) - 0.5
    level = along * stride + 0.12 * s * (body.velocity[..., None, :2] - wanted)
    level = level + HEIGHT * body.slope[..., None, :]
    return torch.cat([level, _lift(swing, command)[..., None]], dim=-1) + command.new_tensor(_STAND)


def _stance_forces(command: Tensor, body: Body, feet: Tensor, down: Tensor) -> Tensor:
    """Ground forces on the feet, trunk frame (..., 4, 3) N: least squares for a wrench that brings the trunk back."""
    stands, w = command[..., 3:], body.angular_velocity
    place = stands * CENTRING * _standing_place(feet, body.slope)
    carry = robot.GRAVITY + 100 * (HEIGHT - body.height) - 14 * body.velocity[..., 2:]
    push = 6 * (command[..., :2] - body.velocity[..., :2]) + place[..., :2]
    force = robot.MASS * (carry * upward(body.roll_pitch) + pad(push, (0, 1)))
    tilt = (body.roll_pitch - lean(body.slope)) * w.new_tensor([250.0, 400.0])
    turn = 10 * command[..., 2:3] + place[..., 2:]
    moment = torch.cat([-tilt, turn], dim=-1) - w * w.new_tensor([20.0, 30.0, 10.0])
    forces = _shared_out(force, moment, feet - feet.new_tensor(COM), down)
    normal = forces[..., 2:].clamp(0.0, _FORCE_BOUND)
    bound = _FRICTION * normal
    return torch.cat([forces[..., :2].minimum(bound).maximum(-bound), normal], dim=-1)


def _shared_out(force: Tensor, moment: Tensor, feet: Tensor, down: Tensor) -> Tensor:
    """Forces (..., 4, 3) on the feet that are down (..., 4, 1) which come nearest to a force and a moment (..., 3).

    feet: (..., 4, 3) m from the centre of mass. The least squares of A f = w, f = A^T (A A^T + eps I)^-1 w, as the motion
    of a rigid body of point masses, one a foot and a small one (eps) at the centre of mass: the force accelerates all
    alike, and the moment about their centre turns them, with an inertia of theirs.
    """
    share = down / down.sum(-2, keepdim=True).clamp(min=2.0).square()  # lifted feet vanish
    mass, place = pad(share, (0, 0, 0, 1), value=_SINGULAR), pad(feet, (0, 0, 0, 1))
    total = mass.sum(-2)
    centre = (mass * place).sum(-2) / total
    arm = place - centre[..., None, :]
    xx, yy, zz = (mass * arm * arm).sum(-2).unbind(-1)
    yz, zx, xy = (mass * _after(arm) * _after(_after(arm))).sum(-2).unbind(-1)
    xx, yy, zz = yy + zz + _SINGULAR, zz + xx + _SINGULAR, xx + yy + _SINGULAR
    inertia = [torch.stack(row, dim=-1) for row in ((xx, -xy, -zx), (-xy, yy, -yz), (-zx, -yz, zz))]
    turn = _solved(*inertia, moment - _cross(centre, force))
    return (mass * ((force / total)[..., None, :] + _cross(turn[..., None, :], arm)))[..., :4, :]


def _after(v: Tensor) -> Tensor:
    """The components of (..., 3) moved on by one: y, z, x."""
    return v[..., [1, 2, 0]]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return _after(a * _after(b) - _after(a) * b)


def _solved(a: Tensor, b: Tensor, c: Tensor, right: Tensor) -> Tensor:
    """x of M x = right, (..., 3), for the symmetric M of the rows a, b, c, by Cramer's rule."""
    x, y, z = _cross(b, c), _cross(c, a), _cross(a, b)
    adjugate = torch.stack([x, y, z], dim=-2)
    return (adjugate @ right[..., None])[..., 0] / (a * x).sum(-1, keepdim=True)


def _standing_place(feet: Tensor, slope: Tensor) -> Tensor:
    """Where the trunk would stand over its feet (..., 4, 3) as in the nominal posture: forward, left (m), yaw (rad).

    Without this pull a standing trunk creeps: soft joints that are told to hold their force follow every lean.
    """
    centre, stand = feet[..., :2].mean(dim=-2), feet.new_tensor(_STAND[:, :2] - _CENTRE)
    arms = feet[..., :2] - centre[..., None, :]
    across = (arms * feet.new_tensor(_AROUND)).sum((-1, -2))
    turn = (across / (stand * arms).sum((-1, -2)).clamp(min=1e-3)).atan()
    return torch.cat([centre - feet.new_tensor(_CENTRE) - HEIGHT * slope, turn[..., None]], dim=-1)
