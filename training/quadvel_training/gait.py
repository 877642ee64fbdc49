"""A trotting gait with a clock: what the teacher of the first stage is built on.

Swing feet follow a trajectory towards a foothold that the velocity error corrects; stance feet push the trunk towards
the commanded velocity, height and attitude (virtual forces, least squares over the feet on the ground).
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description import robot
from quadvel_description.kinematics import foot_jacobians, foot_positions, inverse_kinematics

HEIGHT = 0.40  # m, wanted trunk height
COM = np.array([0.004, 0.0018, -0.03])  # m, of the whole robot in the trunk frame, roughly
OFFSET = np.array([0.0, 0.5, 0.5, 0.0])  # of a cycle: diagonal pairs
LIFT = 0.08  # m
LEAD = 0.025  # s, by which the soft gains lag behind a swing
LEG_WEIGHT = np.tile([-1.07, 0.34, -0.27, 1.07, 0.34, -0.27], 2)  # N m, of a lifted leg
CENTRING = 30.0  # 1/s^2, pull of the standing trunk to the middle of its feet, and to their heading
SPEED_WEIGHTS = (1.0, 1.3, 0.35)  # how fast the feet go for 1 m/s forward, 1 m/s sideways, 1 rad/s
SLOWEST, FASTEST = 2.2, 3.8  # Hz
FULL_SPEED = 2.5  # m/s, from which on the gait is at its fastest
_STAND = foot_positions(robot.NOMINAL_Q)


@attrs.frozen
class Body:
    """What the gait reads of the true state, in the body frame (m, m/s, rad, rad/s)."""

    q: np.ndarray  # (n, 12)
    velocity: np.ndarray  # (n, 2)
    angular_velocity: np.ndarray  # (n, 3)
    roll_pitch: np.ndarray  # (n, 2)
    lean: np.ndarray  # (n, 2), roll and pitch that the trunk is to have: those of the ground
    height: np.ndarray  # (n,)
    vertical_speed: np.ndarray  # (n,)


def speed(command: np.ndarray) -> np.ndarray:
    """How fast the feet have to go for a command (..., 4), m/s, (...)."""
    return np.linalg.norm(command[..., :3] * SPEED_WEIGHTS, axis=-1)


def frequency(command: np.ndarray) -> np.ndarray:
    """Cycles a second, 2.2 Hz rising to 3.8 Hz at 2.5 m/s."""
    return SLOWEST + (FASTEST - SLOWEST) * np.clip(speed(command) / FULL_SPEED, 0, 1)


def duty(command: np.ndarray) -> np.ndarray:
    """Share of the cycle on the ground, 0.62 falling to 0.42 at 2.5 m/s."""
    return 0.62 - 0.2 * np.clip(speed(command) / FULL_SPEED, 0, 1)


def leg_phase(phase: np.ndarray) -> np.ndarray:
    """Each leg's phase in [0, 1), (..., 4), from the gait's, (...)."""
    return (phase[..., None] + OFFSET) % 1.0


def wants_contact(phase: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Which feet should be on the ground, (..., 4) bool; all of them in stance."""
    return (leg_phase(phase) < duty(command)[..., None]) | (command[..., 3:] > 0.5)


def swing_height(phase: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Wanted height of each foot above ground, (..., 4) m."""
    d = duty(command)[..., None]
    s = np.clip((leg_phase(phase) - d) / (1 - d), 0, 1)
    return LIFT * np.sin(np.pi * s) ** 2 * (command[..., 3:] < 0.5)


def targets(phase: np.ndarray, command: np.ndarray, body: Body, kp: float) -> np.ndarray:
    """Joint targets (n, 12) rad: swing feet by position, stance feet by force, through the soft gains."""
    down = wants_contact(phase, command)
    feet = _swing_feet(phase + LEAD * frequency(command), command, body)
    swing = inverse_kinematics(feet) + LEG_WEIGHT / kp
    q = np.where(np.repeat(down, 3, axis=-1), body.q, swing)
    force = _stance_forces(command, body, down)
    torque = -(np.swapaxes(foot_jacobians(body.q), -1, -2) @ force[..., None])[..., 0]
    return q + torque.reshape(q.shape) / kp


def _swing_feet(phase: np.ndarray, command: np.ndarray, body: Body) -> np.ndarray:
    """Where the swinging feet are to be, trunk frame (n, 4, 3) m: half a stride ahead, corrected by the velocity error.

    On a slope they go where the centre of mass would fall, not below the hips.
    """
    d, f = duty(command)[..., None], frequency(command)[..., None]
    s = np.clip((leg_phase(phase) - d) / (1 - d), 0, 1)
    ahead = np.stack(
        [
            command[:, 0:1] - command[:, 2:3] * _STAND[:, 1],
            command[:, 1:2] + command[:, 2:3] * _STAND[:, 0],
        ],
        axis=-1,
    )  # velocity of the trunk above each foot
    stride = ahead * (d / f)[..., None]
    along = -0.5 + s * s * (3 - 2 * s)
    feet = np.broadcast_to(_STAND, (len(command), 4, 3)).copy()
    feet[..., :2] += (
        along[..., None] * stride + 0.12 * s[..., None] * (body.velocity - command[:, :2])[:, None]
    )
    feet[..., :2] += _downhill(body.lean)[:, None]
    feet[..., 2] += swing_height(phase, command)
    return feet


def _stance_forces(command: np.ndarray, body: Body, down: np.ndarray) -> np.ndarray:
    """Ground forces on the feet, trunk frame (n, 4, 3) N: least squares for a wrench that brings the trunk back."""
    n = len(command)
    roll, pitch = body.roll_pitch.T
    up = np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], axis=-1)
    error = command[:, :2] - body.velocity
    force = (
        robot.MASS * (robot.GRAVITY + 100 * (HEIGHT - body.height) - 14 * body.vertical_speed)[:, None] * up
    )
    force[:, :2] += robot.MASS * 6.0 * error
    feet = foot_positions(body.q)
    place = _standing_place(feet, body.lean) * (command[:, 3:] > 0.5)
    force[:, :2] += robot.MASS * CENTRING * place[:, :2]
    w = body.angular_velocity
    twist = 10 * (command[:, 2] - w[:, 2]) + CENTRING * place[:, 2]
    roll, pitch = (body.roll_pitch - body.lean).T
    moment = np.stack([-250 * roll - 20 * w[:, 0], -400 * pitch - 30 * w[:, 1], twist], axis=-1)
    load = down / np.maximum(down.sum(-1, keepdims=True), 2)  # forces vanish on lifted feet
    map_ = np.zeros((n, 6, 4, 3))
    map_[:, :3] = np.eye(3)[None, :, None, :] * load[:, None, :, None]
    x, y, z = np.moveaxis(feet - COM, -1, 0) * load
    map_[:, 3, :, 1], map_[:, 3, :, 2] = -z, y
    map_[:, 4, :, 0], map_[:, 4, :, 2] = z, -x
    map_[:, 5, :, 0], map_[:, 5, :, 1] = -y, x
    a = map_.reshape(n, 6, 12)
    wrench = np.concatenate([force, moment], axis=-1)
    normal = a @ np.swapaxes(a, -1, -2) + 1e-4 * np.eye(6)
    solved = (np.swapaxes(a, -1, -2) @ np.linalg.solve(normal, wrench[..., None])).reshape(n, 4, 3)
    forces = solved * load[..., None]
    forces[..., 2] = np.clip(forces[..., 2], 0.0, 400.0)
    bound = 0.6 * forces[..., 2:]
    forces[..., :2] = np.clip(forces[..., :2], -bound, bound)
    return forces


def _downhill(lean: np.ndarray) -> np.ndarray:
    """How far from below the trunk the centre of mass would fall on the ground, (n, 2) m, trunk frame."""
    roll, pitch = lean.T
    return HEIGHT * np.stack([np.tan(pitch), -np.tan(roll)], axis=-1)


def _standing_place(feet: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """Where the trunk would stand over its feet (n, 4, 3) as in the nominal posture: forward, left (m), yaw (rad), (n, 3).

    Without this pull a standing trunk creeps: soft joints that are told to hold their force follow every lean.
    """
    centre, stand = feet[..., :2].mean(axis=1), _STAND[:, :2] - _STAND[:, :2].mean(axis=0)
    arms = feet[..., :2] - centre[:, None]
    turn = np.arctan2(
        (stand[:, 0] * arms[..., 1] - stand[:, 1] * arms[..., 0]).sum(-1), (stand * arms).sum((-1, -2))
    )
    place = centre - _STAND[:, :2].mean(axis=0) - _downhill(lean)
    return np.concatenate([place, turn[:, None]], axis=-1)
