"""Response of the measured torque to the commands, at every lag, and the checks that use it.

A drive under PD control gives tau = kp (q_des(t - lag) - q) - kd dq. The joint's own angle, speed
and direction of motion are projected out of both the torque and the command (Frisch, Waugh and
Lovell). The correlation of the two residuals is the partial correlation of torque and command.
Its sign, its best lag and its best joint do not depend on gains, friction and offset.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from scipy.optimize import linear_sum_assignment

from quadvel_description.arrays import Bools, Floats, Indices
from quadvel_description.name_list import format_names

from ..findings import Finding
from ..log import Log
from .channels import DEGREE_RAD, MOVING_SPAN_RAD, TURN_RAD, resting

MAX_ROWS = 4000
"""Rows of a log that are used, spread over its length."""
LAG_STEP_S, MAX_LAG_S = 0.002, 0.1
"""s; largest lag to either side; lags are `LAG_STEP_S` apart, or one row of the log if that is more."""
MAX_DRIVE_DELAY_S = 0.045
"""s; longest delay of a drive: the model has 26 ms at most, and rows at 50 Hz add up to 20 ms."""
TIME_ROUNDING_S = 1e-9
"""s; a command this much later than an instant is still in force at it (round-off of summed times)."""
FRICTION_SPEED_RAD_S = 0.05
"""rad/s; width of the smooth step of friction, tanh(dq / width)."""

# `python -m benchmarks.identification.limits FOLDER` prints the distributions behind these limits; the
# numbers here include two walks and a replay of a Go2.
EXPLAINED_ERROR_SHARE = 0.5
"""Command, angle and speed explain a torque if they leave less than this share of it: so for 95 % of
the joints.
"""
MIN_SIGN_CORRELATION = 0.8
"""Partial correlation with the own command, from which its sign is certain; 0.996 and more with a
reversed sign.
"""
PREFERRED_ERROR_RATIO = 0.3
"""A second explanation is preferred on a joint if it leaves less than this share of the first one's
error.
"""
MIN_ANSWERED_SHARE = 0.1
"""Smallest share of the torque left by speed and friction that the position error has to explain.

On logs of PD drives it was usually 0.97, and in 1 % below 0.05, at the lag of the partial correlation
given q. At the lag of the best fit, which is used now, it is at least that.
"""
SAME_COMMAND_CORRELATION = 0.95
"""Commands that correlate more are the same, and their joints cannot be distinguished."""
UNIT_GAIN_FACTOR = 8.0
"""A gain off by more than this factor is in another unit; 98 % of the joints are within 0.5 to 1.25."""
_BOUND_QUANTILES = (0.3, 0.5, 0.7, 0.9)
"""Quantiles of a torque's size at which a bound may lie: a torque that is often at it is noisy there."""


@attrs.frozen(eq=False)
class Response:
    """Response of the torque of J joints to their commands, on R rows and L lags.

    Attributes:
        log: The log, with the feed-forward torque subtracted.
        rows: (R,) state rows used.
        lags: (L,) lags from a command to its torque, s.
        error_share: (L, J) share of each joint's torque variance that command, angle and speed
            leave.
        command_correlation: (J,) partial correlation with the own command at the best lag.
        angle_correlation: (J,) partial correlation with the own angle, given the command.
        gain: (J,) gain of the position error, N m/rad, at the lag of `answered_share`.
        command_gain: (J,) gain of the command given the angle, N m/rad; springs do not change it.
        answered_share: (J,) share of the torque left by speed and friction that the position
            error explains, at the best lag that a drive can have.
    """

    log: Log
    rows: Indices
    lags: Floats
    error_share: Floats
    command_correlation: Floats
    angle_correlation: Floats
    gain: Floats
    command_gain: Floats
    answered_share: Floats

    @property
    def min_error_share(self) -> Floats:
        """Error share (J,) at each joint's best lag."""
        return np.asarray(self.error_share.min(axis=0))


def measure_response(log: Log) -> Response | None:
    """Measure the response of the torque to the commands in the valid rows.

    Args:
        log: The log.

    Returns:
        The response at lags up to `MAX_LAG_S`; None without torque or with fewer than 50 rows.
    """
    log = log.without_feed_forward()
    step = max(LAG_STEP_S, log.period)
    known = (log.t > log.t_cmd[0] + MAX_LAG_S) & (log.t < log.t_cmd[-1] - MAX_LAG_S)
    row = np.flatnonzero(log.valid.any(axis=1) & known)
    row = row[:: max(1, len(row) // MAX_ROWS)]
    if log.tau is None or len(row) < 50:
        return None
    lags = step * np.arange(-int(MAX_LAG_S / step + 0.5), int(MAX_LAG_S / step + 0.5) + 1)
    of_a_drive = (lags > -0.5 * step) & (lags < MAX_DRIVE_DELAY_S + 0.5 * step)
    at = [log.command_rows(log.t[row] - lag + TIME_ROUNDING_S) for lag in lags]
    left, found = np.empty((len(lags), len(log.joints))), np.empty((5, len(log.joints)))
    for j in range(len(log.joints)):
        left[:, j], found[:, j] = _of_joint(log, row, at, of_a_drive, j)
    return Response(log, row, lags, left, *found)


def _of_joint(
    log: Log, row: Indices, at: Sequence[Indices], of_a_drive: Bools, j: int
) -> tuple[Floats, tuple[float, float, float, float, float]]:
    """Error share (L,) of joint `j`, and its five scalars of `Response`.

    Args:
        log: The log, with the feed-forward torque subtracted.
        row: (R,) state rows.
        at: Command rows (R,) of each lag.
        of_a_drive: (L,) lags that a drive can have.
        j: Index of the joint.
    """
    assert log.tau is not None
    q, dq, tau = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq, log.tau))
    commands = np.stack([np.asarray(log.q_des[k, j], dtype=float) for k in at], 1)
    variance = float(np.var(tau)) + 1e-12
    y, p, c = (_project_out(motion_regressors(dq), x) for x in (tau, q, commands))
    # y: torque, p: angle, c: commands (R, L), each with speed, friction and offset projected out.
    # The angle is projected out of torque and commands too; r (L,) is their partial correlation.
    torque_rest, of_c = _residual(y, p), c - np.outer(p, p @ c) / (p @ p + 1e-12)
    size = np.sqrt(np.sum(of_c**2, axis=0)) + 1e-9 * np.sqrt(len(row))
    r = torque_rest @ of_c / size / (np.linalg.norm(torque_rest) + 1e-12)
    # A periodic torque correlates with either sign, half a period apart: prefer the positive one
    # unless the negative one explains clearly more.
    right, opposite = (int(np.argmax(sign * r)) for sign in (1.0, -1.0))
    k = (
        opposite
        if 1.0 - r[opposite] ** 2 < PREFERRED_ERROR_RATIO * (1.0 - max(r[right], 0.0) ** 2)
        else right
    )
    other = _residual(p, c[:, k])
    angle = float(other @ _residual(y, c[:, k]) / (np.linalg.norm(other) * np.linalg.norm(y) + 1e-12))
    command_gain = float(torque_rest @ of_c[:, k] / size[k] ** 2)
    gain, answer = _answer_to_error(y, c[:, of_a_drive] - p[:, None])
    misses = (torque_rest[:, None] - of_c * (torque_rest @ of_c / size**2)) ** 2 / variance
    return misses.mean(axis=0), (float(r[k]), angle, gain, command_gain, answer)


def _answer_to_error(y: Floats, error: Floats) -> tuple[float, float]:
    """Gain (N m/rad) of the position error, and the share of `y` it explains, at its best lag.

    The lag of the best partial correlation does not serve here. Given the angle, a command of one
    frequency explains nothing at any lag, and on a stiff joint the best lag is that of the commanded
    speed. No lag is preferred unless another explains clearly more: one frequency does not show it.

    Args:
        y: (R,) torque, N m, with speed, friction and offset projected out.
        error: (R, K) position error, rad, at no lag and at K - 1 lags, with the same projected out.
    """
    # At each lag: y = kp e + rest,  kp = (e . y) / |e|^2,  share = (e . y)^2 / (|e|^2 |y|^2).
    product, square = error.T @ y, np.sum(error**2, axis=0)
    share = product**2 / (square * (y @ y) + 1e-12)
    signed = np.sign(product) * share
    best = int(np.argmax(signed))
    if 1.0 - signed[best] > PREFERRED_ERROR_RATIO * (1.0 - signed[0]):
        best = 0
    gain = float(product[best] / (square[best] + 1e-12))
    return gain, float(share[best]) if gain > 0.0 else 0.0


def motion_regressors(dq: Floats) -> Floats:
    """Return the regressors of speed, Coulomb friction and offset.

    Args:
        dq: (R,) speeds, rad/s.

    Returns:
        (R, 3) columns dq, tanh(dq / FRICTION_SPEED_RAD_S), 1.
    """
    return np.stack([dq, np.tanh(dq / FRICTION_SPEED_RAD_S), np.ones(len(dq))], 1)


def least_squares_residual(signals: Floats, x: Floats) -> Floats:
    """Compute the residual of a least-squares fit.

    Args:
        signals: (R, K) regressors.
        x: (R,) values.

    Returns:
        (R,) residual.
    """
    return np.asarray(x - signals @ np.linalg.lstsq(signals, x, rcond=1e-9)[0])


def _project_out(regressors: Floats, x: Floats) -> Floats:
    """Residual of `x` (R,) or (R, L) after a least-squares fit on `regressors` (R, K)."""
    basis = np.linalg.qr(regressors)[0]
    left: Floats = x - basis @ (basis.T @ x)
    return left


def _residual(y: Floats, x: Floats) -> Floats:
    """Residual of `y` (R,) after a least-squares fit on one regressor `x` (R,)."""
    left: Floats = y - x * (x @ y) / (x @ x + 1e-12)
    return left


def opposite_signs(log: Log, found: Response) -> Iterator[Finding]:
    """Joints whose command, angle or torque has the opposite sign of the two others.

    Args:
        log: The log to check.
        found: Its response.

    Yields:
        A refusal for each field with the opposite sign.
    """
    clear = found.min_error_share < EXPLAINED_ERROR_SHARE
    strong = (
        clear
        & (np.abs(found.command_correlation) > MIN_SIGN_CORRELATION)
        & (np.abs(found.angle_correlation) > MIN_ANSWERED_SHARE)
    )
    # A torque kp (q_des - q) correlates positively with q_des and negatively with q.
    command_inverted, angle_inverted = found.command_correlation < 0.0, found.angle_correlation > 0.0
    cases = (
        ("q_des", command_inverted & ~angle_inverted, "{} answers its own command with the opposite sign"),
        (
            "tau",
            command_inverted & angle_inverted,
            "has the opposite sign on {}, or q and q_des are exchanged there",
        ),
        ("q", ~command_inverted & angle_inverted, "{} has the opposite sign of its command and its torque"),
    )
    for field, hit, text in cases:
        if (hit & strong).any():
            joints = log.joints_where(hit & strong)
            r = float(np.median(found.command_correlation[hit & strong]))
            correlation = f"partial correlation of torque and command {r:.2f}"
            description = f"{field}: {text.format(format_names(joints))} ({correlation})"
            yield Finding("refusal", field, joints, description)


def joint_order(log: Log, found: Response) -> Iterator[Finding]:
    """Another order of the joints in one field that explains the torque far better.

    Args:
        log: The log to check.
        found: Its response.

    Yields:
        A refusal that names the field and the joints.
    """
    if len(log.joints) < 2 or (found.min_error_share < MIN_ANSWERED_SHARE).all():
        return
    joints = range(len(log.joints))
    best: tuple[float, Finding] = 0.0, Finding("refusal", "", (), "")
    for field, what, of_command, of_motion in (
        ("q_des", "q follows another joint's command", 1, 0),
        ("q", "torque answers its own command at another joint's angle", 0, 1),
        ("tau", "tau follows another joint's command and motion", 1, 1),
    ):
        left = np.array(
            [
                [_error_share(found, j, k if of_command else j, k if of_motion else j) for k in joints]
                for j in joints
            ]
        )
        moved, order = _best_order(log, found.min_error_share, left)
        score = float(np.sum(np.log(left[moved, order[moved]] / found.min_error_share[moved])))
        if len(moved) >= 2 and score < best[0]:
            best = score, _order_finding(log, field, what, moved, order)
    if best[0] < 0.0:
        yield best[1]


def _error_share(found: Response, j: int, k: int, m: int) -> float:
    """Share of joint j's torque that k's command and m's motion leave, at the best of three lags."""
    log, row = found.log, found.rows[::4]
    assert log.tau is not None
    tau, q, dq = (np.asarray(x, dtype=float) for x in (log.tau[row, j], log.q[row, m], log.dq[row, m]))
    shares = []
    for lag in (0.0, 0.006, 0.012):
        q_des = np.asarray(log.q_des[log.command_rows(log.t[row] - lag + TIME_ROUNDING_S), k], dtype=float)
        y, error = (_project_out(motion_regressors(dq), x) for x in (tau, q_des - q))
        shares.append(float(np.var(_residual(y, error) if error @ y > 0.0 else y) / (np.var(tau) + 1e-12)))
    return min(shares)


def _best_order(log: Log, own: Floats, left: Floats) -> tuple[Indices, Indices]:
    """The best assignment of columns (Hungarian method), and the joints that gain clearly by it.

    Args:
        log: The log.
        own: (J,) error share with the columns as they are.
        left: (J, J) error share of joint j with the columns of joint k.
    """
    order = linear_sum_assignment(np.log(left + 1e-6))[1]
    other = left[np.arange(len(order)), order]
    commands = _normalised(log.q_des[:: max(1, len(log.q_des) // MAX_ROWS)])
    # Exclude the joint itself and joints with the same command.
    same = np.abs(commands.T @ commands)[np.arange(len(order)), order] > SAME_COMMAND_CORRELATION
    return np.flatnonzero(
        (other < PREFERRED_ERROR_RATIO * own) & (other < EXPLAINED_ERROR_SHARE) & ~same
    ), order


def _order_finding(log: Log, field: str, what: str, moved: Indices, order: Indices) -> Finding:
    """The refusal of a wrong order of joints."""
    pairs = format_names([f"{log.joints[j]} follows {log.joints[order[j]]}" for j in moved])
    text = f"{field}: a joint's {what} ({pairs}): the columns are in different orders"
    return Finding("refusal", field, tuple(log.joints[j] for j in moved), text)


def unresponsive(log: Log, found: Response) -> Iterator[Finding]:
    """Torque that has nothing to do with the position error.

    Args:
        log: The log to check.
        found: Its response.

    Yields:
        A refusal if all joints are concerned, else a warning.
    """
    used = log.valid[found.rows].any(axis=0)
    lost = found.answered_share < MIN_ANSWERED_SHARE
    moves = ~resting(log)
    if (lost | ~used).all():
        rests = np.ptp(log.q_des, axis=0) < MOVING_SPAN_RAD
        never = (
            f"q_des never changes on {format_names(log.joints_where(rests))}, and tau " if rests.any() else ""
        )
        text = (
            f"tau: {never}does not answer the position error on any joint (which explains "
            f"{100 * found.answered_share.max():.0f} % of it at most); expected q_des, q and tau of the same "
            "joints, with the same signs"
        )
        yield Finding("refusal", "tau", log.joints, text)
    elif (lost & moves & used).any():
        joints = log.joints_where(lost & moves & used)
        text = (
            f"tau: does not answer the position error on {format_names(joints)}: results for these joints "
            "are unreliable"
        )
        yield Finding("warning", "tau", joints, text)


def gain_units(log: Log, found: Response) -> Iterator[Finding | Log]:
    """Gains of another unit than the torque's: a servo's own numbers, N m/degree, mN m.

    Args:
        log: The log to check.
        found: Its response.

    Yields:
        A refusal; or a warning and the log without gains, so that these are fitted.
    """
    if log.kp is None:
        return
    asked = np.median(log.kp[log.command_rows(log.t[found.rows])], axis=0)
    clear = (
        ~resting(log) & (found.min_error_share < EXPLAINED_ERROR_SHARE) & (asked > 0.0) & (found.gain > 0.0)
    )
    if not clear.any():
        return
    ratio = found.gain / np.where(asked > 0.0, asked, 1.0)
    off = clear & _is_far_off(ratio) & _is_far_off(found.command_gain / np.where(asked > 0.0, asked, 1.0))
    off &= [not (one and _is_bounded(log, found, j)) for j, one in enumerate(off)]
    if not off.any():
        return
    number, joints = float(np.median(ratio[off])), log.joints_where(off)
    causes = [*_exchanged_gains(log), *_UNITS_OF_TORQUE]
    known = [unit for unit, factor in causes if abs(np.log(number / factor)) < np.log(1.5)]
    if known or (off != clear).any():
        expected = f"{known[0]}? " if known else ""
        size = f"{number:.3g}" if number < 100.0 else f"{number:.2g}"
        text = f"tau: {size} times what kp asks for on {format_names(joints)}: {expected}expected N m, and kp in N m/rad"
        yield Finding("refusal", "tau", joints, text)
        return
    text = (
        f"kp: the torque shows {number:.3g} times what it asks for, on all joints: it is in a unit of its own, "
        "as a servo's is; both gains are fitted"
    )
    yield Finding("warning", "kp", joints, text)
    yield attrs.evolve(log, kp=None, kd=None)


def _exchanged_gains(log: Log) -> Iterator[tuple[str, float]]:
    """Ratio of the torque to what kp asks for if kp and kd are exchanged, with that mistake."""
    if log.kp is not None and log.kd is not None:
        kp, kd = float(np.median(log.kp)), float(np.median(log.kd))
        if kd > kp > 0.0:
            yield f"kp {kp:.3g} and kd {kd:.3g} exchanged", kd / kp


def _is_bounded(log: Log, found: Response, j: int) -> bool:
    """Whether a bound on the torque that is asked for explains a joint better than another unit does."""
    assert log.tau is not None
    assert log.kp is not None
    row, lags = found.rows, found.lags[(found.lags >= 0.0) & (found.lags <= MAX_DRIVE_DELAY_S)]
    q, dq, tau = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq, log.tau))
    bounds, left = np.quantile(np.abs(tau), _BOUND_QUANTILES), []
    for lag in lags:
        k = log.command_rows(log.t[row] - lag + TIME_ROUNDING_S)
        asked = log.kp[k, j] * (log.q_des[k, j] - q) - (0.0 if log.kd is None else log.kd[k, j] * dq)
        left += [np.mean((tau - np.clip(asked, -bound, bound)) ** 2) for bound in bounds]
    return bool(min(left) < found.min_error_share[j] * np.var(tau))


def _is_far_off(ratio: Floats) -> Bools:
    """Whether a ratio, or its inverse, exceeds `UNIT_GAIN_FACTOR`."""
    return np.abs(np.log(np.maximum(ratio, 1e-12))) > np.log(UNIT_GAIN_FACTOR)


_UNITS_OF_TORQUE = (
    ("tau in mN m", 1e3),
    ("tau in kN m, or kp in mN m/rad", 1e-3),
    ("kp in N m/degree", 360.0 / TURN_RAD),
    ("q in degrees, or tau of another unit", DEGREE_RAD),
)
"""Known ratios of the torque to kp times the position error, each with the mistake that causes it."""


def command_tracking(log: Log) -> Iterator[Finding]:
    """Without torque: joints that follow their own command inverted, or another joint's command.

    Args:
        log: The log to check.

    Yields:
        A refusal.
    """
    if log.tau is not None:
        return
    row = np.flatnonzero(log.valid.any(axis=1))
    row = row[:: max(1, len(row) // MAX_ROWS)]
    q = _normalised(log.q[row])
    # Correlation of q (rows) with q_des (columns) at each lag, (L, J, J).
    alike = np.stack(
        [
            q.T @ _normalised(log.q_des[log.command_rows(log.t[row] - lag + TIME_ROUNDING_S)])
            for lag in np.arange(0.0, MAX_LAG_S, 0.01)
        ]
    )
    most, least = alike.max(axis=0), alike.min(axis=0)
    opposite = least.diagonal()
    hit = (opposite < -EXPLAINED_ERROR_SHARE) & (most.diagonal() < 0.0)
    if hit.any():
        joints = log.joints_where(hit)
        text = (
            f"q_des: {format_names(joints)} follows its own command with the opposite sign "
            f"(correlation {np.median(opposite[hit]):.2f})"
        )
        yield Finding("refusal", "q_des", joints, text)
        return
    left = 1.0 - np.maximum(most, 0.0) ** 2
    moved, order = _best_order(log, left.diagonal(), left)
    if len(moved) >= 2:
        yield _order_finding(log, "q_des", "q follows another joint's command", moved, order)


def _normalised(values: Floats) -> Floats:
    """Columns with their mean removed and scaled to length 1; a constant column becomes 0."""
    centred = values.astype(float) - values.astype(float).mean(axis=0)
    length = np.sqrt(np.sum(centred**2, axis=0))
    return np.divide(centred, length, out=np.zeros_like(centred), where=length > 1e-6)
