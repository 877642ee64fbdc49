"""Contract: do robot, driver and controller mean the same by order, sign, zero, unit, frame, scale and memory?"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.name_list import format_names

from ..cause import NOTHING, Cause, Link, Measurement, Trace, worst_span
from ..explanation import AGREES_RAD, Explanation
from ..hypotheses import CONVENTIONS, best_convention, best_offset
from ..imu import USUAL_GYROSCOPE, USUAL_QUATERNION
from ..signals import Signals

CLEAR_COEFFICIENT = 0.3
"""Smallest coefficient of the PD law that shows its sign or scale."""
UNEXPLAINED_SHARE = 0.1
"""Share of a torque's variance that its own command leaves if the drive follows another one."""
BETTER_PAIRING, MIN_ERROR_N2M2 = 4.0, 4.0
"""Factor by which another command explains the torque better, and the smallest error that needs it."""
MAX_SPREAD_AT_REST_RAD = 0.02
EXPLAINED_SHARE = 0.3
"""Share of the mean square torque that a sign may leave."""
SIMILAR = 2.0
"""Ratio of the unevenness that two explanations leave, up to which both are named."""
CERTAIN = 3.0
"""Standard errors by which a coefficient may differ from its estimate."""
MIN_SHARE_USED = 0.85
"""Share of the states that a fit has to explain before its coefficients count."""
SLOW_SHARE = 0.5
"""Share of an offset that the slower half of the states has to show; the offset itself is there at every speed."""
HOT_DEG_C = 80.0
MIN_AGREEING_JOINTS = 9


def joint_trace(signals: Signals, joint: int, expected: Array | None = None) -> Trace:
    """Return the torque of a joint, with the one that its command asks for.

    Args:
        signals: The run.
        joint: Index of the joint.
        expected: Other expected torques, (n,), N m.

    Returns:
        The trace.
    """
    run = signals.run
    assert run.tau is not None
    asked = signals.torque.asked_at(signals.torque.exact.delay)[:, joint] if expected is None else expected
    rows = np.maximum(run.command_rows(signals.torque.exact.delay), 0)
    shown = np.where(run.commands.servo[rows], asked, np.nan)
    return Trace(f"torque of {run.joints[joint]}, N m", run.time, run.tau[:, joint], shown)


def torque_span(signals: Signals, joint: int) -> tuple[float, float]:
    """Return the span in which a joint's torque is furthest from what its command asks for.

    Args:
        signals: The run.
        joint: Index of the joint.

    Returns:
        Begin and end, s.
    """
    run, model = signals.run, signals.torque
    assert run.tau is not None
    rows = run.command_rows(model.exact.delay)
    off = np.abs(run.tau[:, joint] - model.asked_at(model.exact.delay)[:, joint])
    return worst_span(run.time, np.where((rows >= 0) & run.commands.servo[np.maximum(rows, 0)], off, 0.0))


class JointScale(Cause):
    """An angle or a speed has another unit or gear ratio: the slope of the angles is not the reported speed, or the
    drive's torque shows another angle than the recording.
    """

    link = Link.CONTRACT
    unit = "factor minus 1"
    least = 0.15
    remedy = "Turn one joint by a known angle by hand and read it in `quadvel status --joints`; correct the unit in the driver"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        found: list[tuple[float, int, str, float]] = []
        slope = signals.slope_over_speed
        moving = np.flatnonzero(slope > 0.0)
        found += [(abs(math.log(slope[j])), int(j), "speed", float(slope[j])) for j in moving]
        if "torque" in signals.parts:
            for j, fit in enumerate(signals.torque.fits):
                if not (is_certain(signals, j) and fit.command > CLEAR_COEFFICIENT and fit.angle > 0.0):
                    continue
                ratio = fit.angle / fit.command
                if not 0.7 < fit.speed / fit.angle < 1.4:
                    continue  # the speeds are in the same unit as the angles, or their slope shows it
                doubt = 3.0 * math.hypot(fit.errors[1] / fit.angle, fit.errors[0] / fit.command)
                off = max(abs(math.log(ratio)) - doubt, 0.0)
                found.append((off, j, "angle", fit.command / fit.angle))
        if not found:
            return None
        off, j, what, factor = max(found)
        span = worst_span(run.time, np.abs(run.dq[:, j]))
        if what == "speed":
            dt = np.maximum(np.diff(run.time), 1e-6)  # s; repeated states have one stamp
            slopes = np.concatenate([[0.0], np.diff(run.q[:, j]) / dt])
            trace = Trace(
                f"speed of {run.joints[j]} and slope of its angle, rad/s", run.time, run.dq[:, j], slopes
            )
            sentence = f"{run.joints[j]}: the slope of the angle is {factor:.3g} times the reported speed, expected 1"
        else:
            trace = joint_trace(signals, j)
            sentence = f"{run.joints[j]}: the torque shows 1/{factor:.3g} of the recorded angle"
        unit = "; 57.3 and 0.0175 are degrees" if off > 3.0 else ""
        return Measurement(math.expm1(off), sentence + unit, span, (trace,))


class JointSign(Cause):
    """A joint counts the other way: its torque follows the negative command or angle, the slope of its angle has the
    other sign than its speed, or planted feet fit trunk and gyroscope only with the sign turned.
    """

    link = Link.CONTRACT
    unit = "joints"
    least = 0.5
    remedy = (
        "Command a small positive step to the joint alone, hanging, and compare angle and motion with the URDF; turn "
        "the sign in the driver, for states and commands"
    )

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        wrong = {
            int(j): "its speed has the other sign" for j in np.flatnonzero(signals.slope_over_speed < 0.0)
        }
        if "drives" in signals.parts:
            exact = signals.torque.exact
            own = np.diagonal(exact.pairs)
            for other, text in (
                (exact.flipped, "its torque follows the negative command"),
                (exact.turned, "its torque has the other sign than its command asks for"),
            ):
                clear = (own > BETTER_PAIRING * other) & (other < EXPLAINED_SHARE * exact.variance)
                for k in np.flatnonzero(clear & (own > MIN_ERROR_N2M2)):
                    wrong.setdefault(int(k), text)
        if "torque" in signals.parts:
            for j, fit in enumerate(signals.torque.fits):
                if (
                    is_certain(signals, j)
                    and fit.angle < -CLEAR_COEFFICIENT < CLEAR_COEFFICIENT < fit.command
                ):
                    wrong.setdefault(j, "its torque follows the negative angle")
        if wrong:
            j, why = next(iter(wrong.items()))
            names = ", ".join(run.joints[k] for k in wrong)
            trace = joint_trace(signals, j) if "drives" in signals.parts else _speed_trace(signals, j)
            return Measurement(
                len(wrong), f"{names}: {why}", worst_span(run.time, np.abs(run.dq[:, j])), (trace,)
            )
        return _convention(signals, "sign")


def is_certain(signals: Signals, joint: int) -> bool:
    """Return whether a joint's own command explains its torque, with coefficients that the motion determines.

    Args:
        signals: The run.
        joint: Index of the joint.

    Returns:
        True if coefficients say something about sign, scale and zero.
    """
    model, fit = signals.torque, signals.torque.fits[joint]
    assert model.run.tau is not None
    variance = max(float(model.run.tau[model.rows, joint].var()), 1e-6)
    explained = model.own_errors[:, joint].min() < UNEXPLAINED_SHARE * variance
    certain = max(fit.errors[:2]) < 0.2 * min(abs(fit.command), abs(fit.angle))
    return bool(explained and certain and fit.share_used > MIN_SHARE_USED)


def _speed_trace(signals: Signals, j: int) -> Trace:
    run = signals.run
    slopes = np.concatenate([[0.0], np.diff(run.q[:, j]) / np.diff(run.time)])
    return Trace(f"speed of {run.joints[j]} and slope of its angle, rad/s", run.time, run.dq[:, j], slopes)


def _convention(signals: Signals, kind: str) -> Measurement | None:
    """Measurement of the best order or sign for states and commands together, by the planted feet."""
    if not {"torque", "imu", "robot"} <= signals.parts:
        return None
    if not signals.imu.best.is_usual and signals.imu.usual.error > MIN_IMU_ERROR:
        return NOTHING  # the IMU itself is read wrongly
    best, usual = best_convention(signals.run)
    if best is None or CONVENTIONS[best.name].kind != kind:
        return NOTHING
    offset = best_offset(signals.legs)
    left = np.inf if offset is None or offset.size == 0.0 else offset.after / best.legs.unevenness
    if left < 1.0:
        return NOTHING  # a wrong zero explains the heights better
    experiment = "read the angle of the joint at a known posture, and again after a known turn"
    alternatives = (("joint_offset", experiment),) if left < SIMILAR else ()
    height = signals.legs.height
    traces = (
        Trace("height of FR minus RR foot below the trunk, m", signals.run.time, height[:, 0] - height[:, 2],
              best.legs.height[:, 0] - best.legs.height[:, 2]),
    )  # fmt: skip
    sentence = (
        f"planted feet contradict gyroscope and vertical: {usual.text}; with {best.name} in states and commands "
        f"it is {best.text}"
    )
    off = np.where(signals.legs.planted.any(axis=1), np.abs(height[:, 0] - height[:, 2]), 0.0)
    return Measurement(1.0, sentence, worst_span(signals.run.time, off), traces, alternatives)


class JointOrder(Cause):
    """The joints come in another order: a drive's torque follows another joint's command, or planted feet fit trunk
    and gyroscope only with legs exchanged.
    """

    link = Link.CONTRACT
    unit = "joints"
    least = 1.5
    remedy = (
        "Command a small step to one joint after the other, hanging, and see which one moves; map the order by name "
        "in the driver, for states and commands"
    )

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        if "drives" not in signals.parts:
            return None
        run, exact = signals.run, signals.torque.exact
        # A reordering takes every command once: the order with the least error of all joints together.
        own, source = np.diagonal(exact.pairs), linear_sum_assignment(exact.pairs)[1]
        best = exact.pairs[np.arange(len(source)), source]
        gain = own - best
        moved = np.flatnonzero(
            (source != np.arange(len(source)))
            & (own > BETTER_PAIRING * best)
            & (gain > max(MIN_ERROR_N2M2, UNEXPLAINED_SHARE * float(exact.variance.mean())))
        )
        if len(moved) >= 2:
            j = int(moved[np.argmax(gain[moved])])
            i = int(source[j])
            listed = format_names([f"{run.joints[a]} follows {run.joints[source[a]]}" for a in moved])
            rows = np.maximum(run.command_rows(exact.delay), 0)
            other = run.commands.kp[rows, i] * (run.commands.q[rows, i] - run.q[:, j])
            other -= run.commands.kd[rows, i] * run.dq[:, j]
            sentence = (
                f"{listed}: the torque of {run.joints[j]} is {math.sqrt(best[j]):.1f} N m off that command, "
                f"{math.sqrt(own[j]):.1f} N m off its own"
            )
            trace = joint_trace(signals, j, other)
            off = np.where(
                run.commands.servo[rows], np.abs(signals.torque.asked_at(exact.delay)[:, j] - other), 0.0
            )
            return Measurement(len(moved), sentence, worst_span(run.time, off), (trace,))
        found = _convention(signals, "order")
        return found and Measurement(12.0 * found.value, found.sentence, found.span, found.traces)


class JointOffset(Cause):
    """The zero of a joint is off: its torque shows a constant error of the angle, or planted feet on level ground
    stand at different heights.
    """

    link = Link.CONTRACT
    unit = "rad"
    least = 0.035
    needs = ("drives",)
    remedy = "Calibrate the zeros: `quadvel calibrate`"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, found = signals.run, (0.0, 0, "")
        if "torque" not in signals.parts:
            return self._at_rest(signals)
        for j, fit in enumerate(signals.torque.fits):
            if fit.command > CLEAR_COEFFICIENT and is_certain(signals, j):
                offset = fit.offset / fit.command
                size = abs(offset) - 3.0 * fit.errors[3] / fit.command
                is_clear = fit.errors[3] / fit.command < 0.02 and size > found[0]
                if is_clear and signals.torque.slow_offset(j) * np.sign(offset) > SLOW_SHARE * abs(offset):
                    found = (size, j, f"{offset:+.3f} rad between the drive's angle and the recorded one")
        size, j, sentence = found
        if size < self.least and "ground" in signals.parts:
            tried = best_offset(signals.legs)
            if tried is None:
                return None if not sentence else Measurement(size)
            if tried.size > self.least:
                trace = Trace(
                    "height between the leg's foot and the others, m",
                    tried.time,
                    tried.measured,
                    tried.expected,
                )
                sentence = (
                    f"{run.joints[tried.joint]}: {tried.offset:+.3f} rad in states and commands would put the feet "
                    f"on one plane; they are {1e3 * tried.before:.1f} mm apart, then {1e3 * tried.after:.1f} mm"
                )
                off = np.abs(tried.measured - tried.expected)
                return Measurement(tried.size, sentence, worst_span(tried.time, off), (trace,))
            size = max(size, tried.size)
        text = f"{run.joints[j]}: {sentence}"
        return Measurement(size, text, torque_span(signals, j), (joint_trace(signals, j),))

    def _at_rest(self, signals: Signals) -> Measurement:
        """Measure a robot that stopped at once: a constant torque that nothing asked for, by the stiffness."""
        run, exact = signals.run, signals.torque.exact
        assert run.tau is not None
        rows = run.command_rows(exact.delay)
        keep = (rows >= 0) & run.commands.servo[np.maximum(rows, 0)]
        off = (signals.torque.asked_at(exact.delay) - run.tau)[keep] / run.commands.kp[rows[keep]]
        middle = np.median(off, axis=0)
        spread = 1.4826 * np.median(np.abs(off - middle), axis=0)
        middle = np.where(spread < MAX_SPREAD_AT_REST_RAD, middle, 0.0)
        doubt = 5.0 * spread / math.sqrt(len(off))
        j = int(np.argmax(np.abs(middle) - doubt))
        sentence = (
            f"{run.joints[j]}: {-middle[j]:+.3f} rad between the drive's angle and the recorded one, at rest"
        )
        size = max(float(abs(middle[j]) - doubt[j]), 0.0)
        # At rest a constant torque error may have any of these causes.
        experiment = "move the joint alone, hanging, over its range: only an offset leaves a constant error"
        others = (("weak_drive", experiment), ("joint_scale", experiment))
        return Measurement(size, sentence, torque_span(signals, j), (joint_trace(signals, j),), others)


class Gains(Cause):
    """All drives act with other gains than commanded."""

    link = Link.CONTRACT
    unit = "factor minus 1"
    least = 0.1
    needs = ("torque",)
    remedy = "Compare the gains in the driver with those of the policy file; identify the drives: `quadvel identify`"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, trained = signals.run, signals.trained.gains
        if run.temperature is not None and run.temperature.value.max() > HOT_DEG_C:
            return NOTHING  # `temperature` explains weaker gains
        moved = [j for j, fit in enumerate(signals.torque.fits) if fit.has_moved]
        fits = [signals.torque.fits[j] for j in moved]
        if len(fits) < MIN_AGREEING_JOINTS * len(run.joints) // 12:
            return None
        kp = np.array([fit.command for fit in fits]) / trained[0]
        kd = np.array([fit.speed for fit in fits]) / trained[1]
        kp_error, kd_error = (float(np.median([fit.errors[k] for fit in fits])) for k in (0, 2))
        found = []
        for name, ratio, tolerance in (("kp", kp, CERTAIN * kp_error), ("kd", kd, 0.45)):
            middle = float(np.median(ratio))
            agree = int(
                (np.sign(np.log(np.maximum(ratio, 1e-3))) == np.sign(math.log(max(middle, 1e-3)))).sum()
            )
            if middle > 0.05 and agree >= MIN_AGREEING_JOINTS * len(fits) // 12:
                if name == "kd" and kd_error > 0.1:
                    continue
                found.append((max(abs(math.log(middle)) - tolerance, 0.0), name, middle))
        if not found:
            return NOTHING
        off, name, middle = max(found)
        worst = moved[int(np.argmax(np.abs(np.log(np.maximum(kp, 1e-3)))))]
        share = middle * trained[0 if name == "kp" else 1]
        sentence = (
            f"{name}: the drives act with {share:.2f} of the commanded gain, expected {share / middle:.2f}"
        )
        heat: tuple[tuple[str, str], ...] = ()
        if run.temperature is None and name == "kp" and middle < 1.0:
            heat = (("temperature", "record motor_status too, let the motors cool and repeat the walk"),)
        return Measurement(
            math.expm1(off), sentence, torque_span(signals, worst), (joint_trace(signals, worst),), heat
        )


class QuaternionOrder(Cause):
    """The orientation is stored in another order or direction: gyroscope and accelerometer fit another reading of it."""

    link = Link.CONTRACT
    unit = "times"
    least = 3.0
    needs = ("imu",)
    remedy = "Convert the orientation to w, x, y, z, body to world, in the driver"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        imu = signals.imu
        if imu.best.quaternion == USUAL_QUATERNION:
            return Measurement(1.0)
        return _imu_measurement(signals, imu.best.quaternion, USUAL_GYROSCOPE, "gyro_frame")


class GyroFrame(Cause):
    """The gyroscope has another sign, axis order, frame or unit: the turn of the orientation fits another reading."""

    link = Link.CONTRACT
    unit = "times"
    least = 3.0
    needs = ("imu",)
    remedy = (
        "Turn the robot by hand about each axis and read the turn rates in `quadvel status --joints`; "
        "correct frame and unit in the driver"
    )

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        imu = signals.imu
        if imu.best.gyroscope == USUAL_GYROSCOPE:
            return Measurement(1.0)
        return _imu_measurement(signals, USUAL_QUATERNION, imu.best.gyroscope, "quaternion_order")


def turn_evidence(signals: Signals) -> tuple[Trace, tuple[float, float]]:
    """Compare the turns of the orientation with the integrated gyroscope, both read as usual.

    Args:
        signals: The run.

    Returns:
        The axis that differs most, and the span in which the turns differ most, s.
    """
    imu, time = signals.imu, signals.run.time
    turns, expected = imu.turns(USUAL_QUATERNION), imu.integrals(USUAL_GYROSCOPE)
    axis = int(np.argmax(np.mean((turns - expected) ** 2, axis=0)))
    middle = time[len(time) - len(turns) :]
    trace = Trace(f"turn about {'xyz'[axis]} in 50 ms and integrated gyroscope, rad", middle, turns[:, axis],
                  expected[:, axis])  # fmt: skip
    return trace, worst_span(middle, np.linalg.norm(turns - expected, axis=1))


def _imu_measurement(signals: Signals, quaternion: str, gyroscope: str, other: str) -> Measurement:
    """Improvement by other conventions, with the axis that differs most as a picture."""
    usual, best = signals.imu.usual, signals.imu.best
    if usual.error < MIN_IMU_ERROR:
        return Measurement(1.0)
    trace, span = turn_evidence(signals)
    what = f"as {quaternion}" if quaternion != USUAL_QUATERNION else f"with the gyroscope as {gyroscope}"
    sentence = f"{usual}; read {what}: {best}"
    experiment = "tilt the robot by hand about one axis after the other: the gyroscope shows its own axis"
    alternatives = ((other, experiment),) if signals.imu.is_ambiguous else ()
    return Measurement(usual.error / max(best.error, 1e-6), sentence, span, (trace,), alternatives)


MIN_IMU_ERROR = 1.5
"""Error of the usual conventions, in units of their scales, from which others are considered."""


class _Actions(Cause):
    """Causes that the replay of the policy distinguishes."""

    link = Link.CONTRACT
    unit = "rad"
    least = AGREES_RAD
    needs = ("policy",)

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        found = Explanation.of(signals.replay)
        if found.cause != self.name():
            return NOTHING
        shown, joint = found.base, found.worst_joint
        names = signals.run.joints
        trace = Trace(
            f"target of {names[joint]} and the policy's, rad",
            shown.time,
            shown.recorded[:, joint],
            shown.expected[:, joint],
        )
        off = np.where(shown.valid, np.abs(shown.recorded - shown.expected), 0.0).max(axis=1)
        sentence = f"recorded targets differ from the policy's by {found.error:.3f} rad; {found.sentence}"
        return Measurement(found.error, sentence, worst_span(shown.time, off), (trace,))


class ObservationScale(_Actions):
    """The controller scales a part of the observation otherwise: with that scale the policy gives the recorded actions."""

    remedy = "Take scales and offsets from the metadata of the policy file"


class ObservationOrder(_Actions):
    """The controller orders the observation otherwise: in that order the policy gives the recorded actions."""

    remedy = "Build the observation by name, in the order of the metadata of the policy file"


class ActionScale(_Actions):
    """The controller scales the actions otherwise: recorded and replayed targets differ by a factor."""

    remedy = "Take `action_scale` and `action_offset` from the metadata of the policy file"


class MemoryReset(_Actions):
    """The memory of the network is cleared while it walks: so replayed, the policy gives the recorded actions."""

    remedy = "Reset the policy only where a walk begins; hand its memory on from tick to tick"


class MemoryKept(_Actions):
    """The memory of the network was not cleared when the walk began: the actions differ at first and agree later."""

    remedy = "Reset the policy where a walk begins"


class StaleObservation(_Actions):
    """The controller answers with older states than it should: with those the policy gives the recorded actions."""

    link = Link.TIMING
    remedy = "Read the newest state at each tick: a queue of depth 1, and no copy that is taken earlier"


class OtherActions(_Actions):
    """The actions are not those of this policy, and no change that was tried explains them."""

    remedy = "Name the policy file that drove: `--policy`; compare observation and metadata term by term"
