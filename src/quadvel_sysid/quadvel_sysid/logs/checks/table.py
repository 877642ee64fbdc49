"""The table of checks that a log passes before anything is fitted to it.

Each check looks for one defect and describes it in a sentence. A refusal means that a report on
this log would be wrong. A warning means that a part of the log is left out, was corrected or is
unreliable. The order matters: a cause is checked before its symptoms. `python -m
quadvel_sysid.logs.checks` prints the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import attrs

from ..findings import Finding
from ..log import GAP_FACTOR, Log
from . import angles, channels, clocks, commands, response, separability, stamps, torque
from .pd_control import masked_rows


@attrs.frozen
class Check:
    """One row of the table of checks.

    Attributes:
        run: The check. It yields findings, and the corrected log if it can correct the defect.
            The first line of its docstring is the first column of the table.
        measured: The quantity that is compared with the limit.
        limit: The limit, with its unit.
        consequence: What happens beyond the limit.
    """

    run: Callable[..., Iterator[Finding | Log]]
    measured: str
    limit: str
    consequence: str


ROW_CHECKS = (
    Check(
        stamps.bursts,
        f"share of the steps below {stamps.BURST_STEP:.0%} of the mean step",
        f"{stamps.MIN_BURST_SHARE:.0%}",
        "the rows of a burst are spread over the time since the last one, with a warning",
    ),
    Check(
        stamps.time_bases,
        "spacing of the rows, s; its longest step; the spans of t and t_cmd",
        f"{stamps.MIN_PERIOD_S:g} to {stamps.MAX_PERIOD_S:g} s; a day; {stamps.MAX_SPAN_RATIO:g} times as long",
        "refusal",
    ),
    Check(
        stamps.sampling_rates,
        "spacings, in times of the usual one",
        f"{GAP_FACTOR:g}",
        "note, warning of gaps",
    ),
    Check(masked_rows, "rows of `valid` that are false", "any", "note; left out"),
    Check(
        channels.motionless,
        "span of q, rad; or its standard deviation, rad, and the ratio of this to the noise that its second "
        "differences suggest",
        f"{channels.MOVING_SPAN_RAD:g}; {channels.RESTING_RAD:g}, {channels.RESTING_RATIO:g}",
        "warning; on all joints a refusal",
    ),
    Check(
        channels.repeated_rows,
        "share of the rows in motion that repeat the whole state before, or its torque",
        f"{channels.REPEATED_ROWS_SHARE:.0%}",
        "the rows in which it changed are used, with a warning",
    ),
    Check(
        angles.wrapped_angles,
        "steps of q from one row to the next, rad off a full turn",
        f"{angles.WRAP_TOLERANCE_RAD:g}",
        "unwrapped, with a warning",
    ),
    Check(
        angles.exchanged_angles,
        "correlation of dq with the slope of q_des; ratio A / B of the variances of dq that the slopes of "
        "q_des (A) and of q (B) leave; on most joints that move",
        f"{angles.EXCHANGED_CORRELATION:g}; {angles.EXCHANGED_ERROR_RATIO:g}",
        "refusal",
    ),
    Check(
        angles.unusable_speed,
        "dq that is missing, or has one sign while the slope of q has both; correlation of the two; "
        "steps of the encoder of q",
        f"each sign in {torque.MIN_SIGN_SHARE:.0%} of the rows; {angles.UNRELATED_CORRELATION:g}",
        "computed from q, with a note or a warning; if dq as logged explains the torque better, it stays",
    ),
    Check(
        torque.spikes,
        "deviation of a row of tau from the rows around it and from a fitted PD law, standard deviations",
        f"{torque.SPIKE_SIGMAS:g} in both",
        "left out, with a warning",
    ),
    Check(
        torque.unsigned_torque,
        "tau of one sign that reaches 0: error of the magnitude of a PD law over that of a PD law with an "
        "offset, if the latter leaves half of the torque or more",
        f"{torque.MAGNITUDE_ERROR_RATIO:g}",
        "refusal",
    ),
    Check(
        angles.speed_units,
        "slope of q over dq, and their correlation",
        f"a factor of {angles.UNIT_FACTOR:g} at a correlation of {angles.UNIT_CORRELATION:g}",
        "refusal, with the unit that would explain it",
    ),
    Check(
        commands.constant_command,
        "if q_des spans almost nothing of what q spans: share of the torque that a PD law about q_des "
        "leaves; share of the remaining torque that q explains",
        f"{commands.MAX_HOLDING_ERROR:g}; {commands.MIN_ANSWERED_SHARE:g}",
        "left out, with a warning; on all joints, or without torque, a refusal",
    ),
    Check(
        angles.angle_units,
        "size of q_des over that of q; difference of the two, one taken as degrees, over their size; "
        "size of q, rad; of joints with other names also q_des - q, rms, rad",
        f"25 to 130; {angles.SAME_ANGLE_SHARE:g}; {angles.MAX_ANGLE_RAD:g}; {angles.MAX_MISSED_RAD:g}",
        "refusal",
    ),
    Check(
        channels.duplicated_channels,
        "joints whose q or tau is the same to the bit",
        "all rows",
        "warning",
    ),
    Check(
        channels.joint_ranges,
        "q beyond the range that the model's joint of that name has, rad",
        f"{channels.RANGE_MARGIN_RAD:g}",
        "warning",
    ),
    Check(
        channels.clipped_channels,
        "share of the rows at one extreme, in runs of three or more",
        "0.2 %",
        "warning; of commands a note",
    ),
    Check(channels.torque_presence, "span of tau, N m", "0", "treated as not logged, with a warning"),
    Check(
        clocks.clock_offset,
        "lag from command to torque (without torque, to the acceleration) with the smallest error, s; this "
        "error over that of the best lag a drive can have; certainty, in standard errors over pieces of "
        f"{clocks.PIECE_S:g} s",
        f"0 to {response.MAX_DRIVE_DELAY_S:g} s (without torque -{clocks.MAX_MOTION_LAG_S:g} to "
        f"{clocks.MAX_MOTION_LAG_S:g} s); {response.PREFERRED_ERROR_RATIO:g}; "
        f"{clocks.MIN_STANDARD_ERRORS:g}",
        "refusal",
    ),
    Check(
        channels.commanded_gains,
        "kp and kd: there, constant, not negative",
        "0",
        "note; refusal of negative ones",
    ),
)
"""Checks of all rows."""

RESPONSE_CHECKS = (
    Check(
        response.joint_order,
        "share of the torque left by the best order of joints, over that left by the order as it is",
        f"{response.PREFERRED_ERROR_RATIO:g} on two joints or more whose commands differ "
        f"(correlation below {response.SAME_COMMAND_CORRELATION:g})",
        "refusal",
    ),
    Check(
        response.opposite_signs,
        "partial correlation of torque and own command, given the joint's angle, speed and direction",
        f"below {-response.MIN_SIGN_CORRELATION:g}",
        "refusal: which of q, q_des and tau has the opposite sign",
    ),
    Check(
        response.unresponsive,
        "share of the torque left by speed and friction that the position error explains, at the best lag "
        "that a drive can have",
        f"{response.MIN_ANSWERED_SHARE:.0%}",
        "warning; on all joints a refusal",
    ),
    Check(
        response.gain_units,
        "gain that the torque shows over the one commanded, of the position error and of the command alone",
        f"a factor of {response.UNIT_GAIN_FACTOR:g}",
        "refusal if a unit or one joint explains it; else the gains are in a servo's own unit and are "
        "fitted, with a warning",
    ),
)
"""Checks of logs with torque, in the rows under PD control."""

MOTION_CHECKS = (
    Check(
        response.command_tracking,
        f"without torque: correlation r of q with commands up to {response.MAX_LAG_S:g} s before; 1 - r^2 "
        "of the best order of joints over that of the order as it is",
        f"r below {-response.EXPLAINED_ERROR_SHARE:g} at every lag; "
        f"{response.PREFERRED_ERROR_RATIO:g} on two joints",
        "refusal: the sign, or the order",
    ),
    Check(
        channels.torque_or_gains,
        "tau, kp and kd that are there",
        "the torque or both gains",
        "refusal",
    ),
    Check(
        separability.collinear,
        "share of what a parameter does to the torque that no mix of the others does",
        f"{separability.MIN_SEPARATION:g}",
        "note or warning, with the motion that would separate them",
    ),
)
"""Checks of the motion, in the rows under PD control; all run, even after a finding."""


def markdown_table() -> str:
    """Format all checks as a Markdown table, in their order.

    Returns:
        The table, as it stands in docs/identification.md.
    """
    lines = ["| check | measured | limit | then |", "|---|---|---|---|"]
    for check in (*ROW_CHECKS, *RESPONSE_CHECKS, *MOTION_CHECKS):
        summary = str(check.run.__doc__).partition("\n")[0].rstrip(".")
        lines.append(f"| {summary} | {check.measured} | {check.limit} | {check.consequence} |")
    return "\n".join(lines)
