"""Health of robot and link: one sentence for the operator, and values for /diagnostics. No ROS.

`driver` publishes it. It judges the reports of `link` and the newest state of the board, in the
units of `LinkReport` and `BoardState`.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum

import numpy as np

from quadvel_description.arrays import Bools
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_nodes.number_text import counted

from .board_state import BoardState
from .link import SILENCE_LIMIT_S, LinkReport
from .remote import BUTTONS, OperatorCommand

HOT_MOTOR_C = 70  # deg C, warning limit; the limit of the board is not published
LOW_BATTERY = 15  # %, warning limit; a Go2 with less than `min_battery` is not taken over
BAD_DATAGRAMS = ("wrong_length", "wrong_crc", "unusable", "from_others")


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


Status = tuple[Level, str]


class Health:
    """Assesses one link from report to report."""

    def __init__(self, board: str, robot: Robot) -> None:
        """Create the assessment of a link.

        Args:
            board: Name of the board, for messages.
            robot: Names of the joints, codes of the board.
        """
        self._board, self._robot = board, robot
        self._before: dict[str, int] = {}

    def assess(self, report: LinkReport, newest: BoardState | None, stopped: bool) -> Status:
        """Return the most severe problem of robot and link.

        Args:
            report: The report of the link.
            newest: The newest state, None before the first one.
            stopped: Whether the operator stopped the robot by the remote.

        Returns:
            Level and sentence; OK if there is no problem.
        """
        problems = [
            *self._link_problems(report),
            *self._motor_problems(newest, report),
            *_battery_problems(newest),
            *_operator_problems(stopped),
        ]
        self._before = report.counts
        healthy = "commands are followed" if report.commanded else "no low_cmd: the joints are damped"
        return max(problems, key=lambda problem: problem[0], default=(Level.OK, healthy))

    def _link_problems(self, report: LinkReport) -> Iterator[Status]:
        new = {name: count - self._before.get(name, 0) for name, count in report.counts.items()}
        refusal = report.last_refusal if any(new[name] for name in BAD_DATAGRAMS) else ""
        if report.counter_rate is not None:
            rate = f"{report.counter_rate:.0f} a second"
            yield Level.ERROR, f"the counter of {self._board} runs at {rate}, expected some 1000 or 1000000"
        elif report.silence > SILENCE_LIMIT_S:
            since = "yet" if report.silence == float("inf") else f"for {report.silence:.1f} s"
            network = report.last_error if new["network_errors"] else ""
            frozen = "its tick stands still" if new["repeated"] > new["states"] else ""
            reason = refusal or frozen or network or self._robot.drive.no_state_hint
            yield Level.ERROR, f"no state from {self._board} {since}: {reason}"
        elif refusal:
            bad = sum(new[name] for name in BAD_DATAGRAMS)
            yield Level.WARN, f"{counted(bad, 'datagram')} dropped in the last second, the last: {refusal}"
        if report.takeover:
            yield Level.ERROR, report.takeover
        if new["command_timeouts"]:
            yield Level.WARN, "low_cmd stopped: the joints were damped"

    def _motor_problems(self, newest: BoardState | None, report: LinkReport) -> Iterator[Status]:
        if newest is None or report.silence > SILENCE_LIMIT_S:
            return
        mode = self._robot.drive.dropped_out_mode
        for i in np.flatnonzero(dropped_out(newest, self._robot)):
            error = f"mode {mode}, error {newest.motor_error[i]}"
            yield (
                Level.ERROR,
                f"{JOINT_NAMES[i]} has dropped out ({error}): stop the robot and let it cool down",
            )
        hottest = int(np.argmax(newest.temperature))
        if newest.temperature[hottest] >= HOT_MOTOR_C:
            yield Level.WARN, f"{JOINT_NAMES[hottest]} is at {newest.temperature[hottest]} deg C: let it rest"


def dropped_out(state: BoardState, robot: Robot) -> Bools:
    """Find the motors that the board has switched off.

    Args:
        state: State of the board.
        robot: Codes of the board.

    Returns:
        Whether each has, (n,); all false if the code is not known.
    """
    if robot.drive.dropped_out_mode is None:
        return np.zeros(len(JOINT_NAMES), bool)
    switched_off: Bools = state.motor_mode == robot.drive.dropped_out_mode
    return switched_off


def _battery_problems(newest: BoardState | None) -> Iterator[Status]:
    if newest is not None and newest.battery is not None and newest.battery.charge < LOW_BATTERY:
        yield Level.WARN, f"the battery is at {newest.battery.charge} %: lie down and charge it"


def _operator_problems(stopped: bool) -> Iterator[Status]:
    if stopped:
        release = " + ".join(str(button.name) for button in BUTTONS[OperatorCommand.RELEASE])
        yield Level.WARN, f"stopped by the remote; {release} release it"


def diagnostic_values(report: LinkReport, newest: BoardState | None, robot: Robot) -> dict[str, object]:
    """Return all values for /diagnostics.

    Args:
        report: The report of the link.
        newest: The newest state, None before the first one.
        robot: The robot that is driven.

    Returns:
        Values by name.
    """
    values: dict[str, object] = {
        "robot": robot.name,
        "state_rate_hz": f"{report.state_rate:.0f}",
        "send_rate_hz": f"{report.send_rate:.0f}",
        "silence_s": f"{report.silence:.3f}",
        "tick_unit": report.tick_unit or "unknown",
        **report.counts,
        "last_refusal": report.last_refusal,
        "last_error": report.last_error,
    }
    if newest is not None:
        for i, joint in enumerate(JOINT_NAMES):
            values[f"{joint} temperature"] = int(newest.temperature[i])
            values[f"{joint} mode"] = int(newest.motor_mode[i])
            values[f"{joint} error"] = int(newest.motor_error[i])
        values["imu temperature"] = newest.imu_temperature
        if newest.battery is not None:
            battery = newest.battery
            values["battery"] = f"{battery.charge} %, {battery.voltage:.1f} V, {battery.current:.1f} A"
    return values
