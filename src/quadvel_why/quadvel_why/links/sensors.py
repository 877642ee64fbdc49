"""Sensors: does each of them follow what the others show?"""

from __future__ import annotations

import numpy as np
from typing_extensions import override

from ..cause import Cause, Link, Measurement, Trace, worst_span
from ..signals import Signals
from .contract import turn_evidence


class EncoderHeld(Cause):
    """Angle and speed of a joint keep their bits for several states while other joints change."""

    link = Link.SENSORS
    unit = "states"
    least = 2.5
    remedy = "Look at the encoder's cable and the bus of this leg; `quadvel up` stops such a robot (`encoder_frozen`)"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        same = (np.diff(run.q, axis=0) == 0.0) & (np.diff(run.dq, axis=0) == 0.0) & (run.q[1:] != 0.0)
        alone = same & ~signals.repeated[1:, None] & (same.sum(axis=1) <= len(run.joints) // 2)[:, None]
        counts = alone.sum(axis=0)
        j = int(np.argmax(counts))
        held = np.concatenate([[False], alone[:, j]])
        expected = np.interp(run.time, run.time[~held], run.q[~held, j])
        trace = Trace(f"angle of {run.joints[j]}, rad", run.time, run.q[:, j], expected)
        sentence = f"{run.joints[j]}: angle and speed stay the same bit by bit in {counts[j]} states"
        return Measurement(float(counts[j]), sentence, worst_span(run.time, held.astype(float)), (trace,))


class EncoderDropout(Cause):
    """The angle of a joint jumps further than its speeds allow, or is no number."""

    link = Link.SENSORS
    unit = "rad"
    least = 0.05
    remedy = "Look at the encoder's cable; refuse single samples that the speed contradicts"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        jumps = np.abs(np.nan_to_num(signals.jumps, nan=np.pi))
        slope = signals.slope_over_speed
        if np.isfinite(slope).any() and (np.abs(np.log(np.abs(slope[np.isfinite(slope)]))) > 0.3).any():
            return Measurement(0.0)  # `joint_scale`
        row, j = np.unravel_index(int(np.argmax(jumps)), jumps.shape)
        count = int((jumps[:, j] > max(self.least, 0.5 * jumps[row, j])).sum())
        expected = run.q[0, j] + np.concatenate([[0.0], np.cumsum(run.dq[1:, j] * np.diff(run.time))])
        near = slice(max(int(row) - 20, 0), int(row) + 20)
        expected += np.median(run.q[near, j] - expected[near])
        trace = Trace(
            f"angle of {run.joints[j]} and its integrated speed, rad", run.time, run.q[:, j], expected
        )
        sentence = f"{run.joints[j]}: the angle jumps by {jumps[row, j]:.2f} rad in one state, {count} times"
        span = worst_span(run.time, np.concatenate([[0.0], jumps[:, j]]))
        return Measurement(float(jumps[row, j]), sentence, span, (trace,))


class ImuHeld(Cause):
    """Orientation and angular velocity keep their bits for several states while the joints change."""

    link = Link.SENSORS
    unit = "states"
    least = 2.5
    needs = ("imu",)
    remedy = "Look at the IMU's cable and the rate at which the driver reads it"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        assert run.imu is not None
        both = np.hstack([run.imu.quaternion, run.imu.angular_velocity])
        held = np.concatenate([[False], (np.diff(both, axis=0) == 0.0).all(axis=1)]) & ~signals.repeated
        rate = run.imu.angular_velocity[:, 0]
        expected = np.interp(run.time, run.time[~held], rate[~held])
        trace = Trace("angular velocity about x, rad/s", run.time, rate, expected)
        sentence = f"orientation and angular velocity stay the same in {held.sum()} states"
        return Measurement(float(held.sum()), sentence, worst_span(run.time, held.astype(float)), (trace,))


class ImuContradicts(Cause):
    """Orientation, gyroscope and accelerometer contradict each other, and no convention explains it."""

    link = Link.SENSORS
    unit = "times the usual error"
    least = 3.0
    needs = ("imu",)
    remedy = "Calibrate the IMU at rest; look for a filter that lags, a bias, or a loose mounting"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        usual = signals.imu.usual
        trace, span = turn_evidence(signals)
        return Measurement(usual.error, str(usual), span, (trace,))
