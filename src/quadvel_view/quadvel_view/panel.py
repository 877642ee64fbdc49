"""Readings of the page as JSON, from a picture and the operator's state.

`picture` holds the state, and `viewer` sends the readings to the page.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from .operator import BRAKING_MODES, PUBLISH_PERIOD_S, Operator
from .picture import FRESH_S, RobotPicture

TOPIC_PUBLISHERS = {"/controller/state": "controller", "/command": "command mux", "/joint_states": "robot"}
"""Topics with a continuous stream, and their publishers."""
OWN_SOURCE = "teleop"
"""Name of the page's input in the command mux."""
EFFECT_DELAY_S = 0.5
"""Time after which the command mux should have selected the page's input."""


def panel(picture: RobotPicture, operator: Operator, now: float) -> dict[str, Any]:
    """Return the readings of the page; None stands for an unknown number.

    Args:
        picture: The state of the robot.
        operator: Hold and STOP.
        now: s, on the clock of the picture.

    Returns:
        Numbers and texts for JSON.
    """
    alive = picture.is_fresh("/controller/state", now) and picture.state is not None
    return {
        "mode": picture.state.mode_name if alive else "",
        **_mode_reasons(picture, operator, alive),
        "notices": list(_notices(picture, operator, now)),
        "stopped": operator.stopped,
        "source": picture.source if picture.is_fresh("/command", now) else "",
        "commanded": _rounded(picture.commanded, alive),
        "measured": _rounded(picture.measured, picture.is_fresh("/odom", now)),
        "torque": _rounded(picture.torque / picture.robot.torque_limit, picture.has_fresh_joints(now)),
        "loop": _loop_timing(picture.state) if alive else {},
        "lamps": _lamps(picture, alive),
        "simulated": any(name in picture.nodes for name in ("sim_node", "board")),
    }


def _mode_reasons(picture: RobotPicture, operator: Operator, alive: bool) -> dict[str, str]:
    """Explain the mode of the robot, and why it follows no velocity."""
    if not alive:
        return {"reason": "no message from the controller", "refusal": ""}
    if operator.stopped:
        braking = picture.state.mode_name in BRAKING_MODES
        return {
            "reason": "STOP is latched" if braking else "STOP is latched; the joints are not damped yet",
            "refusal": "release the STOP, then stand up",
        }
    return {"reason": picture.state.reason, "refusal": picture.state.walk_refusal}


def _notices(picture: RobotPicture, operator: Operator, now: float) -> Iterator[str]:
    """Yield a sentence for each obstacle between operator and robot."""
    for topic, name in TOPIC_PUBLISHERS.items():
        if (silence := picture.silence(topic, now)) > FRESH_S:
            yield f"no message from the {name} for {silence:.0f} s"
    if late := operator.message_gap(now):
        yield f"commands arrive {late:.1f} s apart, expected {PUBLISH_PERIOD_S:g} s: the robot may stop in between"
    if operator.hold_duration(now) > EFFECT_DELAY_S and picture.source != OWN_SOURCE:
        yield f"the command mux follows another source: '{picture.source}'"


def _loop_timing(state: Any) -> dict[str, float | None]:
    """Return rate and timing of the control loop."""
    return {
        "rate": _number(state.rate_hz, 1),
        "period": _number(state.period_p99_ms, 2),
        "compute": _number(state.compute_p99_us, 0),
        "missed": int(state.overruns),
    }


def _lamps(picture: RobotPicture, alive: bool) -> list[dict[str, str]]:
    """List the fault first, then findings, then the nodes' health."""
    lamps = []
    if alive and picture.state.fault:
        lamps.append({"name": picture.state.fault, "level": "error", "text": picture.state.reason})
    if alive:
        lamps += [{"name": "finding", "level": "warning", "text": text} for text in picture.state.findings]
    for name, node in sorted(picture.nodes.items()):
        lamps.append({"name": name, "level": node.level, "text": node.text})
    for topic, error in sorted(picture.rejected.items()):
        lamps.append({"name": topic, "level": "warning", "text": f"invalid message: {error}"})
    return lamps


def _rounded(values: Any, known: bool) -> list[float | None]:
    """Round values to three digits; None if unknown."""
    return [_number(value, 3) if known else None for value in values]


def _number(value: float, digits: int) -> float | None:
    """Round a number; None if it is not finite, because JSON has no NaN."""
    return round(float(value), digits) if math.isfinite(value) else None
