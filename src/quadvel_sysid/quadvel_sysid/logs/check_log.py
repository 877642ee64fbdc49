"""Check measured logs, and correct what can be corrected, before anything is fitted to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Bools
from quadvel_description.name_list import format_names

from .checks import response
from .checks.pd_control import explainable_rows
from .checks.table import MOTION_CHECKS, RESPONSE_CHECKS, ROW_CHECKS, Check
from .findings import Finding
from .log import Log, LogError


@attrs.frozen(eq=False)
class CheckedLog:
    """A log that passed through the checks, and their findings.

    Attributes:
        log: The corrected log. Its `valid` is restricted to rows that a PD model can explain.
        findings: All findings, in the order of the checks.
    """

    log: Log
    findings: tuple[Finding, ...]

    def raise_refusal(self) -> None:
        """Raise an error if the log was refused.

        Raises:
            LogError: At least one finding is a refusal; the message joins their sentences.
        """
        refused = [finding.text for finding in self.findings if finding.kind == "refusal"]
        if refused:
            raise LogError(f"{self.log.name}: {'; and '.join(refused)}")


def check_log(log: Log, gains: tuple[float, float] | None = None) -> CheckedLog:
    """Run all checks on a log, in their order, up to the first refusal.

    The checks of the rows come first, then the search for rows outside PD control, then the
    checks of the response to commands, then those of the motion.

    Args:
        log: The log to check.
        gains: Commanded kp (N m/rad) and kd (N m s/rad), used if the log holds none.

    Returns:
        The corrected log and the findings.
    """
    held = [name for name in ("kp", "kd") if getattr(log, name) is not None]
    unused = log.holds_other_gains(gains)
    log = log.with_gains(gains)
    findings = [Finding("note", text.partition(":")[0], (), text) for text in log.remarks]
    if unused:
        instead = "them, so --gains is not used" if len(held) == 2 else "it, so --gains is not used for it"
        findings.append(Finding("warning", "kp", (), f"{', '.join(held)}: the log holds {instead}"))
    findings += [Finding("warning", text.partition(":")[0], (), text) for text in log.warnings]
    for check in ROW_CHECKS:
        log = _run_check(check, findings, log)
    if _has_refusal(findings):
        return CheckedLog(log, tuple(findings))
    answer = log.without_feed_forward()
    valid, why = explainable_rows(answer)
    findings += why
    log = attrs.evolve(log, valid=valid)
    findings += _joints_without_rows(log)
    found = None if _has_refusal(findings) else response.measure_response(log)
    for check in RESPONSE_CHECKS if found else ():
        log = _run_check(check, findings, log, found)
    if not _has_refusal(findings):  # independent of each other: all of them run
        findings += [one for check in MOTION_CHECKS for one in check.run(log) if isinstance(one, Finding)]
    return CheckedLog(log, tuple(findings))


def check_logs(
    train: Sequence[Log],
    heldout: Sequence[Log] = (),
    gains: tuple[float, float] | None = None,
    on_checked: Callable[[CheckedLog], None] = lambda checked: None,
) -> tuple[list[CheckedLog], list[CheckedLog]]:
    """Check the logs of one identification, and reduce them to the joints that they can identify.

    These are the joints of the first log that have valid rows in the logs to fit, and in those to
    report on.

    Args:
        train: Logs to fit, at least one.
        heldout: Logs to report on.
        gains: Commanded kp (N m/rad) and kd (N m s/rad) of logs that hold none.
        on_checked: Called with each checked log, before the log may be refused.

    Returns:
        The checked logs to fit, and those to report on.

    Raises:
        LogError: A log is refused, its joints or fields differ from the first one's, or no joint is
            left.
    """

    def passed(log: Log) -> CheckedLog:
        checked = check_log(_with_joints_of_first(log, train), gains)
        on_checked(checked)
        checked.raise_refusal()
        return checked

    parts = [passed(log) for log in train], [passed(log) for log in heldout]
    used = np.ones(len(train[0].joints), bool)
    for part in parts:
        if part:
            used &= np.any([one.log.valid.any(axis=0) for one in part], axis=0)
    if not used.any():
        raise LogError(
            f"{train[0].name}: valid: no joint has rows both in the logs to fit and in those to report on, "
            "expected one or more"
        )
    train_parts, heldout_parts = ([_select_joints(one, used) for one in part] for part in parts)
    return train_parts, heldout_parts


def _select_joints(checked: CheckedLog, used: Bools) -> CheckedLog:
    """The checked log with the marked joints (J,) alone."""
    return attrs.evolve(checked, log=checked.log.select_joints(checked.log.joints_where(used)))


def _joints_without_rows(log: Log) -> list[Finding]:
    """A note on the joints without a valid row, if other joints have some; the cause is another finding."""
    lost: Bools = np.asarray(~log.valid.any(axis=0))
    if lost.all() or not lost.any():
        return []
    joints = log.joints_where(lost)
    text = (
        f"valid: no row of {format_names(joints)} is left in this log; joints without rows are left out "
        "of the model"
    )
    return [Finding("note", "valid", joints, text)]


def _with_joints_of_first(log: Log, logs: Sequence[Log]) -> Log:
    """The log with the joints of the first; raises LogError unless robots and kinds of torque agree."""
    first = logs[0]
    if log.robot is not first.robot and log.robot and first.robot:
        expected = f"expected {first.robot.name!r} as of {first.name}"
        raise LogError(f"{log.name}: robot is {log.robot.name!r}, {expected}")
    if (log.tau is None) != (first.tau is None):
        lacking, other = (log, first) if log.tau is None else (first, log)
        raise LogError(f"{lacking.name}: tau: the field is missing, expected it as in {other.name}")
    if len(log.joints) > len(first.joints):
        extra = next(name for name in log.joints if name not in first.joints)
        raise LogError(f"{log.name}: joint_names: '{extra}' is not in {first.name}, expected the same joints")
    return log.select_joints(first.joints)


def _run_check(check: Check, findings: list[Finding], log: Log, *given: Any) -> Log:
    """Run one check, unless the log was refused before; append its findings and return the log."""
    if not _has_refusal(findings):
        for one in check.run(log, *given):
            if isinstance(one, Log):
                log = one
            else:
                findings.append(one)
    return log


def _has_refusal(findings: list[Finding]) -> bool:
    """Whether one of the findings is a refusal."""
    return any(finding.kind == "refusal" for finding in findings)
