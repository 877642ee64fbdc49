"""Task: was the robot asked for something that it can do?"""

from __future__ import annotations

import numpy as np
from typing_extensions import override

from ..cause import Cause, Link, Measurement, Trace, worst_span
from ..signals import Signals


class CommandOutOfRange(Cause):
    """The commanded velocity exceeds what the policy was trained to follow; the controller clamps it."""

    link = Link.TASK
    unit = "share"
    least = 0.05
    needs = ("command",)
    remedy = "Limit the velocity at its source: `command_limits` in the metadata of the policy file"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        asked = signals.run.velocity_command
        assert asked is not None
        assert signals.policy is not None
        limits = signals.policy.metadata.limits
        given = np.array([limits.clamp(row[:3]) for row in asked.value])
        beyond = np.linalg.norm(asked.value[:, :3] - given, axis=1)
        size = np.maximum(np.linalg.norm(given, axis=1), 0.1)
        moves = asked.value[:, 3] < 0.5
        value = float(np.max(np.where(moves, beyond / size, 0.0), initial=0.0))
        axis = int(np.argmax(np.abs(asked.value[:, :3] - given).max(axis=0)))
        name = ("vx, m/s", "vy, m/s", "wz, rad/s")[axis]
        trace = Trace(f"commanded and allowed {name}", asked.time, asked.value[:, axis], given[:, axis])
        k = int(np.argmax(beyond))
        shown = ", ".join(f"{x:.1f}" for x in asked.value[k, :3])
        allowed = ", ".join(f"{x:.1f}" for x in given[k])
        sentence = f"commanded ({shown}) m/s, m/s, rad/s, the policy follows at most ({allowed})"
        return Measurement(value, sentence, worst_span(asked.time, beyond), (trace,))
