"""Supervisor of the controller: runs one mode at a time and answers the faults that `guards` finds.

Plain arrays and times in, joint commands out; it knows no ROS. `transitions` decides which mode
follows which, `modes` implements the modes, `command_limits` limits the joint commands.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import NotFiniteError

from .backup_velocity import BackupVelocity, Estimator
from .command_limits import JointCommandLimiter
from .config import SupervisorConfig
from .guard import WALK_MODES, Finding, Guard, GuardInput, GuardSet, Level
from .guards import GUARDS
from .guards.trunk import AccelerometerImplausible
from .guards.velocity import EstimateStale, EstimateWrong
from .modes import Damping, Mode, ModeInput, Policy, Posture, Walk
from .observation import VelocityCommandLimits
from .tick_input import TickInput
from .transitions import (
    DAMPED_MODES,
    VELOCITY_MODES,
    Situation,
    due_transition,
    request_refusal,
    walk_refusal,
)

NO_VELOCITY = VelocityCommandLimits((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
STANCE_COMMAND = np.array([0.0, 0.0, 0.0, 1.0])
VELOCITY_DECAY_S = 0.2
"""Decay time of the last known velocity while the robot brakes without an estimate."""
CONFIRMED_SHARE = 0.5
"""Share of the largest accepted difference of estimate and Kalman filter up to which a filter that
is some states behind confirms the estimate.
"""
MIN_STEPPING_SPEED = 0.2
"""m/s, above which a robot that must stand continues stepping: feet that stop under a moving trunk
trip it.
"""

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


class Supervisor:
    """Runs one mode at a time and answers the faults that its guards find.

    Attributes:
        fault: Name of the guard that made the robot stop, "" if none did.
        findings: What is wrong now.
        limits: How often each limit of joint commands acted.
        command: The command in effect, (4,): vx, vy (m/s), wz (rad/s), 1 to stand and 0 to walk.
        inference_seconds: Duration of the network's last run, s; NaN where no network ran.
    """

    def __init__(
        self,
        robot: Robot,
        policy: Policy | None,
        config: SupervisorConfig | None = None,
        backup: Estimator | None = None,
        guards: Iterable[type[Guard]] = GUARDS,
    ) -> None:
        """Create a supervisor in passive mode.

        Args:
            robot: The robot.
            policy: The policy that walks; None: the robot stands up, stands and lies down only.
            config: Gains, durations and limits; None for the defaults.
            backup: Filter that replaces a missing or wrong velocity estimate, and whose velocity the trim uses
                (`velocity_trim`; without it that of the estimate); None for none.
            guards: Guard classes, in priority order.

        Raises:
            ValueError: A limit exceeds what the robot's drives can do.
        """
        self._config = c = config or SupervisorConfig()
        c.check(robot)
        self._robot, self._bounds = robot, c.guards.joint_bounds(robot)
        self._command_limits = NO_VELOCITY if policy is None else policy.metadata.limits
        nominal = robot.nominal_q if policy is None else np.array(policy.metadata.nominal_q)
        paths = {
            "stand_up": [(c.fold_time, robot.lie_q), (c.rise_time, nominal)],
            "stance": [(c.settle_time, nominal)],
            "lie_down": [(c.lie_down_time, robot.lie_q)],
        }
        self._postures = {mode: Posture(robot, path, c.stand_kp, c.stand_kd) for mode, path in paths.items()}
        self._walk = policy and Walk(policy, c.blend_time, c.max_velocity_trim)
        damping = Damping(c.damping_kd)
        self._modes: dict[str, Mode] = {**self._postures, "passive": damping, "fault": damping}
        if self._walk:
            self._modes["walk"] = self._walk
        self._situation = Situation(c, self._postures["stance"], c.auto_stand, has_policy=policy is not None)
        self._guards, self._backup = GuardSet(guards), BackupVelocity(backup)
        self._deferred_input: GuardInput | None = None  # of the last tick, until the deferred guards have run
        self._limiter = JointCommandLimiter(robot, c.joint_limits)
        self.limits = self._limiter.counts
        self.fault = ""
        self.findings: list[Finding] = []
        self.command = STANCE_COMMAND.copy()
        self.inference_seconds = float("nan")
        self._entered_at: float | None = None  # s; None: the mode is entered at the next tick
        self._previous_answer = JointCommand.damping(c.damping_kd)

    @property
    def mode(self) -> str:
        """The present mode, one of MODES."""
        return self._situation.mode

    @property
    def reason(self) -> str:
        """Why the robot is in this mode, one sentence."""
        return self._situation.reason

    @property
    def trim(self) -> tuple[float, float, float]:
        """What is added to the commanded vx, vy (m/s) and wz (rad/s) now; zero unless the robot walks."""
        return self._walk.trim if self._walk and self.mode == "walk" else (0.0, 0.0, 0.0)

    @property
    def walk_refusal(self) -> str:
        """Why the robot does not follow a velocity now, one sentence; "" if it does."""
        return walk_refusal(self._situation)

    def enable_walking(self, enabled: bool) -> tuple[bool, str]:
        """Allow or forbid walking; a walking robot that is forbidden to walk stands still on its policy.

        The robot ignores a velocity that is commanded at that moment: a zero velocity must come
        first.

        A controller without `require_operator`, as that of a simulated robot, needs no permission: it
        refuses to forbid walking.

        Args:
            enabled: Whether walking is allowed.

        Returns:
            Whether the request was accepted, and a sentence.
        """
        now = self._situation
        if not self._config.require_operator:
            return enabled, "this robot needs no permission to walk; nothing was changed"
        if enabled and not now.is_walking_allowed:
            now.neutral_seen = False
        now.walking_enabled = enabled
        return True, "a command may start walking" if now.is_walking_allowed else "the robot stands still"

    def request(self, mode: str, requester: str = "") -> tuple[bool, str]:
        """Request a mode.

        "passive" is always accepted and clears a fault. "stance" clears the stop of a robot that
        stands, if its cause is gone. "stand_up" of a robot in stance changes nothing.

        Args:
            mode: One of MODES, except "fault".
            requester: Who asks, for the reason.

        Returns:
            Whether the request was accepted, and a sentence.
        """
        now = self._situation
        if (now.mode, mode) == ("stance", "stand_up"):
            return True, "the robot stands already"
        if refusal := request_refusal(mode, now):
            return False, refusal
        now.auto_stand = False
        reason = f"requested by {requester}" if requester else "requested"
        if mode != now.mode:
            self._switch(mode, reason)
        elif mode == "stance" and now.latch.cause:
            now.latch.open()
            now.reason, self.fault = reason, ""
        return True, f"mode is {mode}"

    def fail(self, reason: str, fault: str) -> None:
        """Latch damping until "passive" is requested, unless the joints are damped already; the first reason stays.

        Args:
            reason: One sentence.
            fault: Name of the fault.
        """
        if self.mode not in DAMPED_MODES:
            self._switch("fault", reason, fault)

    def tick(self, inputs: TickInput) -> JointCommand:
        """Run one control tick.

        The robot ignores stale commands: after each start, fault and stop, it walks only after it
        received a zero command while standing.

        Args:
            inputs: Everything that is known from outside.

        Returns:
            The joint command.
        """
        self.inference_seconds = float("nan")
        self.run_deferred()
        now, state = self._situation, inputs.state
        assert state is not None
        now.inputs = inputs
        self.command, command_fault = self._effective_command(inputs)
        guard_input = self._run_guards(state)
        if command_fault and now.mode == "walk":
            self.findings.append(_command_finding(command_fault, inputs))
        self._handle_findings(state.time)
        velocity = self._select_velocity(guard_input)
        if now.mode == "walk" and now.speed > MIN_STEPPING_SPEED:
            self.command[3] = 0.0
        elapsed = 0.0 if self._entered_at is None else state.time - self._entered_at
        mode_input = ModeInput(
            elapsed, state, velocity, self.command, self._previous_answer, self._backup.velocity
        )
        if self._walk and self._config.reset_gap < guard_input.gap <= self._config.guards.silence_limit:
            self._walk.reset()
        self._follow_table(mode_input)
        answer = self._run_mode(mode_input, guard_input)
        answer.tick = state.tick
        self._previous_answer, self._deferred_input = answer, guard_input
        return answer

    def run_deferred(self) -> None:
        """Run the deferred guards and the backup filter on the last tick, if they did not run yet.

        Call it after the answer left, so that the next tick takes less time; optional.
        """
        if self._deferred_input is None:
            return
        self._guards.check_deferred(self._deferred_input)
        if self.mode in DAMPED_MODES:
            self._backup.reset()
        else:
            self._backup.add(self._deferred_input.state)
        self._deferred_input = None

    def _run_guards(self, state: RobotState) -> GuardInput:
        """Run the immediate guards; `findings` are those that have an effect in this mode."""
        now, inputs = self._situation, self._situation.inputs
        before = now.last.state if now.last else None
        velocity = None if inputs.velocity is None else np.asarray(inputs.velocity, float)
        self._backup.confirm(velocity, CONFIRMED_SHARE * self._config.guards.max_velocity_error)
        guard_input = GuardInput(
            robot=self._robot,
            bounds=self._bounds,
            config=self._config.guards,
            mode=now.mode,
            state=state,
            previous=before,
            age=inputs.now - state.time,
            gap=state.time - before.time if before else 0.0,
            command=self._previous_answer,
            velocity=velocity,
            backup=self._backup.velocity,
            is_moving=now.mode == "walk" and not self.command[3],
            overruns=inputs.overruns,
            motors=inputs.motors,
            duplicate_publisher=inputs.duplicate_publisher,
            refused=inputs.refused,
            stopped=inputs.stopped,
        )
        now.findings = self._guards.check(guard_input)
        self.findings = [finding for finding in now.findings if now.mode in finding.modes]
        return guard_input

    def _handle_findings(self, time: float) -> None:
        """Latch damping or the stop for the first finding that requires it; `time`: of the state, s."""
        now = self._situation
        for finding in self.findings:
            if finding.level is Level.DAMPING:
                self.fail(finding.sentence, finding.name)
                return
        for finding in self.findings:
            if finding.level is Level.STANCE and now.latch.cause is None:
                now.latch.close(finding, time)
                now.reason, self.fault = finding.sentence, finding.name
                now.neutral_seen = False
                self.command = STANCE_COMMAND.copy()

    def _select_velocity(self, guard_input: GuardInput) -> Array | None:
        """Return the estimate, else the backup velocity; in walk without both, the decaying last velocity.

        v' = v exp(-dt / VELOCITY_DECAY_S)
        """
        now = self._situation
        distrusted = any(finding.name in UNTRUSTED_ESTIMATE_FAULTS for finding in now.findings)
        velocity = self._backup.newest() if distrusted else guard_input.velocity
        if velocity is not None:
            now.velocity = velocity
        elif now.mode == "walk":
            velocity = now.velocity = now.velocity * math.exp(-max(guard_input.gap, 0.0) / VELOCITY_DECAY_S)
        return velocity

    def _follow_table(self, mode_input: ModeInput) -> None:
        """Take the automatic transition that is due, if any."""
        now = self._situation
        posture = self._postures.get(now.mode)
        now.path_ended = posture is not None and posture.is_finished(mode_input.elapsed)
        now.last = mode_input
        if due := due_transition(now):
            mode, entry = due
            now.auto_stand = False
            self._switch(mode, entry.reason(now), entry.fault)

    def _run_mode(self, mode_input: ModeInput, guard_input: GuardInput) -> JointCommand:
        mode = self._modes[self.mode]
        if self._entered_at is None:
            self._entered_at = mode_input.state.time
            mode_input = attrs.evolve(mode_input, elapsed=0.0)
            mode.enter(mode_input)
        try:
            answer = mode.tick(mode_input)
        except FloatingPointError as error:
            self.fail(str(error), "policy_not_finite")
            return JointCommand.damping(self._config.damping_kd)
        if self._walk and self.mode == "walk":
            self.inference_seconds = self._walk.inference_seconds
        self._limiter.apply(answer, guard_input.commanded_torque, mode_input.state)
        return answer

    def _effective_command(self, inputs: TickInput) -> tuple[Array, str]:
        """Return the command in effect, and its fault of SUPERVISOR_FAULTS or "".

        Without a valid, finite command that is allowed to move the robot, the effective command is
        to stand.
        """
        now = self._situation
        if inputs.command is None:
            not_finite = isinstance(inputs.refused.get("command"), NotFiniteError)
            return STANCE_COMMAND.copy(), "command_not_finite" if not_finite else "command_stale"
        numbers = np.asarray(inputs.command, float).tolist()
        if not _all_finite(numbers):
            return STANCE_COMMAND.copy(), "command_not_finite"
        stands = numbers[3] >= 0.5 or not any(numbers[:3])
        if stands and now.is_walking_allowed and not now.latch.cause and now.mode in VELOCITY_MODES:
            now.neutral_seen = True
        if numbers[3] >= 0.5 or not (now.neutral_seen and now.is_walking_allowed):
            return STANCE_COMMAND.copy(), ""
        clamped = self._command_limits.clamp(numbers[:3])
        return np.array([*clamped, 0.0]), "" if clamped == tuple(numbers[:3]) else "command_out_of_range"

    def _switch(self, mode: str, reason: str, fault: str = "") -> None:
        now = self._situation
        now.mode, now.reason = mode, reason
        self._entered_at = None
        if mode not in VELOCITY_MODES:
            now.neutral_seen = False
        if mode in DAMPED_MODES:
            now.walking_enabled = False
            now.latch.open()
            self.fault = fault
            if self._walk:
                self._walk.reset()


def _command_finding(fault: str, inputs: TickInput) -> Finding:
    """Return the finding of an unfit command."""
    level, modes, sentence = SUPERVISOR_FAULTS[fault]
    refusal = inputs.refused.get("command") if inputs.command is None else None
    return Finding(fault, level, modes, f"command is refused: {refusal}" if refusal else sentence)


def _all_finite(numbers: Iterable[float]) -> bool:
    """Return whether all numbers are finite; faster than NumPy for a few numbers."""
    return all(map(math.isfinite, numbers))
