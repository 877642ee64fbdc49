"""Calibration of encoder zeros and IMU tilt from a suspended and a standing robot.

Suspended robot, joints moving slowly to and fro: the torque that moves a leg against gravity and
inertia is a known function of the joint angles, so the measured torques determine the encoder
zeros. Friction changes its sign with the direction of motion and is fitted, too.

Standing robot on a level floor: the four feet are equally high, and the IMU gives the vertical.

One least-squares problem holds both, so that the standard errors contain what the records cannot
tell apart: equal offsets of four hips resemble a tilted IMU. A rotation of the IMU about the
vertical axis is not observable.
"""

from __future__ import annotations

import attrs
import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2

from quadvel_description.arrays import Array, Bools, Indices
from quadvel_description.kinematics import foot_positions, rotate, rotate_inverse
from quadvel_description.robot import Robot

from .calibration import Calibration, CalibrationError
from .calibration_samples import BLOCK_S, UP, CalibrationDataError, Motion, Samples
from .leg_dynamics import leg_torque

__all__ = ["CalibrationDataError", "CalibrationFit", "Samples", "fit_calibration"]

MAX_CHANCE = 0.001
"""Zeros are significant together if encoders that are right show as large ones with less probability."""
SIGNIFICANT_ERRORS = 3.0
"""Standard errors from which on a tilt of the IMU is significant."""
TORQUE_NOISE_NM = 0.05
"""Standard deviation of a mean torque before the residuals are known, N m."""
CORRELATION_SPANS_S = (BLOCK_S, 0.1, 0.5, 1.0, 2.0)
"""Spans over which residuals are averaged, s: the means of correlated ones scatter more."""
ZERO_PRIOR_RAD = 0.035
"""Prior standard deviation of an encoder zero, rad (2 deg)."""
MOUNTING_PRIOR_RAD = 0.05
"""Prior standard deviation of the IMU's tilt, rad (3 deg)."""
TORQUE_SCALE_PRIOR = 0.1
"""Prior standard deviation of the scale of measured torques."""
TORQUE_OFFSET_PRIOR_NM = 0.02
"""Prior standard deviation of the offset of measured torques, N m: it resembles an encoder's."""
FRICTION_PRIOR = 10.0
"""Prior standard deviation of Coulomb (N m) and viscous (N m s/rad) friction: they are free."""
MIN_TORQUE_NOISE_NM = 0.005
"""Least standard deviation of a mean torque, N m."""
FOOT_HEIGHT_NOISE_M = 0.001
"""Standard deviation of the height of a standing foot, m: floor, and rubber of the foot."""
DIFFERENCE_STEP_RAD = 1e-6
"""Step of differences by angles, rad."""
_MOUNTING = slice(12, 14)  # parameters: zeros, mounting, then those of the torques
_SENSORS = 14
_TORQUE_KINDS = 4  # scale, Coulomb friction, viscous friction and offset of each joint
_SIZE = _SENSORS + 12 * _TORQUE_KINDS
_PRIOR_DEVIATIONS = np.repeat(
    [
        ZERO_PRIOR_RAD,
        MOUNTING_PRIOR_RAD,
        TORQUE_SCALE_PRIOR,
        FRICTION_PRIOR,
        FRICTION_PRIOR,
        TORQUE_OFFSET_PRIOR_NM,
    ],
    [12, 2, 12, 12, 12, 12],
)


@attrs.frozen(eq=False)
class CalibrationFit:
    """Result of a calibration.

    Attributes:
        estimate: All offsets, estimated together.
        zero_errors: Standard errors of the joint zeros, (12,), rad; NaN if they were not estimated.
        mounting_errors: Standard errors of the IMU's tilt in `estimate`, (2,), rad.
        tilt: The IMU's tilt for the zeros that `calibration` corrects, (2,), rad: that of `estimate`, or
            estimated again from the same records for encoders that are right.
        tilt_errors: Standard errors of `tilt`, (2,), rad.
        calibration: The correction to apply: all of `estimate` if the zeros together are significant;
            else `tilt`, if it is significant.
        unevenness: Largest distance of a foot from the plane of the feet, m; NaN without a standing
            record.
    """

    estimate: Calibration
    zero_errors: Array
    mounting_errors: Array
    tilt: Array
    tilt_errors: Array
    calibration: Calibration
    unevenness: float


def fit_calibration(robot: Robot, suspended: Samples | None, standing: Samples | None) -> CalibrationFit:
    """Fit the calibration to the records; without a suspended one the encoders count as right.

    Args:
        robot: The robot.
        suspended: States of a suspended robot that moves its joints slowly; None if there are none.
        standing: States of a robot that stands on a level floor; None if there are none.

    Returns:
        The calibration and its quality.

    Raises:
        CalibrationDataError: A joint does not move in both directions, or a standing robot moves.
    """
    problem = _Problem.from_records(robot, suspended, standing)
    free = np.arange(_SENSORS) >= (12 if suspended is None else 0)
    estimate, covariance = problem.solve(free)
    errors = np.where(free, np.sqrt(np.diag(covariance)), np.nan)
    written, chosen, chosen_errors = estimate, estimate, errors
    if not _zeros_are_significant(estimate, covariance):
        chosen, covariance = problem.solve(np.arange(_SENSORS) >= 12)
        chosen_errors = np.sqrt(np.diag(covariance))
        written = np.where(np.abs(chosen) >= SIGNIFICANT_ERRORS * chosen_errors, chosen, 0.0)
    calibration = _as_calibration(written)
    return CalibrationFit(
        estimate=_as_calibration(estimate),
        zero_errors=errors[:12],
        mounting_errors=errors[_MOUNTING],
        tilt=chosen[_MOUNTING],
        tilt_errors=chosen_errors[_MOUNTING],
        calibration=calibration,
        unevenness=float("nan") if problem.stand is None else problem.stand.unevenness(calibration),
    )


def _zeros_are_significant(estimate: Array, covariance: Array) -> bool:
    """Return whether chance does not explain the zeros: a Wald test of all twelve together.

    Significant zeros are all corrected: their errors depend on each other, and a hip that is left off
    would shift the other three.

    Args:
        estimate: All zeros and the mounting, (14,), rad.
        covariance: Their covariance, (14, 14), rad^2; 0 for those that are not estimated.
    """
    zeros, spread = estimate[:12], covariance[:12, :12]
    return bool(spread.any() and zeros @ np.linalg.solve(spread, zeros) > chi2.isf(MAX_CHANCE, 12))


def _as_calibration(sensors: Array) -> Calibration:
    """Return the calibration of zeros and mounting, (14,) rad."""
    try:
        return Calibration(sensors[:12], sensors[_MOUNTING])
    except CalibrationError as error:
        raise CalibrationDataError(f"{error}; check --robot and the joints") from None


@attrs.frozen(eq=False)
class _Problem:
    """Least squares over zeros and mounting (14,), and torque parameters (12 * _TORQUE_KINDS,).

    Attributes:
        swing: The suspended record; None if there is none.
        stand: The standing record; None if there is none.
    """

    swing: _Swing | None
    stand: _Stand | None

    @classmethod
    def from_records(cls, robot: Robot, suspended: Samples | None, standing: Samples | None) -> _Problem:
        """Check and condense the records."""
        if suspended is not None:
            suspended.check_suspended()
        if standing is not None:
            standing.check_standing()
        return cls(
            None if suspended is None else _Swing.from_samples(robot, suspended),
            None if standing is None else _Stand.from_samples(robot, standing),
        )

    def solve(self, free: Bools) -> tuple[Array, Array]:
        """Return zeros and mounting, (14,) rad, and their covariance; those not free are zero.

        The second fit weights the torques of each joint by the residuals of the first.
        """
        noise, refined = np.full(12, TORQUE_NOISE_NM), self
        if self.swing is not None:
            first, _ = self._fit(free, noise)
            noise = self.swing.noise(first)
            refined = attrs.evolve(self, swing=self.swing.with_inertia(first))
        x, jacobian = refined._fit(free, noise)
        covariance = np.zeros((_SENSORS, _SENSORS))
        covariance[np.ix_(free, free)] = np.linalg.inv(jacobian.T @ jacobian)[: free.sum(), : free.sum()]
        return x[:_SENSORS], covariance

    def _fit(self, free: Bools, noise: Array) -> tuple[Array, Array]:
        """Return all parameters (_SIZE,), and the Jacobian of the residuals by the free ones."""
        columns = np.append(free, np.full(_SIZE - _SENSORS, True))
        x = _prior_means(self.swing)

        def whole(values: Array) -> Array:
            x[columns] = values
            return x

        fit: OptimizeResult = least_squares(
            lambda values: self._residuals(whole(values), noise),
            x[columns],
            lambda values: self._jacobian(whole(values), noise)[:, columns],
        )
        return whole(fit.x).copy(), fit.jac

    def _residuals(self, x: Array, noise: Array) -> Array:
        rows = [(x - _prior_means(self.swing)) / _PRIOR_DEVIATIONS]
        if self.swing is not None:
            rows.append((self.swing.residuals(x) / noise)[self.swing.motion.steady])
        if self.stand is not None:
            rows.append(self.stand.residuals(x))
        return np.concatenate(rows)

    def _jacobian(self, x: Array, noise: Array) -> Array:
        rows = [np.diag(1.0 / _PRIOR_DEVIATIONS)]
        if self.swing is not None:
            rows.append((self.swing.jacobian(x) / noise[:, None])[self.swing.motion.steady])
        if self.stand is not None:
            rows.append(self.stand.jacobian(x))
        return np.vstack(rows)


@attrs.frozen(eq=False)
class _Swing:
    """Torques of a suspended robot.

        tau = k tau_hold(q - z) + tau_inertia + c sign(dq) + d dq + b

    The parameters are zeros z (12,) and mounting (2,), then k, c, d and b of each joint. The fit does
    not change tau_inertia: noise of the accelerations would make k, and with it z, too small.

    Attributes:
        robot: The robot.
        motion: Its motion.
        inertia: Torques tau_inertia that accelerate the legs, (n, 12), N m.
    """

    robot: Robot
    motion: Motion
    inertia: Array

    @classmethod
    def from_samples(cls, robot: Robot, suspended: Samples) -> _Swing:
        """Average the states; the inertia is that of encoders and torques that are right."""
        motion = Motion.from_samples(suspended)
        bare = cls(robot, motion, np.zeros_like(motion.q))
        return bare.with_inertia(_prior_means(bare))

    def with_inertia(self, x: Array) -> _Swing:
        """Return the same with the inertia for given parameters."""
        motion, scale = self.motion, x[_SENSORS : _SENSORS + 12]
        moving = self._torque(x, motion.dq, motion.ddq) - self._holding(x)
        return attrs.evolve(self, inertia=scale * moving)

    def residuals(self, x: Array) -> Array:
        """Return measured less modelled torques, (n, 12), N m."""
        scale, dry, viscous, offset = x[_SENSORS:].reshape(_TORQUE_KINDS, 12)
        motion = self.motion
        friction = dry * np.sign(motion.dq) + viscous * motion.dq
        return motion.tau - scale * self._holding(x) - self.inertia - friction - offset

    def jacobian(self, x: Array) -> Array:
        """Return the derivatives of the residuals, (n, 12, _SIZE); those by angles from differences."""
        motion, own = self.motion, np.arange(12)
        scale, torque = x[_SENSORS : _SENSORS + 12], self._holding(x)
        slopes = np.zeros((len(torque), 12, _SIZE))
        for k in range(3):  # the same joint of all legs at once: no leg's torque depends on another's zeros
            moved = np.flatnonzero(own % 3 == k)
            change = self._torque_change(x, moved, torque) * scale
            for joint in moved:
                leg = slice(joint - k, joint - k + 3)
                slopes[:, leg, joint] = change[:, leg]
        for parameter in range(_MOUNTING.start, _MOUNTING.stop):
            slopes[:, :, parameter] = self._torque_change(x, parameter, torque) * scale
        by_kind = slopes[:, :, _SENSORS:].reshape(-1, 12, _TORQUE_KINDS, 12)
        for kind, slope in enumerate((torque, np.sign(motion.dq), motion.dq, np.ones_like(torque))):
            by_kind[:, own, kind, own] = slope
        return -slopes

    def noise(self, x: Array) -> Array:
        """Return the standard deviation of the joints' torques, (12,), N m, raised to cover their correlation.

        Means of m residuals scatter with sigma / sqrt(m) if they are independent; the largest sigma
        over CORRELATION_SPANS_S is taken.
        """
        residuals, steady = self.residuals(x), self.motion.steady
        noise = np.full(12, MIN_TORQUE_NOISE_NM)
        for joint in range(12):
            mine, times = residuals[steady[:, joint], joint], self.motion.time[steady[:, joint]]
            for span in CORRELATION_SPANS_S:
                group = np.unique(np.floor(times / span), return_inverse=True)[1]
                sums, counts = np.bincount(group, mine), np.bincount(group)
                noise[joint] = max(noise[joint], np.sqrt(np.mean(sums**2 / counts)))
        return noise

    def _torque_change(self, x: Array, parameters: Indices | int, torque: Array) -> Array:
        """Return the derivative of `_holding` by one parameter, or by several together, (n, 12)."""
        moved = x.copy()
        moved[parameters] += DIFFERENCE_STEP_RAD
        return (self._holding(moved) - torque) / DIFFERENCE_STEP_RAD

    def _holding(self, x: Array) -> Array:
        """Return the torques against gravity for zeros and mounting of x, (n, 12), N m."""
        rest = np.zeros_like(self.motion.q)
        return self._torque(x, rest, rest)

    def _torque(self, x: Array, dq: Array, ddq: Array) -> Array:
        """Return the torques without friction for zeros and mounting of x, (n, 12), N m."""
        q, down = self.motion.q - x[:12], -rotate(_mounting(x), self.motion.up)
        legs = (slice(3 * leg, 3 * leg + 3) for leg in range(4))
        return np.hstack(
            [
                leg_torque(self.robot, i, q[:, own], dq[:, own], ddq[:, own], down)
                for i, own in enumerate(legs)
            ]
        )


@attrs.frozen(eq=False)
class _Stand:
    """Heights of the feet of a standing robot.

    Attributes:
        robot: The robot.
        q: Mean joint angles, (12,), rad.
        up: Mean vertical in the frame of the IMU, (3,).
    """

    robot: Robot
    q: Array
    up: Array

    @classmethod
    def from_samples(cls, robot: Robot, standing: Samples) -> _Stand:
        """Average the states."""
        up = rotate_inverse(standing.quaternion, UP).mean(axis=0)
        return cls(robot, standing.q.mean(axis=0), up / np.linalg.norm(up))

    def residuals(self, x: Array) -> Array:
        """Return the feet's heights above their mean, (4,), in FOOT_HEIGHT_NOISE_M."""
        height = foot_positions(self.robot, self.q - x[:12]) @ rotate(_mounting(x), self.up)
        return (height - height.mean()) / FOOT_HEIGHT_NOISE_M

    def jacobian(self, x: Array) -> Array:
        """Return the derivatives of the residuals, (4, _SIZE), from differences."""
        slopes, here = np.zeros((4, _SIZE)), self.residuals(x)
        for parameter in range(_SENSORS):
            moved = x.copy()
            moved[parameter] += DIFFERENCE_STEP_RAD
            slopes[:, parameter] = (self.residuals(moved) - here) / DIFFERENCE_STEP_RAD
        return slopes

    def unevenness(self, calibration: Calibration) -> float:
        """Return the largest distance of a foot from the plane of the feet, m."""
        feet = foot_positions(self.robot, self.q - calibration.joint_zeros)
        centred = feet - feet.mean(axis=0)
        return float(np.abs(centred @ np.linalg.svd(centred)[2][2]).max())


def _mounting(x: Array) -> Array:
    """Return the rotation from trunk to IMU as a quaternion (w, x, y, z), (4,)."""
    return Calibration(imu_mounting=x[_MOUNTING]).mounting


def _prior_means(swing: _Swing | None) -> Array:
    """Return the prior means of all parameters, (_SIZE,)."""
    x = np.zeros(_SIZE)
    if swing is not None:
        x[_SENSORS:] = np.concatenate(
            [np.ones(12), swing.robot.joint_friction, swing.robot.joint_damping, np.zeros(12)]
        )
    return x
