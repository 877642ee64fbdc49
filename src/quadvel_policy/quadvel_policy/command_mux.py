"""Arbitration between velocity sources by priority, with limits on the rate of change. Knows no ROS.

The supervisor limits the command further to what the policy can follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

MAX_RAMP_STEP_S = 0.05
"""Largest time step of the ramp, so that the command does not jump after a stall."""
Axes = tuple[float, float, float]
ZERO: Axes = (0.0, 0.0, 0.0)


@attrs.frozen
class MuxInput:
    """A velocity source.

    Attributes:
        name: Name of the source.
        priority: Priority; the highest among the active sources wins.
        timeout: Time after which a silent source is inactive, s.
    """

    name: str
    priority: int
    timeout: float = attrs.field(validator=attrs.validators.gt(0.0))


def _axes(default: Axes, description: str) -> Any:
    """Declare a field of a positive limit of each axis."""

    def check(_: object, field: attrs.Attribute[Axes], value: Axes) -> None:
        if len(value) != 3 or not all(math.isfinite(x) and x > 0.0 for x in value):
            raise ValueError(f"{field.name} is {list(value)}, expected three numbers above 0 (vx, vy, wz)")

    return attrs.field(default=default, validator=check, metadata={"description": description})


@attrs.frozen(kw_only=True)
class MuxConfig:
    """Limits of the command, each for vx, vy (m/s) and wz (rad/s).

    Attributes:
        max_velocity: Largest |vx|, |vy| (m/s) and |wz| (rad/s).
        acceleration: Largest rate of change away from zero, m/s^2 and rad/s^2.
        stop_acceleration: Largest rate of change towards zero, m/s^2 and rad/s^2.
        dead_zone: |vx|, |vy| (m/s), |wz| (rad/s); a command below all three counts as zero.
    """

    max_velocity: Axes = _axes((4.5, 2.2, 6.3), "largest vx, vy, wz passed on, m/s, rad/s")
    acceleration: Axes = _axes((2.0, 1.4, 6.0), "largest change of a command away from zero, m/s^2, rad/s^2")
    stop_acceleration: Axes = _axes(
        (5.0, 4.0, 8.0),
        "the same towards zero: braking, and where every source is silent or a lock is set",
    )
    dead_zone: Axes = _axes(
        (0.02, 0.02, 0.02), "a command below this on every axis counts as zero, m/s, rad/s"
    )


@attrs.frozen
class MuxOutput:
    """Command of the mux.

    Attributes:
        velocity: vx, vy (m/s), wz (rad/s), (3,).
        stance: Whether the robot must stand still.
        source: Name of the active source, or "none".
    """

    velocity: Array
    stance: bool
    source: str


class CommandMux:
    """Selects the active velocity source with the highest priority.

    Attributes:
        locks: Names of the active locks; any lock stops the robot.
        stance_requested: Whether the operator requested to stand still.
    """

    def __init__(self, inputs: Sequence[MuxInput], config: MuxConfig = MuxConfig()) -> None:
        """Create a mux.

        Args:
            inputs: Velocity sources.
            config: Limits of the command.

        Raises:
            ValueError: Two sources share a name or a priority.
        """
        for field in ("name", "priority"):
            values = [getattr(i, field) for i in inputs]
            if not values or len(set(values)) != len(values):
                raise ValueError(f"inputs have the {field} list {values}, expected each {field} once")
        self._inputs = sorted(inputs, key=lambda i: -i.priority)
        self._config = config
        self._received: dict[str, tuple[float, Axes]] = {}
        self._velocity = ZERO
        self._updated: float | None = None
        self.locks: set[str] = set()
        self.stance_requested = False

    def receive(self, name: str, now: float, velocity: ArrayLike) -> None:
        """Receive a velocity.

        Args:
            name: Name of the source.
            now: Time, s.
            velocity: vx, vy (m/s), wz (rad/s), (3,).

        Raises:
            ValueError: A number is not finite.
        """
        vx, vy, wz = np.asarray(velocity, float).tolist()
        if not all(map(math.isfinite, (vx, vy, wz))):
            raise ValueError(f"{name}: the velocity is {[vx, vy, wz]}, expected finite numbers")
        self._received[name] = (now, (vx, vy, wz))

    def update(self, now: float) -> MuxOutput:
        """Compute the command: the active velocity, at most one ramp step from the last command.

        Args:
            now: Time, s.

        Returns:
            The command; its stance is set once the velocity is zero.
        """
        # If the clock was set back, drop messages from the future: they would become fresh later.
        self._received = {name: entry for name, entry in self._received.items() if entry[0] <= now}
        source = self._active_input(now)
        if source is None or self.locks or self.stance_requested:
            source, target = None, ZERO
        else:
            target = self._target(self._received[source.name][1])
        elapsed = 0.0 if self._updated is None else min(max(now - self._updated, 0.0), MAX_RAMP_STEP_S)
        self._updated = now
        self._velocity = self._ramp(target, elapsed)
        stance = not any(target) and not any(self._velocity)
        return MuxOutput(np.array(self._velocity), stance, source.name if source else "none")

    def _active_input(self, now: float) -> MuxInput | None:
        """Return the active source with the highest priority, or None."""
        for source in self._inputs:
            if source.name in self._received and now - self._received[source.name][0] <= source.timeout:
                return source
        return None

    def _target(self, velocity: Axes) -> Axes:
        c = self._config
        if all(abs(v) < zone for v, zone in zip(velocity, c.dead_zone, strict=True)):
            return ZERO
        vx, vy, wz = (min(max(v, -most), most) for v, most in zip(velocity, c.max_velocity, strict=True))
        return vx, vy, wz

    def _ramp(self, target: Axes, elapsed: float) -> Axes:
        """Move straight towards `target` by at most what each axis may change in `elapsed` (s)."""
        c, now = self._config, self._velocity
        rates = zip(target, now, c.stop_acceleration, c.acceleration, strict=True)
        steps = [(stop if abs(t) < abs(v) else start) * elapsed for t, v, stop, start in rates]
        differences = [t - v for t, v in zip(target, now, strict=True)]
        if all(abs(d) <= step for d, step in zip(differences, steps, strict=True)):
            return target
        if not all(steps):  # no time has passed
            return now
        most = max(abs(d) / step for d, step in zip(differences, steps, strict=True))
        vx, vy, wz = (v + d / most for v, d in zip(now, differences, strict=True))
        return vx, vy, wz
