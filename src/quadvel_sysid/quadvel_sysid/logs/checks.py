"""What a log says before anything is fitted to it: one table of checks, in the order in which causes come before symptoms.

Each check asks one thing and says what it found in a sentence. A refusal means that a report on this log would be wrong;
a warning that a part of it is not used or was mended, or is to be read with care. `python -m quadvel_sysid.logs.checks`
prints the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import attrs

from . import angles, channels, clocks, commands, response, separability, stamps, torque
from .findings import Finding
from .log import GAP, Log, LogError
from .pd_control import explainable, masked


@attrs.frozen
class Check:
    """`look` yields what it found, and the log anew where it mended it."""

    look: Callable[..., Iterator[Finding | Log]]
    measures: str
    limit: str
    then: str


@attrs.frozen(eq=False)
class Inspection:
    """What was found, and the log as it is to be used: mended, `valid` narrowed to the rows that a PD model can explain."""

    log: Log
    findings: tuple[Finding, ...]

    def raise_refusal(self) -> None:
        """Raises LogError with what was refused, if anything was."""
        refused = [finding.text for finding in self.findings if finding.kind == "refusal"]
        if refused:
            raise LogError(f"{self.log.name}: {'; and '.join(refused)}")


def inspect(log: Log, gains: tuple[float, float] | None = None) -> Inspection:
    """All that can be said about the log, check by check, as far as the first refusal.

    `gains` are the commanded kp and kd (N m/rad, N m s/rad) of a log that holds none.
    """
    log = log.with_gains(gains)
    findings = [Finding("note", text.partition(":")[0], (), text) for text in log.remarks]
    findings += [Finding("warning", text.partition(":")[0], (), text) for text in log.warnings]
    for check in OF_ROWS:
        log = _looked(check, findings, log)
    if _refused(findings):
        return Inspection(log, tuple(findings))
    answer = log.without_feed_forward()
    valid, why = explainable(answer)
    findings += why
    log = attrs.evolve(log, valid=valid)
    found = None if _refused(findings) else response.measured(log)
    for check in OF_RESPONSE if found else ():
        log = _looked(check, findings, log, found)
    if not _refused(findings):  # these say nothing of each other: all are heard
        findings += [one for check in OF_MOTION for one in check.look(log) if isinstance(one, Finding)]
    return Inspection(log, tuple(findings))


def _looked(check: Check, findings: list[Finding], log: Log, *given: Any) -> Log:
    """The log as the check leaves it, what it found added to `findings`; nothing where one has refused already."""
    if not _refused(findings):
        for one in check.look(log, *given):
            if isinstance(one, Log):
                log = one
            else:
                findings.append(one)
    return log


def _refused(findings: list[Finding]) -> bool:
    return any(finding.kind == "refusal" for finding in findings)


OF_ROWS = (
    Check(stamps.clocks, "spacing of the rows, s; its longest step; the spans of t and t_cmd",
          f"{stamps.FASTEST:g} to {stamps.SLOWEST:g} s; a day; {stamps.LONGEST_SPAN:g} times as long", "refusal"),
    Check(stamps.rates, "spacings, in times of the usual one", f"{GAP:g}", "note, warning of gaps"),
    Check(masked, "rows of `valid` that are false", "any", "note; left out"),
    Check(channels.still, "span of q, rad", f"{channels.REACHES:g}", "warning; on all joints a refusal"),
    Check(channels.held, "share of the rows in motion that repeat the whole state before, or its torque", f"{channels.MOSTLY:.0%}",
          "the rows in which it changed are used, with a warning"),
    Check(angles.wrapped, "steps of q from one row to the next, rad off a full turn", f"{angles.WRAPPED:g}",
          "unwrapped, with a warning"),
    Check(angles.speed, "dq that is not there, has one sign while the slope of q has both; correlation of the two; ticks of q",
          f"each sign in {torque.BOTH_WAYS:.0%} of the rows; {angles.UNLIKE:g}",
          "made from q, with a note or a warning; where the torque is explained better by dq as logged, that stays"),
    Check(torque.spikes, "how far rows of tau stand off the rows around and off what a PD law explains, standard deviations",
          f"{torque.FAR:g} in both", "left out, with a warning"),
    Check(torque.sign, "tau of one sign that reaches 0: the error that the size of what a PD law asks for leaves, over that of the "
          "law with an offset, where that leaves half of the torque or more", f"{torque.CLEARLY:g}", "refusal"),
    Check(angles.units, "slope of q over dq, and their correlation",
          f"a factor of {angles.OFF:g} at a correlation of {angles.ALIKE:g}", "refusal, with the unit that would explain it"),
    Check(commands.constant, "where q_des spans next to nothing of what q spans: share of the torque that a "
          "PD law about it leaves; share of the rest that the angle explains",
          f"{commands.HELD:g}; {commands.ANSWERED:g}", "left out, with a warning; on all joints, or without torque, a refusal"),
    Check(angles.degrees, "size of q_des over that of q; size of q, rad", f"25 to 130; {angles.TURNS:g}", "refusal"),
    Check(channels.copies, "joints whose q or tau is the same to the bit", "all rows", "warning"),
    Check(channels.ranges, "q beyond the range that the model's joint of that name has, rad", f"{channels.REACH:g}", "warning"),
    Check(channels.clipped, "share of the rows at one extreme, in runs of three or more", "0.2 %", "warning; of commands a note"),
    Check(channels.torque, "span of tau, N m", "0", "taken as not logged, with a warning"),
    Check(clocks.clock, "lag from command to torque (without torque, to the acceleration) that leaves least, s; what it leaves "
          f"over what those of a drive leave, and how sure that is, in standard errors over pieces of {clocks.PIECE:g} s",
          f"0 to {clocks.LATEST:g} s (without torque -{clocks.SLOW:g} to {clocks.SLOW:g} s); {response.BETTER:g}; "
          f"{clocks.STANDARD_ERRORS:g}",
          "refusal"),
    Check(channels.gains, "kp and kd: there, constant, not negative", "0", "note; refusal of negative ones"),
)  # fmt: skip
"""What is asked of all rows."""

OF_RESPONSE = (
    Check(response.columns, "share of the torque left by the best order of joints, over that left by the order as it is",
          f"{response.BETTER:g} on two joints or more whose commands differ (correlation below {response.SAME:g})", "refusal"),
    Check(response.signs, "partial correlation of torque and own command, beside the joint's angle, speed and direction",
          f"below {-response.SURE:g}", "refusal: which of q, q_des and tau has the opposite sign"),
    Check(response.deaf, "share of the torque, beside speed and friction, that the position error explains",
          f"{response.UNANSWERED:.0%}", "warning; on all joints a refusal"),
    Check(response.scale, "gain that the torque shows over the one commanded, of the position error and of the command alone",
          f"a factor of {response.FAR_OFF:g}",
          "refusal where a unit or one joint explains it; else the gains are in a servo's own unit and are fitted, with a warning"),
)  # fmt: skip
"""What is asked of logs with torque, in the rows under PD control."""

OF_MOTION = (
    Check(response.followed, f"without torque: correlation r of q with commands up to {response.REACH:g} s before; 1 - r^2 "
          "of the best order of joints over that of the order as it is",
          f"r below {-response.CLEAR:g} at every lag; {response.BETTER:g} on two joints", "refusal: the sign, or the order"),
    Check(channels.scaled, "tau, kp and kd that are there", "the torque or both gains", "refusal"),
    Check(separability.collinear, "share of what a parameter does to the torque that no mix of the others does",
          f"{separability.APART:g}", "note or warning, with the motion that would separate them"),
)  # fmt: skip
"""What is asked of the motion, in the rows under PD control; each is asked, whatever the others say."""


def table() -> str:
    """All checks in their order, as Markdown."""
    lines = ["| check | measured | limit | then |", "|---|---|---|---|"]
    for check in (*OF_ROWS, *OF_RESPONSE, *OF_MOTION):
        asks = str(check.look.__doc__).partition("\n")[0].rstrip(".")
        lines.append(f"| {asks} | {check.measures} | {check.limit} | {check.then} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
