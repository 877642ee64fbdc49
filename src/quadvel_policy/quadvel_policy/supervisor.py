"""Supervisor of the controller: transitions between modes, and responses to the faults that `guards` finds.

Plain arrays and times in, joint commands out; it knows no ROS. `modes` implements the modes,
`command_limits` limits the joint commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.robot import JOINT_NAMES, LIE_Q
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import MessageError, NotFiniteError

from .backup_velocity import BackupVelocity, Estimator
from .command_limits import JointCommandLimiter, JointCommandLimits
from .guard import (
    FALL_TIME_S,
    WALK_MODES,
    Finding,
    Guard,
    GuardConfig,
    GuardInput,
    GuardSet,
    Level,
    MotorStatus,
)
from .guards import GUARDS, AccelerometerImplausible, DuplicatePublisher, EstimateStale, EstimateWrong
from .modes import Damping, Mode, ModeInput, Policy, Posture, Walk
from .settings import setting

MODES = ("passive", "stand_up", "stance", "walk", "lie_down", "fault")
"""Names of the modes, in the order of the constants of quadvel_msgs/ControllerState."""
DAMPED_MODES = ("passive", "fault")
ALLOWED_FROM = {
    "stand_up": ("passive", "lie_down"),
    "stance": ("passive", "walk"),
    "walk": ("stance",),
    "lie_down": ("stand_up", "stance", "walk"),
}
"""For each mode, the modes from which it may be requested; passive may always be requested."""
VELOCITY_MODES = ("stance", "walk")
"""Modes in which the robot follows a velocity command."""
STANCE_COMMAND = np.array([0.0, 0.0, 0.0, 1.0])
VELOCITY_DECAY_S = 0.2
"""Decay time of the last known velocity while the robot brakes without an estimate."""
MIN_STEPPING_SPEED = 0.2
"""m/s, above which a robot that must stand continues stepping: feet that stop under a moving trunk
trip it.
"""
MAX_STIFFNESS, MAX_DAMPING = 1000.0, 50.0
"""N m/rad and N m s/rad; larger gains make the legs oscillate."""
MAX_BRAKE_TIME_FACTOR = 1.8  # of `brake_time`, after which a moving robot goes to stance anyway

UNTRUSTED_ESTIMATE_FAULTS = {
    guard.name() for guard in (EstimateStale, EstimateWrong, AccelerometerImplausible)
}
"""Faults with which the backup velocity replaces the estimate."""

SUPERVISOR_FAULTS: dict[str, tuple[Level, tuple[str, ...], str]] = {
    "stand_up_failed": (
        Level.DAMPING,
        ("stand_up",),
        "Standing up ended more than `max_posture_error` from the nominal posture.",
    ),
    "policy_not_finite": (Level.DAMPING, WALK_MODES, "The policy's output is not finite."),
    "command_stale": (
        Level.LIMIT,
        WALK_MODES,
        "There is no fresh command: the robot stands still on its policy.",
    ),
    "command_not_finite": (
        Level.LIMIT,
        WALK_MODES,
        "A command is not finite: the robot stands still on its policy.",
    ),
    "command_out_of_range": (
        Level.LIMIT,
        WALK_MODES,
        "A command exceeds the limits of the policy: it is clamped to them.",
    ),
}
"""Faults that the supervisor detects itself: level, modes and condition by name."""

Transition = tuple[str, str] | None
"""Next mode and reason, or None."""


@attrs.frozen(kw_only=True)
class SupervisorConfig(GuardConfig, JointCommandLimits):
    """Gains and durations of the modes, limits of guards and commands; each field is a node parameter."""

    auto_stand: bool = setting(False, "stand up once, automatically, as soon as the robot reports")
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
    blend_time: float = setting(0.15, "over which the policy's torques fade in, s", at_most=FALL_TIME_S)
    reset_gap: float = setting(
        0.02, "time without a state after which the policy's memory is reset, s", at_most=FALL_TIME_S
    )
    max_posture_error: float = setting(
        0.35, "largest joint error at which the robot counts as standing, rad", at_most=1.5
    )
    max_standing_speed: float = setting(
        0.1, "largest speed at which walking may end in a posture, m/s", at_most=1.0
    )
    brake_time: float = setting(
        0.6, "in which the policy brings the robot to a stand after a fault, s", at_most=FALL_TIME_S
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
        refused: set from outside; by topic, why the messages since the last accepted one were
            refused.
        stopped: set from outside; time that the controller did not run before the present state, s.
    """

    def __init__(
        self,
        policy: Policy,
        config: SupervisorConfig = SupervisorConfig(),
        backup: Estimator | None = None,
        guards: Iterable[type[Guard]] = GUARDS,
    ) -> None:
        """Create a supervisor in passive mode.

        Args:
            policy: The policy that walks.
            config: Gains, durations and limits.
            backup: Filter that replaces a missing or wrong velocity estimate; None for none.
            guards: Guard classes, in priority order.
        """
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
        self._transitions: dict[str, Callable[[ModeInput], Transition]] = {
            "passive": self._next_from_passive,
            "stand_up": self._next_from_stand_up,
            "stance": self._next_from_stance,
            "walk": self._next_from_walk,
            "lie_down": self._next_from_lie_down,
        }
        self._guards = GuardSet(guards)
        self._backup = BackupVelocity(backup)
        self._deferred_input: GuardInput | None = (
            None  # of the last tick, while the rest of it is still to be looked at
        )
        self._limiter = JointCommandLimiter(c)
        self.limits = self._limiter.counts
        self.mode, self.reason, self.fault = "passive", "waiting for a mode request", ""
        self.findings: list[Finding] = []
        self._all_findings: list[Finding] = []  # in all modes
        self.command = STANCE_COMMAND.copy()
        self.inference_seconds = float("nan")
        self.duplicate_publisher: str | None = None
        self.overruns = 0
        self.motors: MotorStatus | None = None
        self.refused: dict[str, MessageError] = {}
        self.stopped = 0.0
        self._auto_stand = c.auto_stand
        self._walking_enabled = False
        self.neutral_seen = False  # a zero command has arrived since the robot was ready to walk
        self._latched_stop: Finding | None = None  # the fault that made the robot stop and stand
        self._latched_at = 0.0  # s, on the clock of the states
        self._velocity = np.zeros(3)  # m/s, the last known one
        self._last_input: ModeInput | None = None
        self._entered_at: float | None = None  # s; None: the mode is entered at the next tick
        self._previous_answer = JointCommand.damping(c.damping_kd)

    @property
    def walk_refusal(self) -> str:
        """Reason why the robot does not follow a velocity now, one sentence; "" if it does."""
        if self.mode == "fault":
            return "the robot is in fault: request passive, then stand_up"
        if self.mode not in VELOCITY_MODES:
            return f"the robot is in mode {self.mode}, expected {' or '.join(VELOCITY_MODES)}"
        if self._latched_stop:
            return (
                f"the robot was stopped ({self._latched_stop.sentence}): request stance when that is mended"
            )
        if not self._is_walking_allowed:
            return "walking is not allowed yet: call ~/enable_walking"
        if not self.neutral_seen:
            return "a zero velocity has to be commanded first"
        return ""

    @property
    def _is_walking_allowed(self) -> bool:
        return self._walking_enabled or not self.config.require_operator

    def enable_walking(self, enabled: bool) -> tuple[bool, str]:
        """Allow or forbid walking; a walking robot that is forbidden to walk stands still on its policy.

        The robot ignores a velocity that is commanded at that moment: a zero velocity must come
        first.

        Args:
            enabled: Whether walking is allowed.

        Returns:
            Whether the request was accepted, and a sentence.
        """
        if enabled and not self._is_walking_allowed:
            self.neutral_seen = False
        self._walking_enabled = enabled
        return True, "a command may start walking" if self._is_walking_allowed else "the robot stands still"

    def request(self, mode: str) -> tuple[bool, str]:
        """Request a mode.

        "passive" is always accepted and clears a fault. "stance" clears the stop of a robot that
        stands, if its cause is gone.

        Args:
            mode: One of MODES, except "fault".

        Returns:
            Whether the request was accepted, and a sentence.
        """
        if mode not in MODES or mode == "fault":
            return False, f"mode is '{mode}', expected one of {', '.join(MODES[:-1])}"
        refusal = self._mode_refusal(mode)
        if refusal:
            return False, refusal
        self._auto_stand = False
        if mode != self.mode:
            self._switch(mode, "requested")
        elif mode == "stance" and self._latched_stop:
            self._latched_stop, self.fault = None, ""
            self.reason = "requested"
        return True, f"mode is {mode}"

    def fail(self, reason: str, fault: str) -> None:
        """Latch damping until "passive" is requested, unless the joints are damped already; the first reason stays.

        Args:
            reason: One sentence.
            fault: Name of the fault.
        """
        if self.mode not in DAMPED_MODES:
            self._switch("fault", reason)
            self.fault = fault

    def tick(
        self, now: float, state: RobotState, velocity: ArrayLike | None, command: ArrayLike | None
    ) -> JointCommand:
        """Run one control tick.

        The robot ignores stale commands: after each start, fault and stop, it walks only after it
        received a zero command while standing.

        Args:
            now: Time, s, on the clock of `state.time`.
            state: The measured state.
            velocity: Velocity of the trunk, body frame, (3,), m/s; None without a fresh estimate.
            command: vx, vy (m/s), wz (rad/s), stance (0 or 1), (4,); None without a fresh command,
                then the robot stands.

        Returns:
            The joint command.
        """
        self.inference_seconds = float("nan")
        self._run_deferred()
        self.command, unfit = self._effective_command(command)
        guard_input = self._run_guards(now, state, None if velocity is None else np.asarray(velocity, float))
        if unfit and self.mode == "walk":
            level, modes, sentence = SUPERVISOR_FAULTS[unfit]
            refusal = self.refused.get("command") if command is None else None
            sentence = f"command is refused: {refusal}" if refusal else sentence
            self.findings.append(Finding(unfit, level, modes, sentence))
        self._handle_findings(self.findings, state.time)
        velocity = self._select_velocity(guard_input)
        if self.mode == "walk" and self._speed > MIN_STEPPING_SPEED:
            self.command[3] = 0.0
        mode_input = self._mode_input(state, velocity)
        if self.config.reset_gap < guard_input.gap <= self.config.silence_limit:
            self._walk.reset()
        if self.mode in self._transitions and (following := self._transitions[self.mode](mode_input)):
            self._switch(*following)
        answer = self._run_mode(mode_input)
        answer.tick = state.tick
        self._last_input, self._previous_answer, self._deferred_input = mode_input, answer, guard_input
        return answer

    def prepare(self) -> None:
        """Do work ahead of the next tick, so that its answer takes less time; optional."""
        if self.mode == "walk":
            self._walk.prepare()
        self._run_deferred()

    def _run_deferred(self) -> None:
        """Run the deferred guards and the backup filter on the last tick, after its answer."""
        if self._deferred_input is None:
            return
        self._guards.check_deferred(self._deferred_input)
        if self.mode in DAMPED_MODES:
            self._backup.reset()
        else:
            self._backup.update(self._deferred_input.state)
        self._deferred_input = None

    def _run_guards(self, now: float, state: RobotState, velocity: Array | None) -> GuardInput:
        """Run the immediate guards; `findings` are those that have an effect in this mode."""
        before = self._last_input.state if self._last_input else None
        guard_input = GuardInput(
            config=self.config,
            mode=self.mode,
            state=state,
            previous=before,
            age=now - state.time,
            gap=state.time - before.time if before else 0.0,
            command=self._previous_answer,
            velocity=velocity,
            backup=self._backup.velocity,
            is_moving=self.mode == "walk" and not self.command[3],
            overruns=self.overruns,
            motors=self.motors,
            duplicate_publisher=self.duplicate_publisher,
            refused=self.refused,
            stopped=self.stopped,
        )
        self._all_findings = self._guards.check(guard_input)
        self.findings = [finding for finding in self._all_findings if self.mode in finding.modes]
        return guard_input

    def _handle_findings(self, findings: list[Finding], time: float) -> None:
        """Latch damping or the stop for the first finding that requires it."""
        for finding in findings:
            if finding.level is Level.DAMPING:
                self.fail(finding.sentence, finding.name)
                return
        for finding in findings:
            if finding.level is Level.STANCE and self._latched_stop is None:
                self._latched_stop, self._latched_at = finding, time
                self.reason, self.fault = finding.sentence, finding.name
                self.neutral_seen = False
                self.command = STANCE_COMMAND.copy()

    def _select_velocity(self, guard_input: GuardInput) -> Array | None:
        """Return the estimate, else the backup velocity; in walk without both, the decaying last velocity.

        v' = v exp(-dt / VELOCITY_DECAY_S)
        """
        distrusted = any(finding.name in UNTRUSTED_ESTIMATE_FAULTS for finding in self._all_findings)
        velocity = guard_input.backup if distrusted else guard_input.velocity
        if velocity is not None:
            self._velocity = velocity
        elif self.mode == "walk":
            velocity = self._velocity = self._velocity * math.exp(
                -max(guard_input.gap, 0.0) / VELOCITY_DECAY_S
            )
        return velocity

    def _run_mode(self, mode_input: ModeInput) -> JointCommand:
        mode = self._modes[self.mode]
        if self._entered_at is None:
            self._entered_at = mode_input.state.time
            mode_input = attrs.evolve(mode_input, elapsed=0.0)
            mode.enter(mode_input)
        try:
            answer = mode.tick(mode_input)
        except FloatingPointError as error:
            self.fail(str(error), "policy_not_finite")
            return JointCommand.damping(self.config.damping_kd)
        if self.mode == "walk":
            self.inference_seconds = self._walk.inference_seconds
        self._limiter.apply(answer, self._previous_answer, mode_input.state)
        return answer

    @property
    def _speed(self) -> float:
        """Last known speed, m/s."""
        return float(np.linalg.norm(self._velocity))

    def _mode_input(self, state: RobotState, velocity: Array | None) -> ModeInput:
        elapsed = 0.0 if self._entered_at is None else state.time - self._entered_at
        return ModeInput(elapsed, state, velocity, self.command, self._previous_answer)

    def _effective_command(self, command: ArrayLike | None) -> tuple[Array, str]:
        """Return the command in effect, and its fault of SUPERVISOR_FAULTS or "".

        Without a valid, finite command that is allowed to move the robot, the effective command is
        to stand.
        """
        if command is None:
            not_finite = isinstance(self.refused.get("command"), NotFiniteError)
            return STANCE_COMMAND.copy(), "command_not_finite" if not_finite else "command_stale"
        numbers = np.asarray(command, float).tolist()
        if not _all_finite(numbers):
            return STANCE_COMMAND.copy(), "command_not_finite"
        stands = numbers[3] >= 0.5 or not any(numbers[:3])
        if stands and self._is_walking_allowed and not self._latched_stop and self.mode in VELOCITY_MODES:
            self.neutral_seen = True
        if numbers[3] >= 0.5 or not (self.neutral_seen and self._is_walking_allowed):
            return STANCE_COMMAND.copy(), ""
        clamped = self._command_limits.clamp(numbers[:3])
        is_within = np.array_equal(clamped, numbers[:3])
        return np.array([*clamped, 0.0]), "" if is_within else "command_out_of_range"

    def _switch(self, mode: str, reason: str) -> None:
        self.mode, self.reason = mode, reason
        self._entered_at = None
        if mode not in VELOCITY_MODES:
            self.neutral_seen = False
        if mode in DAMPED_MODES:
            self._walking_enabled = False
            self._latched_stop, self.fault = None, ""
            self._walk.reset()

    def _blocking_fault(self, mode: str) -> str | None:
        """Return a fault that would end `mode` immediately, one sentence, or None.

        This is a second publisher that exists now, or a finding of the last tick.
        """
        found = (
            finding.sentence
            for finding in self._all_findings
            if finding.level is Level.DAMPING
            and mode in finding.modes
            and finding.name != DuplicatePublisher.name()
        )
        return self.duplicate_publisher or next(found, None)

    def _mode_refusal(self, mode: str) -> str | None:
        """Return why this mode cannot be entered now, or None."""
        if mode == "passive":
            return None
        if mode == self.mode:
            return self._release_refusal() if mode == "stance" else None
        if self.mode == "fault":
            return f"is in fault ({self.reason}), request passive first"
        if self._last_input is None:
            return "the robot has not reported yet"
        if self.mode not in ALLOWED_FROM[mode]:
            return f"{mode} can't follow {self.mode}, expected {' or '.join(ALLOWED_FROM[mode])}"
        return self._blocking_fault(mode) or self._transition_refusal(mode, self._last_input)

    def _release_refusal(self) -> str | None:
        """Return why a stopped robot cannot be released, or None if it can or was not stopped."""
        if self._latched_stop and any(
            finding.name == self._latched_stop.name for finding in self._all_findings
        ):
            return f"what stopped the robot is still there: {self._latched_stop.sentence}"
        return None

    def _transition_refusal(self, mode: str, last: ModeInput) -> str | None:
        if mode == "walk":
            if self._latched_stop:
                return self.walk_refusal
            if not self._is_walking_allowed:
                return "walking is not allowed yet: call ~/enable_walking"
            if last.velocity is None:
                return "there is no fresh velocity estimate"
        if self.mode == "passive" and mode == "stance":
            return self._posture_error(last)
        if self.mode == "walk" and (not last.command[3] or self._speed > self.config.max_standing_speed):
            return f"the robot walks ({self._speed:.2f} m/s), command stance first"
        return None

    def _posture_error(self, mode_input: ModeInput) -> str | None:
        """Return a sentence if a joint is far from the nominal posture, else None."""
        error = mode_input.state.q - self._stance.final_posture(mode_input.state)
        i = int(np.argmax(np.abs(error)))
        if abs(error[i]) <= self.config.max_posture_error:
            return None
        limit = self.config.max_posture_error
        return f"{JOINT_NAMES[i]} is {error[i]:+.2f} rad off the nominal posture, limit {limit:.2f}"

    def _next_from_passive(self, mode_input: ModeInput) -> Transition:
        if self._auto_stand and self._blocking_fault("stand_up") is None:
            self._auto_stand = False
            return "stand_up", "stands up by itself at the start"
        return None

    def _next_from_stand_up(self, mode_input: ModeInput) -> Transition:
        if not self._stand_up.is_finished(mode_input.elapsed):
            return None
        error = self._posture_error(mode_input)
        if error:
            self.fail(f"standing up failed: {error}", "stand_up_failed")
            return None
        return "stance", self._latched_stop.sentence if self._latched_stop else "stood up"

    def _next_from_stance(self, mode_input: ModeInput) -> Transition:
        asked = not mode_input.command[3] and mode_input.command[:3].any()
        if asked and mode_input.velocity is not None and self._stance.is_finished(mode_input.elapsed):
            return "walk", "a velocity was commanded"
        return None

    def _next_from_walk(self, mode_input: ModeInput) -> Transition:
        """After a stop, go to stance once the policy has braked the robot."""
        if self._latched_stop is None:
            return None
        braked, c = mode_input.state.time - self._latched_at, self.config
        still = self._speed <= c.max_standing_speed
        if braked < c.brake_time or not (still or braked >= MAX_BRAKE_TIME_FACTOR * c.brake_time):
            return None
        return "stance", self._latched_stop.sentence

    def _next_from_lie_down(self, mode_input: ModeInput) -> Transition:
        return ("passive", "lies") if self._lie_down.is_finished(mode_input.elapsed) else None


def _all_finite(numbers: Iterable[float]) -> bool:
    """Return whether all numbers are finite; faster than NumPy for a few numbers."""
    return all(map(math.isfinite, numbers))
