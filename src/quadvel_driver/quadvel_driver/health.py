"""How robot and link do, in one sentence that a person can act on, and in figures. No ROS."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum

import numpy as np

from quadvel_description.robot import JOINT_NAMES

from .link import SILENCE, LinkReport
from .remote import BUTTONS, Order
from .wire import BoardState

HOT = 70  # deg C, of a motor; the board's own limit is not published
DROPPED_OUT = 8  # motor mode of one that the board has switched off
BAD_DATAGRAMS = ("wrong_length", "wrong_crc", "unusable", "from_others")


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


Problem = tuple[Level, str]


class Health:
    """Judges one link from report to report. board: its address and port, for people."""

    def __init__(self, board: str) -> None:
        self._board = board
        self._before: dict[str, int] = {}

    def judge(self, report: LinkReport, newest: BoardState | None, stopped: bool) -> Problem:
        """The worst there is to say. newest: the last state, if there was one. stopped: by the operator."""
        problems = [*self._of_link(report), *_of_motors(newest, report), *_of_operator(stopped)]
        self._before = report.counts
        said = "commands are followed" if report.commanded else "no low_cmd: the joints are damped"
        return max(problems, key=lambda problem: problem[0], default=(Level.OK, said))

    def _of_link(self, report: LinkReport) -> Iterator[Problem]:
        new = {name: count - self._before.get(name, 0) for name, count in report.counts.items()}
        why = report.last_refusal if any(new[name] for name in BAD_DATAGRAMS) else ""
        if report.counter_rate is not None:
            rate = f"{report.counter_rate:.0f} a second"
            yield Level.ERROR, f"the counter of {self._board} runs at {rate}, expected some 1000 or 1000000"
        elif report.silence > SILENCE:
            since = "yet" if report.silence == float("inf") else f"for {report.silence:.1f} s"
            network = report.last_error if new["network_errors"] else ""
            frozen = "its tick stands still" if new["repeated"] > new["states"] else ""
            reason = (
                why
                or frozen
                or network
                or "is the robot on and in low-level mode, and is this the right network?"
            )
            yield Level.ERROR, f"no state from {self._board} {since}: {reason}"
        elif why:
            bad = sum(new[name] for name in BAD_DATAGRAMS)
            yield Level.WARN, f"{bad} datagrams dropped in the last second, the last: {why}"
        if new["command_timeouts"]:
            yield Level.WARN, "low_cmd stopped: the joints were damped"


def _of_motors(newest: BoardState | None, report: LinkReport) -> Iterator[Problem]:
    if newest is None or report.silence > SILENCE:
        return
    for i in np.flatnonzero(newest.motor_mode == DROPPED_OUT):
        error = f"mode {DROPPED_OUT}, error {newest.motor_error[i]}"
        yield Level.ERROR, f"{JOINT_NAMES[i]} has dropped out ({error}): stop the robot and let it cool down"
    hottest = int(np.argmax(newest.temperature))
    if newest.temperature[hottest] >= HOT:
        yield Level.WARN, f"{JOINT_NAMES[hottest]} is at {newest.temperature[hottest]} deg C: let it rest"


def _of_operator(stopped: bool) -> Iterator[Problem]:
    if stopped:
        release = " + ".join(str(button.name) for button in BUTTONS[Order.RELEASE])
        yield Level.WARN, f"stopped by the remote; {release} release it"


def figures(report: LinkReport, newest: BoardState | None) -> dict[str, object]:
    """All there is to know, by name, for /diagnostics."""
    values: dict[str, object] = {
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
    return values
