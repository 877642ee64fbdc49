"""Defines scripted walks: modes to request, and velocities to command, with durations. No ROS.

It only decides what to request at a time; the caller sends it, such as
`quadvel_lab.scripted_planner`.
"""

from __future__ import annotations

import attrs

Velocity = tuple[float, float, float]  # vx, vy (m/s), wz (rad/s)


@attrs.frozen
class ModeRequest:
    """Request a mode of the controller and wait for a mode, in `stance` also until velocities are followed.

    A zero velocity is commanded in the awaited mode, as the controller asks for before it walks.

    Attributes:
        name: Name of the step.
        mode: Requested mode.
        awaited_mode: Mode that ends the step.
        timeout: Time after which the script fails, s.
    """

    name: str
    mode: str
    awaited_mode: str
    timeout: float


@attrs.frozen
class Drive:
    """Command a constant velocity.

    Attributes:
        name: Name of the step.
        velocity: vx, vy (m/s), wz (rad/s).
        duration: Duration, s.
    """

    name: str
    velocity: Velocity
    duration: float


Step = ModeRequest | Drive

STAND_UP = ModeRequest("stand up", "stand_up", awaited_mode="stance", timeout=20.0)
LIE_DOWN = ModeRequest("lie down", "lie_down", awaited_mode="passive", timeout=10.0)
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
    """The robot does not follow the script; the message is one sentence."""


@attrs.frozen
class Action:
    """Action of the script at one instant.

    Attributes:
        step: Name of the step.
        requested_mode: Mode to request, or None. It stays until the controller reports the mode; the
            caller decides how often to repeat a request.
        velocity: Velocity to command: vx, vy (m/s), wz (rad/s), body frame; None: no command.
    """

    step: str
    requested_mode: str | None = None
    velocity: Velocity | None = None


class ScriptRunner:
    """Executes the steps of a script according to time and controller mode.

    Args:
        steps: The steps.
    """

    def __init__(self, steps: tuple[Step, ...]) -> None:
        self._steps = list(steps)
        self._step_start: float | None = None  # start of the present step, s

    def update(self, now: float, mode: str, reason: str = "", walk_refusal: str = "") -> Action | None:
        """Return the next action.

        Args:
            now: Time, s.
            mode: Mode of the controller; "" before its first report.
            reason: Reason of the mode, for error messages.
            walk_refusal: Why the controller would not follow a velocity; empty where it would.

        Returns:
            The action; None at the end of the script.

        Raises:
            ScriptError: The controller is in fault or lies down, or a request timed out.
        """
        if mode == "fault":
            raise ScriptError(f"the controller is in fault: {reason}")
        if (
            self._steps
            and self._step_start is not None
            and self._is_over(self._steps[0], now - self._step_start, mode, walk_refusal)
        ):
            self._steps.pop(0)
            self._step_start = None
        if not self._steps:
            return None
        if self._step_start is None:
            self._step_start = now
        step = self._steps[0]
        if isinstance(step, Drive):
            if mode in ("passive", "lie_down"):
                raise ScriptError(f"the controller is in mode {mode} during '{step.name}': {reason}")
            return Action(step.name, velocity=step.velocity)
        # The mode is "" before the controller's first report.
        if mode == step.awaited_mode:
            return Action(step.name, velocity=(0.0, 0.0, 0.0))
        return Action(step.name, requested_mode=step.mode if mode not in ("", step.mode) else None)

    def _is_over(self, step: Step, elapsed: float, mode: str, walk_refusal: str) -> bool:
        """Return whether a step has ended. Raises ScriptError after the timeout of a request."""
        if isinstance(step, Drive):
            return elapsed >= step.duration
        is_over = mode == step.awaited_mode and not (mode == "stance" and walk_refusal)
        if not is_over and elapsed > step.timeout:
            found = f"{mode or 'unknown'}" + (f": {walk_refusal}" if mode == "stance" else "")
            raise ScriptError(f"'{step.name}' took more than {step.timeout:g} s; the mode is {found}")
        return is_over
