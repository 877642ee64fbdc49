"""What the motion of a log can tell apart: collinearity of what the parameters change in the torque, in words.

Linear in small changes (Eq. 1): the gains weigh position error and speed, an input delay the slope of the command, an
output delay the slope of the whole torque. Where one of these traces is a mix of the others, only their sum is seen.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .channels import rows_of
from .findings import Finding
from .log import Log

APART = 0.3
"""Share (of the root mean square) of a trace that no mix of the others gives; below it a sentence is due."""
HALF_WIDTH = 0.005  # s, of slopes

KP, KD = 30.0, 0.5  # where the log does not say; only their ratio matters here

# Of each pair: what separates the two.
PAIRS = {
    (
        "input delay",
        "output delay",
    ): "the joint's own motion (kp dq + kd ddq), which only the output delay shifts",
    ("kd", "Coulomb friction"): "changes of speed: move slower and faster",
    ("kp", "torque offset"): "changes of the position error: load the joint both ways",
    ("kd", "output delay"): "fast changes of the torque: steps or higher frequencies",
}


def collinear(log: Log) -> Iterator[Finding]:
    """A sentence for each pair of parameters that this motion hardly separates, and for what it cannot show."""
    traces = _traces(log)
    if traces is None:
        return
    if not any(one["input delay"].any() for one in traces):
        text = "q_des: the command never changes, so that no delay of the command can be identified"
        yield Finding("warning", "q_des", (), text)
    for (first, second), motion in PAIRS.items():
        shares = [_apart(one[first], one[second], _others(one, first, second)) for one in traces]
        share = float(np.median(shares))
        if share < APART:
            text = (
                f"q_des: {first} and {second} are separable only through {motion}; "
                f"here that is {100 * share:.0f} % of what they do to the torque"
            )
            yield Finding("note" if share > 0.5 * APART else "warning", "q_des", (), text)


def _traces(log: Log) -> list[dict[str, NDArray[np.float64]]] | None:
    """Of each moving joint, what a small change of each parameter does to the torque, (n,); None if none moves."""
    row = rows_of(log)
    row = row[log.valid[row].any(axis=1)]
    reach = max(1, round(HALF_WIDTH / log.period))
    first, last = np.maximum(row - reach, 0), np.minimum(row + reach, len(log.t) - 1)
    span = (log.t[last] - log.t[first])[:, None]
    command = log.command_rows(log.t[row])
    q_des = log.q_des[command].astype(float)
    dq = log.dq[row].astype(float)
    ddq = (log.dq[last] - log.dq[first]) / span
    slope = (log.q_des[log.command_rows(log.t[last])] - log.q_des[log.command_rows(log.t[first])]) / span
    kp = KP if log.kp is None or not log.kp.any() else np.asarray(log.kp)[command]
    kd = KD if log.kd is None or not log.kd.any() else np.asarray(log.kd)[command]
    traces = {
        "kp": q_des - log.q[row],
        "kd": -dq,
        "input delay": -kp * slope,
        "output delay": -kp * (slope - dq) + kd * ddq,
        "Coulomb friction": -np.tanh(dq / 0.05),
        "torque offset": np.ones_like(dq),
    }
    moving = np.flatnonzero(np.sqrt(np.sum(dq**2, axis=0)) > 0.01 * np.sqrt(len(row)))
    return [{name: values[:, j] for name, values in traces.items()} for j in moving] or None


def _others(traces: dict[str, NDArray[np.float64]], *but: str) -> NDArray[np.float64]:
    """The gains' own traces, as they are always fitted too."""
    return np.stack([traces[name] for name in ("kp", "kd") if name not in but], axis=1)


def _apart(a: NDArray[np.float64], b: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Sine of the angle between two traces once the others are taken out of both.

    1 where one of them is nothing at all, 0 where the others leave nothing of it.
    """
    whole = np.linalg.norm(a) * np.linalg.norm(b)
    if whole < 1e-12:
        return 1.0
    if others.shape[1]:
        a, b = (x - others @ np.linalg.lstsq(others, x, rcond=None)[0] for x in (a, b))
    left = np.linalg.norm(a) * np.linalg.norm(b)
    if left < 1e-9 * whole:
        return 0.0
    cosine = float(np.sum(a * b)) / float(left)
    return float(np.sqrt(max(0.0, 1.0 - cosine**2)))
