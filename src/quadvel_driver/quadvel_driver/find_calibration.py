"""Finds what a robot's sensors show at zero, from how it hangs and how it stands.

Hung, with its joints moving slowly to and fro: the torque that holds a leg against its weight is known at each angle, so the
angles at which it is found tell the encoders' zeros; friction shows itself by changing its sign with the direction. Standing
on a level floor: its four feet say where up is in the trunk's frame, and the IMU says where it thinks it is. As the weight
pulls along what the IMU calls down, both are found in turn until they agree. An IMU that is turned about the vertical axis
shows in neither.
"""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from quadvel_description import robot
from quadvel_description.kinematics import foot_positions, rotate, rotate_inverse
from quadvel_description.state import RobotState

from .calibration import Calibration

MOVING = 0.05  # rad/s, from which on a joint's friction points against its motion
STILL = 0.1  # rad/s, up to which a robot that stands counts as standing still
LEVEL = 0.02  # m, that the feet may be off one plane
SAMPLES = 10000  # of a hung robot, that are enough
LEAST = 100  # of either
ROUNDS = 6  # of finding one with the other: four hips that are off alike look much like an IMU that leans
NOISE = 0.25  # N m, of a measured torque
USUAL = 0.035  # rad, two degrees, that encoders are off as a rule
SCALE = 0.1  # by which measured torques may be too large or too small as a whole
TURN = 30  # states before and after a joint turns round: there it is accelerated, and torque is more than weight and friction
UP = np.array([0.0, 0.0, 1.0])
Array = NDArray[np.float64]


class NotFound(ValueError):
    """Why a recording tells nothing, in one sentence."""


@attrs.frozen(eq=False)
class Found:
    """The calibration; standard errors (12,) rad of its zeros, nan where they were not looked for; feet off their plane, m."""

    calibration: Calibration
    zero_errors: Array
    unevenness: float


@attrs.frozen(eq=False)
class Samples:
    """Rows of states: q, dq, tau (n, 12), quaternion (n, 4)."""

    q: Array
    dq: Array
    tau: Array
    quaternion: Array

    @classmethod
    def of(cls, states: Iterable[RobotState]) -> Samples:
        """From states. Raises NotFound where there are too few."""
        rows = [(state.q, state.dq, state.tau, state.quaternion) for state in states]
        if len(rows) < LEAST:
            raise NotFound(f"{len(rows)} states, expected {LEAST} at least")
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))


def find(hung: Samples | None, standing: Samples | None) -> Found:
    """What the recordings tell; where there is none of a kind, what it would tell is taken to be right. Raises NotFound."""
    calibration, errors, unevenness = Calibration(), np.full(12, np.nan), float("nan")
    if hung is not None:
        _check_hung(hung)
    if standing is not None:
        _check_standing(standing)
    for _ in range(ROUNDS):
        if standing is not None:
            mounting, unevenness = _imu_mounting(standing, calibration)
            calibration = attrs.evolve(calibration, imu_mounting=mounting)
        if hung is not None:
            zeros, errors = _joint_zeros(hung, calibration)
            calibration = attrs.evolve(calibration, joint_zeros=zeros)
    return Found(calibration, errors, unevenness)


def holding_torque(q: Array, down: Array) -> Array:
    """Torque (n, 12) N m that holds legs in the air at q (n, 12) rad; down: (n, 3), where the weight pulls, trunk frame."""
    return np.hstack([_leg_torque(q[:, 3 * leg : 3 * leg + 3], down, leg) for leg in range(4)])


def _leg_torque(q: Array, down: Array, leg: int) -> Array:
    """The same for one leg, (n, 3)."""
    (joints, centres), axes, masses = _leg_masses(q, robot.LEGS[leg])
    torque = np.zeros_like(q)
    for joint in range(3):
        for body in range(joint, 3):
            moment = np.cross(centres[body] - joints[joint], masses[body] * robot.GRAVITY * down)
            torque[:, joint] -= (axes[joint] * moment).sum(axis=1)
    return torque


def _leg_masses(q: Array, leg: str) -> tuple[tuple[list[Array], list[Array]], list[Array], list[float]]:
    """Joints' and bodies' places (n, 3) m, joint axes (n, 3) and the bodies' masses (kg) of a leg, trunk frame."""
    place, turn = np.zeros((len(q), 3)), np.broadcast_to(np.eye(3), (len(q), 3, 3))
    joints, centres, axes, masses = [], [], [], []
    for k, kind in enumerate(robot.KINDS):
        link = next(link for link in robot.LINKS if link.name == f"{leg}_{kind}")
        body = robot.combined_inertial(link.name)
        place = place + turn @ np.array(link.origin)
        turn = turn @ _turned(q[:, k], 0 if link.axis == "x" else 1)
        joints.append(place)
        axes.append(turn[:, :, 0 if link.axis == "x" else 1])
        centres.append(place + turn @ np.array(body.com))
        masses.append(float(body.mass))
    return (joints, centres), axes, masses


def _turned(angle: Array, axis: int) -> Array:
    """Rotation matrices (n, 3, 3) about x (0) or y (1)."""
    matrices = np.zeros((len(angle), 3, 3))
    a, b = [i for i in range(3) if i != axis]
    sign = 1.0 if axis == 0 else -1.0
    matrices[:, axis, axis] = 1.0
    matrices[:, a, a] = matrices[:, b, b] = np.cos(angle)
    matrices[:, b, a], matrices[:, a, b] = sign * np.sin(angle), -sign * np.sin(angle)
    return matrices


def _joint_zeros(hung: Samples, calibration: Calibration) -> tuple[Array, Array]:
    """The encoders' zeros and their standard errors, (12,) rad each, with the IMU as `calibration` has it."""
    down = rotate(calibration.mounting, rotate_inverse(hung.quaternion, -UP))
    legs = [_leg_zeros(hung, down, leg, calibration.joint_zeros) for leg in range(4)]
    zeros, errors = np.array(legs).transpose(1, 0, 2).reshape(2, 12)
    return zeros, errors


def _leg_zeros(hung: Samples, down: Array, leg: int, start: Array) -> tuple[Array, Array]:
    """The same for the joints of one leg, (3,) each. down: (n, 3), where the weight pulls, trunk frame."""
    joints = slice(3 * leg, 3 * leg + 3)
    steady = np.flatnonzero(_is_steady(hung.dq[:, joints]))
    rows = steady[:: max(1, len(steady) // SAMPLES)]
    q, dq, tau, down = hung.q[rows, joints], hung.dq[rows, joints], hung.tau[rows, joints], down[rows]

    def residuals(x: Array) -> Array:
        """Of zeros, torque scales, dry and viscous friction, (3,) each."""
        zeros, scale, dry, viscous = x.reshape(4, 3)
        model = scale * _leg_torque(q - zeros, down, leg) + dry * np.sign(dq) + viscous * dq
        return np.concatenate([((tau - model) / NOISE).ravel(), (scale - 1.0) / SCALE, zeros / USUAL])

    guess = np.concatenate([start[joints], np.ones(3), robot.FRICTION[joints], robot.DAMPING[joints]])
    fit = least_squares(residuals, guess, x_scale=np.repeat([0.1, 0.1, 0.5, 0.5], 3))
    variance = np.square(fit.fun[:-6]).sum() / (fit.fun.size - 6 - fit.x.size)
    errors = np.sqrt(max(variance, 1.0) * np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    return fit.x[:3], errors[:3]


def _is_steady(dq: Array) -> NDArray[np.bool_]:
    """Which rows of joint speeds (n, 3) have each joint under way, and not turning round a little before or after."""
    under_way = np.abs(dq) > MOVING
    same = np.sign(dq[1:]) == np.sign(dq[:-1])
    steady: NDArray[np.bool_] = np.all(under_way, axis=1)
    steady = np.logical_and(steady, np.append(True, same.all(axis=1)))
    around = np.convolve(np.logical_not(steady), np.ones(2 * TURN + 1), mode="same")
    return np.asarray(around < 0.5)


def _imu_mounting(standing: Samples, calibration: Calibration) -> tuple[Array, float]:
    """How the IMU leans (2,) rad, and how far the feet are off one plane, m, with the zeros as `calibration` has them."""
    feet = foot_positions(standing.q - calibration.joint_zeros).mean(axis=0)
    centred = feet - feet.mean(axis=0)
    normal = np.linalg.svd(centred)[2][2]
    normal = normal * np.sign(normal[2])
    shown = rotate_inverse(standing.quaternion, UP).mean(axis=0)
    shown = shown / np.linalg.norm(shown)
    turn = np.cross(shown, normal)
    size = float(np.linalg.norm(turn))
    angle = np.arctan2(size, shown @ normal)
    return turn[:2] * (angle / size if size > 0.0 else 1.0), float(np.abs(centred @ normal).max())


def _check_hung(hung: Samples) -> None:
    """Raises NotFound where a joint does not move both ways."""
    for i, name in enumerate(robot.JOINT_NAMES):
        moving = hung.dq[:, i]
        if min((moving > MOVING).sum(), (moving < -MOVING).sum()) < LEAST // 2:
            raise NotFound(f"{name} hardly moves to and fro; record quadvel excite creep with the robot hung")


def _check_standing(standing: Samples) -> None:
    """Raises NotFound where a robot moves, or its feet are on no plane."""
    speed = float(np.abs(standing.dq.mean(axis=0)).max()), float(np.median(np.abs(standing.dq)))
    if max(speed) > STILL:
        raise NotFound(f"the joints move at {max(speed):.2f} rad/s, expected a robot that stands still")
    bent = standing.q.mean(axis=0).reshape(4, 3)[:, 2]
    if (bent < -2.2).any():
        raise NotFound(f"a knee is bent by {bent.min():.2f} rad, expected a robot that stands")
