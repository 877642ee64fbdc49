"""Guards of the messages with states, and of the process that answers them. No ROS.

`guard.GuardSet` runs them; the supervisor acts on what they find.
"""

from __future__ import annotations

import math

import numpy as np
from typing_extensions import override

from quadvel_nodes.messages import QUATERNION_TOLERANCE, BackInTimeError, NotFiniteError, NotUnitError

from ..guard import Guard, GuardInput, Level


class DuplicatePublisher(Guard):
    """More than one simulator or driver reports states."""

    @override
    def check(self, data: GuardInput) -> str | None:
        return data.duplicate_publisher


class StateNotFinite(Guard):
    """A number of the state is not finite."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if isinstance(refusal := data.refused.get("low_state"), NotFiniteError):
            return f"low_state is refused: {refusal}"
        if data.is_sound:
            return None
        for name in ("q", "dq", "quaternion", "angular_velocity"):
            if not np.isfinite(getattr(data.state, name)).all():
                return f"the state's {name} is not finite"
        return None


class AttitudeNotUnit(Guard):
    """The norm of the orientation's quaternion is not 1, within 5 %."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if isinstance(refusal := data.refused.get("low_state"), NotUnitError):
            return f"low_state is refused: {refusal}"
        length = math.hypot(*data.state.quaternion.tolist())
        return (
            f"the state's quaternion has length {length:.2f}, expected 1"
            if abs(length - 1.0) > QUATERNION_TOLERANCE
            else None
        )


class StateBackInTime(Guard):
    """The time of the states went back."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if isinstance(refusal := data.refused.get("low_state"), BackInTimeError):
            return f"low_state is refused: {refusal}"
        return f"the state's time went back by {-1e3 * data.gap:.0f} ms" if data.gap < 0.0 else None


class ControllerStopped(Guard):
    """The controller did not run for longer than `max_state_age`, while the robot continued."""

    @override
    def check(self, data: GuardInput) -> str | None:
        limit = data.config.max_state_age
        if min(data.stopped, data.gap) <= limit:
            return None
        stopped = f"the controller did not run for {1e3 * data.stopped:.0f} ms while the robot continued"
        return f"{stopped}, limit {1e3 * limit:.0f} ms"


class StateStale(Guard):
    """The state is older than `max_state_age`, or no valid state came for so long.

    For a simulated robot that falls silent the limit is `max_standstill`, as its time then stands
    still.
    """

    @override
    def check(self, data: GuardInput) -> str | None:
        if refusal := data.refused.get("low_state"):
            return f"low_state is refused: {refusal}"
        limit = data.config.silence_limit
        if data.age > limit:
            return f"the state is {1e3 * data.age:.0f} ms old, limit {1e3 * limit:.0f} ms"
        if data.gap > limit:
            return f"no state came for {1e3 * data.gap:.0f} ms, limit {1e3 * limit:.0f} ms"
        return None


class StateFrozen(Guard):
    """States arrive, but the robot's tick has not changed for `frozen_tick_time`."""

    def __init__(self) -> None:
        self._time = 0.0

    @override
    def check(self, data: GuardInput) -> str | None:
        repeats = data.previous is not None and data.state.tick == data.previous.tick and data.gap > 0.0
        self._time = self._time + data.gap if repeats else 0.0
        if self._time < data.config.frozen_tick_time:
            return None
        return f"the robot's tick has stayed at {data.state.tick} for {1e3 * self._time:.0f} ms"


class Overruns(Guard):
    """More than `max_overruns` consecutive deadlines were missed (on a real robot; a simulated one waits)."""

    level = Level.STANCE

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.overruns <= data.config.max_overruns:
            return None
        return f"{data.overruns} consecutive deadlines were missed, limit {data.config.max_overruns:g}"
