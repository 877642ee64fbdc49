"""What the drives made of the commands: torque against the PD law, for every pairing of joint and command.

For joint i and command j, at a delay D from the sending of a command to the torque,

    tau_i(t) = a_1 (kp_j q_des,j + tau_ff,j) - a_2 kp_j q_i + a_3 kd_j (dq_des,j - dq_i) + b kp_j

with the command of t - D. A healthy drive has a_1 = a_2 = a_3 = 1 and b = 0 for j = i. A gain changes all
three alike, a sign turns a_1, a unit of the angles changes a_2 alone, and b is an offset of the zero, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

from .run import Run

DELAY_STEP_S = 0.001
MAX_DELAY_S = 0.045
MIN_ROWS, MIN_EXACT_ROWS = 60, 6
MAX_EXACT_DELAY_S = 0.031
REGRESSORS = 4
EQUAL_ERROR = 1.02
"""Ratio to the least error up to which delays count as equally good."""
MIN_MOVED_RAD = 0.01
"""Standard deviation of an angle whose noise, at most 1 mrad, does not decide a fit; joints of a standing robot have
less, hips of a walking one 0.026, its other joints 0.1 or more."""
LITTLE_TORQUE_NM = 8.0
"""Torque that every healthy drive gives, N m; fits start from rows below it."""
MIN_SPREAD_NM = 0.05
FIT_ROUNDS = 5
OUTLIER = 4.0
"""Residual, in robust standard deviations, above which a row is left out of a fit."""


def robust_std(values: Array) -> float:
    """Return the standard deviation that the median of the magnitudes suggests.

    Args:
        values: Numbers of any shape around zero.

    Returns:
        1.4826 median(|x|).
    """
    return float(1.4826 * np.median(np.abs(values))) if values.size else float("nan")


@attrs.frozen(eq=False)
class DriveFit:
    """Fit of one joint.

    Attributes:
        command: a_1 of the module's equation: factor of kp q_des + tau_ff, 1 if healthy.
        angle: a_2: factor of kp q, 1 if healthy.
        speed: a_3: factor of kd (dq_des - dq), 1 if healthy.
        offset: b: offset of the zero of the angle, rad, 0 if healthy.
        errors: Standard errors of the four, (4,).
        share_used: Share of the rows that are no outliers.
        spread: Standard deviation of the residual torque in these rows, N m.
        has_moved: Whether the joint moved by more than the noise of its angle: else its coefficients say nothing.
    """

    command: float
    angle: float
    speed: float
    offset: float
    errors: Array
    share_used: float
    spread: float
    has_moved: bool


class ExactModel:
    """PD law with the commanded gains, for every pairing and sign: few rows suffice.

        tau_i = clip(kp_j (s q_des,j - q_i) + s tau_ff,j - kd_j dq_i, -limit, limit),  s = 1 or -1

    Attributes:
        delay: Delay at which the best pairings fit best, s.
        pairs: Mean square errors of joint i under command j, (J, J), N^2 m^2.
        flipped: Mean square errors of joint i under its own negative command, (J,), N^2 m^2.
        turned: Mean square errors of the negative torque of joint i under its own command, (J,), N^2 m^2.
        variance: Mean square of the torques, (J,), N^2 m^2.
        rows: Number of states behind these numbers.
    """

    def __init__(self, run: Run) -> None:
        assert run.tau is not None
        joints = len(run.joints)
        limit = run.robot.torque_limit if run.is_own else np.full(joints, np.inf)
        found = []
        before: Indices | None = None
        for delay in np.arange(0.0, MAX_EXACT_DELAY_S, DELAY_STEP_S):
            rows = run.command_rows(float(delay))
            if before is not None and np.array_equal(rows, before):
                continue
            before = rows
            keep = (rows >= 0) & run.commands.servo[np.maximum(rows, 0)] & np.isfinite(run.q).all(axis=1)
            if keep.sum() < MIN_EXACT_ROWS:
                continue
            kp, q_des, ff = (getattr(run.commands, f)[rows[keep]] for f in ("kp", "q", "tau"))
            tau, q = run.tau[keep], run.q[keep]
            damping = run.commands.kd[rows[keep]] * (run.commands.dq[rows[keep]] - run.dq[keep])
            pairs = np.empty((joints, joints))
            for j in range(joints):
                asked = kp[:, j, None] * (q_des[:, j, None] - q) + ff[:, j, None] + damping
                pairs[:, j] = np.mean((tau - np.clip(asked, -limit, limit)) ** 2, axis=0)
            against = np.clip(kp * (-q_des - q) - ff + damping, -limit, limit)
            flipped = np.mean((tau - against) ** 2, axis=0)
            own = np.clip(kp * (q_des - q) + ff + damping, -limit, limit)
            turned = np.mean((tau + own) ** 2, axis=0)
            best = float(np.minimum(np.minimum(pairs.min(axis=1), flipped), turned).sum())
            found.append(
                (best, float(delay), pairs, flipped, turned, np.mean(tau**2, axis=0), int(keep.sum()))
            )
        self.rows = 0
        if found:
            best_found = min(found, key=lambda one: one[0])
            _, self.delay, self.pairs, self.flipped, self.turned, self.variance, self.rows = best_found


class TorqueModel:
    """PD law of all pairings of joints and commands of a run; needs the reported torque.

    Attributes:
        run: The run.
        rows: States that the fits use, (n,): servo commands act at every delay.
    """

    def __init__(self, run: Run) -> None:
        self.run = run
        assert run.tau is not None
        self.rows = self._usable_rows()

    @property
    def is_usable(self) -> bool:
        """Whether there are enough rows."""
        return int(self.rows.sum()) >= MIN_ROWS

    def _usable_rows(self) -> Bools:
        commands = self.run.commands
        newest, oldest = self.run.command_rows(0.0), self.run.command_rows(MAX_DELAY_S)
        usable = (oldest >= 0) & commands.servo[np.maximum(oldest, 0)] & commands.servo[np.maximum(newest, 0)]
        finite = np.isfinite(self.run.q).all(axis=1) & np.isfinite(self.run.tau).all(axis=1)  # type: ignore[arg-type]
        return np.asarray(usable & finite)

    @cached_property
    def delays(self) -> Array:
        """Delays that are tried, s."""
        return np.arange(0.0, MAX_DELAY_S + 1e-9, DELAY_STEP_S)

    def _products(self, delay: float) -> tuple[Array, Array, Array]:
        """Asked torque at angle 0 without damping, kp, and kd (dq_des - dq), each (n, J), of the commands of this delay."""
        commands, rows = self.run.commands, np.maximum(self.run.command_rows(delay), 0)
        kp = commands.kp[rows]
        damping = commands.kd[rows] * (commands.dq[rows] - self.run.dq)
        return kp * commands.q[rows] + commands.tau[rows], kp, damping

    @cached_property
    def own_errors(self) -> Array:
        """Mean square of the torque that the joint's own command does not explain, (delays, J), N^2 m^2."""
        joints = range(len(self.run.joints))
        return self._errors([(i, i) for i in joints])

    @cached_property
    def exact(self) -> ExactModel:
        """The same drives without free numbers; it needs only few rows."""
        return ExactModel(self.run)

    def _errors(self, pairs: Sequence[tuple[int, int]]) -> Array:
        """Mean square errors (delays, pairs) after a free fit of a_1, a_2, a_3 and b."""
        keep, run = self.rows, self.run
        tau, q = run.tau[keep], run.q[keep]  # type: ignore[index]
        found, before = np.empty((len(self.delays), len(pairs))), None
        for d, delay in enumerate(self.delays):
            rows = run.command_rows(float(delay))[keep]
            if before is not None and np.array_equal(rows, before):
                found[d] = found[d - 1]
                continue
            before = rows
            asked, kp, damping = (each[keep] for each in self._products(float(delay)))
            for k, (i, j) in enumerate(pairs):
                x = _regressors(asked[:, j], kp[:, j], damping[:, j], q[:, i])
                gram, right = x.T @ x, x.T @ tau[:, i]
                weights = np.linalg.solve(gram + 1e-9 * np.trace(gram) * np.eye(REGRESSORS), right)
                found[d, k] = np.mean((tau[:, i] - x @ weights) ** 2)
        return found

    @cached_property
    def delay_range(self) -> tuple[float, float]:
        """Shortest and longest delay that explain the torque equally well, s."""
        # The median over joints: one faulty drive does not decide.
        error = np.median(self.own_errors / self.own_errors.min(axis=0), axis=1)
        good = np.flatnonzero(error <= EQUAL_ERROR * error.min())
        return float(self.delays[good[0]]), float(self.delays[good[-1]])

    @property
    def delay(self) -> float:
        """Middle of `delay_range`, s."""
        return 0.5 * sum(self.delay_range)

    @cached_property
    def asked(self) -> Array:
        """Torque that the commands ask of ideal drives at the best delay, (n, J), N m."""
        return self.asked_at(self.delay)

    def asked_at(self, delay: float) -> Array:
        """Return the torque that the commands ask of ideal drives.

        Args:
            delay: From the sending of a command until it acts, s.

        Returns:
            kp (q_des - q) + kd (dq_des - dq) + tau_ff, (n, J), N m.
        """
        asked, kp, damping = self._products(delay)
        return np.asarray(asked - kp * self.run.q + damping)

    @cached_property
    def fits(self) -> list[DriveFit]:
        """Robust fit of each joint with its own command."""
        return [self._fit(joint) for joint in range(len(self.run.joints))]

    def _fit(self, i: int) -> DriveFit:
        """Least squares on rows of little torque, then on all rows that these explain."""
        run, keep = self.run, self.rows
        asked, kp, damping = (each[keep][:, i] for each in self._products(self.delay))
        x, y = _regressors(asked, kp, damping, run.q[keep][:, i]), run.tau[keep][:, i]  # type: ignore[index]
        little = np.abs(self.asked[keep][:, i]) < LITTLE_TORQUE_NM
        use = little if little.sum() >= MIN_ROWS else np.ones(len(y), bool)
        weights, use, spread = _robust_fit(x, y, use)
        covariance = np.linalg.pinv(x[use].T @ x[use]) * np.mean((y - x @ weights)[use] ** 2)
        command, angle, speed, offset = weights.tolist()
        errors = np.sqrt(np.diag(covariance))
        has_moved = bool(run.q[keep][:, i].std() > MIN_MOVED_RAD)
        return DriveFit(command, angle, speed, offset, errors, float(use.mean()), spread, has_moved)

    def slow_offset(self, joint: int) -> float:
        """Return the offset of a joint's zero in the slower half of the states.

        An offset is there at every speed. What a speed-torque limit takes away, which a fit of all
        states explains by an offset as well, is not.

        Args:
            joint: Index of the joint.

        Returns:
            b / a_1 of the module's equation, rad.
        """
        run, speed = self.run, np.abs(self.run.dq[:, joint])
        keep = self.rows & (speed <= np.median(speed[self.rows]))
        asked, kp, damping = (each[keep][:, joint] for each in self._products(self.delay))
        x, y = _regressors(asked, kp, damping, run.q[keep][:, joint]), run.tau[keep][:, joint]  # type: ignore[index]
        weights, _, _ = _robust_fit(x, y, np.ones(len(y), bool))
        return float(weights[3] / weights[0])

    @cached_property
    def modelled(self) -> Array:
        """Torque that the fits explain at every state, (n, J), N m."""
        run = self.run
        asked, kp, damping = self._products(self.delay)
        return np.column_stack(
            [
                _regressors(asked[:, i], kp[:, i], damping[:, i], run.q[:, i])
                @ np.array([fit.command, fit.angle, fit.speed, fit.offset])
                for i, fit in enumerate(self.fits)
            ]
        )


def _robust_fit(x: Array, y: Array, use: Bools) -> tuple[Array, Bools, float]:
    """Least squares without outliers.

    Args:
        x: Regressors, (n, p).
        y: Torque, (n,), N m.
        use: Rows of the first fit, (n,).

    Returns:
        The weights (p,), the rows that are no outliers, and the standard deviation of their residual.
    """
    weights: Array = np.zeros(x.shape[1])
    spread = MIN_SPREAD_NM
    for _ in range(FIT_ROUNDS):
        weights = np.asarray(np.linalg.lstsq(x[use], y[use], rcond=None)[0], np.float64)
        error = y - x @ weights
        spread = max(robust_std(error[use]), MIN_SPREAD_NM)
        use = np.abs(error) < OUTLIER * spread
        if use.sum() < MIN_ROWS // 2:
            use = np.ones(len(y), bool)
    return weights, use, spread


def _regressors(asked: Array, kp: Array, damping: Array, q: Array) -> Array:
    """Columns of a_1, a_2, a_3 and b, (n, 4)."""
    return np.column_stack([asked, -kp * q, damping, kp])
