"""How the measured torque goes with the commands: partial correlations at every lag, and the checks that read them.

A drive under PD control gives kp (q_des(t - lag) - q) - kd dq. Of the torque of a joint and of a command, what the joint's
own angle, speed and direction of motion explain is taken out (Frisch, Waugh and Lovell); the correlation of what is left
says with which sign, how late, and to whose command the torque answers, whatever gains, friction and offset are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from .channels import DEGREE, REACHES, TURN, names
from .findings import Finding, some
from .log import Array, Bools, Log

ROWS = 4000
"""Rows that are looked at, spread over the log."""
LAG_STEP, REACH = 0.002, 0.1
"""s between the lags that are looked at, a row of the log at least, and how far they go to either side."""
ROUNDING = 1e-9
"""s, by which a command may be later than the instant at which it counts, a sum of rounded numbers."""
AT_REST = 0.05
"""rad/s, within which friction turns its sign."""

# `python -m tests.identification.limits FOLDER` prints what the limits rest on, here with two walks and a replay of a Go2.
CLEAR = 0.5
"""Share of the torque that a joint's command, angle and speed leave, below which they explain it: so for 95 % of the joints."""
SURE = 0.8
"""Partial correlation with the own command, from which its sign is told: 0.996 and more where a sign was reversed."""
BETTER = 0.3
"""A second account must leave less than this share of what the first one leaves, to be preferred on one joint."""
UNANSWERED = 0.1
"""Share of the torque that speed and friction leave, explained by the position error: usually 0.97, in 1 % below 0.05."""
SAME = 0.95
"""Correlation from which two commands are one, and no order of columns can be told."""
FAR_OFF = 8.0
"""Times the commanded gain, or as small a part of it: 0.5 to 1.25 in 98 %. Beyond, the units are others."""


@attrs.frozen(eq=False)
class Response:
    """Of R rows and J joints; `log` is without feed-forward torque."""

    log: Log
    row: NDArray[np.intp]
    lags: Array  # (L,) s, from a command to its torque
    left: Array  # (L, J), share of each joint's torque that its command of that lag, its angle and its speed leave
    command: Array  # (J,), partial correlation with the own command at the best lag
    angle: Array  # (J,), partial correlation with the own angle beside it
    gain: Array  # (J,) N m/rad, of the position error
    command_gain: Array  # (J,) N m/rad, of the command beside the angle: springs leave it as it is
    answer: Array  # (J,), share that the position error explains of what speed and friction leave

    @property
    def best(self) -> Array:
        """(J,), what each joint's best lag leaves."""
        return np.asarray(self.left.min(axis=0))


def measured(log: Log) -> Response | None:
    """The response in the valid rows of a log with torque, at lags up to REACH; None where that is too short."""
    log = log.without_feed_forward()
    step = max(LAG_STEP, log.period)
    known = (log.t > log.t_cmd[0] + REACH) & (log.t < log.t_cmd[-1] - REACH)
    row = np.flatnonzero(log.valid.any(axis=1) & known)
    row = row[:: max(1, len(row) // ROWS)]
    if log.tau is None or len(row) < 50:
        return None
    lags = step * np.arange(-int(REACH / step + 0.5), int(REACH / step + 0.5) + 1)
    at = [log.command_rows(log.t[row] - lag + ROUNDING) for lag in lags]
    left, found = np.empty((len(lags), len(log.joints))), np.empty((5, len(log.joints)))
    for j in range(len(log.joints)):
        left[:, j], found[:, j] = _of_joint(log, row, at, j)
    return Response(log, row, lags, left, *found)


def _of_joint(
    log: Log, row: NDArray[np.intp], at: Sequence[NDArray[np.intp]], j: int
) -> tuple[Array, tuple[float, float, float, float, float]]:
    """`left` (L,) of joint `j`, and `command`, `angle`, `gain`, `command_gain`, `answer` of `Response`.

    `at` are the command rows of each lag.
    """
    assert log.tau is not None
    q, dq, tau = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq, log.tau))
    commands = np.stack([np.asarray(log.q_des[k, j], dtype=float) for k in at], 1)
    variance = float(np.var(tau)) + 1e-12
    y, p, c = (_without(motion(dq), x) for x in (tau, q, commands))
    # With the angle taken out of torque and commands.
    beside, of_c = _residual(y, p), c - np.outer(p, p @ c) / (p @ p + 1e-12)
    size = np.sqrt(np.sum(of_c**2, axis=0)) + 1e-9 * np.sqrt(len(row))
    r = beside @ of_c / size / (np.linalg.norm(beside) + 1e-12)
    # Waves answer with either sign, half a period apart: the opposite one has to explain clearly more.
    right, opposite = (int(np.argmax(sign * r)) for sign in (1.0, -1.0))
    k = opposite if 1.0 - r[opposite] ** 2 < BETTER * (1.0 - max(r[right], 0.0) ** 2) else right
    other = _residual(p, c[:, k])
    angle = float(other @ _residual(y, c[:, k]) / (np.linalg.norm(other) * np.linalg.norm(y) + 1e-12))
    error = c[:, k] - p
    gain = float(error @ y / (error @ error + 1e-12))
    command_gain = float(beside @ of_c[:, k] / size[k] ** 2)
    answer = float((error @ y) ** 2 / ((error @ error) * (y @ y) + 1e-12))
    misses = (beside[:, None] - of_c * (beside @ of_c / size**2)) ** 2 / variance
    return misses.mean(axis=0), (float(r[k]), angle, gain, command_gain, answer if gain > 0.0 else 0.0)


def motion(dq: Array) -> Array:
    """What of the torque the motion explains beside the angle: speed, friction and an offset, (R, 3)."""
    return np.stack([dq, np.tanh(dq / AT_REST), np.ones(len(dq))], 1)


def _without(regressors: Array, x: Array) -> Array:
    """What a linear fit on `regressors` (R, K) leaves of `x` (R,) or (R, L)."""
    basis = np.linalg.qr(regressors)[0]
    left: Array = x - basis @ (basis.T @ x)
    return left


def _residual(y: Array, x: Array) -> Array:
    left: Array = y - x * (x @ y) / (x @ x + 1e-12)
    return left


def signs(log: Log, found: Response) -> Iterator[Finding]:
    """Joints whose command, angle or torque has the opposite sign of the two others."""
    clear = found.best < CLEAR
    strong = clear & (np.abs(found.command) > SURE) & (np.abs(found.angle) > UNANSWERED)
    cases = (
        ("q_des", (found.command < 0.0) & (found.angle < 0.0), "{} answers its own command with the opposite sign"),
        ("tau", (found.command < 0.0) & (found.angle > 0.0), "has the opposite sign on {}, of which command and angle have theirs"),
        ("q", (found.command > 0.0) & (found.angle > 0.0), "{} has the opposite sign of its command and its torque"),
    )  # fmt: skip
    for field, hit, text in cases:
        if (hit & strong).any():
            joints = names(log, hit & strong)
            r = float(np.median(found.command[hit & strong]))
            said = f"{field}: {text.format(some(joints))} (partial correlation of torque and command {r:.2f})"
            yield Finding("refusal", field, joints, said)


def columns(log: Log, found: Response) -> Iterator[Finding]:
    """Another order of the joints in one of the fields, that explains the torque far better than the order as it is."""
    if len(log.joints) < 2 or (found.best < UNANSWERED).all():
        return
    joints = range(len(log.joints))
    best: tuple[float, Finding] = 0.0, Finding("refusal", "", (), "")
    for field, what, of_command, of_motion in (
        ("q_des", "q follows another joint's command", 1, 0),
        ("q", "torque answers its own command at another joint's angle", 0, 1),
        ("tau", "tau follows another joint's command and motion", 1, 1),
    ):
        left = np.array(
            [[_left(found, j, k if of_command else j, k if of_motion else j) for k in joints] for j in joints]
        )
        told, order = _reordered(log, found.best, left)
        score = float(np.sum(np.log(left[told, order[told]] / found.best[told])))
        if len(told) >= 2 and score < best[0]:
            best = score, _other_order(log, field, what, told, order)
    if best[0] < 0.0:
        yield best[1]


def _left(found: Response, j: int, k: int, m: int) -> float:
    """Share of the torque of joint j that the command of k and the motion of m leave, at the better of three lags."""
    log, row = found.log, found.row[::4]
    assert log.tau is not None
    tau, q, dq = (np.asarray(x, dtype=float) for x in (log.tau[row, j], log.q[row, m], log.dq[row, m]))
    shares = []
    for lag in (0.0, 0.006, 0.012):
        q_des = np.asarray(log.q_des[log.command_rows(log.t[row] - lag + ROUNDING), k], dtype=float)
        y, error = (_without(motion(dq), x) for x in (tau, q_des - q))
        shares.append(float(np.var(_residual(y, error) if error @ y > 0.0 else y) / (np.var(tau) + 1e-12)))
    return min(shares)


def _reordered(log: Log, own: Array, left: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Joints that the best order moves and that gain clearly by it, and that order.

    `own` (J,) is the share that is left as it is, `left` (J, J) the one with the columns of each other joint.
    """
    order = linear_sum_assignment(np.log(left + 1e-6))[1]
    other = left[np.arange(len(order)), order]
    commands = _unit(log.q_des[:: max(1, len(log.q_des) // ROWS)])
    same = (
        np.abs(commands.T @ commands)[np.arange(len(order)), order] > SAME
    )  # the joint itself, or one led alike
    return np.flatnonzero((other < BETTER * own) & (other < CLEAR) & ~same), order


def _other_order(log: Log, field: str, what: str, told: NDArray[np.intp], order: NDArray[np.intp]) -> Finding:
    pairs = some([f"{log.joints[j]} follows {log.joints[order[j]]}" for j in told])
    text = f"{field}: a joint's {what} ({pairs}): the columns stand in different orders"
    return Finding("refusal", field, tuple(log.joints[j] for j in told), text)


def deaf(log: Log, found: Response) -> Iterator[Finding]:
    """Torque that has nothing to do with the position error."""
    used = log.valid[found.row].any(axis=0)
    lost = found.answer < UNANSWERED
    moves = np.ptp(log.q[found.row], axis=0) > REACHES
    if (lost | ~used).all():
        rests = np.ptp(log.q_des, axis=0) < REACHES
        never = f"q_des never changes on {some(names(log, rests))}, and tau " if rests.any() else ""
        text = (
            f"tau: {never}does not answer the position error on any joint (which explains {100 * found.answer.max():.0f} % of it "
            "at most); expected q_des, q and tau of the same joints, with the same signs"
        )
        yield Finding("refusal", "tau", log.joints, text)
    elif (lost & moves & used).any():
        joints = names(log, lost & moves & used)
        text = f"tau: does not answer the position error on {some(joints)}: what is found there is not to be trusted"
        yield Finding("warning", "tau", joints, text)


def scale(log: Log, found: Response) -> Iterator[Finding | Log]:
    """Gains of another unit than the torque's: a servo's own numbers, N m/degree, mN m."""
    if log.kp is None:
        return
    asked = np.median(log.kp[log.command_rows(log.t[found.row])], axis=0)
    clear = (found.best < CLEAR) & (asked > 0.0) & (found.gain > 0.0)
    if not clear.any():
        return
    ratio = found.gain / np.where(asked > 0.0, asked, 1.0)
    off = clear & _far(ratio) & _far(found.command_gain / np.where(asked > 0.0, asked, 1.0))
    if not off.any():
        return
    number, joints = float(np.median(ratio[off])), names(log, off)
    known = [unit for unit, factor in _UNITS_OF_TORQUE if abs(np.log(number / factor)) < np.log(1.5)]
    if known or (off != clear).any():
        expected = f"{known[0]}? " if known else ""
        size = f"{number:.3g}" if number < 100.0 else f"{number:.2g}"
        text = (
            f"tau: {size} times what kp asks for on {some(joints)}: {expected}expected N m, and kp in N m/rad"
        )
        yield Finding("refusal", "tau", joints, text)
        return
    text = (
        f"kp: the torque shows {number:.3g} times what it asks for, on all joints: it is in a unit of its own, as a servo's "
        "is; both gains are fitted"
    )
    yield Finding("warning", "kp", joints, text)
    yield attrs.evolve(log, kp=None, kd=None)


def _far(ratio: Array) -> Bools:
    return np.abs(np.log(np.maximum(ratio, 1e-12))) > np.log(FAR_OFF)


_UNITS_OF_TORQUE = (
    ("tau in mN m", 1e3),
    ("tau in kN m, or kp in mN m/rad", 1e-3),
    ("kp in N m/degree", 360.0 / TURN),
    ("q in degrees, or tau of another unit", DEGREE),
)
"""By how much, as a factor, the torque may be off what the gains ask for: within a factor of 1.5."""


def followed(log: Log) -> Iterator[Finding]:
    """Without torque: joints that follow their own command with the opposite sign, or another joint's command."""
    if log.tau is not None:
        return
    row = np.flatnonzero(log.valid.any(axis=1))
    row = row[:: max(1, len(row) // ROWS)]
    q = _unit(log.q[row])
    alike = np.stack(
        [
            q.T @ _unit(log.q_des[log.command_rows(log.t[row] - lag + ROUNDING)])
            for lag in np.arange(0.0, REACH, 0.01)
        ]
    )  # (L, J, J)
    most, least = alike.max(axis=0), alike.min(axis=0)
    opposite = least.diagonal()
    hit = (opposite < -CLEAR) & (most.diagonal() < 0.0)
    if hit.any():
        joints = names(log, hit)
        text = f"q_des: {some(joints)} follows its own command with the opposite sign (correlation {np.median(opposite[hit]):.2f})"
        yield Finding("refusal", "q_des", joints, text)
        return
    left = 1.0 - np.maximum(most, 0.0) ** 2
    told, order = _reordered(log, left.diagonal(), left)
    if len(told) >= 2:
        yield _other_order(log, "q_des", "q follows another joint's command", told, order)


def _unit(values: Array) -> NDArray[np.float64]:
    """Columns without their means, of length 1; a column that never changes stays 0."""
    centred = values.astype(float) - values.astype(float).mean(axis=0)
    length = np.sqrt(np.sum(centred**2, axis=0))
    return np.divide(centred, length, out=np.zeros_like(centred), where=length > 1e-6)
