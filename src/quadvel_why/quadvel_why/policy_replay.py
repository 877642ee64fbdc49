"""Replays the policy on what was recorded: are the recorded commands its actions, and if not, what would make them?

The observation is built by the controller's own function. A `Variant` is a hypothesis about what the controller did
differently; the right one reproduces the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array, Bools, Indices
from quadvel_description.network_input import InputLayout
from quadvel_policy.command_limits import JointCommandLimits
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.observation import JOINTS, build_observation
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import MIN_STEPPING_SPEED, STANCE_COMMAND

from .run import SAME_INSTANT_S, Run

Observe = Callable[[NDArray[np.float32], InputLayout], NDArray[np.float32]]
"""Changes a finished observation."""
MAX_FEED_FORWARD_NM = 1e-3
"""Feed-forward torque, N m, above which the joint-command limits acted.

A target is then not the action of the policy; neither is one with a torque near its limit.
"""
NEAR_LIMIT = 0.98
"""Share of a limit from which it may have changed the target."""
LEFT_OUT_JOINTS = 2
"""Joints of each tick, those furthest off, that an error leaves out.

Limits act on single joints of a robot that falls, a wrong observation or memory on all.
"""
BEFORE_FAULT_S = 0.25
"""Time before a fault, s, in which guards may already replace velocity and command."""
MIN_TICKS = 20
"""Fewest ticks that give an error."""
MODE_REPORT_PERIOD_S = 0.05
"""Longest time from the start of a walk to the first report of it."""


def term_slice(layout: InputLayout, name: str) -> slice:
    """Return the place of a term in an observation.

    Args:
        layout: The observation.
        name: Name of the term.

    Returns:
        Its slice.
    """
    sizes = [term.size for term in layout.terms]
    k = layout.names.index(name)
    return slice(sum(sizes[:k]), sum(sizes[: k + 1]))


@attrs.frozen
class Variant:
    """A hypothesis about what the controller did.

    Attributes:
        name: What it did, for people.
        observe: Change of the observation; None: none.
        reset_every: Ticks after which it cleared the memory; 0: never.
        late: Age of the states that it used, ticks; 0: the newest.
        with_recorded_actions: Whether the previous actions are the recorded ones, not those of the replay.
    """

    name: str
    observe: Observe | None = None
    reset_every: int = 0
    late: int = 0
    with_recorded_actions: bool = False


@attrs.frozen(eq=False)
class Replay:
    """A replay of k ticks.

    Attributes:
        time: Times of the states, (k,), s.
        expected: Targets of the policy, (k, 12), rad.
        recorded: Recorded targets, (k, 12), rad.
        valid: Targets that no limit changed, (k, 12).
    """

    time: Array
    expected: Array
    recorded: Array
    valid: Bools

    @cached_property
    def error(self) -> float:
        """Root mean square of recorded minus expected targets, of all but LEFT_OUT_JOINTS in each tick, rad."""
        return self.error_within(slice(None))

    def error_within(self, part: slice) -> float:
        """Return the error of some ticks.

        Args:
            part: The ticks.

        Returns:
            Root mean square without the LEFT_OUT_JOINTS furthest off in each tick, rad; NaN without
            valid ticks.
        """
        if self.valid[part].sum() < MIN_TICKS:
            return float("nan")
        return float(np.sqrt(np.nanmean(self._squares[part])))

    @property
    def usual_error(self) -> float:
        """Error that three of four ticks do not exceed, as `error`, rad; NaN without valid ticks."""
        if self.valid.sum() < MIN_TICKS:
            return float("nan")
        ticks = self._squares[np.isfinite(self._squares).any(axis=1)]
        return float(np.sqrt(np.percentile(np.nanmean(ticks, axis=1), 75.0)))

    @cached_property
    def _squares(self) -> Array:
        """Squared errors of all but LEFT_OUT_JOINTS, (k, 10), rad^2; NaN where a limit acted."""
        squares = np.where(self.valid, (self.recorded - self.expected) ** 2, np.nan)
        return np.sort(squares, axis=1)[:, :-LEFT_OUT_JOINTS]


class PolicyReplay:
    """Replays of one policy on one run of this stack.

    Attributes:
        policy: The policy.
        ticks: Rows of the commands that the policy gave, (k,), of the longest walk that was recorded
            from its beginning.
    """

    def __init__(self, run: Run, policy: PolicyFile) -> None:
        self._run, self.policy = run, policy
        self.ticks = self._policy_ticks()
        self._prepared: dict[int, NDArray[np.float32]] = {}

    @property
    def is_usable(self) -> bool:
        """Whether there is a walk with a velocity estimate to replay."""
        return len(self.ticks) >= MIN_TICKS and self._run.estimate is not None and self._run.imu is not None

    def _policy_ticks(self) -> Indices:
        """Return the rows of the longest walk's commands that differ from the command before."""
        run, commands = self._run, self._run.commands
        if run.modes is None or run.imu is None:
            return np.zeros(0, int)
        with_gains = np.isclose(commands.kp, np.array(self.policy.metadata.kp)).all(axis=1) & commands.servo
        # The mode is reported less often than commands leave: the fade-in changes kp from tick to tick.
        fading = np.zeros(len(commands.time), bool)
        fading[1:] = (np.abs(np.diff(commands.kp, axis=0)) > 1e-6).any(axis=1) & commands.servo[1:]
        longest = np.zeros(0, int)
        for begin in run.modes.begins("walk"):
            starts = np.flatnonzero(fading & (commands.time > begin - MODE_REPORT_PERIOD_S))
            if not starts.size:
                break
            first = int(starts[0]) - 1  # the first tick of a walk repeats the command before it
            stop = first + 1
            while stop < len(commands.time) and (with_gains[stop] or fading[stop]):
                stop += 1
            if stop - first > len(longest):
                longest = np.arange(first, stop)
        changed = (np.diff(commands.target[longest], axis=0, prepend=np.nan) != 0.0).any(axis=1)
        return longest[changed]

    @cached_property
    def _velocity_rows(self) -> Indices:
        """Estimate in use at each tick: the one of the state before."""
        assert self._run.estimate is not None
        answered = self._run.time[self._run.commands.answers[self.ticks]]
        rows = np.searchsorted(self._run.estimate.time, answered - SAME_INSTANT_S, side="left") - 1
        return np.maximum(rows, 0)

    @cached_property
    def _velocity_commands(self) -> Array:
        """vx, vy, wz and stance in effect at each tick, (k, 4)."""
        run = self._run
        answered = run.time[run.commands.answers[self.ticks]]
        if run.velocity_command is None:
            if run.effective_command is None:
                return np.tile(STANCE_COMMAND, (len(self.ticks), 1))
            return run.effective_command.latest_at(answered + SAME_INSTANT_S)
        asked = run.velocity_command.latest_at(answered + SAME_INSTANT_S)
        limits = self.policy.metadata.limits
        stands = (asked[:, 3] >= 0.5) | self._made_to_stand(answered)
        return np.array(
            [
                STANCE_COMMAND if still else [*limits.clamp(row[:3]), 0.0]
                for row, still in zip(asked, stands, strict=True)
            ]
        )

    def _made_to_stand(self, times: Array) -> Bools:
        """Return whether the controller reported a stand before and after each time, (k,)."""
        reports = self._run.effective_command
        if reports is None:
            return np.zeros(len(times), bool)
        before = np.searchsorted(reports.time, times + SAME_INSTANT_S, side="right") - 1
        after = np.minimum(before + 1, len(reports.time) - 1)
        stands = reports.value[:, 3] >= 0.5
        return np.asarray(stands[np.maximum(before, 0)] & stands[after])

    @cached_property
    def base(self) -> Replay:
        """The replay with the unchanged policy and observation."""
        return self.run(Variant("as the file says"))

    @cached_property
    def _fault_time(self) -> float:
        """Time of the first fault that was reported since the walk began, s; infinity without one."""
        modes, began = self._run.modes, self._run.commands.time[self.ticks[0]]
        assert modes is not None
        faults = (t for t, fault in zip(modes.time, modes.fault, strict=True) if fault and t >= began)
        return float(next(faults, np.inf))

    @cached_property
    def _limited(self) -> Bools:
        """Targets that the limits of joint commands may have changed, (k, 12)."""
        run, commands, ticks = self._run, self._run.commands, self.ticks
        rows, limits = commands.answers[ticks], JointCommandLimits()

        def torque(command: Indices) -> Array:
            asked = commands.kp[command] * (commands.target[command] - run.q[rows])
            return np.asarray(asked - commands.kd[command] * run.dq[rows])

        now, before = torque(ticks), torque(np.maximum(ticks - 1, 0))
        power = np.maximum(now * run.dq[rows], 0.0).sum(axis=1, keepdims=True)
        return np.asarray(
            (np.abs(commands.tau[ticks]) > MAX_FEED_FORWARD_NM)
            | (np.abs(now) > NEAR_LIMIT * run.robot.torque_limit)
            | (np.abs(now - before) > NEAR_LIMIT * limits.max_torque_step)
            | (np.abs(run.dq[rows]) > NEAR_LIMIT * run.robot.velocity_limit)
            | (power > NEAR_LIMIT * limits.max_power)
        )

    def _observations(self, late: int) -> NDArray[np.float32]:
        """Observations of all ticks without the previous actions, (k, 48)."""
        run = self._run
        assert run.imu is not None
        assert run.estimate is not None
        rows = np.maximum(run.commands.answers[self.ticks] - late, 0)
        velocity = run.estimate.value[self._velocity_rows]
        command = self._velocity_commands.copy()
        command[np.linalg.norm(velocity, axis=1) > MIN_STEPPING_SPEED, 3] = 0.0
        return build_observation(
            self.policy.metadata.observation,
            command=self._trimmed(command),
            quaternion=run.imu.quaternion[rows],
            q=run.q[rows],
            dq=run.dq[rows],
            linear_velocity=velocity,
            angular_velocity=run.imu.angular_velocity[rows],
            previous_action=np.zeros((len(rows), JOINTS)),
        )

    def _trimmed(self, command: Array) -> Array:
        """Add the reported trim, between reports interpolated, to the commands of all ticks, (k, 4)."""
        reports = self._run.trim
        if reports is None:
            return command
        answered = self._run.time[self._run.commands.answers[self.ticks]]
        trim = [np.interp(answered, reports.time, axis) for axis in reports.value.T]
        trimmed = command.copy()
        trimmed[:, :3] += np.where(command[:, 3:] < 0.5, np.array(trim).T, 0.0)
        return trimmed

    def run(self, variant: Variant, most: int | None = None) -> Replay:
        """Replay the walk: the observations of the recording with the actions of the replay.

        Args:
            variant: The hypothesis.
            most: Largest number of ticks; None: the whole walk.

        Returns:
            The replay.
        """
        meta, ticks = self.policy.metadata, self.ticks[:most]
        if variant.late not in self._prepared:
            self._prepared[variant.late] = self._observations(variant.late)
        observations = self._prepared[variant.late]
        term = next(term for term in meta.observation.terms if term.name == "previous_action")
        own = term_slice(meta.observation, term.name)
        bound = np.inf if term.clip is None else term.clip
        commands, time = self._run.commands, self._run.time[self._run.commands.answers[ticks]]
        recorded = (commands.target[ticks] - meta.action_offset) / meta.action_scale
        action, actions = np.zeros(JOINTS, np.float32), np.empty((len(ticks), JOINTS), np.float32)
        self.policy.reset()
        for k in range(len(ticks)):
            observation = observations[k].copy()
            if variant.with_recorded_actions and k:
                action = recorded[k - 1]
            observation[own] = np.clip((action - term.offset) * term.scale, -bound, bound)
            if variant.observe is not None:
                observation = variant.observe(observation, meta.observation)
            if variant.reset_every and k % variant.reset_every == 0:
                self.policy.reset()
            action = actions[k] = self.policy.step(observation)
        faded = time - time[0] >= SupervisorConfig().blend_time
        sound = time < self._fault_time - BEFORE_FAULT_S
        valid = ~self._limited[: len(ticks)] & (faded & sound)[:, None]
        return Replay(time, meta.action.targets(actions), commands.target[ticks], valid)

    def best(self, variants: Sequence[Variant], most: int) -> tuple[Variant, float]:
        """Return the variant that reproduces the commands best.

        Args:
            variants: The hypotheses.
            most: Number of ticks that decide.

        Returns:
            The variant and its error, rad.
        """
        errors = [self.run(variant, most).error for variant in variants]
        k = int(np.nanargmin(errors))
        return variants[k], errors[k]
