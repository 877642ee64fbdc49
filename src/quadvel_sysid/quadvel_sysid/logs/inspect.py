"""What a log says before anything is fitted to it: time, units, names, control, excitation. Nothing is fitted here.

Each check looks at one thing and says what it found in a sentence. A refusal means that a report on this log
would be wrong; a warning that a part of it is not used, or is to be read with care.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal

import attrs
import numpy as np

from . import excited, plausible
from .findings import Finding, some
from .log import Array, Bools, Log, LogError
from .pd_control import in_words, out_of_control, stretches, without_position_gain

GAP = 3.5  # times the usual spacing
PAUSE = 0.1  # s, without a command, where they come regularly
LONGEST_GAP = 86_400.0  # s; a longer one is no pause, but a clock that was set
LONGEST_SPAN = 30.0  # times that of the states, of the commands
LEAST_VALID = 0.5  # s, of states that a model may be judged on


@attrs.frozen(eq=False)
class Inspection:
    """What was found, and the log with `valid` narrowed to the rows that a PD model can explain."""

    log: Log
    findings: tuple[Finding, ...]

    def raise_refusal(self) -> None:
        """Raises LogError with the first refusal, if there is one."""
        for finding in self.findings:
            if finding.kind == "refusal":
                raise LogError(f"{self.log.name}: {finding.text}")


def inspect(log: Log) -> Inspection:
    """All that can be said about the log, check by check, as far as the first refusal."""
    findings = [Finding("note", text.partition(":")[0], (), text) for text in log.remarks]
    for check in CHECKS:
        findings += check(log)
        if _refused(findings):
            return Inspection(log, tuple(findings))
    answer = log.without_feed_forward()
    valid, why = _explainable(answer)
    findings += why
    if not _refused(findings):
        answer = attrs.evolve(answer, valid=valid)
        for check in CHECKS_UNDER_CONTROL:
            findings += check(answer)
    return Inspection(attrs.evolve(log, valid=valid), tuple(findings))


def _refused(findings: list[Finding]) -> bool:
    return any(finding.kind == "refusal" for finding in findings)


def clocks(log: Log) -> Iterator[Finding]:
    """Clocks that were set in the middle, and two time bases that have nothing in common."""
    for field, time in (("t", log.t), ("t_cmd", log.t_cmd)):
        row = int(np.argmax(np.diff(time)))
        step = float(time[row + 1] - time[row])
        if step > max(LONGEST_GAP, 1e3 * float(np.median(np.diff(time)))):
            text = (
                f"{field}: jumps by {step:.6g} s from row {row} to row {row + 1}; expected one clock, in seconds: "
                "was it set while this was recorded?"
            )
            yield Finding("refusal", field, (), text)
    spans = f"t_cmd: {log.t_cmd[0]:.6g} to {log.t_cmd[-1]:.6g} s, t: {log.t[0]:.6g} to {log.t[-1]:.6g} s"
    ratio = (log.t_cmd[-1] - log.t_cmd[0]) / (log.t[-1] - log.t[0])
    if log.t_cmd[0] > log.t[-1] or log.t_cmd[-1] < log.t[0]:
        yield Finding("refusal", "t_cmd", (), f"{spans}: nothing in common, expected one clock for both")
    elif ratio > LONGEST_SPAN:
        text = f"{spans}: {ratio:.3g} times as long, expected both in seconds and of the same recording"
        yield Finding("refusal", "t_cmd", (), text)


def rates(log: Log) -> Iterator[Finding]:
    """Rate, jitter, gaps and missing rows of both time bases."""
    for field, time in (("t", log.t), ("t_cmd", log.t_cmd)):
        if field == "t_cmd" and time is log.t:
            continue
        steps = np.diff(time)
        low, usual, high = (float(x) for x in np.percentile(steps, [5, 50, 95]))
        yield Finding(
            "note",
            field,
            (),
            f"{field}: {len(time)} rows over {time[-1] - time[0]:.2f} s, {1 / usual:.4g} Hz; "
            f"spacing {1e3 * low:.2f} to {1e3 * high:.2f} ms (5 to 95 %), at most {1e3 * steps.max():.2f} ms",
        )
        regular = high < 2.0 * usual
        gaps = np.flatnonzero(steps > max(GAP * usual, PAUSE if field == "t_cmd" else 0.0))
        if gaps.size and (regular or field == "t"):
            longest = int(gaps[np.argmax(steps[gaps])])
            yield Finding(
                "warning",
                field,
                (),
                f"{field}: {gaps.size} gap{'s' * (gaps.size > 1)}, the longest of {steps[longest]:.3f} s "
                f"at {time[longest]:.2f} s",
            )
        if regular:
            missing = int(np.sum(np.round(steps[steps < GAP * usual] / usual) - 1.0))
            if missing > 0.001 * len(time):
                yield Finding(
                    "warning", field, (), f"{field}: about {missing} rows were dropped, one at a time"
                )
    if log.t_cmd[-1] < log.t[-1] - PAUSE:
        yield Finding(
            "warning",
            "t_cmd",
            (),
            f"t_cmd: the last command came {log.t[-1] - log.t_cmd[-1]:.2f} s before the last state; "
            "it is taken to be held",
        )


def repeats(log: Log) -> Iterator[Finding]:
    """Rows that say the same as the row before although the joints move."""
    same = (np.diff(log.q, axis=0) == 0.0).all(axis=1) & (np.diff(log.dq, axis=0) == 0.0).all(axis=1)
    moving = np.abs(log.dq[1:]).max(axis=1) > 0.05
    repeated = int((same & moving).sum())
    if repeated:
        share = repeated / max(1, int(moving.sum()))
        kind: Literal["note", "warning"] = "warning" if share > 0.01 else "note"
        yield Finding(
            kind,
            "q",
            (),
            f"q: {repeated} rows ({100 * share:.1f} % of those in motion) repeat the row before",
        )


def clipped(log: Log) -> Iterator[Finding]:
    """Channels that stay at one extreme value again and again while the joint moves."""
    for field in ("q", "dq", "tau", "q_des"):
        values = getattr(log, field)
        if values is None:
            continue
        hit: dict[str, str] = {}
        for j, joint in enumerate(log.joints):
            for bound in (float(values[:, j].min()), float(values[:, j].max())):
                at = values[:, j] == bound
                runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], at, [0]]))))[::2]
                if np.sum(runs >= 3) >= 3 and at.mean() > 0.002 and at.mean() < 0.5:
                    hit[joint] = f"{joint} at {bound:.4g} in {100 * at.mean():.1f} %"
        if hit:
            unit = {"q": "rad", "dq": "rad/s", "tau": "N m", "q_des": "rad"}[field]
            yield Finding(
                "note" if field == "q_des" else "warning",
                field,
                tuple(hit),
                f"{field}: clipped ({unit}): {some(list(hit.values()))} of the rows",
            )


def still(log: Log) -> Iterator[Finding]:
    """Joints that never move."""
    reach = np.ptp(log.q, axis=0)
    resting = tuple(joint for joint, r in zip(log.joints, reach, strict=True) if r < 1e-3)
    if len(resting) == len(log.joints):
        yield Finding("refusal", "q", resting, "q: no joint ever moves, so nothing can be identified")
    elif resting:
        yield Finding(
            "warning",
            "q",
            resting,
            f"q: never moves: {some(resting)}; of these only the torque at rest is seen",
        )


def gains(log: Log) -> Iterator[Finding]:
    """Gains that are not there, or change."""
    for field, values in (("kp", log.kp), ("kd", log.kd)):
        if values is None:
            yield Finding("note", field, (), f"{field}: not in the log; it is fitted")
            continue
        if (values < 0.0).any():
            yield Finding(
                "refusal", field, (), f"{field}: found {values.min():g}, expected gains of 0 or more"
            )
        used = values[(values > 0.0).any(axis=1)]
        if len(used) and (np.ptp(used, axis=0) > 1e-6 * used.max()).any():
            yield Finding("note", field, (), f"{field}: changes in the log, {used.min():g} to {used.max():g}")


def torque(log: Log) -> Iterator[Finding]:
    if log.tau is None:
        text = "tau: not in the log; effects are judged by the motion that follows from the commands"
        yield Finding("note", "tau", (), text)
        return
    dead = tuple(j for j, reach in zip(log.joints, np.ptp(log.tau, axis=0), strict=True) if reach == 0.0)
    if len(dead) == len(log.joints):
        yield Finding(
            "refusal", "tau", dead, "tau: never changes on any joint; leave the field out if not measured"
        )
    elif dead:
        yield Finding("warning", "tau", dead, f"tau: never changes: {some(dead)}")


CHECKS: tuple[Callable[[Log], Iterator[Finding]], ...] = (
    clocks,
    rates,
    repeats,
    still,
    plausible.copies,
    plausible.units,
    plausible.ranges,
    plausible.time_bases,
    clipped,
    gains,
    torque,
)
CHECKS_UNDER_CONTROL = (
    plausible.exchanged,
    plausible.answer_of_torque,
    excited.collinear,
)
"""These ask how the joints answer their commands."""


def _explainable(log: Log) -> tuple[Bools, list[Finding]]:
    """The rows that a PD model can explain, and what was left out of the others."""
    findings: list[Finding] = []
    for exclude in (_as_the_log_says, _before_commands, _without_gain, _unanswered):
        out, why = exclude(log)
        log = attrs.evolve(log, valid=log.valid & ~out)
        findings += why
    seconds = float(log.valid.any(axis=1).sum()) * log.period
    if seconds < LEAST_VALID:
        text = f"valid: {seconds:.2f} s under PD control are left, expected {LEAST_VALID} s or more"
        findings.append(Finding("refusal", "valid", (), text))
    return log.valid, findings


def _as_the_log_says(log: Log) -> tuple[Bools, list[Finding]]:
    masked: Bools = ~log.valid
    if not masked.any():
        return masked, []
    text = f"valid: false {_spans(masked.any(axis=1), log.t)}; left out, as the log says"
    return masked, [Finding("note", "valid", (), text)]


def _before_commands(log: Log) -> tuple[Bools, list[Finding]]:
    early: Bools = (log.t < log.t_cmd[0])[:, None]
    text = f"t_cmd: no command before {log.t_cmd[0]:.3f} s; left out"
    return early, [Finding("note", "t_cmd", (), text)] if early.any() else []


def _without_gain(log: Log) -> tuple[Bools, list[Finding]]:
    off = without_position_gain(log)
    everywhere: Any = off.all(axis=1)
    findings = []
    if everywhere.any():
        text = f"kp: 0 (damping, switched off or torque control) {_spans(everywhere, log.t)}; left out"
        findings.append(Finding("warning", "kp", (), text))
    alone = tuple(log.joints[j] for j in np.flatnonzero((off & ~everywhere[:, None]).any(axis=0)))
    if alone:
        text = f"kp: 0 at times on {some(alone)} alone; left out there"
        findings.append(Finding("warning", "kp", alone, text))
    return off, findings


def _unanswered(log: Log) -> tuple[Bools, list[Finding]]:
    lost = out_of_control(log)
    if not lost.any():
        return lost[:, None], []
    field, what = (
        ("q", "the joints no longer follow") if log.tau is None else ("tau", "the torque no longer answers")
    )
    text = (
        f"{field}: {what} the position error {_spans(lost, log.t)}: not under PD control "
        "(damping or switched off); left out"
    )
    return lost[:, None], [Finding("warning", field, (), text)]


def _spans(rows: Any, t: Array) -> str:
    spans = stretches(rows, t)
    return f"{in_words(spans, t)} ({sum(last - first for first, last in spans):.2f} s)"
