"""What the page is told of a picture, an operator and a recording: numbers and words as JSON has them."""

from __future__ import annotations

import math
from typing import Any

from quadvel_description import robot

from .operator import Operator
from .picture import RobotPicture


def panel(picture: RobotPicture, operator: Operator, now: float) -> dict[str, Any]:
    """The readings of the page; None stands for a number that is not there. now: s, on the clock of the picture."""
    alive = picture.is_fresh("/controller/state", now) and picture.state is not None
    return {
        "mode": picture.state.mode_name if alive else "",
        "reason": picture.state.reason if alive else "no controller is heard",
        "refusal": picture.state.walk_refusal if alive else "",
        "stopped": operator.stopped,
        "source": picture.source if picture.is_fresh("/command", now) else "",
        "commanded": _rounded(picture.commanded, alive),
        "measured": _rounded(picture.measured, picture.is_fresh("/odom", now)),
        "torque": _rounded(picture.torque / robot.TORQUE_LIMIT, picture.shows_joints(now)),
        "loop": _loop(picture.state) if alive else {},
        "lamps": _lamps(picture, alive),
        "simulated": any(name in picture.nodes for name in ("sim_node", "board")),
    }


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
