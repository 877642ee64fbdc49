"""The controller's modes and its safety: what may follow what, and when damping is the only answer.

Plain arrays and times in, joint commands out; it knows no ROS. `modes` holds what each mode does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.command_range import within_range
from quadvel_description.robot import JOINT_NAMES, LIE_Q, LOWER, UPPER
from quadvel_description.state import JointCommand, RobotState

from .modes import Array, Damping, Mode, Policy, Posture, Tick, Walk

MODES = ("passive", "stand_up", "stance", "walk", "lie_down", "fault")
"""In the order of the numbers in quadvel_msgs/ControllerState."""
LIMP = ("passive", "fault")
FOLLOWS = {
    "stand_up": ("passive", "lie_down"),
    "stance": ("passive", "walk"),
    "walk": ("stance",),
    "lie_down": ("stand_up", "stance", "walk"),
}
"""From which modes each may be requested; passive always may."""
FOLLOWING = ("stance", "walk")
"""In which modes a velocity is followed"""
STILL = np.array([0.0, 0.0, 0.0, 1.0])

Following = tuple[str, str] | None  # the next mode and the reason


def setting(default: Any, description: str, positive: bool = True) -> Any:
    """A field of a configuration that becomes a node parameter with this description."""
    validator = attrs.validators.gt(0.0) if positive else None
    return attrs.field(default=default, validator=validator, metadata={"description": description})


@attrs.frozen(kw_only=True)
class SupervisorConfig:
    """Gains and times of the modes, and the limits beyond which the robot goes to damping."""

    auto_stand: bool = setting(
        False, "stand up once, by itself, as soon as the robot reports", positive=False
    )
    require_operator: bool = setting(
        False, "walk only after ~/enable_walking was called (set it on a robot)", positive=False
    )
    stand_kp: float = setting(100.0, "gain of standing up, stance and lying down, N m/rad")
    stand_kd: float = setting(3.0, "damping of standing up, stance and lying down, N m s/rad")
    damping_kd: float = setting(5.0, "damping when passive or in fault, N m s/rad")
    fold_time: float = setting(0.8, "first part of standing up: to the lying posture, s")
    rise_time: float = setting(1.2, "second part of standing up: to the nominal posture, s")
    settle_time: float = setting(0.3, "from walking back to the nominal posture, s")
    lie_down_time: float = setting(1.0, "from standing to the lying posture, s")
    blend_time: float = setting(0.15, "over which the policy's torques fade in, s")
    max_state_age: float = setting(0.05, "oldest state, and longest time without one, before a fault, s")
    reset_gap: float = setting(0.02, "time without a state after which the policy's memory is reset, s")
    max_tilt: float = setting(1.05, "largest angle between the trunk's and the world's vertical, rad")
    max_joint_speed: float = setting(40.0, "largest measured joint speed, rad/s")
    joint_margin: float = setting(0.2, "how far a measured angle may lie outside the mechanical range, rad")
    max_posture_error: float = setting(0.35, "largest joint error at which the robot counts as standing, rad")
    max_standing_speed: float = setting(0.3, "largest speed at which walking may end in a posture, m/s")


class Supervisor:
    """Runs one mode at a time and latches damping where something is unsafe.

    policy: what drives in walk; its metadata gives limits and the nominal posture. After each tick: `mode`
    (one of MODES), `reason` (one sentence), `command` (4,) in effect, `walk_refusal`, `inference_seconds`
    (nan where no network ran). `obstacle`: what somebody else found that forbids moving, a sentence, or None.
    """

    def __init__(self, policy: Policy, config: SupervisorConfig = SupervisorConfig()) -> None:
        self.config = c = config
        nominal = np.array(policy.metadata.nominal_q)
        self._limits = policy.metadata.limits
        low, high = LOWER - c.joint_margin, UPPER + c.joint_margin
        speed, any_number = np.full(12, c.max_joint_speed), np.full(7, np.finfo(float).max)
        self._middle = np.concatenate((0.5 * (low + high), np.zeros(19)))
        self._reach = np.concatenate((0.5 * (high - low), speed, any_number))
        self._walk = Walk(policy, c.blend_time)
        self._stance = Posture([(c.settle_time, nominal)], c.stand_kp, c.stand_kd)
        self._stand_up = Posture([(c.fold_time, LIE_Q), (c.rise_time, nominal)], c.stand_kp, c.stand_kd)
        self._lie_down = Posture([(c.lie_down_time, LIE_Q)], c.stand_kp, c.stand_kd)
        damping = Damping(c.damping_kd)
        self._modes: dict[str, Mode] = {
            "passive": damping,
            "stand_up": self._stand_up,
            "stance": self._stance,
            "walk": self._walk,
            "lie_down": self._lie_down,
            "fault": damping,
        }
        self._after: dict[str, Callable[[Tick], Following]] = {
            "passive": self._after_passive,
            "stand_up": self._after_stand_up,
            "stance": self._after_stance,
            "lie_down": self._after_lie_down,
        }
        self.mode, self.reason = "passive", "waits for an order"
        self.command = STILL.copy()
        self.inference_seconds = float("nan")
        self.obstacle: str | None = None
        self._auto_stand = c.auto_stand
        self._enabled = False
        self._zero_seen = False  # a command to stand still came since a velocity could have been followed
        self._last: Tick | None = None
        self._age = 0.0
        self._entered: float | None = None  # None: at the next tick
        self._previous = JointCommand.damping(c.damping_kd)

    @property
    def walk_refusal(self) -> str:
        """Why a velocity that is commanded now is not followed, a sentence; empty where it is."""
        if self.mode == "fault":
            return "the robot is in fault: request passive, then stand_up"
        if self.mode not in FOLLOWING:
            return f"the robot is in mode {self.mode}, expected {' or '.join(FOLLOWING)}"
        if not self._operator_agrees:
            return "walking is not allowed yet: call ~/enable_walking"
        if not self._zero_seen:
            return "a zero velocity has to be commanded first"
        return ""

    @property
    def _operator_agrees(self) -> bool:
        return self._enabled or not self.config.require_operator

    def enable_walking(self, enabled: bool) -> tuple[bool, str]:
        """The operator allows walking, or takes it back: then a walking robot stands still on its policy.

        A velocity that is commanded at that moment does not count: a zero one has to come first.
        """
        if enabled and not self._operator_agrees:
            self._zero_seen = False
        self._enabled = enabled
        return True, "a command may start walking" if self._operator_agrees else "the robot stands still"

    def request(self, mode: str) -> tuple[bool, str]:
        """Ask for a mode; (taken or not, a sentence). "passive" is always taken and clears a fault."""
        if mode not in MODES or mode == "fault":
            return False, f"mode is '{mode}', expected one of {', '.join(MODES[:-1])}"
        refusal = self._refusal(mode)
        if refusal:
            return False, refusal
        self._auto_stand = False
        if mode != self.mode:
            self._switch(mode, "was asked for")
        return True, f"mode is {mode}"

    def fail(self, reason: str) -> None:
        """Latch damping until "passive" is requested. The first reason stays; a limp robot stays as it is."""
        if self.mode not in LIMP:
            self._switch("fault", reason)

    def tick(
        self, now: float, state: RobotState, velocity: ArrayLike | None, command: ArrayLike | None
    ) -> JointCommand:
        """One control tick: what the joints are to do.

        now: s, on the clock of state.time. velocity: (3,) m/s, body frame, None without a fresh estimate.
        command: (4,) vx, vy (m/s), wz (rad/s), stance (0 or 1); None without a fresh one: the robot stands.
        After every start, fault and rest a velocity counts only once a zero one was commanded to the standing robot, so that
        it never walks off on an order that was given to another run of the controller.
        """
        self.inference_seconds = float("nan")
        self.command = self._limited(command)
        self._age = now - state.time
        speed = None if velocity is None else np.asarray(velocity, float)
        gap = 0.0 if self._last is None else state.time - self._last.state.time
        seen = self._seen(state, speed)
        if self.mode not in LIMP:
            self._check(seen, gap)
        if self.mode in self._after and (following := self._after[self.mode](seen)):
            self._switch(*following)
        answer = self._answer(seen)
        answer.tick = state.tick
        self._last, self._previous = seen, answer
        return answer

    def prepare(self) -> None:
        """Between two ticks, what can be done ahead of the next one, so that its answer comes sooner; may be left out."""
        if self.mode == "walk":
            self._walk.prepare()

    def _answer(self, seen: Tick) -> JointCommand:
        mode = self._modes[self.mode]
        if self._entered is None:
            self._entered = seen.state.time
            seen = attrs.evolve(seen, elapsed=0.0)
            mode.enter(seen)
        try:
            answer = mode.tick(seen)
        except FloatingPointError as error:
            self.fail(str(error))
            return JointCommand.damping(self.config.damping_kd)
        if self.mode == "walk":
            self.inference_seconds = self._walk.inference_seconds
        answer.q, torque = within_range(answer.q, answer.kp, seen.state.q)
        answer.tau = answer.tau + torque
        return answer

    def _seen(self, state: RobotState, velocity: Array | None) -> Tick:
        elapsed = 0.0 if self._entered is None else state.time - self._entered
        return Tick(elapsed, state, velocity, self.command, self._previous)

    def _limited(self, command: ArrayLike | None) -> Array:
        """The command in effect: stand still where there is none, where it says so, is not finite, or is refused."""
        if command is None:
            return STILL.copy()
        numbers = np.asarray(command, float).tolist()
        stands = numbers[3] >= 0.5 or not any(numbers[:3])
        if stands and self._operator_agrees and self.mode in FOLLOWING:
            self._zero_seen = True
        if numbers[3] >= 0.5 or not _finite(numbers) or not (self._zero_seen and self._operator_agrees):
            return STILL.copy()
        return np.array([*self._limits.held(numbers[:3]), 0.0])

    def _switch(self, mode: str, reason: str) -> None:
        self.mode, self.reason = mode, reason
        self._entered = None
        if mode not in FOLLOWING:
            self._zero_seen = False
        if mode in LIMP:
            self._enabled = False
            self._walk.forget()

    def _check(self, seen: Tick, gap: float) -> None:
        """Latch the first problem of this tick; a short gap only costs the policy its memory."""
        problem = next(self._problems(seen, gap), None) or self._jump(seen.state, gap)
        if problem:
            self.fail(problem)
        elif gap > self.config.reset_gap:
            self._walk.forget()

    def _problems(self, seen: Tick, gap: float = 0.0) -> Iterator[str]:
        """Every reason to go to damping, as sentences. gap: s since the state before."""
        c, state = self.config, seen.state
        if self.obstacle:
            yield self.obstacle
        sound = self._is_sound(state)
        if not sound:
            yield from self._not_finite(state)
        if self._age > c.max_state_age:
            yield f"the state is {1e3 * self._age:.0f} ms old, limit {1e3 * c.max_state_age:.0f} ms"
        if gap < 0.0:
            yield f"the state's time went back by {-1e3 * gap:.0f} ms"
        if gap > c.max_state_age:
            yield f"no state came for {1e3 * gap:.0f} ms, limit {1e3 * c.max_state_age:.0f} ms"
        yield from self._attitude_problems(state.quaternion)
        if not sound:
            yield from self._joint_problems(state)
        if self.mode == "walk" and seen.velocity is None:
            yield "there is no fresh velocity estimate"
        if seen.velocity is not None and not _finite(seen.velocity.tolist()):
            yield "the velocity estimate is not finite"

    def _jump(self, state: RobotState, gap: float) -> str | None:
        """A sentence where joints that a posture holds are elsewhere at once: a robot put back, or an encoder at fault."""
        if self._last is None or not isinstance(self._modes[self.mode], Posture):
            return None
        moved = state.q - self._last.state.q
        i = int(np.argmax(np.abs(moved)))
        limit = self.config.max_joint_speed * gap + self.config.joint_margin
        if abs(moved[i]) <= limit:
            return None
        return f"{JOINT_NAMES[i]} moved by {moved[i]:+.2f} rad in {1e3 * gap:.0f} ms, limit {limit:.2f}"

    def _is_sound(self, state: RobotState) -> bool:
        """Whether every number is finite and every joint within its limits: all in one look, as it mostly is."""
        numbers = np.concatenate((state.q, state.dq, state.quaternion, state.angular_velocity))
        return np.count_nonzero(np.abs(numbers - self._middle) <= self._reach) == len(numbers)

    def _not_finite(self, state: RobotState) -> Iterator[str]:
        for name in ("q", "dq", "quaternion", "angular_velocity"):
            if not np.isfinite(getattr(state, name)).all():
                yield f"the state's {name} is not finite"

    def _attitude_problems(self, quaternion: Array) -> Iterator[str]:
        w, x, y, z = quaternion.tolist()
        length = math.hypot(w, x, y, z)
        if abs(length - 1.0) > 0.05:
            yield f"the state's quaternion has length {length:.2f}, expected 1"
        tilt = math.acos(max(-1.0, min(1.0 - 2.0 * (x * x + y * y), 1.0)))
        if tilt > self.config.max_tilt:
            yield f"the trunk is tilted by {tilt:.2f} rad, limit {self.config.max_tilt:.2f}"

    def _joint_problems(self, state: RobotState) -> Iterator[str]:
        c = self.config
        outside = np.maximum(LOWER - state.q, state.q - UPPER)
        for i in np.flatnonzero(outside > c.joint_margin):
            limits = f"{LOWER[i]:.2f} to {UPPER[i]:.2f}"
            yield f"{JOINT_NAMES[i]} is at {state.q[i]:.2f} rad, its range is {limits}"
        for i in np.flatnonzero(np.abs(state.dq) > c.max_joint_speed):
            yield f"{JOINT_NAMES[i]} moves at {state.dq[i]:.0f} rad/s, limit {c.max_joint_speed:.0f}"

    def _refusal(self, mode: str) -> str | None:
        """Why this mode can't be had now; None where it can."""
        if mode in ("passive", self.mode):
            return None
        if self.mode == "fault":
            return f"is in fault ({self.reason}), request passive first"
        if self._last is None:
            return "the robot has not reported yet"
        if self.mode not in FOLLOWS[mode]:
            return f"{mode} can't follow {self.mode}, expected {' or '.join(FOLLOWS[mode])}"
        return next(self._problems(self._last), None) or self._refusal_of_move(mode, self._last)

    def _refusal_of_move(self, mode: str, last: Tick) -> str | None:
        if mode == "walk" and not self._operator_agrees:
            return "walking is not allowed yet: call ~/enable_walking"
        if mode == "walk" and last.velocity is None:
            return "there is no fresh velocity estimate"
        if self.mode == "passive" and mode == "stance":
            return self._posture_error(last)
        if self.mode == "walk":
            speed = 0.0 if last.velocity is None else float(np.linalg.norm(last.velocity))
            if not last.command[3] or speed > self.config.max_standing_speed:
                return f"the robot walks ({speed:.2f} m/s), command stance first"
        return None

    def _posture_error(self, seen: Tick) -> str | None:
        """A sentence where a joint is far from the nominal posture."""
        error = seen.state.q - self._stance.goal(seen.state)
        i = int(np.argmax(np.abs(error)))
        if abs(error[i]) <= self.config.max_posture_error:
            return None
        limit = self.config.max_posture_error
        return f"{JOINT_NAMES[i]} is {error[i]:+.2f} rad off the nominal posture, limit {limit:.2f}"

    def _after_passive(self, seen: Tick) -> Following:
        if self._auto_stand and next(self._problems(seen), None) is None:
            self._auto_stand = False
            return "stand_up", "stands up by itself at the start"
        return None

    def _after_stand_up(self, seen: Tick) -> Following:
        if not self._stand_up.done(seen.elapsed):
            return None
        error = self._posture_error(seen)
        return ("fault", f"standing up failed: {error}") if error else ("stance", "stood up")

    def _after_stance(self, seen: Tick) -> Following:
        asked = not seen.command[3] and seen.command[:3].any()
        if asked and seen.velocity is not None and self._stance.done(seen.elapsed):
            return "walk", "a velocity was commanded"
        return None

    def _after_lie_down(self, seen: Tick) -> Following:
        return ("passive", "lies") if self._lie_down.done(seen.elapsed) else None


def _finite(numbers: Iterable[float]) -> bool:
    """For a few numbers quicker than NumPy."""
    return all(map(math.isfinite, numbers))
