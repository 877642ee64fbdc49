"""The controller's modes and its safety: what may follow what, and what is done about the faults that `guards` finds.

Plain arrays and times in, joint commands out; it knows no ROS. `modes` holds what each mode does, `command_limits` what
no command may ask for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.robot import JOINT_NAMES, LIE_Q
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import MessageError, NotFiniteError

from .backup_velocity import BackupVelocity, Estimator
from .command_limits import CommandLimits, CommandLimitsConfig
from .guard import FALL_TIME, WALK, Finding, Guard, GuardConfig, GuardInput, GuardSet, Level, MotorStatus
from .guards import GUARDS, AccelerometerImplausible, DuplicatePublisher, EstimateStale, EstimateWrong
from .modes import Array, Damping, Mode, Policy, Posture, Tick, Walk
from .settings import setting

MODES = ("passive", "stand_up", "stance", "walk", "lie_down", "fault")
"""In the order of the numbers in quadvel_msgs/ControllerState."""
DAMPED_MODES = ("passive", "fault")
ALLOWED_FROM = {
    "stand_up": ("passive", "lie_down"),
    "stance": ("passive", "walk"),
    "walk": ("stance",),
    "lie_down": ("stand_up", "stance", "walk"),
}
"""From which modes each may be requested; passive always may."""
POSTURE_AFTER = ("stance", "walk")
"""In which modes a velocity is followed"""
STANCE_COMMAND = np.array([0.0, 0.0, 0.0, 1.0])
MEMORY_OF_VELOCITY = 0.2  # s, over which a velocity that nobody knows any more fades while the robot brakes
STEPPING_SPEED = 0.2
"""m/s, above which a robot that is to stand steps on: feet that stop behind a moving trunk trip it"""
MAX_STIFFNESS, MAX_DAMPING = 1000.0, 50.0
"""N m/rad and N m s/rad: more shakes the legs instead of holding them"""
PATIENCE_IN_BRAKING = 1.8  # times `brake_time`, after which a robot that still moves is put into its posture

SPOIL_THE_ESTIMATE = {guard.name() for guard in (EstimateStale, EstimateWrong, AccelerometerImplausible)}
"""With any of these the backup's velocity is followed"""

OTHER_FAULTS: dict[str, tuple[Level, tuple[str, ...], str]] = {
    "stand_up_failed": (
        Level.DAMPING,
        ("stand_up",),
        "Standing up ended more than `max_posture_error` from the nominal posture.",
    ),
    "policy_not_finite": (Level.DAMPING, WALK, "The policy's output is not finite."),
    "command_stale": (Level.LIMIT, WALK, "There is no fresh command: the robot stands still on its policy."),
    "command_not_finite": (
        Level.LIMIT,
        WALK,
        "A command is not finite: the robot stands still on its policy.",
    ),
    "command_out_of_range": (
        Level.LIMIT,
        WALK,
        "A command is beyond what the policy can follow: it is held within that.",
    ),
}
"""What the supervisor notices itself: name, level, modes, and what is noticed"""

Following = tuple[str, str] | None  # the next mode and the reason


@attrs.frozen(kw_only=True)
class SupervisorConfig(GuardConfig, CommandLimitsConfig):
    """Gains and times of the modes; the limits of guards and commands."""

    auto_stand: bool = setting(False, "stand up once, by itself, as soon as the robot reports")
    require_operator: bool = setting(False, "walk only after ~/enable_walking was called (set it on a robot)")
    stand_kp: float = setting(
        150.0, "gain of standing up, stance and lying down, N m/rad", at_most=MAX_STIFFNESS
    )
    stand_kd: float = setting(
        4.0, "damping of standing up, stance and lying down, N m s/rad", at_most=MAX_DAMPING
    )
    damping_kd: float = setting(5.0, "damping when passive or in fault, N m s/rad", at_most=MAX_DAMPING)
    fold_time: float = setting(0.8, "first part of standing up: to the lying posture, s", at_most=60.0)
    rise_time: float = setting(1.2, "second part of standing up: to the nominal posture, s", at_most=60.0)
    settle_time: float = setting(0.3, "from walking back to the nominal posture, s", at_most=60.0)
    lie_down_time: float = setting(1.0, "from standing to the lying posture, s", at_most=60.0)
    blend_time: float = setting(0.15, "over which the policy's torques fade in, s", at_most=FALL_TIME)
    reset_gap: float = setting(
        0.02, "time without a state after which the policy's memory is reset, s", at_most=FALL_TIME
    )
    max_posture_error: float = setting(
        0.35, "largest joint error at which the robot counts as standing, rad", at_most=1.5
    )
    max_standing_speed: float = setting(
        0.1, "largest speed at which walking may end in a posture, m/s", at_most=1.0
    )
    brake_time: float = setting(
        0.6, "in which the policy brings the robot to a stand after a fault, s", at_most=FALL_TIME
    )


class Supervisor:
    """Runs one mode at a time and answers the faults that its guards find.

    Attributes:
        mode: the present mode, one of MODES.
        reason: why it is in this mode, one sentence.
        fault: name of the guard that made the robot stop, "" if none did.
        findings: what is wrong now.
        limits: how often each limit of commands acted.
        command: the command in effect, (4,): vx, vy (m/s), wz (rad/s), 1 to stand and 0 to walk.
        walk_refusal: why the robot may not walk now, "" if it may.
        inference_seconds: duration of the network's last run, s; NaN where no network ran.
        duplicate_publisher: set from outside; the second source of states, a sentence, or None.
        overruns: set from outside; deadlines missed in a row.
        motors: set from outside; temperatures and errors of the motors.
        refused: set from outside; by topic, why the messages since the last accepted one were refused.
        stopped: set from outside; time that the controller did not run before the present state, s.
    """

    def __init__(
        self,
        policy: Policy,
        config: SupervisorConfig = SupervisorConfig(),
        backup: Estimator | None = None,
        guards: Iterable[type[Guard]] = GUARDS,
    ) -> None:
        self.config = c = config
        nominal = np.array(policy.metadata.nominal_q)
        self._command_limits = policy.metadata.limits
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
            "walk": self._after_walk,
            "lie_down": self._after_lie_down,
        }
        self._watch = GuardSet(guards)
        self._backup = BackupVelocity(backup)
        self._sight: GuardInput | None = (
            None  # of the last tick, while the rest of it is still to be looked at
        )
        self._limiter = CommandLimits(c)
        self.limits = self._limiter.counts
        self.mode, self.reason, self.fault = "passive", "waits for an order", ""
        self.findings: list[Finding] = []
        self._found: list[Finding] = []  # in whatever mode
        self.command = STANCE_COMMAND.copy()
        self.inference_seconds = float("nan")
        self.duplicate_publisher: str | None = None
        self.overruns = 0
        self.motors: MotorStatus | None = None
        self.refused: dict[str, MessageError] = {}
        self.stopped = 0.0
        self._auto_stand = c.auto_stand
        self._enabled = False
        self.neutral_seen = False  # a command to stand still came since a velocity could have been followed
        self._held: Finding | None = None  # what made the robot stop and stand
        self._held_since = 0.0  # s, on the clock of the states
        self._velocity = np.zeros(3)  # the last that was known
        self._last: Tick | None = None
        self._entered: float | None = None  # None: at the next tick
        self._previous = JointCommand.damping(c.damping_kd)

    @property
    def walk_refusal(self) -> str:
        """Why a velocity that is commanded now is not followed, a sentence; empty where it is."""
        if self.mode == "fault":
            return "the robot is in fault: request passive, then stand_up"
        if self.mode not in POSTURE_AFTER:
            return f"the robot is in mode {self.mode}, expected {' or '.join(POSTURE_AFTER)}"
        if self._held:
            return f"the robot was stopped ({self._held.sentence}): request stance when that is mended"
        if not self._operator_agrees:
            return "walking is not allowed yet: call ~/enable_walking"
        if not self.neutral_seen:
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
            self.neutral_seen = False
        self._enabled = enabled
        return True, "a command may start walking" if self._operator_agrees else "the robot stands still"

    def request(self, mode: str) -> tuple[bool, str]:
        """Ask for a mode; (taken or not, a sentence).

        "passive" is always taken and clears a fault. "stance" lets a robot walk again that was stopped and stands, where the
        cause is gone.
        """
        if mode not in MODES or mode == "fault":
            return False, f"mode is '{mode}', expected one of {', '.join(MODES[:-1])}"
        refusal = self._refusal(mode)
        if refusal:
            return False, refusal
        self._auto_stand = False
        if mode != self.mode:
            self._switch(mode, "was asked for")
        elif mode == "stance" and self._held:
            self._held, self.fault = None, ""
            self.reason = "was asked for"
        return True, f"mode is {mode}"

    def fail(self, reason: str, fault: str) -> None:
        """Latch damping until "passive" is requested. The first reason stays; a limp robot stays as it is."""
        if self.mode not in DAMPED_MODES:
            self._switch("fault", reason)
            self.fault = fault

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
        self._finish()
        self.command, unfit = self._limited(command)
        sight = self._look(now, state, None if velocity is None else np.asarray(velocity, float))
        if unfit and self.mode == "walk":
            level, modes, sentence = OTHER_FAULTS[unfit]
            refusal = self.refused.get("command") if command is None else None
            sentence = f"command is refused: {refusal}" if refusal else sentence
            self.findings.append(Finding(unfit, level, modes, sentence))
        self._act_on(self.findings, state.time)
        velocity = self._velocity_in_effect(sight)
        if self.mode == "walk" and self._speed > STEPPING_SPEED:
            self.command[3] = 0.0
        seen = self._seen(state, velocity)
        if self.config.reset_gap < sight.gap <= self.config.max_silence:
            self._walk.reset()
        if self.mode in self._after and (following := self._after[self.mode](seen)):
            self._switch(*following)
        answer = self._answer(seen)
        answer.tick = state.tick
        self._last, self._previous, self._sight = seen, answer, sight
        return answer

    def prepare(self) -> None:
        """Between two ticks, what can be done ahead of the next one, so that its answer comes sooner; may be left out."""
        if self.mode == "walk":
            self._walk.prepare()
        self._finish()

    def _finish(self) -> None:
        """What of the last tick could wait until it was answered: the slower guards, and the backup, which rests with the robot."""
        if self._sight is None:
            return
        self._watch.check_deferred(self._sight)
        if self.mode in DAMPED_MODES:
            self._backup.reset()
        else:
            self._backup.follow(self._sight.state)
        self._sight = None

    def _look(self, now: float, state: RobotState, velocity: Array | None) -> GuardInput:
        """Let the guards look at this tick; `findings` are those that matter in this mode."""
        before = self._last.state if self._last else None
        sight = GuardInput(
            config=self.config,
            mode=self.mode,
            state=state,
            before=before,
            age=now - state.time,
            gap=state.time - before.time if before else 0.0,
            asked=self._previous,
            velocity=velocity,
            backup=self._backup.velocity,
            moves=self.mode == "walk" and not self.command[3],
            overruns=self.overruns,
            motors=self.motors,
            duplicate_publisher=self.duplicate_publisher,
            refused=self.refused,
            stopped=self.stopped,
        )
        self._found = self._watch.check(sight)
        self.findings = [finding for finding in self._found if self.mode in finding.modes]
        return sight

    def _act_on(self, findings: list[Finding], time: float) -> None:
        """Latch damping, or let the robot stop and stand, for the first finding that asks for it."""
        for finding in findings:
            if finding.level is Level.DAMPING:
                self.fail(finding.sentence, finding.name)
                return
        for finding in findings:
            if finding.level is Level.STANCE and self._held is None:
                self._held, self._held_since = finding, time
                self.reason, self.fault = finding.sentence, finding.name
                self.neutral_seen = False
                self.command = STANCE_COMMAND.copy()

    def _velocity_in_effect(self, sight: GuardInput) -> Array | None:
        """The estimate, the backup's where that is missing or wrong, and what is left of the last one for a robot that brakes."""
        distrusted = any(finding.name in SPOIL_THE_ESTIMATE for finding in self._found)
        velocity = sight.backup if distrusted else sight.velocity
        if velocity is not None:
            self._velocity = velocity
        elif self.mode == "walk":
            velocity = self._velocity = self._velocity * math.exp(-max(sight.gap, 0.0) / MEMORY_OF_VELOCITY)
        return velocity

    def _answer(self, seen: Tick) -> JointCommand:
        mode = self._modes[self.mode]
        if self._entered is None:
            self._entered = seen.state.time
            seen = attrs.evolve(seen, elapsed=0.0)
            mode.enter(seen)
        try:
            answer = mode.tick(seen)
        except FloatingPointError as error:
            self.fail(str(error), "policy_not_finite")
            return JointCommand.damping(self.config.damping_kd)
        if self.mode == "walk":
            self.inference_seconds = self._walk.inference_seconds
        self._limiter.apply(answer, self._previous, seen.state)
        return answer

    @property
    def _speed(self) -> float:
        """The last that was known, m/s."""
        return float(np.linalg.norm(self._velocity))

    def _seen(self, state: RobotState, velocity: Array | None) -> Tick:
        elapsed = 0.0 if self._entered is None else state.time - self._entered
        return Tick(elapsed, state, velocity, self.command, self._previous)

    def _limited(self, command: ArrayLike | None) -> tuple[Array, str]:
        """The command in effect, and which of OTHER_FAULTS it has.

        Stand still where there is none, where it says so, is not finite, or is refused.
        """
        if command is None:
            not_finite = isinstance(self.refused.get("command"), NotFiniteError)
            return STANCE_COMMAND.copy(), "command_not_finite" if not_finite else "command_stale"
        numbers = np.asarray(command, float).tolist()
        if not _finite(numbers):
            return STANCE_COMMAND.copy(), "command_not_finite"
        stands = numbers[3] >= 0.5 or not any(numbers[:3])
        if stands and self._operator_agrees and not self._held and self.mode in POSTURE_AFTER:
            self.neutral_seen = True
        if numbers[3] >= 0.5 or not (self.neutral_seen and self._operator_agrees):
            return STANCE_COMMAND.copy(), ""
        held = self._command_limits.held(numbers[:3])
        return np.array([*held, 0.0]), "" if np.array_equal(held, numbers[:3]) else "command_out_of_range"

    def _switch(self, mode: str, reason: str) -> None:
        self.mode, self.reason = mode, reason
        self._entered = None
        if mode not in POSTURE_AFTER:
            self.neutral_seen = False
        if mode in DAMPED_MODES:
            self._enabled = False
            self._held, self.fault = None, ""
            self._walk.reset()

    def _forbids(self, mode: str) -> str | None:
        """What would end `mode` at once, a sentence: the second publisher that is there now, or what the last tick found."""
        found = (
            finding.sentence
            for finding in self._found
            if finding.level is Level.DAMPING
            and mode in finding.modes
            and finding.name != DuplicatePublisher.name()
        )
        return self.duplicate_publisher or next(found, None)

    def _refusal(self, mode: str) -> str | None:
        """Why this mode can't be had now; None where it can."""
        if mode == "passive":
            return None
        if mode == self.mode:
            return self._refusal_to_go_on() if mode == "stance" else None
        if self.mode == "fault":
            return f"is in fault ({self.reason}), request passive first"
        if self._last is None:
            return "the robot has not reported yet"
        if self.mode not in ALLOWED_FROM[mode]:
            return f"{mode} can't follow {self.mode}, expected {' or '.join(ALLOWED_FROM[mode])}"
        return self._forbids(mode) or self._refusal_of_move(mode, self._last)

    def _refusal_to_go_on(self) -> str | None:
        """Why a robot that was stopped and stands is not let go; None where it is, or was not stopped."""
        if self._held and any(finding.name == self._held.name for finding in self._found):
            return f"what stopped the robot is still there: {self._held.sentence}"
        return None

    def _refusal_of_move(self, mode: str, last: Tick) -> str | None:
        if mode == "walk":
            if self._held:
                return self.walk_refusal
            if not self._operator_agrees:
                return "walking is not allowed yet: call ~/enable_walking"
            if last.velocity is None:
                return "there is no fresh velocity estimate"
        if self.mode == "passive" and mode == "stance":
            return self._posture_error(last)
        if self.mode == "walk" and (not last.command[3] or self._speed > self.config.max_standing_speed):
            return f"the robot walks ({self._speed:.2f} m/s), command stance first"
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
        if self._auto_stand and self._forbids("stand_up") is None:
            self._auto_stand = False
            return "stand_up", "stands up by itself at the start"
        return None

    def _after_stand_up(self, seen: Tick) -> Following:
        if not self._stand_up.done(seen.elapsed):
            return None
        error = self._posture_error(seen)
        if error:
            self.fail(f"standing up failed: {error}", "stand_up_failed")
            return None
        return "stance", self._held.sentence if self._held else "stood up"

    def _after_stance(self, seen: Tick) -> Following:
        asked = not seen.command[3] and seen.command[:3].any()
        if asked and seen.velocity is not None and self._stance.done(seen.elapsed):
            return "walk", "a velocity was commanded"
        return None

    def _after_walk(self, seen: Tick) -> Following:
        """A robot that is stopped brakes on its policy, then stands."""
        if self._held is None:
            return None
        braked, c = seen.state.time - self._held_since, self.config
        still = self._speed <= c.max_standing_speed
        if braked < c.brake_time or not (still or braked >= PATIENCE_IN_BRAKING * c.brake_time):
            return None
        return "stance", self._held.sentence

    def _after_lie_down(self, seen: Tick) -> Following:
        return ("passive", "lies") if self._lie_down.done(seen.elapsed) else None


def _finite(numbers: Iterable[float]) -> bool:
    """For a few numbers quicker than NumPy."""
    return all(map(math.isfinite, numbers))
