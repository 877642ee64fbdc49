"""What the legs say about trunk and ground: forces from torques, velocities and heights of planted feet.

Needs the kinematics of the robot. With p and J of each foot in the trunk frame, R the orientation and w the gyroscope,

    f = -J^-T tau               force of the ground on a foot, massless legs
    v = v_roll - (w x p + J dq) velocity of the trunk if the foot does not slip
    z = (R p)_z                 height of the foot relative to the trunk
"""

from __future__ import annotations

from functools import cached_property
from itertools import combinations

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools
from quadvel_description.kinematics import foot_kinematics, rotation_matrix
from quadvel_description.quadruped import GRAVITY
from quadvel_description.state import RobotState
from quadvel_estimator.odometry import leg_velocity

from .run import Run
from .torque import robust_std

PLANTED_N = 40.0
"""Force on the ground, N, above which a foot counts as planted."""
RESTING_M_S = 0.3
"""Largest difference of the trunk's velocity from two feet that rest on the ground, m/s."""
MIN_PUSH_N = 10.0
BALANCE_WINDOW_S, MIN_BALANCE_ROWS = 0.05, 60
DAMPING_M2 = 1e-4
"""Damping (m^2) of the least squares for the foot forces; it bounds them near a straight leg."""
WALKED_SLOPE_RAD = 0.29
"""Steepest ground on which the shipped policy was shown to walk, 15 degrees, and a margin for its measurement."""
HELD_SHARE = 0.5
"""A robot whose feet carry less than this share of its weight hangs, or is held."""
PAIRS = tuple(combinations(range(4), 2))


@attrs.frozen(eq=False)
class GroundPlane:
    """Slope that fits the pairs of planted feet best.

    Attributes:
        slope: (2,), rise per metre along x and y of the world.
        heights: (k,), height between the two feet of each pair, m, in the order of time.
        on_slope: (k,), the same on that slope, m.
        time: (k,), s.
    """

    slope: Array
    heights: Array
    on_slope: Array
    time: Array

    @property
    def spread(self) -> float:
        """Robust standard deviation of the heights about the slope, m; NaN without a pair."""
        return robust_std(self.heights - self.on_slope)

    @property
    def angle(self) -> float:
        """Inclination of the slope, rad."""
        return float(np.arctan(np.linalg.norm(self.slope)))


class Legs:
    """Forces, velocities and heights of the feet of a run; angles may be corrected first.

    Attributes:
        usable: States that count, (n,): the robot walks, or stands too.
    """

    def __init__(
        self, run: Run, joints: tuple[Array, Array, Array] | None = None, walking_only: bool = False
    ) -> None:
        """Compute what the recorded (or corrected) joints say.

        Args:
            run: The run, of the own robot, with IMU and torques.
            joints: Angles, speeds and torques instead of the recorded ones, (n, 12) each.
            walking_only: Whether only walking counts, not standing.
        """
        assert run.imu is not None
        assert run.tau is not None
        self.run = run
        self._q, self._dq, self._tau = joints or (run.q, run.dq, run.tau)
        self.rotation = rotation_matrix(run.imu.quaternion)
        self.feet, self._jacobians = foot_kinematics(run.robot, self._q)
        finite = np.isfinite(self._q).all(axis=1) & np.isfinite(run.imu.quaternion).all(axis=1)
        self.usable = (run.walking if walking_only else run.on_feet) & finite

    def _to_world(self, vectors: Array) -> Array:
        return np.asarray(vectors @ self.rotation.swapaxes(-1, -2))

    @cached_property
    def force(self) -> Array:
        """Force of the ground on each foot, world frame, (n, 4, 3), N."""
        torque = self._tau.reshape(-1, 4, 3, 1)
        transposed = self._jacobians.swapaxes(-1, -2)
        # Damped least squares of J^T f = -tau: f = -(J J^T + lambda)^-1 J tau.
        damped = self._jacobians @ transposed + DAMPING_M2 * np.eye(3)
        return self._to_world(-np.linalg.solve(damped, self._jacobians @ torque)[..., 0])

    @cached_property
    def hangs(self) -> bool:
        """Whether the robot hangs: its feet say nothing about the ground."""
        total = self.force[..., 2].sum(axis=1)[self.usable]
        return bool(len(total) and total.mean() < HELD_SHARE * GRAVITY * self.run.robot.mass)

    @cached_property
    def planted(self) -> Bools:
        """Whether each foot stands, (n, 4)."""
        return np.asarray((self.force[..., 2] > PLANTED_N) & self.usable[:, None])

    @cached_property
    def velocity(self) -> Array:
        """Velocity of the trunk from each leg, world frame, (n, 4, 3), m/s."""
        run = self.run
        assert run.imu is not None
        state = RobotState(
            0.0,
            0,
            self._q,
            self._dq,
            self._tau,
            run.imu.quaternion,
            run.imu.angular_velocity,
            run.imu.linear_acceleration,
            np.zeros(4),
        )
        return self._to_world(leg_velocity(run.robot, state, self.rotation))

    @cached_property
    def height(self) -> Array:
        """Height of each foot relative to the trunk, (n, 4), m."""
        return np.asarray(self._to_world(self.feet)[..., 2])

    def pair_rows(self) -> list[tuple[int, int, Bools]]:
        """Return the pairs of feet with the states in which both stand.

        Returns:
            Two legs and a mask (n,) each.
        """
        return [(i, j, self.planted[:, i] & self.planted[:, j]) for i, j in PAIRS]

    @cached_property
    def disagreement(self) -> float:
        """Median difference of the trunk's velocity between two planted legs, m/s."""
        found = [
            np.linalg.norm((self.velocity[:, i] - self.velocity[:, j])[rows], axis=-1)
            for i, j, rows in self.pair_rows()
        ]
        values = np.concatenate(found)
        return float(np.median(values)) if len(values) else float("inf")

    @cached_property
    def unevenness(self) -> float:
        """Robust standard deviation of the height between two planted feet, m."""
        found = [(self.height[:, i] - self.height[:, j])[rows] for i, j, rows in self.pair_rows()]
        values = np.concatenate(found)
        return robust_std(values) if len(values) else float("inf")

    @cached_property
    def plane(self) -> GroundPlane:
        """Slope of the ground under the feet that rest on it, by least squares.

        At high speed the torque that swings a leg looks like a force on its foot: both feet of a
        pair also have to show the same velocity of the trunk.
        """
        world = self._to_world(self.feet)
        heights, apart, times = [], [], []
        for i, k, both in self.pair_rows():
            sliding = np.linalg.norm(self.velocity[:, i] - self.velocity[:, k], axis=-1)
            rows = both & (sliding < RESTING_M_S)
            heights.append((self.height[:, i] - self.height[:, k])[rows])
            apart.append((world[:, i, :2] - world[:, k, :2])[rows])
            times.append(self.run.time[rows])
        z, d, time = np.concatenate(heights), np.concatenate(apart), np.concatenate(times)
        order = np.argsort(time, kind="stable")
        z, d, time = z[order], d[order], time[order]
        slope = np.linalg.solve(d.T @ d + 1e-3 * np.eye(2), d.T @ z)
        return GroundPlane(np.asarray(slope), np.asarray(z), np.asarray(d @ slope), time)

    @cached_property
    def trunk_velocity(self) -> Array:
        """Velocity of the trunk from the planted feet, body frame, (n, 3), m/s; NaN without one.

        The component-wise median of the planted legs.
        """
        legs = np.where(self.planted[..., None], self.velocity, np.nan)
        some = self.planted.any(axis=1)
        found = np.full((len(self.planted), 3), np.nan)
        found[some] = np.nanmedian(legs[some], axis=1)
        return np.asarray((found[:, None] @ self.rotation)[:, 0])

    @cached_property
    def roll_balance(self) -> float:
        """Correlation of the roll moment of the feet with the change of the roll rate; negative if sides are exchanged.

        I dw/dt = sum p x f: on a sound robot both have the same sign.
        """
        assert self.run.imu is not None
        half = max(1, round(0.5 * BALANCE_WINDOW_S / self.run.period))
        rate = self.run.imu.angular_velocity[:, 0]
        pushes = np.where(self.force[..., 2:] > MIN_PUSH_N, self.force @ self.rotation, 0.0)
        moment = np.cross(self.feet, pushes).sum(axis=1)[:, 0]
        total = np.concatenate([[0.0], np.cumsum(moment)])
        change, mean = rate[2 * half :] - rate[: -2 * half], (total[2 * half : -1] - total[: -2 * half - 1])
        use = self.usable[2 * half :] & self.usable[: -2 * half]
        if use.sum() <= MIN_BALANCE_ROWS or np.ptp(change[use]) == 0.0 or np.ptp(mean[use]) == 0.0:
            return 0.0
        return float(np.corrcoef(change[use], mean[use])[0, 1])
