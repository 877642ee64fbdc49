"""A walk written down: which modes to order, which velocities to command, and for how long. No ROS."""

from __future__ import annotations

import attrs

Velocity = tuple[float, float, float]  # vx, vy (m/s), wz (rad/s)

RETRY = 0.5  # s, between two orders of the same mode: the controller may not be ready for the first


@attrs.frozen
class Order:
    """Order `mode` of the controller and wait for the mode `until`, for `patience` s at most."""

    name: str
    mode: str
    until: str
    patience: float


@attrs.frozen
class Drive:
    """Command `velocity` for `seconds`."""

    name: str
    velocity: Velocity
    seconds: float


Step = Order | Drive

STAND_UP = Order("stand up", "stand_up", until="stance", patience=20.0)
LIE_DOWN = Order("lie down", "lie_down", until="passive", patience=10.0)
SCRIPTS: dict[str, tuple[Step, ...]] = {
    "full": (
        STAND_UP,
        Drive("stance", (0.0, 0.0, 0.0), 4.0),
        Drive("forward 0.5 m/s", (0.5, 0.0, 0.0), 5.0),
        Drive("forward 1.0 m/s", (1.0, 0.0, 0.0), 5.0),
        Drive("forward 1.5 m/s", (1.5, 0.0, 0.0), 5.0),
        Drive("backward 0.5 m/s", (-0.5, 0.0, 0.0), 5.0),
        Drive("left 0.3 m/s", (0.0, 0.3, 0.0), 5.0),
        Drive("right 0.3 m/s", (0.0, -0.3, 0.0), 5.0),
        Drive("turn left 0.8 rad/s", (0.0, 0.0, 0.8), 5.0),
        Drive("turn right 0.8 rad/s", (0.0, 0.0, -0.8), 5.0),
        Drive("forward, left and turn", (0.6, 0.2, 0.5), 5.0),
        Drive("stop", (0.0, 0.0, 0.0), 4.0),
        LIE_DOWN,
    ),
    "circuit": (
        STAND_UP,
        Drive("forward 0.5 m/s", (0.5, 0.0, 0.0), 5.0),
        Drive("forward 1.0 m/s", (1.0, 0.0, 0.0), 5.0),
        Drive("backward 0.4 m/s", (-0.4, 0.0, 0.0), 5.0),
        Drive("left 0.3 m/s", (0.0, 0.3, 0.0), 5.0),
        Drive("turn left 0.7 rad/s", (0.0, 0.0, 0.7), 5.0),
        Drive("forward, right and turn", (0.6, -0.2, -0.4), 5.0),
        Drive("stop", (0.0, 0.0, 0.0), 2.0),
        LIE_DOWN,
    ),
    "quick": (
        STAND_UP,
        Drive("forward 0.5 m/s", (0.5, 0.0, 0.0), 4.0),
        Drive("stop", (0.0, 0.0, 0.0), 4.0),
        LIE_DOWN,
    ),
}


class ScriptError(RuntimeError):
    """The robot does not do what the script says; one sentence."""


@attrs.frozen
class Action:
    """What to do now: order a mode, or command a velocity, or neither."""

    step: str
    order: str | None = None
    velocity: Velocity | None = None


class ScriptRunner:
    """Goes through `steps` as time and the controller's modes allow."""

    def __init__(self, steps: tuple[Step, ...]) -> None:
        self._steps = list(steps)
        self._since: float | None = None  # when the present step began
        self._ordered: float | None = None

    def update(self, now: float, mode: str, reason: str = "") -> Action | None:
        """What to do at `now` (s) while the controller is in `mode` for `reason`; None at the end.

        mode: "" as long as the controller has not been heard. Raises ScriptError on a fault, and where the
        patience of an order is over.
        """
        if mode == "fault":
            raise ScriptError(f"the controller is in fault: {reason}")
        if self._steps and self._since is not None and self._over(self._steps[0], now - self._since, mode):
            self._steps.pop(0)
            self._since = self._ordered = None
        if not self._steps:
            return None
        if self._since is None:
            self._since = now
        step = self._steps[0]
        if isinstance(step, Drive):
            if mode in ("passive", "lie_down"):
                raise ScriptError(f"the controller is in mode {mode} during '{step.name}': {reason}")
            return Action(step.name, velocity=step.velocity)
        return Action(step.name, order=step.mode if self._is_due(step, now, mode) else None)

    def _over(self, step: Step, elapsed: float, mode: str) -> bool:
        if isinstance(step, Drive):
            return elapsed >= step.seconds
        if mode != step.until and elapsed > step.patience:
            found = mode or "unknown"
            raise ScriptError(f"'{step.name}' took more than {step.patience:g} s; the mode is {found}")
        return mode == step.until

    def _is_due(self, order: Order, now: float, mode: str) -> bool:
        if mode in ("", order.mode) or (self._ordered is not None and now - self._ordered < RETRY):
            return False
        self._ordered = now
        return True
