"""Takeover of the joints from the robot's own controller, without a fight. No ROS.

What is sent, in this order:

- nothing, until the battery is charged, the motion switcher has released the robot's own controller,
  and no program has written `rt/lowcmd` or been connected to it for QUIET_S;
- commands, or damping without them; the switcher is asked again every ASK_PERIOD_S;
- damping for BRAKE_S, if another program writes `rt/lowcmd` or is connected to it, or if the robot's
  own controller is back;
- then nothing, until the driver is started again: two writers would fight over the joints.
"""

from __future__ import annotations

import math
from typing import Protocol

from typing_extensions import override

from quadvel_driver.board_state import BoardState
from quadvel_driver.takeover import Access, Takeover

from .motion_switcher import Answer, Api
from .wire import MOTOR_OFF

ASK_PERIOD_S = 0.5  # between two requests to the motion switcher
ANSWER_TIMEOUT_S = 3.0  # without an answer: a robot without motion switcher
RELEASE_TIMEOUT_S = 10.0  # without a release, after which the operator is informed
QUIET_S = 1.0  # without commands or writers of others, before the joints are taken
BRAKE_S = 0.5  # time of braking after the joints are lost
OBEY_TIMEOUT_S = 1.0  # of commands that motors do not follow


class Switcher(Protocol):
    """See `MotionSwitcher`."""

    def ask(self, api: Api) -> None:
        """Send a request."""

    def answers(self) -> list[Answer]:
        """Take the answers to own requests."""


class Commands(Protocol):
    """See `DdsTransport`."""

    def claim(self) -> None:
        """Create the writer of commands."""

    def foreign_commands(self) -> int:
        """Count the commands of other programs since the last call."""

    def foreign_writers(self) -> int:
        """Count other programs' writers of commands, also silent ones."""


class DdsTakeover(Takeover):
    """Takes the joints once, keeps watching, and lets go if anyone else commands them."""

    def __init__(self, commands: Commands, switcher: Switcher, min_battery: int) -> None:
        """Create a takeover that may not send anything yet.

        Args:
            commands: Topic of the commands.
            switcher: The robot's motion switcher.
            min_battery: Least state of charge, %.
        """
        super().__init__()
        self.access = Access.NONE
        self._commands, self._switcher = commands, switcher
        self._min_battery = min_battery
        self._mode: str | None = None  # the robot's own controller, "" for none, None while unknown
        self._codes: dict[int, int] = {}  # of the last answer to each request, 0 for success
        self._last_request = Api.CHECK_MODE
        self._asked_at = self._answered_at = -math.inf
        self._asking_since: float | None = None
        self._held_back_at = -math.inf  # when `problem` last spoke against a takeover
        self._obeyed_at = -math.inf
        self._lost_at: float | None = None

    @override
    def update(self, now: float, newest: BoardState | None) -> None:
        foreign = self._foreign_problem()
        self._hear_mode(now)
        if self.access is Access.FULL:
            self._keep(now, newest, foreign)
        elif self._lost_at is not None:
            if now - self._lost_at > BRAKE_S:
                self.access = Access.NONE
        else:
            self._take(now, newest, foreign)

    def _take(self, now: float, newest: BoardState | None, foreign: str) -> None:
        """Take the joints if nothing speaks against it."""
        reason = self._state_problem(newest)  # if there is one, the robot's own controller keeps the legs
        if not reason:
            self._ask_for_mode(now)
            reason = self._mode_problem(now) or foreign
        if reason:
            self.problem, self._held_back_at = reason, now
        elif now - self._held_back_at >= QUIET_S:
            self._commands.claim()
            self.problem, self._obeyed_at = "", now
            self.access = Access.FULL

    def _keep(self, now: float, newest: BoardState | None, foreign: str) -> None:
        """Let go if anyone else commands the joints; else say what the operator should know."""
        lost = foreign
        if self._mode:
            lost = f"the robot's own controller '{self._mode}' is back"
        if lost:
            self._lost_at, self.access = now, Access.BRAKE
            self.problem = f"{lost}: the joints were braked and let go; end it and start the driver again"
            return
        self._ask_for_mode(now)
        if newest is not None and (newest.motor_mode != MOTOR_OFF).any():
            self._obeyed_at = now
        self.problem = ""
        if now - self._obeyed_at > OBEY_TIMEOUT_S:
            self.problem = f"the motors stay off (mode {MOTOR_OFF}) though rt/lowcmd is sent: only the EDU model obeys it"
        elif now - self._answered_at > ANSWER_TIMEOUT_S:
            self.problem = (
                f"the motion switcher has not answered for {ANSWER_TIMEOUT_S:g} s: "
                "whether the robot's own controller is back is not known"
            )

    def _state_problem(self, newest: BoardState | None) -> str:
        if newest is None or newest.battery is None:
            return "no state of the robot"
        if newest.battery.charge < self._min_battery:
            return (
                f"the battery is at {newest.battery.charge} %, expected at least {self._min_battery} %: "
                "the joints are not taken over"
            )
        return ""

    def _foreign_problem(self) -> str:
        count, writers = self._commands.foreign_commands(), self._commands.foreign_writers()
        if count:
            return f"another program commands the joints ({count} samples on rt/lowcmd)"
        if writers:
            return f"another program may command the joints ({writers} silent writers of rt/lowcmd)"
        return ""

    def _hear_mode(self, now: float) -> None:
        """Take the answers of the motion switcher."""
        for answer in self._switcher.answers():
            self._codes[answer.api] = answer.code
            self._answered_at = now
            if answer.api == Api.CHECK_MODE:
                self._mode = answer.mode

    def _ask_for_mode(self, now: float) -> None:
        """Ask for the mode, and for the release of a controller that holds the legs."""
        if now - self._asked_at < ASK_PERIOD_S:
            return
        self._asked_at = now
        if self._asking_since is None:
            self._asking_since = now
        # One request at a time: the robot's reader may keep the last one only.
        release = bool(self._mode) and self._last_request is Api.CHECK_MODE
        self._last_request = Api.RELEASE_MODE if release else Api.CHECK_MODE
        self._switcher.ask(self._last_request)

    def _mode_problem(self, now: float) -> str:
        """Return why the robot's own controller is not known to have let go, or "" if it has."""
        assert self._asking_since is not None
        since = now - self._asking_since
        if self._codes.get(Api.CHECK_MODE):
            return self._refusal(Api.CHECK_MODE)
        if self._mode is None or now - self._answered_at > ANSWER_TIMEOUT_S:
            if since < ANSWER_TIMEOUT_S:
                return "asking the robot for its mode"
            return (
                f"the motion switcher has not answered for {ANSWER_TIMEOUT_S:g} s: "
                "firmware before 1.0.24 has none and cannot release the legs"
            )
        if self._mode and self._codes.get(Api.RELEASE_MODE):
            return self._refusal(Api.RELEASE_MODE)
        if self._mode:
            stubborn = f", and has not let go for {since:.0f} s" if since > RELEASE_TIMEOUT_S else ""
            return f"the robot's own controller '{self._mode}' holds the legs{stubborn}"
        return ""

    def _refusal(self, api: Api) -> str:
        return (
            f"the motion switcher answers request {api} with error {self._codes[api]}: "
            "this firmware does not release the legs"
        )
