"""Calibration of encoder zeros and IMU tilt from a suspended and a standing robot.

Suspended robot, joints moving slowly to and fro: the torque that holds a leg against gravity is a
known function of the joint angles, so the measured torques determine the encoder zeros. Friction
changes its sign with the direction of motion and is fitted, too.

Standing robot on a level floor: the four feet give the vertical in the trunk frame, and the IMU
gives its own vertical. The gravity model needs the IMU, and the feet need the zeros, so both fits
alternate until they agree. A rotation of the IMU about the vertical axis is not observable.
"""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np
from scipy.optimize import least_squares

from quadvel_description.arrays import Array, Bools
from quadvel_description.kinematics import foot_positions, rotate, rotate_inverse
from quadvel_description.quadruped import GRAVITY, JOINT_NAMES, KINDS, LEGS
from quadvel_description.robot import Robot
from quadvel_description.state import RobotState

from .calibration import Calibration

MIN_MOVING_SPEED = 0.05  # rad/s, above which friction opposes the motion
MAX_STANDING_SPEED = 0.1  # rad/s, largest joint speed of a robot that stands still
MAX_ROWS = 10000  # states of a suspended robot that are used
MIN_ROWS = 100  # states needed of either record
ALTERNATIONS = 6  # equal offsets of four hips resemble a tilted IMU, so the fits converge slowly
TORQUE_NOISE_NM = 0.25  # standard deviation of a measured torque
ZERO_PRIOR_RAD = 0.035  # (2 deg), prior standard deviation of an encoder zero
TORQUE_SCALE_PRIOR = 0.1  # prior standard deviation of the scale of measured torques
ZERO_STEP_RAD = 1e-6  # step of differences by encoder zeros
REVERSAL_MARGIN = 30  # states around a reversal to leave out: the joint accelerates there
UP = np.array([0.0, 0.0, 1.0])


class CalibrationDataError(ValueError):
    """A recording cannot be used for calibration; the text is the reason, in one sentence."""


@attrs.frozen(eq=False)
class CalibrationFit:
    """Result of a calibration.

    Attributes:
        calibration: The calibration.
        zero_errors: Standard errors of the joint zeros, (12,), rad; NaN if they were not fitted.
        unevenness: Largest distance of a foot from the plane of the feet, m; NaN without a standing
            record.
    """

    calibration: Calibration
    zero_errors: Array
    unevenness: float


@attrs.frozen(eq=False)
class Samples:
    """States as arrays.

    Attributes:
        q: Joint angles, (n, 12), rad.
        dq: Joint speeds, (n, 12), rad/s.
        tau: Joint torques, (n, 12), N m.
        quaternion: Orientation (w, x, y, z), (n, 4).
    """

    q: Array
    dq: Array
    tau: Array
    quaternion: Array

    @classmethod
    def from_states(cls, states: Iterable[RobotState]) -> Samples:
        """Collect states.

        Args:
            states: Measured states.

        Returns:
            Their arrays.

        Raises:
            CalibrationDataError: There are fewer than MIN_ROWS states.
        """
        rows = [(state.q, state.dq, state.tau, state.quaternion) for state in states]
        if len(rows) < MIN_ROWS:
            raise CalibrationDataError(f"{len(rows)} states, expected {MIN_ROWS} at least")
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))


def fit_calibration(robot: Robot, suspended: Samples | None, standing: Samples | None) -> CalibrationFit:
    """Fit the calibration to the records; parameters without a record keep zero offset.

    Args:
        robot: The robot.
        suspended: States of a suspended robot that moves its joints slowly; None if there are none.
        standing: States of a robot that stands on a level floor; None if there are none.

    Returns:
        The calibration and its quality.

    Raises:
        CalibrationDataError: A joint does not move in both directions, or a standing robot moves.
    """
    calibration, errors, unevenness = Calibration(), np.full(12, np.nan), float("nan")
    if suspended is not None:
        _check_suspended(suspended)
    if standing is not None:
        _check_standing(standing)
    for _ in range(ALTERNATIONS):
        if standing is not None:
            mounting, unevenness = _imu_mounting(robot, standing, calibration)
            calibration = attrs.evolve(calibration, imu_mounting=mounting)
        if suspended is not None:
            zeros, errors = _joint_zeros(robot, suspended, calibration)
            calibration = attrs.evolve(calibration, joint_zeros=zeros)
    return CalibrationFit(calibration, errors, unevenness)


def holding_torque(robot: Robot, q: Array, down: Array) -> Array:
    """Compute the joint torques that hold legs in the air against gravity.

        tau_j = -a_j . sum over bodies b beyond j of (c_b - p_j) x (m_b g e_down)

    with joint axis a_j, joint position p_j, and centre of mass c_b.

    Args:
        robot: The robot.
        q: Joint angles, (n, 12), rad.
        down: Direction of gravity in the trunk frame, unit vectors, (n, 3).

    Returns:
        Torques, (n, 12), N m.
    """
    return np.hstack([_leg_torque(robot, q[:, 3 * leg : 3 * leg + 3], down, leg) for leg in range(4)])


def _leg_torque(robot: Robot, q: Array, down: Array, leg: int) -> Array:
    """Return the holding torque of one leg, (n, 3), N m."""
    (joints, centres), axes, masses = _leg_masses(robot, q, LEGS[leg])
    torque = np.zeros_like(q)
    for joint in range(3):
        for body in range(joint, 3):
            moment = np.cross(centres[body] - joints[joint], masses[body] * GRAVITY * down)
            torque[:, joint] -= (axes[joint] * moment).sum(axis=1)
    return torque


def _leg_masses(
    robot: Robot, q: Array, leg: str
) -> tuple[tuple[list[Array], list[Array]], list[Array], list[float]]:
    """Return joint positions and centres of mass (n, 3) m, joint axes (n, 3) and masses (kg) of a leg, trunk frame."""
    position, rotation = np.zeros((len(q), 3)), np.broadcast_to(np.eye(3), (len(q), 3, 3))
    joints, centres, axes, masses = [], [], [], []
    for k, kind in enumerate(KINDS):
        link = next(link for link in robot.links if link.name == f"{leg}_{kind}")
        body = robot.combined_inertial(link.name)
        position = position + rotation @ np.array(link.origin)
        rotation = rotation @ _rotation_about(q[:, k], 0 if link.axis == "x" else 1)
        joints.append(position)
        axes.append(rotation[:, :, 0 if link.axis == "x" else 1])
        centres.append(position + rotation @ np.array(body.com))
        masses.append(float(body.mass))
    return (joints, centres), axes, masses


def _rotation_about(angle: Array, axis: int) -> Array:
    """Return the rotation matrices (n, 3, 3) about x (0) or y (1)."""
    matrices = np.zeros((len(angle), 3, 3))
    a, b = [i for i in range(3) if i != axis]
    sign = 1.0 if axis == 0 else -1.0
    matrices[:, axis, axis] = 1.0
    matrices[:, a, a] = matrices[:, b, b] = np.cos(angle)
    matrices[:, b, a], matrices[:, a, b] = sign * np.sin(angle), -sign * np.sin(angle)
    return matrices


def _joint_zeros(robot: Robot, suspended: Samples, calibration: Calibration) -> tuple[Array, Array]:
    """Return the encoder zeros and their standard errors, (12,) rad each, for the IMU tilt of `calibration`."""
    down = rotate(calibration.mounting, rotate_inverse(suspended.quaternion, -UP))
    legs = [_leg_zeros(robot, suspended, down, leg, calibration.joint_zeros) for leg in range(4)]
    zeros, errors = np.array(legs).transpose(1, 0, 2).reshape(2, 12)
    return zeros, errors


def _leg_zeros(robot: Robot, suspended: Samples, down: Array, leg: int, start: Array) -> tuple[Array, Array]:
    """Return zeros and standard errors of one leg, (3,) rad each.

    The covariance of the fit is s^2 (J^T J)^-1 with the residual variance s^2, at least 1.

    Args:
        robot: The robot.
        suspended: States of a suspended robot.
        down: Direction of gravity in the trunk frame, (n, 3).
        leg: Index of the leg.
        start: Initial zeros, (12,), rad.
    """
    joints = slice(3 * leg, 3 * leg + 3)
    steady = np.flatnonzero(_is_steady(suspended.dq[:, joints]))
    rows = steady[:: max(1, len(steady) // MAX_ROWS)]
    problem = _LegProblem(
        robot,
        leg,
        q=suspended.q[rows, joints],
        dq=suspended.dq[rows, joints],
        tau=suspended.tau[rows, joints],
        down=down[rows],
    )
    guess = np.concatenate(
        [start[joints], np.ones(3), robot.joint_friction[joints], robot.joint_damping[joints]]
    )
    scale = np.repeat([0.1, 0.1, 0.5, 0.5], 3)
    fit = least_squares(problem.residuals, guess, problem.jacobian, x_scale=scale)
    variance = np.square(fit.fun[:-6]).sum() / (fit.fun.size - 6 - fit.x.size)
    errors = np.sqrt(max(variance, 1.0) * np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    return fit.x[:3], errors[:3]


@attrs.frozen(eq=False)
class _LegProblem:
    """Least squares over the zeros z, torque scales k, Coulomb friction c and viscous friction d of a leg.

        tau = k tau_hold(q - z) + c sign(dq) + d dq

    It is weighted by TORQUE_NOISE_NM, with priors k = 1 +- TORQUE_SCALE_PRIOR and z = 0 +-
    ZERO_PRIOR_RAD. The parameters are (z, k, c, d) of the three joints, (12,).

    Attributes:
        robot: The robot.
        leg: Index of the leg.
        q: Joint angles, (n, 3), rad.
        dq: Joint speeds, (n, 3), rad/s.
        tau: Joint torques, (n, 3), N m.
        down: Direction of gravity in the trunk frame, (n, 3).
    """

    robot: Robot
    leg: int
    q: Array
    dq: Array
    tau: Array
    down: Array

    def residuals(self, x: Array) -> Array:
        """Return the weighted residuals of the torques and of the priors of k and z, (3 n + 6,)."""
        zeros, scale, dry, viscous = x.reshape(4, 3)
        model = scale * self._holding(zeros) + dry * np.sign(self.dq) + viscous * self.dq
        priors = (scale - 1.0) / TORQUE_SCALE_PRIOR, zeros / ZERO_PRIOR_RAD
        return np.concatenate([((self.tau - model) / TORQUE_NOISE_NM).ravel(), *priors])

    def jacobian(self, x: Array) -> Array:
        """Return the derivatives of the residuals, (3 n + 6, 12); those by z from differences."""
        zeros, scale, _, _ = x.reshape(4, 3)
        model = np.zeros((len(self.q), 3, 4, 3))  # d tau_joint / d (kind of parameter, of joint)
        holding, own = self._holding(zeros), np.arange(3)
        for joint, step in enumerate(ZERO_STEP_RAD * np.eye(3)):
            model[:, :, 0, joint] = scale * (self._holding(zeros + step) - holding) / ZERO_STEP_RAD
        for kind, slope in enumerate((holding, np.sign(self.dq), self.dq), 1):
            model[:, own, kind, own] = slope
        priors = np.zeros((2, 3, 4, 3))
        priors[0, own, 1, own], priors[1, own, 0, own] = 1.0 / TORQUE_SCALE_PRIOR, 1.0 / ZERO_PRIOR_RAD
        return np.vstack([-model.reshape(-1, 12) / TORQUE_NOISE_NM, priors.reshape(-1, 12)])

    def _holding(self, zeros: Array) -> Array:
        return _leg_torque(self.robot, self.q - zeros, self.down, self.leg)


def _is_steady(dq: Array) -> Bools:
    """Return the rows of joint speeds (n, 3) in which all joints move, and none reverses nearby, (n,)."""
    under_way = np.abs(dq) > MIN_MOVING_SPEED
    same = np.sign(dq[1:]) == np.sign(dq[:-1])
    steady: Bools = np.all(under_way, axis=1)
    steady = np.logical_and(steady, np.append(True, same.all(axis=1)))
    around = np.convolve(np.logical_not(steady), np.ones(2 * REVERSAL_MARGIN + 1), mode="same")
    return np.asarray(around < 0.5)


def _imu_mounting(robot: Robot, standing: Samples, calibration: Calibration) -> tuple[Array, float]:
    """Return the tilt of the IMU, (2,) rad, and the largest distance of a foot from their plane, m.

    The tilt is the rotation from the vertical that the IMU shows to the normal of the plane of the
    feet (the singular vector of the smallest singular value of the centred foot positions).
    """
    feet = foot_positions(robot, standing.q - calibration.joint_zeros).mean(axis=0)
    centred = feet - feet.mean(axis=0)
    normal = np.linalg.svd(centred)[2][2]
    normal = normal * np.sign(normal[2])
    imu_up = rotate_inverse(standing.quaternion, UP).mean(axis=0)
    imu_up = imu_up / np.linalg.norm(imu_up)
    rotation = np.cross(imu_up, normal)
    sine = float(np.linalg.norm(rotation))
    angle = np.arctan2(sine, imu_up @ normal)
    return rotation[:2] * (angle / sine if sine > 0.0 else 1.0), float(np.abs(centred @ normal).max())


def _check_suspended(suspended: Samples) -> None:
    """Raise CalibrationDataError if a joint does not move in both directions."""
    for i, name in enumerate(JOINT_NAMES):
        moving = suspended.dq[:, i]
        if min((moving > MIN_MOVING_SPEED).sum(), (moving < -MIN_MOVING_SPEED).sum()) < MIN_ROWS // 2:
            raise CalibrationDataError(
                f"{name} hardly moves to and fro; record quadvel excite creep with the robot suspended"
            )


def _check_standing(standing: Samples) -> None:
    """Raise CalibrationDataError if the robot moves or does not stand on straight enough legs."""
    speed = float(np.abs(standing.dq.mean(axis=0)).max()), float(np.median(np.abs(standing.dq)))
    if max(speed) > MAX_STANDING_SPEED:
        raise CalibrationDataError(
            f"the joints move at {max(speed):.2f} rad/s, expected a robot that stands still"
        )
    bent = standing.q.mean(axis=0).reshape(4, 3)[:, 2]
    if (bent < -2.2).any():
        raise CalibrationDataError(f"a knee is bent by {bent.min():.2f} rad, expected a robot that stands")
