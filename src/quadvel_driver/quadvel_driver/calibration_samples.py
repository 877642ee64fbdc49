"""States of a recording as arrays, and what a suspended robot shows of its torques."""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools
from quadvel_description.kinematics import rotate_inverse
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.state import RobotState

MIN_ROWS = 100
"""States needed of a record."""
MIN_MOVING_SPEED = 0.05
"""Joint speed above which friction opposes the motion, rad/s."""
MAX_STANDING_SPEED = 0.1
"""Largest joint speed of a robot that stands still, rad/s."""
MAX_STANDING_BEND_RAD = 2.2
"""Knees of a standing robot are bent less than this, rad."""
BLOCK_S = 0.02
"""Duration over which states are averaged, s."""
MAX_BLOCK_GAP_S = 0.5 * BLOCK_S
"""Blocks further apart than BLOCK_S and this are not neighbours, s: states are missing."""
REVERSAL_MARGIN_S = 0.1
"""Time around a reversal to leave out, s: the joint sticks there."""
CREEP_HINT = "record quadvel excite creep with the robot suspended"
"""How to make the record that is expected."""
UP = np.array([0.0, 0.0, 1.0])
"""Vertical in the world frame."""


class CalibrationDataError(ValueError):
    """A recording cannot be used for calibration; the text is the reason, in one sentence."""


@attrs.frozen(eq=False)
class Samples:
    """States as arrays.

    Attributes:
        time: Times of the states, (n,), s.
        q: Joint angles, (n, 12), rad.
        dq: Joint speeds, (n, 12), rad/s.
        tau: Joint torques, (n, 12), N m.
        quaternion: Orientation (w, x, y, z), (n, 4).
    """

    time: Array
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
        rows = [(state.time, state.q, state.dq, state.tau, state.quaternion) for state in states]
        if len(rows) < MIN_ROWS:
            raise CalibrationDataError(f"{len(rows)} states, expected {MIN_ROWS} at least")
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))

    def check_suspended(self) -> None:
        """Check that all joints move in both directions.

        Raises:
            CalibrationDataError: A joint does not.
        """
        for i, name in enumerate(JOINT_NAMES):
            moving = self.dq[:, i]
            if min((moving > MIN_MOVING_SPEED).sum(), (moving < -MIN_MOVING_SPEED).sum()) < MIN_ROWS // 2:
                raise CalibrationDataError(f"suspended robot: {name} hardly moves to and fro; {CREEP_HINT}")

    def check_standing(self) -> None:
        """Check that the robot stands still, on straight enough legs.

        Raises:
            CalibrationDataError: It moves, or a knee is bent too far.
        """
        speed = float(np.abs(self.dq.mean(axis=0)).max()), float(np.median(np.abs(self.dq)))
        if max(speed) > MAX_STANDING_SPEED:
            raise CalibrationDataError(
                f"standing robot: the joints move at {max(speed):.2f} rad/s, expected a robot that stands still"
            )
        bent = self.q.mean(axis=0).reshape(4, 3)[:, 2]
        if (bent < -MAX_STANDING_BEND_RAD).any():
            raise CalibrationDataError(
                f"standing robot: a knee is bent by {bent.min():.2f} rad, expected a robot that stands"
            )


@attrs.frozen(eq=False)
class Motion:
    """Motion and torques of a suspended robot, averaged over BLOCK_S.

    All quantities carry the same smoothing, so that the equation of motion holds between them.

    Attributes:
        time: Times, (n,), s.
        q: Joint angles, (n, 12), rad.
        dq: Joint speeds, (n, 12), rad/s.
        ddq: Joint accelerations, (n, 12), rad/s^2.
        tau: Joint torques, (n, 12), N m.
        up: Vertical in the frame of the IMU, unit vectors, (n, 3).
        steady: Joints that move and do not reverse nearby, (n, 12).
    """

    time: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    up: Array
    steady: Bools

    @classmethod
    def from_samples(cls, samples: Samples) -> Motion:
        """Average states, and differentiate the speeds.

        Args:
            samples: States of a suspended robot.

        Returns:
            The motion.

        Raises:
            CalibrationDataError: The times of the states do not increase evenly.
        """
        up = rotate_inverse(samples.quaternion, UP)
        time, q, dq, tau, up = _averages(samples.time, samples.q, samples.dq, samples.tau, up)
        between = np.diff(time)
        whole = np.abs(between - BLOCK_S) < MAX_BLOCK_GAP_S
        whole = whole[1:] & whole[:-1]
        if whole.sum() < MIN_ROWS:
            raise CalibrationDataError(
                f"suspended robot: {whole.sum()} stretches of {BLOCK_S} s without a gap, expected {MIN_ROWS} at least; "
                f"{CREEP_HINT}"
            )
        ddq = (dq[2:] - dq[:-2]) / (time[2:] - time[:-2])[:, None]
        steady = _is_steady(dq)[1:-1]
        q, dq, tau, up = (_simpson(values)[whole] for values in (q, dq, tau, up))
        up = up / np.linalg.norm(up, axis=1, keepdims=True)
        return cls(time[1:-1][whole], q, dq, ddq[whole], tau, up, steady[whole])


def _averages(time: Array, *columns: Array) -> list[Array]:
    """Return the averages of the times (n,) and of columns (n, k) over blocks of BLOCK_S."""
    block = np.floor((time - time[0]) / BLOCK_S + 1e-6).astype(int)
    begins = np.flatnonzero(np.diff(block, prepend=-1))
    counts = np.diff(np.append(begins, len(time)))
    return [
        np.add.reduceat(values, begins) / counts.reshape(-1, *[1] * (values.ndim - 1))
        for values in (time, *columns)
    ]


def _simpson(values: Array) -> Array:
    """Average rows (n + 2, k) over their neighbours, (n, k): Simpson's rule for the mean over two blocks.

    The central difference of the speed is the mean acceleration over the same two blocks.
    """
    return (values[:-2] + 4.0 * values[1:-1] + values[2:]) / 6.0


def _is_steady(dq: Array) -> Bools:
    """Return where joints move and do not reverse nearby, (n, 12), from joint speeds of the same shape."""
    moving = np.sign(dq) * (np.abs(dq) > MIN_MOVING_SPEED)
    width = round(REVERSAL_MARGIN_S / BLOCK_S)
    padded = np.pad(moving, ((width, width), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * width + 1, axis=0)
    steady: Bools = np.abs(around.sum(axis=2)) == 2 * width + 1
    return steady
