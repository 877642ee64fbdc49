"""What the page is told of a picture, an operator and a recording: numbers and words as JSON has them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from quadvel_description import robot

from .operator import BRAKING, PERIOD, Operator
from .picture import FRESH, RobotPicture

SOURCES = {"/controller/state": "controller", "/command": "command mux", "/joint_states": "robot"}
"""Topics that come all the time, and who publishes them"""
OWN_SOURCE = "teleop"
"""the command mux's name for what the page commands"""
IN_EFFECT = 0.5
"""s after which a velocity that is held should be followed"""


def panel(picture: RobotPicture, operator: Operator, now: float) -> dict[str, Any]:
    """The readings of the page; None stands for a number that is not there. now: s, on the clock of the picture."""
    alive = picture.is_fresh("/controller/state", now) and picture.state is not None
    return {
        "mode": picture.state.mode_name if alive else "",
        **_why(picture, operator, alive),
        "notices": list(_notices(picture, operator, now)),
        "stopped": operator.stopped,
        "source": picture.source if picture.is_fresh("/command", now) else "",
        "commanded": _rounded(picture.commanded, alive),
        "measured": _rounded(picture.measured, picture.is_fresh("/odom", now)),
        "torque": _rounded(picture.torque / robot.TORQUE_LIMIT, picture.shows_joints(now)),
        "loop": _loop(picture.state) if alive else {},
        "lamps": _lamps(picture, alive),
        "simulated": any(name in picture.nodes for name in ("sim_node", "board")),
    }


def _why(picture: RobotPicture, operator: Operator, alive: bool) -> dict[str, str]:
    """Why the robot is in its mode, and why it follows no velocity."""
    if not alive:
        return {"reason": "no controller is heard", "refusal": ""}
    if operator.stopped:
        braking = picture.state.mode_name in BRAKING
        return {
            "reason": "STOP was pressed" if braking else "STOP was pressed; the robot does not brake yet",
            "refusal": "release it, then stand up",
        }
    return {"reason": picture.state.reason, "refusal": picture.state.walk_refusal}


def _notices(picture: RobotPicture, operator: Operator, now: float) -> Iterator[str]:
    """What keeps the operator's commands from the robot, or the robot from the page, a sentence each."""
    for topic, name in SOURCES.items():
        if (silence := picture.silence(topic, now)) > FRESH:
            yield f"no message from the {name} for {silence:.0f} s"
    if late := operator.lateness(now):
        yield f"commands arrive {late:.1f} s apart, expected {PERIOD:g} s: the robot may stop between them"
    if operator.held_for(now) > IN_EFFECT and picture.source != OWN_SOURCE:
        yield f"the command mux does not follow this page; its source is '{picture.source}'"


def _loop(state: Any) -> dict[str, float | None]:
    return {
        "rate": _number(state.rate_hz, 1),
        "period": _number(state.period_p99_ms, 2),
        "compute": _number(state.compute_p99_us, 0),
        "missed": int(state.overruns),
    }


def _lamps(picture: RobotPicture, alive: bool) -> list[dict[str, str]]:
    """Faults first, then what was found, then how the nodes are."""
    lamps = []
    if alive and picture.state.fault:
        lamps.append({"name": picture.state.fault, "level": "error", "text": picture.state.reason})
    if alive:
        lamps += [{"name": "found", "level": "warning", "text": text} for text in picture.state.findings]
    for name, node in sorted(picture.nodes.items()):
        lamps.append({"name": name, "level": node.level, "text": node.text})
    for topic, error in sorted(picture.refused.items()):
        lamps.append({"name": topic, "level": "warning", "text": f"a message was refused: {error}"})
    return lamps


def _rounded(values: Any, known: bool) -> list[float | None]:
    return [_number(value, 3) if known else None for value in values]


def _number(value: float, digits: int) -> float | None:
    """For JSON, which has no NaN."""
    return round(float(value), digits) if math.isfinite(value) else None
