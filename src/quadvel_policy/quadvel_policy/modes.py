"""What the controller does in each of its modes: brake, move to a posture, let the policy drive.

A mode has `enter` and `tick`. When one may follow another, and what is unsafe, is the supervisor's matter.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Protocol

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.kinematics import foot_positions, inverse_kinematics, rotate_inverse
from quadvel_description.state import JointCommand, RobotState

from .observation import JOINTS, PolicyMetadata, build_observation

Array = NDArray[np.float64]

LEAN_TIME = 1.0  # s: shorter, it drives the sway of a standing robot on its own joints (decision 50)
MAX_LEAN = 0.35  # rad
UP = np.array([0.0, 0.0, 1.0])


class Policy(Protocol):
    """What a mode needs of a policy; `PolicyFile` is one."""

    metadata: PolicyMetadata

    def reset(self) -> None: ...

    def prepare(self) -> None: ...

    def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]: ...


@attrs.frozen
class Tick:
    """What a mode sees at one control tick."""

    elapsed: float
    """s since the mode was entered"""
    state: RobotState
    velocity: Array | None
    """(3,) m/s, body frame; None where there is no fresh estimate"""
    command: Array
    """(4,): vx, vy (m/s), wz (rad/s), stance, within limits"""
    previous: JointCommand
    """what the joints were asked for at the tick before"""


class Mode(Protocol):
    """One way to drive the joints."""

    def enter(self, tick: Tick) -> None: ...

    def tick(self, tick: Tick) -> JointCommand: ...


def blend(a: JointCommand, b: JointCommand, share: float) -> JointCommand:
    """The command whose torque is (1 - share) times a's plus share times b's, wherever the joints are."""
    kp_a, kp_b, kd_a, kd_b = (1 - share) * a.kp, share * b.kp, (1 - share) * a.kd, share * b.kd
    kp, kd = kp_a + kp_b, kd_a + kd_b
    return JointCommand(
        q=np.divide(kp_a * a.q + kp_b * b.q, kp, out=b.q.copy(), where=kp > 0),
        dq=np.divide(kd_a * a.dq + kd_b * b.dq, kd, out=b.dq.copy(), where=kd > 0),
        tau=(1 - share) * a.tau + share * b.tau,
        kp=kp,
        kd=kd,
    )


class Damping:
    """Every joint brakes."""

    def __init__(self, kd: float) -> None:
        self._kd = kd

    def enter(self, tick: Tick) -> None:
        """Nothing to prepare."""

    def tick(self, tick: Tick) -> JointCommand:
        """Damping, whatever the state."""
        return JointCommand.damping(self._kd)


def upright(state: RobotState) -> Array:
    """Where the vertical through the trunk's origin goes, 1 m below it in the trunk's frame: forward and left, (2,) m."""
    forward, left, up = -rotate_inverse(state.quaternion, UP)
    way = np.array([forward, left]) / max(-up, math.cos(MAX_LEAN))
    return way * min(1.0, math.tan(MAX_LEAN) / max(math.hypot(*way), 1e-9))


class Posture:
    """Moves smoothly through postures and holds the last one, leaning against slopes.

    path: (seconds, q (12,) rad) for each posture on level ground; kp (N m/rad), kd (N m s/rad): gains of every joint. The
    feet go as far uphill or downhill of where a posture has them as keeps them below the trunk, by the trunk's tilt, smoothed
    over LEAN_TIME and bounded by MAX_LEAN. It starts from the targets at which these gains ask for the torque that the mode
    before asked for, so that no torque jumps; from there on torque changes no faster than kp times the path's speed.
    """

    def __init__(self, path: Sequence[tuple[float, Array]], kp: float, kd: float) -> None:
        self._times = np.cumsum([0.0, *(seconds for seconds, _ in path)])
        self._postures = np.array([np.zeros(JOINTS), *(q for _, q in path)])
        self._feet = foot_positions(self._postures[1:])
        # Not zero where a knee bends the other way.
        self._offset = self._postures[1:] - inverse_kinematics(self._feet)
        self._kp, self._kd = np.full(JOINTS, kp), np.full(JOINTS, kd)
        self._lean, self._leant_at = np.zeros(2), 0.0

    def goal(self, state: RobotState) -> Array:
        """The posture at the end, (12,) rad, for a trunk that is tilted like this one."""
        goal: Array = self._leaning(upright(state))[-1]
        return goal

    def done(self, elapsed: float) -> bool:
        """Whether the path has ended `elapsed` seconds after the entry."""
        return bool(elapsed >= self._times[-1])

    def enter(self, tick: Tick) -> None:
        """Take the start of the path from the joints and from what they were asked for."""
        measured, asked = tick.state.q, tick.previous
        self._postures[0] = measured + (asked.kp * (asked.q - measured) + asked.tau) / self._kp
        self._lean, self._leant_at = upright(tick.state), tick.elapsed

    def tick(self, tick: Tick) -> JointCommand:
        """The posture on the path at this time."""
        share = 1.0 - math.exp(-max(tick.elapsed - self._leant_at, 0.0) / LEAN_TIME)
        self._lean, self._leant_at = self._lean + share * (upright(tick.state) - self._lean), tick.elapsed
        self._postures[1:] = self._leaning(self._lean)
        q, dq = self._at(tick.elapsed)
        return JointCommand(q=q, dq=dq, kp=self._kp, kd=self._kd)

    def _leaning(self, lean: Array) -> Array:
        """The postures of the path, (n, 12) rad, for this `upright`."""
        feet = self._feet.copy()
        feet[..., :2] -= feet[..., 2:].mean(axis=1, keepdims=True) * lean
        leaning: Array = inverse_kinematics(feet) + self._offset
        return leaning

    def _at(self, elapsed: float) -> tuple[Array, Array]:
        """Quintic between postures: q (rad) and dq (rad/s), at rest with no acceleration in each of them."""
        if self.done(elapsed):
            return self._postures[-1].copy(), np.zeros(JOINTS)
        leg = int(np.searchsorted(self._times, elapsed, side="right"))
        seconds = self._times[leg] - self._times[leg - 1]
        s = (elapsed - self._times[leg - 1]) / seconds
        way = self._postures[leg] - self._postures[leg - 1]
        place = s**3 * (10 - 15 * s + 6 * s**2)
        speed = 30 * s**2 * (1 - s) ** 2 / seconds
        return self._postures[leg - 1] + place * way, speed * way


class Walk:
    """The policy drives; on entry its torques fade in over `blend_time` (s).

    inference_seconds: what the last step of the network took.
    """

    def __init__(self, policy: Policy, blend_time: float) -> None:
        self._policy = policy
        self._blend_time = blend_time
        meta = policy.metadata
        self._observation, self._action = meta.observation, meta.action
        self._kp, self._kd = np.array(meta.kp), np.array(meta.kd)
        self._before = JointCommand.damping()
        self.inference_seconds = float("nan")
        self.reset()

    def reset(self) -> None:
        """Start the policy over: its memory and the action that it is told it took."""
        self._policy.reset()
        self._previous_action = np.zeros(JOINTS, np.float32)

    def prepare(self) -> None:
        """Let the policy do ahead what it can of its next step."""
        self._policy.prepare()

    def enter(self, tick: Tick) -> None:
        """Start the policy over, and remember what to fade from."""
        self.reset()
        self._before = tick.previous

    def tick(self, tick: Tick) -> JointCommand:
        """One step of the policy, with a velocity. Raises FloatingPointError if its output is not finite."""
        assert tick.velocity is not None  # the supervisor does not walk without one
        observation = build_observation(
            self._observation,
            command=tick.command,
            quaternion=tick.state.quaternion,
            q=tick.state.q,
            dq=tick.state.dq,
            linear_velocity=tick.velocity,
            angular_velocity=tick.state.angular_velocity,
            previous_action=self._previous_action,
        )
        start = time.perf_counter()
        self._previous_action = self._policy.step(observation)
        self.inference_seconds = time.perf_counter() - start
        asked = JointCommand(q=self._action.targets(self._previous_action), kp=self._kp, kd=self._kd)
        if tick.elapsed < self._blend_time:
            return blend(self._before, asked, tick.elapsed / self._blend_time)
        return asked
