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

from quadvel_description import robot
from quadvel_description.kinematics import foot_positions

from .legs import Legs, angles, joints

HEIGHT = 0.40  # m, wanted trunk height
COM = (0.004, 0.0018, -0.03)  # m, of the whole robot in the trunk frame, roughly
OFFSET = (0.0, 0.5, 0.5, 0.0)  # of a cycle: diagonal pairs
LIFT = 0.08  # m
LEAD = 0.025  # s, by which soft and late drives lag behind a foot's motion
HANDOVER, OF_STANCE = 0.04, 0.27
"""s, in which a leg passes from swing to push and back, and the most of its time on the ground that this may take"""
LEG_WEIGHT = np.tile([[-1.07, 1.07], [0.34, 0.34], [-0.27, -0.27]], 2)  # N m, of a lifted leg
CENTRING = 60.0  # 1/s^2, pull of the standing trunk to the middle of its feet, and to their heading
SPEED_WEIGHTS = (1.0, 1.3, 0.24)  # by which steps come quicker for 1 m/s forward, 1 m/s sideways, 1 rad/s
SLOWEST, QUICKER = 2.2, 0.64  # Hz, and Hz more for each m/s
QUICKEST = 3.0  # m/s, from which on steps come no quicker
FULL_SPEED = 2.5  # m/s, from which on feet stay on the ground for no smaller a share of the cycle
_STAND = foot_positions(robot.NOMINAL_Q).T.copy()
_CENTRE = _STAND[:2].mean(axis=1, keepdims=True)
_FROM_CENTRE = _STAND[:2] - _CENTRE
_AROUND = np.stack([-_STAND[1], _STAND[0]])  # how a foot's place moves at 1 rad/s
_TILT = (250.0, 400.0)  # N m/rad
_TURN = (20.0, 30.0, 10.0)  # N m s/rad
_FORCE_BOUND = 400.0  # N, a foot
_FRICTION = 0.6
_SINGULAR = 1e-4  # against 1/4 a foot: about the line between two feet no moment can be had


@attrs.frozen
class Body:
    """What the gait reads, in the body frame (m, m/s, rad, rad/s)."""

    q: Tensor  # (..., 3, 4), a column a leg
    velocity: Tensor  # (..., 3)
    angular_velocity: Tensor  # (..., 3)
    roll_pitch: Tensor  # (..., 2)
    slope: Tensor  # (..., 2), by how much the ground falls away for 1 m forward, 1 m to the left
    height: Tensor  # (..., 1)


def speed(command: Tensor) -> Tensor:
    """How fast a walk a command (..., 3 or more) is to the steps, m/s forward that need as quick ones, (..., 1)."""
    return (command[..., :3] * command.new_tensor(SPEED_WEIGHTS)).norm(dim=-1, keepdim=True)


def frequency(speed: Tensor) -> Tensor:
    """Cycles a second, 2.2 Hz rising to 4.1 Hz at 3 m/s."""
    return SLOWEST + QUICKER * speed.clamp(max=QUICKEST)


class Cycle:
    """Where in its cycle each leg is: from the gait's phase (..., 1), not negative, and the command (..., 4) it walks at.

    command; frequency (..., 1), Hz; duty (..., 1), share of the cycle on the ground, 0.62 falling to 0.42 at 2.5 m/s; down
    (..., 4) bool: which feet should be on the ground, in stance all.
    """

    def __init__(self, phase: Tensor, command: Tensor) -> None:
        fast = speed(command)
        self.command, self.frequency = command, frequency(fast)
        self.duty = 0.62 - 0.2 / FULL_SPEED * fast.clamp(max=FULL_SPEED)
        self._leg = phase + phase.new_tensor(OFFSET)
        self.stands = command[..., 3:]
        self.down = self._leg.fmod(1.0) < self.duty + self.stands

    def load(self) -> Tensor:
        """How much of its push each leg gives, (..., 4): 0 in its swing, 1 on the ground, without a jump between them.

        The drives are late, so that a handover ends with the change.
        """
        handover = torch.minimum(HANDOVER * self.frequency, OF_STANCE * self.duty)
        ahead = self._leg + 0.5 * handover
        from_middle = ((ahead - 0.5 * self.duty + 0.5).fmod(1.0) - 0.5).abs()
        inside = (0.5 * self.duty - from_middle) / handover
        share = (0.5 + inside + self.stands).clamp(0.0, 1.0)
        return share * share * (3 - 2 * share)

    def swing(self, lead: float = 0.0) -> Tensor:
        """How far each leg's swing has come by `lead` (s) from now, (..., 4): 1 in the first half on the ground, then 0."""
        leg = (self._leg + lead * self.frequency).fmod(1.0)
        landed = (leg < 0.5 * self.duty) & (self.stands == 0)
        return torch.where(landed, 1.0, ((leg - self.duty) / (1 - self.duty)).clamp(min=0.0))

    def lift(self, swing: Tensor) -> Tensor:
        """Wanted height of each foot above ground, (..., 4) m, so far in its swing."""
        return LIFT * (torch.pi * swing.minimum(1 - swing)).sin().square() * (1 - self.stands)


def targets(cycle: Cycle, body: Body) -> Tensor:
    """Joint targets (..., 12) rad: swing feet by position, stance feet by force, through the soft gains."""
    legs = Legs(body.q)
    load = cycle.load()[..., None, :]
    astray = cycle.stands[..., None] * _astray(legs.feet, body.slope)
    on_ground = legs.feet - LEAD * _over_ground(cycle, legs.feet) - astray
    swing, push = angles(torch.stack([_swing_feet(cycle, body), on_ground]))
    swing = swing + body.q.new_tensor(LEG_WEIGHT / robot.KP)
    push = push - legs.torques(_stance_forces(cycle, body, legs.feet, load)) / robot.KP
    return joints(swing + load * (push - swing))


def lean(slope: Tensor) -> Tensor:
    """Roll and pitch (..., 2) rad of a trunk parallel to the ground."""
    return slope.atan() @ slope.new_tensor([[0.0, 1.0], [-1.0, 0.0]])


def upward(roll_pitch: Tensor) -> Tensor:
    """The world's vertical in the body frame, (..., 3), from roll and pitch (..., 2) rad."""
    (roll_sine, sine), (roll_cosine, level) = roll_pitch.sin().split(1, -1), roll_pitch.cos().split(1, -1)
    return torch.cat([-sine, level * roll_sine, level * roll_cosine], dim=-1)


def _swing_feet(cycle: Cycle, body: Body) -> Tensor:
    """Where the swinging feet are to be, trunk frame (..., 3, 4) m: half a stride ahead, corrected by the velocity error.

    On a slope they go where the centre of mass would fall, not below the hips.
    """
    wanted, turn, _ = cycle.command[..., None].split([2, 1, 1], dim=-2)
    swing = cycle.swing(LEAD)
    s = swing[..., None, :]
    stride = (wanted + turn * turn.new_tensor(_AROUND)) * (cycle.duty / cycle.frequency)[..., None]
    error = body.velocity[..., :2, None] - wanted
    level = (s * s * (3 - 2 * s) - 0.5) * stride + 0.12 * s * error + HEIGHT * body.slope[..., None]
    return torch.cat([level, cycle.lift(swing)[..., None, :]], dim=-2) + turn.new_tensor(_STAND)


def _over_ground(cycle: Cycle, feet: Tensor) -> Tensor:
    """How fast the trunk goes over feet (..., 3, 4) m that stand still, where each of them is: (..., 3, 4) m/s."""
    along, turn, _ = cycle.command[..., None].split([2, 1, 1], dim=-2)
    across = feet[..., [1, 0, 2], :] * feet.new_tensor([[-1.0], [1.0], [0.0]])
    return torch.cat([along, torch.zeros_like(turn)], dim=-2) + turn * across


def _stance_forces(cycle: Cycle, body: Body, feet: Tensor, load: Tensor) -> Tensor:
    """Ground forces on the feet, trunk frame (..., 3, 4) N: least squares for a wrench that brings the trunk back."""
    w, v = body.angular_velocity, body.velocity
    along, turn, _ = cycle.command.split([2, 1, 1], dim=-1)
    push, twist = (cycle.stands * CENTRING * _standing_place(feet, body.slope)).split([2, 1], dim=-1)
    carry = robot.GRAVITY + 100 * (HEIGHT - body.height) - 14 * v[..., 2:]
    inward = turn * along.flip(-1) * along.new_tensor([-1.0, 1.0])  # in a curve
    push = 6 * (along - v[..., :2]) + inward + push
    force = robot.MASS * (carry * upward(body.roll_pitch) + push @ push.new_tensor(np.eye(2, 3)))
    tilt = (lean(body.slope) - body.roll_pitch) * w.new_tensor(_TILT)
    moment = torch.cat([tilt, _TURN[2] * turn + twist], dim=-1) - w * w.new_tensor(_TURN)
    arms = feet - feet.new_tensor(COM)[:, None]
    forces = _shared_out(force[..., None], moment[..., None], arms, load)
    level, normal = forces.split([2, 1], dim=-2)
    normal = normal.clamp(0.0, _FORCE_BOUND)
    bound = _FRICTION * normal
    return torch.cat([level.minimum(bound).maximum(-bound), normal], dim=-2)


def _shared_out(force: Tensor, moment: Tensor, feet: Tensor, load: Tensor) -> Tensor:
    """Forces (..., 3, 4) on the feet by their load (..., 1, 4), 0 to 1, which come nearest to a force and a moment (..., 3, 1).

    feet: (..., 3, 4) m from the centre of mass. The least squares of A f = w, f = A^T (A A^T + eps I)^-1 w, as the motion
    of a rigid body of point masses, one a foot and a small one (eps) at the centre of mass: the force accelerates all
    alike, and the moment about their centre turns them, with an inertia of theirs.
    """
    mass = load / load.sum(-1, keepdim=True).clamp(min=2.0).square()  # lifted feet vanish
    total = mass.sum(-1, keepdim=True) + _SINGULAR
    centre = (mass * feet).sum(-1, keepdim=True) / total
    arm, eye = feet - centre, torch.eye(3, dtype=feet.dtype)
    spread = (mass * arm) @ arm.transpose(-1, -2) + _SINGULAR * centre * centre.transpose(-1, -2)
    trace = (spread * eye).sum((-1, -2), keepdim=True)
    turn = _solved((trace + _SINGULAR) * eye - spread, moment - _cross(centre, force))
    return mass * (force / total + _cross(turn, arm))


def _after(v: Tensor) -> Tensor:
    """The rows of (..., 3, n) moved on by one: y, z, x."""
    return v[..., [1, 2, 0], :]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Of columns (..., 3, n)."""
    return _after(a * _after(b) - _after(a) * b)


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    """x (..., 3, 1) of M x = right for a symmetric M (..., 3, 3), by Cramer's rule."""
    after = matrix[..., [1, 2, 0]]
    adjugate = _cross(after, after[..., [1, 2, 0]])
    determinant = (matrix[..., :1] * adjugate[..., :1]).sum(-2, keepdim=True)
    return adjugate @ right / determinant


def _astray(feet: Tensor, slope: Tensor) -> Tensor:
    """How far feet (..., 3, 4) are from where they stand in the nominal posture, forward and to the left, (..., 3, 4) m.

    Forces alone leave it open where each foot stands: led back by nothing, they part within minutes.
    """
    level = feet[..., :2, :] - feet.new_tensor(_STAND[:2]) - HEIGHT * slope[..., None]
    return torch.cat([level, torch.zeros_like(feet[..., :1, :])], dim=-2)


def _standing_place(feet: Tensor, slope: Tensor) -> Tensor:
    """Where the trunk would stand over its feet (..., 3, 4) as in the nominal posture: forward, left (m), yaw (rad).

    Without this pull a standing trunk creeps: soft joints that are told to hold their force follow every lean.
    """
    level = feet[..., :2, :]
    centre = level.mean(dim=-1, keepdim=True)
    arms = level - centre
    across = (arms * feet.new_tensor(_AROUND)).sum((-1, -2), keepdim=True)
    along = (arms * feet.new_tensor(_FROM_CENTRE)).sum((-1, -2), keepdim=True)
    place = centre - feet.new_tensor(_CENTRE) - HEIGHT * slope[..., None]
    return torch.cat([place, (across / along.clamp(min=1e-3)).atan()], dim=-2)[..., 0]
