"""Transitions between the modes: a table of preconditions, and its state diagram. Knows no ROS.

`python -m quadvel_policy.transitions` prints the diagram of docs/architecture.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.quadruped import JOINT_NAMES

from .config import SupervisorConfig
from .guard import MOVING_MODES, Finding, Level
from .guards.states import DuplicatePublisher
from .modes import ModeInput, Posture
from .stop_latch import StopLatch
from .tick_input import TickInput

MODES = ("passive", "stand_up", "stance", "walk", "lie_down", "fault")
"""Names of the modes, in the order of the constants of quadvel_msgs/ControllerState."""
DAMPED_MODES = ("passive", "fault")
VELOCITY_MODES = ("stance", "walk")
"""Modes in which the robot follows a velocity command."""
MAX_BRAKE_TIME_FACTOR = 1.8  # of `brake_time`, after which a moving robot goes to stance anyway


@attrs.define
class Situation:
    """What transitions depend on; the supervisor keeps it up to date.

    Attributes:
        config: Limits.
        stance: The posture of stance.
        auto_stand: Whether the robot still has to stand up by itself.
        has_policy: Whether there is a policy to walk with.
        mode: Present mode, one of MODES.
        reason: Why the robot is in this mode, one sentence.
        latch: The latched stop.
        walking_enabled: Whether the operator has allowed walking.
        neutral_seen: Whether a zero command has arrived since the robot was ready to walk.
        findings: Faults of the last tick, also those without effect in the present mode.
        velocity: Last known velocity of the trunk, body frame, (3,), m/s.
        path_ended: Whether the present mode is a posture at the end of its path.
        inputs: Inputs of the last tick.
        last: Input of the mode at the last tick; None before the robot has reported.
    """

    config: SupervisorConfig
    stance: Posture
    auto_stand: bool
    has_policy: bool = True
    mode: str = "passive"
    reason: str = "waiting for a mode request"
    latch: StopLatch = attrs.Factory(StopLatch)
    walking_enabled: bool = False
    neutral_seen: bool = False
    findings: list[Finding] = attrs.Factory(list)
    velocity: Array = attrs.Factory(lambda: np.zeros(3))
    path_ended: bool = False
    inputs: TickInput = attrs.Factory(TickInput)
    last: ModeInput | None = None

    @property
    def mode_input(self) -> ModeInput:
        """Input of the mode at the last tick, of which there was one."""
        assert self.last is not None
        return self.last

    @property
    def is_walking_allowed(self) -> bool:
        """Whether there is a policy, and the operator allows walking, or need not."""
        return self.has_policy and (self.walking_enabled or not self.config.require_operator)

    @property
    def speed(self) -> float:
        """Last known speed of the trunk, m/s."""
        return math.hypot(*self.velocity.tolist())

    @property
    def posture_error(self) -> str:
        """One sentence if a joint is far from the nominal posture, else ""."""
        error = self.mode_input.state.q - self.stance.final_posture(self.mode_input.state)
        i, limit = int(np.argmax(np.abs(error))), self.config.max_posture_error
        if abs(error[i]) <= limit:
            return ""
        return f"{JOINT_NAMES[i]} is {error[i]:+.2f} rad off the nominal posture, limit {limit:.2f}"


Precondition = Callable[[Situation], str]
"""Returns why a transition is refused, one sentence; "" if it is not. Its docstring labels the diagram."""


def _require_pending_auto_stand(now: Situation) -> str:
    """`auto_stand`, once."""
    return "" if now.auto_stand else "the robot has stood up by itself, or must not"


def _require_ended_path(now: Situation) -> str:
    """The posture is reached."""
    return "" if now.path_ended else "the robot is on its way to the posture"


def _require_nominal_posture(now: Situation) -> str:
    """The joints are near the nominal posture."""
    error = now.posture_error
    return f"{error}, request stand_up" if error else ""


def _require_other_posture(now: Situation) -> str:
    """A joint is off the nominal posture."""
    return "" if now.posture_error else "the joints are near the nominal posture"


def _require_commanded_velocity(now: Situation) -> str:
    """A velocity is commanded."""
    command = now.mode_input.command  # vx, vy, yaw rate, and 1 to stand
    return "" if not command[3] and command[:3].any() else "no velocity is commanded"


def _require_known_velocity(now: Situation) -> str:
    """The velocity is known."""
    return "there is no fresh velocity estimate" if now.mode_input.velocity is None else ""


def _require_no_stop(now: Situation) -> str:
    """No stop is latched."""
    if now.latch.cause is None:
        return ""
    return f"the robot was stopped ({now.latch.sentence}): request stance when that is mended"


def _require_stop(now: Situation) -> str:
    """A stop is latched."""
    return "" if now.latch.cause else "no fault stopped the robot"


def _require_policy(now: Situation) -> str:
    """There is a policy."""
    return "" if now.has_policy else "there is no policy to walk with"


def _require_permission_to_walk(now: Situation) -> str:
    """Walking is allowed."""
    return (
        ""
        if now.is_walking_allowed
        else "walking is not allowed yet: quadvel enable (service ~/enable_walking) allows it"
    )


def _require_zero_command_seen(now: Situation) -> str:
    """A zero velocity was commanded."""
    return "" if now.neutral_seen else "a zero velocity has to be commanded first"


def _require_commanded_stand(now: Situation) -> str:
    """The robot stands, as commanded."""
    if now.mode_input.command[3] and now.speed <= now.config.max_standing_speed:
        return ""
    return f"the robot walks ({now.speed:.2f} m/s), command stance first"


def _require_braked(now: Situation) -> str:
    """It has braked for `brake_time`, longer if it still moves."""
    braking, limit = now.mode_input.state.time - now.latch.since, now.config.brake_time
    if braking >= limit and (
        now.speed <= now.config.max_standing_speed or braking >= MAX_BRAKE_TIME_FACTOR * limit
    ):
        return ""
    return "the policy brakes the robot"


@attrs.frozen
class Automatic:
    """A transition without a request.

    Attributes:
        preconditions: All must hold.
        reason: Makes the sentence for the operator.
        fault: Name of the fault; "" if the transition is none.
    """

    preconditions: tuple[Precondition, ...]
    reason: Callable[[Situation], str]
    fault: str = ""


REQUESTED: dict[tuple[str, str], tuple[Precondition, ...]] = {
    ("passive", "stand_up"): (),
    ("lie_down", "stand_up"): (),
    ("passive", "stance"): (_require_nominal_posture,),
    ("walk", "stance"): (_require_commanded_stand,),
    ("stance", "walk"): (
        _require_policy,
        _require_no_stop,
        _require_permission_to_walk,
        _require_known_velocity,
    ),
    ("stand_up", "lie_down"): (),
    ("stance", "lie_down"): (),
    ("walk", "lie_down"): (_require_commanded_stand,),
}
"""Preconditions of each transition that may be requested; passive may be requested from every mode."""

AUTOMATIC: dict[tuple[str, str], Automatic] = {
    ("passive", "stand_up"): Automatic(
        (_require_pending_auto_stand,), lambda now: "stands up by itself at the start"
    ),
    ("stand_up", "stance"): Automatic(
        (_require_ended_path, _require_nominal_posture), lambda now: now.latch.sentence or "stood up"
    ),
    ("stand_up", "fault"): Automatic(
        (_require_ended_path, _require_other_posture),
        lambda now: f"standing up failed: {now.posture_error}",
        fault="stand_up_failed",
    ),
    # The supervisor replaces a velocity by "stand" until a zero command was seen with walking allowed
    # and no stop latched.
    ("stance", "walk"): Automatic(
        (_require_policy, _require_commanded_velocity, _require_known_velocity, _require_ended_path),
        lambda now: "a velocity was commanded",
    ),
    ("walk", "stance"): Automatic((_require_stop, _require_braked), lambda now: now.latch.sentence),
    ("lie_down", "passive"): Automatic((_require_ended_path,), lambda now: "lies"),
}
"""Transitions by themselves. No transition leads to a mode that a present fault would end at once."""

_AUTOMATIC_FROM = {
    mode: [(target, entry) for (source, target), entry in AUTOMATIC.items() if source == mode]
    for mode in MODES
}


def due_transition(now: Situation) -> tuple[str, Automatic] | None:
    """Find the automatic transition whose preconditions hold.

    Args:
        now: The situation.

    Returns:
        Next mode and entry of AUTOMATIC, or None.
    """
    for target, entry in _AUTOMATIC_FROM[now.mode]:
        if not (_first_refusal(entry.preconditions, now) or _blocking_fault(target, now)):
            return target, entry
    return None


def request_refusal(target: str, now: Situation) -> str:
    """Return why a requested transition is refused.

    Args:
        target: Requested mode.
        now: The situation.

    Returns:
        One sentence; "" if the request is accepted.
    """
    if target not in MODES or target == "fault":
        return f"mode is '{target}', expected one of {', '.join(MODES[:-1])}"
    if target == "passive":
        return ""
    if target == now.mode:
        still_there = target == "stance" and now.latch.persists(now.findings)
        return f"what stopped the robot is still there: {now.latch.sentence}" if still_there else ""
    if now.mode == "fault":
        return f"the robot is in fault ({now.reason}), request passive first"
    if now.last is None:
        return "the robot has not reported yet"
    if (now.mode, target) not in REQUESTED:
        allowed = " or ".join(source for source, to in REQUESTED if to == target)
        return f"{target} can't follow {now.mode}, expected {allowed}"
    return _blocking_fault(target, now) or _first_refusal(REQUESTED[now.mode, target], now)


def walk_refusal(now: Situation) -> str:
    """Return why the robot does not follow a velocity.

    Args:
        now: The situation.

    Returns:
        One sentence; "" if it follows one.
    """
    if now.mode == "fault":
        return "the robot is in fault: request passive, then stand_up"
    if now.mode not in VELOCITY_MODES:
        return f"the robot is in mode {now.mode} ({now.reason}), expected {' or '.join(VELOCITY_MODES)}"
    return _first_refusal(
        (_require_policy, _require_no_stop, _require_permission_to_walk, _require_zero_command_seen), now
    )


def _first_refusal(preconditions: Iterable[Precondition], now: Situation) -> str:
    for precondition in preconditions:
        if refusal := precondition(now):
            return refusal
    return ""


def _blocking_fault(target: str, now: Situation) -> str:
    """Return a fault that would end a mode at once, one sentence, or "".

    This is a second publisher that exists now, or another finding of the last tick.
    """
    if target in DAMPED_MODES:
        return ""
    if now.inputs.duplicate_publisher:
        return now.inputs.duplicate_publisher
    for finding in now.findings:
        if (
            finding.level is Level.DAMPING
            and target in finding.modes
            and finding.name != DuplicatePublisher.name()
        ):
            return finding.sentence
    return ""


def state_diagram() -> str:
    """Return the state diagram of the table.

    Returns:
        A Mermaid stateDiagram; in brackets, the preconditions.
    """
    rows = [
        ("moving", "passive", "request"),
        ("moving", "fault", "[a fault of level damping]"),
        ("fault", "passive", "request"),
        *(
            (*modes, f"request {_label(preconditions)}".rstrip())
            for modes, preconditions in REQUESTED.items()
        ),
        *((*modes, _label(entry.preconditions)) for modes, entry in AUTOMATIC.items()),
    ]
    return "\n".join(
        [
            "stateDiagram-v2",
            "    [*] --> passive",
            "    state moving {",
            *(f"        {mode}" for mode in MOVING_MODES),
            "    }",
            *(f"    {source} --> {target}: {label}" for source, target, label in rows),
        ]
    )


def _label(preconditions: Iterable[Precondition]) -> str:
    """Return the docstrings of preconditions as the guard of a transition in UML, or ""."""
    texts = [(precondition.__doc__ or "").rstrip(".") for precondition in preconditions]
    label = ", ".join(text[0].lower() + text[1:] for text in texts)
    return f"[{label}]" if label else ""


if __name__ == "__main__":
    print(state_diagram())
