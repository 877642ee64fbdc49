"""Collinearity of parameters: which of them the motion of a log can distinguish.

Linearise Eq. 1 in small changes of its parameters. A change of a gain adds a multiple of the
position error or the speed to the torque, an input delay the slope of the command, an output
delay the slope of the whole torque. If one of these traces is a linear combination of the others,
only the combination can be identified.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quadvel_description.arrays import Array

from ..findings import Finding
from ..log import Log
from .channels import sample_rows

MIN_SEPARATION = 0.3
"""Share (root mean square) of a trace outside the span of the others, below which the pair is
reported.
"""
SLOPE_HALF_WIDTH_S = 0.005
"""s to either side over which slopes are computed."""

DEFAULT_KP, DEFAULT_KD = 30.0, 0.5
"""N m/rad and N m s/rad, for logs without gains; only their ratio matters here."""

CONFUSED_PAIRS = {
    (
        "input delay",
        "output delay",
    ): "faster motion of the joint itself, which only the output delay shifts",
    ("kd", "Coulomb friction"): "changes of speed: move slower and faster",
    ("kp", "torque offset"): "changes of the position error: load the joint both ways",
    ("kd", "output delay"): "fast changes of the torque: steps or higher frequencies",
}
"""Pairs of parameters that are often confused, each with the motion that separates them."""


def collinear(log: Log) -> Iterator[Finding]:
    """Pairs of parameters that this motion hardly separates, and parameters that it cannot show.

    Args:
        log: The log to check.

    Yields:
        Notes and warnings.
    """
    traces = _traces(log)
    if traces is None:
        return
    if not any(one["input delay"].any() for one in traces):
        text = "q_des: the command never changes, so that no delay of the command can be identified"
        yield Finding("warning", "q_des", (), text)
    for (first, second), motion in CONFUSED_PAIRS.items():
        shares = [_sine_between(one[first], one[second], _gain_traces(one, first, second)) for one in traces]
        share = float(np.median(shares))
        if share < MIN_SEPARATION:
            text = (
                f"q_des: this motion hardly separates {first} from {second}: only {100 * share:.0f} % of what they "
                f"do to the torque differs; what separates them is {motion}"
            )
            yield Finding("note" if share > 0.5 * MIN_SEPARATION else "warning", "q_des", (), text)


def _traces(log: Log) -> list[dict[str, Array]] | None:
    """Derivative (n,) of each moving joint's torque by each parameter; None if no joint moves."""
    row = sample_rows(log)
    row = row[log.valid[row].any(axis=1)]
    reach = max(1, round(SLOPE_HALF_WIDTH_S / log.period))
    first, last = np.maximum(row - reach, 0), np.minimum(row + reach, len(log.t) - 1)
    span = (log.t[last] - log.t[first])[:, None]
    command = log.command_rows(log.t[row])
    q_des = log.q_des[command].astype(float)
    dq = log.dq[row].astype(float)
    ddq = (log.dq[last] - log.dq[first]) / span
    slope = (log.q_des[log.command_rows(log.t[last])] - log.q_des[log.command_rows(log.t[first])]) / span
    kp = DEFAULT_KP if log.kp is None or not log.kp.any() else np.asarray(log.kp)[command]
    kd = DEFAULT_KD if log.kd is None or not log.kd.any() else np.asarray(log.kd)[command]
    # Derivatives of tau = kp (q_des(t - d_in - d_out) - q(t - d_out)) - kd dq(t - d_out)
    #                     - friction sign(dq) + offset
    # by kp, kd, d_in, d_out, friction and offset, in this order.
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


def _gain_traces(traces: dict[str, Array], *but: str) -> Array:
    """Traces (n, K) of the gains other than `but`; gains are always fitted as well."""
    return np.stack([traces[name] for name in ("kp", "kd") if name not in but], axis=1)


def _sine_between(a: Array, b: Array, others: Array) -> float:
    """Sine of the angle between two traces after projecting out the others.

    1 if one of them is 0; 0 if the others explain one of them entirely.
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
