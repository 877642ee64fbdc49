"""Which of several velocity sources is followed, how fast the command may change, and when to stand still.

Plain numbers and times; it knows no ROS. What a policy can follow is the supervisor's matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
LONGEST_STEP = 0.05  # s, of the ramp at one update: a process that could not run for longer does not jump
Axes = tuple[float, float, float]


@attrs.frozen
class MuxInput:
    """A source of velocities: the highest priority among those heard from within `timeout` (s) wins."""

    name: str
    priority: int
    timeout: float = attrs.field(validator=attrs.validators.gt(0.0))


def _axes(instance: object, field: attrs.Attribute[Axes], value: Axes) -> None:
    if len(value) != 3 or not all(math.isfinite(x) and x > 0.0 for x in value):
        raise ValueError(f"{field.name} is {list(value)}, expected three numbers above 0 (vx, vy, wz)")


@attrs.frozen(kw_only=True)
class MuxConfig:
    """Bounds of the command, each for vx, vy (m/s) and wz (rad/s)."""

    max_velocity: Axes = attrs.field(
        default=(4.5, 2.2, 6.3),
        validator=_axes,
        metadata={"description": "largest vx, vy, wz passed on, m/s, rad/s"},
    )
    acceleration: Axes = attrs.field(
        default=(2.0, 1.4, 6.0),
        validator=_axes,
        metadata={"description": "largest change of a command away from zero, m/s^2, rad/s^2"},
    )
    stop_acceleration: Axes = attrs.field(
        default=(5.0, 4.0, 8.0),
        validator=_axes,
        metadata={
            "description": "the same towards zero: braking, and where every source is silent or a lock is set"
        },
    )
    dead_zone: Axes = attrs.field(
        default=(0.02, 0.02, 0.02),
        validator=_axes,
        metadata={"description": "a command below this on every axis counts as zero, m/s, rad/s"},
    )


@attrs.frozen
class MuxOutput:
    """What to track: velocity (3,), whether to stand still, and the input that won or "none"."""

    velocity: Array
    stance: bool
    source: str


class CommandMux:
    """Arbitrates `inputs`; `receive` takes what arrives, `update` says what to track now.

    locks: names of those that are set. stance_requested: whether the operator asks to stand still.
    Raises ValueError where two inputs share a name or a priority.
    """

    def __init__(self, inputs: Sequence[MuxInput], config: MuxConfig = MuxConfig()) -> None:
        for field in ("name", "priority"):
            values = [getattr(i, field) for i in inputs]
            if not values or len(set(values)) != len(values):
                raise ValueError(f"inputs have the {field} list {values}, expected each {field} once")
        self._inputs = sorted(inputs, key=lambda i: -i.priority)
        self._config = config
        self._heard: dict[str, tuple[float, Array]] = {}
        self._velocity = np.zeros(3)
        self._updated: float | None = None
        self.locks: set[str] = set()
        self.stance_requested = False

    def receive(self, name: str, now: float, velocity: ArrayLike) -> None:
        """A velocity (vx, vy, wz) from the input `name` at `now` (s). Raises ValueError if not finite."""
        value = np.array(velocity, float)
        if not np.isfinite(value).all():
            raise ValueError(f"{name}: the velocity is {value.tolist()}, expected finite numbers")
        self._heard[name] = (now, value)

    def update(self, now: float) -> MuxOutput:
        """What to track at `now` (s): at most a step away from the update before; stance once at zero."""
        # What was heard before the clock was set back would be fresh once more when its time comes again.
        self._heard = {name: heard for name, heard in self._heard.items() if heard[0] <= now}
        source = self._winner(now)
        if source is None or self.locks or self.stance_requested:
            source, target = None, np.zeros(3)
        else:
            target = self._target(self._heard[source.name][1])
        elapsed = 0.0 if self._updated is None else min(max(now - self._updated, 0.0), LONGEST_STEP)
        self._updated = now
        slower = np.abs(target) < np.abs(self._velocity)
        limit = np.where(slower, self._config.stop_acceleration, self._config.acceleration)
        self._velocity = self._ramp(target, limit * elapsed)
        stance = not target.any() and not self._velocity.any()
        return MuxOutput(self._velocity.copy(), stance, source.name if source else "none")

    def _winner(self, now: float) -> MuxInput | None:
        """The first that is fresh."""
        for source in self._inputs:
            if source.name in self._heard and now - self._heard[source.name][0] <= source.timeout:
                return source
        return None

    def _target(self, velocity: Array) -> Array:
        c = self._config
        if (np.abs(velocity) < c.dead_zone).all():
            return np.zeros(3)
        return np.clip(velocity, np.negative(c.max_velocity), c.max_velocity)

    def _ramp(self, target: Array, step: Array) -> Array:
        """Straight towards `target` by at most `step` on each axis."""
        way = target - self._velocity
        if (np.abs(way) <= step).all():
            return target
        if not step.all():  # no time has passed
            return self._velocity
        return self._velocity + way / np.max(np.abs(way) / step)
