"""What the page is told of a picture, an operator and a recording: numbers and words as JSON has them."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadvel_description import robot

from .operator import Operator
from .picture import RobotPicture


def panel(picture: RobotPicture, operator: Operator, now: float) -> dict[str, Any]:
    """The readings of the page. now: s, on the clock of the picture."""
    alive = picture.is_fresh("/controller/state", now) and picture.state is not None
    return {
        "mode": picture.state.mode_name if alive else "",
        "reason": picture.state.reason if alive else "no controller is heard",
        "refusal": picture.state.walk_refusal if alive else "",
        "stopped": operator.stopped,
        "source": picture.source,
        "commanded": _rounded(picture.commanded),
        "measured": _rounded(picture.measured),
        "torque": _rounded(picture.torque / robot.TORQUE_LIMIT),
        "loop": _loop(picture.state) if alive else {},
        "lamps": _lamps(picture, alive),
        "simulated": any(name in picture.nodes for name in ("sim_node", "board")),
    }


def _loop(state: Any) -> dict[str, float]:
    return {
        "rate": round(float(state.rate_hz), 1),
        "period": round(float(state.period_p99_ms), 2),
        "compute": round(float(state.compute_p99_us)),
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
    return lamps


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 3) for value in np.nan_to_num(values)]
