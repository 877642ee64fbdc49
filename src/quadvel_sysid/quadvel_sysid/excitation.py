"""Excitation motions for identification, and proposals which one to record next.

An excitation is an array of joint targets every `PERIOD_S`, within the joints' range and speed.
`quadvel excite` sends them and records the response. `limit_torque` bounds the torque where the
state is known.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import attrs
import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.command_range import clip_to_command_range
from quadvel_description.kinematics import foot_jacobians, inverse_kinematics
from quadvel_description.quadruped import GRAVITY, JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_description.robot_name import DEFAULT_ROBOT, shipped_robots

PERIOD_S = 0.001
"""s between two targets."""
MAX_TORQUE_SHARE = 0.7
"""Share of the torque limit that a target may request."""
_LEG_PHASE = np.array([0.0, 2.0, 2.0, 0.0])
"""Phase k_{i,0} of each leg in Eq. 9: diagonal legs move together."""


def _duration_field(default: float) -> Any:
    """An attrs field for a duration, s."""
    return attrs.field(default=default, validator=[attrs.validators.gt(0.0), attrs.validators.lt(3600.0)])


@attrs.frozen
class Excitation(ABC):
    """A motion of all joints for a given duration.

    Attributes:
        suspended: Whether the robot has to be suspended, with its feet in the air.
        robot: The robot.
        seconds: Duration, s.
    """

    suspended: ClassVar[bool] = True
    robot: Robot
    seconds: float

    @property
    def kp(self) -> float:
        """Position gain that the motion is designed for, N m/rad."""
        return self.robot.kp

    @property
    def kd(self) -> float:
        """Speed gain that the motion is designed for, N m s/rad."""
        return self.robot.kd

    def targets(self) -> Array:
        """Compute the joint targets, within range and speed limits.

        Returns:
            (n, 12) targets, rad, one row every `PERIOD_S`.
        """
        targets = clip_to_command_range(self.robot, self._joint_targets(self._times()))
        return limit_speed(self.robot, targets)

    def support_torque(self) -> Array:
        """Compute the feed-forward torque that carries the robot on its feet.

        Returns:
            (n, 12) torque, N m, one row every `PERIOD_S`; 0 for motions in the air.
        """
        return np.zeros((len(self._times()), 12))

    def _times(self) -> Array:
        """Times (n,) of the targets, s."""
        return PERIOD_S * np.arange(round(self.seconds / PERIOD_S), dtype=np.float64)

    @abstractmethod
    def _joint_targets(self, t: Array) -> Array:
        """Joint targets (n, 12) at the times (n,), rad, before limits."""


def lift_profile(k: ArrayLike) -> Array:
    """Compute the lifting profile of a foot, Eq. 9 of the paper.

        h(k) = -2 k^3 + 3 k^2              0 <= k < 1 (up)
        h(k) = 2 k^3 - 9 k^2 + 12 k - 4    1 <= k < 2 (down)
        h(k) = 0                           2 <= k < 4 (on the ground)

    Args:
        k: Phase, of any shape.

    Returns:
        Share of the lifting height, same shape.
    """
    k = np.asarray(k, float)
    up, down = -2 * k**3 + 3 * k**2, 2 * k**3 - 9 * k**2 + 12 * k - 4
    shape: Array = np.where(k < 1.0, up, np.where(k < 2.0, down, 0.0))
    return shape


@attrs.frozen
class OnGround(Excitation):
    """Base of motions on the ground: diagonal feet are lifted in turn, straight up.

    Two feet carry the robot at any time, and it tips about the line between them until the next
    two touch the ground. The motion stays upright only with stiff legs: with the policy's gains
    they sag by 0.1 m and the trunk tips over within 3 s. The gains are therefore those with which
    the robot stands up. Feed-forward torque carries the weight, so that the feet follow Eq. 9.
    """

    suspended: ClassVar[bool] = False
    kp: ClassVar[float] = 150.0
    kd: ClassVar[float] = 4.0

    @abstractmethod
    def _foot_lift(self, t: Array) -> tuple[Array, Array]:
        """Share of its height that each foot is lifted by (n, 4), and the height (n,), m."""

    def _joint_targets(self, t: Array) -> Array:
        share, height = self._foot_lift(t)
        feet = np.empty((len(t), 4, 3))
        legs = self.robot.legs
        feet[...] = legs.hips
        feet[..., 1] += legs.lateral
        standing = -round(self.robot.nominal_height - self.robot.foot_radius, 6)  # m, relative to the hips
        feet[..., 2] = standing + height[:, None] * share
        return inverse_kinematics(self.robot, feet)

    @override
    def support_torque(self) -> Array:
        # Virtual work: the foot force f_z = m g share gives the torque -J_z^T f_z. The share of a foot
        # falls linearly with its lift.
        down = 1.0 - self._foot_lift(self._times())[0]
        force = self.robot.mass * GRAVITY * down / down.sum(axis=1, keepdims=True)
        jacobians = foot_jacobians(self.robot, self._joint_targets(self._times()))
        return -(jacobians[:, :, 2] * force[..., None]).reshape(-1, 12)


def _lift_of_feet(phase: Array) -> Array:
    """Lifting shares (n, 4) of the feet at the common phase (n,)."""
    return lift_profile((phase[:, None] + _LEG_PHASE) % 4.0)


@attrs.frozen
class FootLifting(OnGround):
    """The paper's trajectory, Eq. 9: diagonal feet lifted in turn.

    Attributes:
        seconds: Duration, s.
        rate: Phase rate, 1/s.
        height: Lifting height, m.
    """

    seconds: float = _duration_field(5.0)
    rate: float = 8.0
    height: float = 0.1

    def _foot_lift(self, t: Array) -> tuple[Array, Array]:
        return _lift_of_feet(self.rate * t), np.full(len(t), self.height)


@attrs.frozen
class Sweep(OnGround):
    """Foot lifting with varying rate and height, which combines many loads and speeds.

    Attributes:
        seconds: Duration, s.
        rates: Lowest and highest phase rate, 1/s.
        heights: Lowest and highest lifting height, m.
    """

    seconds: float = _duration_field(20.0)
    rates: tuple[float, float] = (5.0, 9.0)
    heights: tuple[float, float] = (0.03, 0.1)

    def _foot_lift(self, t: Array) -> tuple[Array, Array]:
        rate = _sweep_between(self.rates, np.sin(2 * np.pi * 2 * t / self.seconds))
        height = _sweep_between(self.heights, np.sin(2 * np.pi * 5 * t / self.seconds))
        return _lift_of_feet(np.cumsum(rate) * PERIOD_S), height


@attrs.frozen
class Chirp(Excitation):
    """All joints swing at once with rising frequencies, which separates lags, delays and inertias.

    Attributes:
        seconds: Duration, s.
        frequencies: First and last frequency, Hz; each joint has its own factor from 0.75 to
            1.25.
        amplitude: Amplitude, rad; less where the speed limit requires it.
    """

    seconds: float = _duration_field(20.0)
    frequencies: tuple[float, float] = (0.3, 20.0)
    amplitude: float = 0.35

    def _joint_targets(self, t: Array) -> Array:
        low, high = self.frequencies
        growth = np.log(high / low) / self.seconds
        frequency = low * np.exp(growth * t)[:, None] * np.linspace(0.75, 1.25, 12)
        fastest = 0.5 * self.robot.velocity_limit / (2 * np.pi * frequency)
        swing = np.minimum(self.amplitude, fastest) * np.sin(
            2 * np.pi * np.cumsum(frequency, axis=0) * PERIOD_S
        )
        return self.robot.nominal_q + _fade_in(t) * swing


@attrs.frozen
class Solo(Excitation):
    """One joint swings at a time while the others hold still, which shows coupling between joints.

    Attributes:
        seconds: Duration of all twelve swings, s.
        amplitude: Amplitude, rad.
    """

    seconds: float = _duration_field(36.0)
    amplitude: float = 0.4

    def _joint_targets(self, t: Array) -> Array:
        turn = self.seconds / 12
        targets = np.tile(self.robot.nominal_q, (len(t), 1))
        for joint in range(12):
            mine = (joint * turn <= t) & (t < (joint + 1) * turn)
            s = (t[mine] - joint * turn) / turn
            window = np.sin(np.pi * s) ** 2
            targets[mine, joint] += self.amplitude * window * np.sin(2 * np.pi * (2 * s + 6 * s**2))
        return targets


@attrs.frozen
class RandomSteps(Excitation):
    """Steps of random size at random times, which show torque limits, backlash and deadband.

    Attributes:
        seconds: Duration, s.
        sizes: Smallest and largest step, rad; uniform in the logarithm.
        holds: Shortest and longest time between steps, s.
        seed: Seed of the random numbers.
    """

    seconds: float = _duration_field(20.0)
    sizes: tuple[float, float] = (0.01, 0.6)
    holds: tuple[float, float] = (0.08, 0.5)
    seed: int = 0

    def _joint_targets(self, t: Array) -> Array:
        n = len(t)
        rng = np.random.default_rng(self.seed)
        targets = np.empty((n, 12))
        for joint in range(12):
            row, offset = 0, 0.0
            while row < n:
                hold = round(rng.uniform(*self.holds) / PERIOD_S)
                targets[row : row + hold, joint] = self.robot.nominal_q[joint] + offset
                row += hold
                size = np.exp(rng.uniform(*np.log(self.sizes)))
                offset = np.clip(offset - np.copysign(size, offset) * rng.choice([1, 1, -1]), -0.5, 0.5)
        return targets


@attrs.frozen
class Creep(Excitation):
    """Slow triangle waves over a wide range, which show static friction, cogging and springs.

    Attributes:
        seconds: Duration, s.
        amplitude: Amplitude, rad.
        periods: Period of the fastest and of the slowest joint, s.
    """

    seconds: float = _duration_field(40.0)
    amplitude: float = 0.5
    periods: tuple[float, float] = (4.0, 11.0)

    def _joint_targets(self, t: Array) -> Array:
        period = np.linspace(*self.periods, 12)
        triangle = 2 * np.abs(2 * ((t[:, None] / period + 0.25) % 1.0) - 1.0) - 1.0
        return self.robot.nominal_q - _fade_in(t) * self.amplitude * triangle


EXCITATIONS: dict[str, type[Excitation]] = {
    "foot-lifting": FootLifting,
    "sweep": Sweep,
    "chirp": Chirp,
    "steps": RandomSteps,
    "creep": Creep,
    "solo": Solo,
}
"""Excitations by the name that `quadvel excite` takes."""


def _sweep_between(bounds: tuple[float, float], wave: Array) -> Array:
    """Map a wave in [-1, 1] to the range between two bounds."""
    low, high = bounds
    return low + (high - low) * 0.5 * (1.0 + wave)


def _fade_in(t: Array) -> Array:
    """Smooth step from 0 to 1 over the first second, (n, 1)."""
    s = np.minimum(t, 1.0)[:, None]
    return s * s * (3.0 - 2.0 * s)


def limit_speed(robot: Robot, targets: Array) -> Array:
    """Limit the speed of targets to the joints' velocity limits.

    Args:
        robot: The robot.
        targets: (n, 12) targets, rad, one row every `PERIOD_S`.

    Returns:
        (n, 12) targets; a step that is too fast becomes a ramp.
    """
    slowed = targets.copy()
    reach = robot.velocity_limit * PERIOD_S
    for row in range(1, len(slowed)):
        before = slowed[row - 1]
        slowed[row] = np.minimum(np.maximum(slowed[row], before - reach), before + reach)
    return slowed


def limit_torque(
    robot: Robot, target: Array, q: Array, dq: Array, kp: float, kd: float, tau: ArrayLike = 0.0
) -> Array:
    """Limit a target so that it requests at most `MAX_TORQUE_SHARE` of the torque limit.

    Solves |kp (target - q) - kd dq + tau| <= bound for the target.

    Args:
        robot: The robot.
        target: (12,) target, rad.
        q: (12,) measured angles, rad.
        dq: (12,) measured speeds, rad/s.
        kp: Position gain, N m/rad.
        kd: Speed gain, N m s/rad.
        tau: Feed-forward torque that is sent with it, N m.

    Returns:
        (12,) limited target, rad.
    """
    bound = MAX_TORQUE_SHARE * robot.torque_limit
    offset = kd * dq - np.asarray(tau)
    return np.clip(target, q + (offset - bound) / kp, q + (offset + bound) / kp)


@attrs.frozen
class Proposal:
    """An excitation to record next, and what it would distinguish.

    Attributes:
        excitation: Key of `EXCITATIONS`.
        seconds: Duration, s.
        separates: Names of the effects, or descriptions of the residual, that it would
            distinguish.
        reason: Why this excitation distinguishes them.
        robot: Name or folder of the robot; "" for joints on a bench, which `quadvel excite` does not move.
    """

    excitation: str
    seconds: float
    separates: tuple[str, ...]
    reason: str
    robot: str

    @property
    def command(self) -> str:
        """The command that records it, as it is typed."""
        if not self.robot:
            return f"move the joints for {self.seconds:g} s as `quadvel excite {self.excitation}` moves a robot's"
        chosen = "" if self.robot == DEFAULT_ROBOT else f" --robot {self.robot}"
        return f"quadvel excite {self.excitation} --seconds {self.seconds:g}{chosen}"


_REASONS = {
    "chirp": "fast swings, in which a lag, a delay, a filter and an inertia turn the phase differently",
    "creep": "slow motion through the range and its turning points: angle and sign of the speed count alone",
    "steps": "large and small steps from rest, in which torque, speed and size of the error vary independently",
    "sweep": "many loads at every speed, for long enough that heat and supply change",
    "solo": "one joint at a time: what the resting ones show comes from the one that moves",
}
"""Reason for each excitation."""
_BEST_EXCITATION = {
    "armature": "chirp",
    "command_hold": "chirp",
    "first_order_lag": "chirp",
    "slew_limit": "chirp",
    "timestamp_skew": "chirp",
    "velocity_filter": "chirp",
    "cogging": "creep",
    "coulomb_friction": "creep",
    "hysteresis": "creep",
    "parallel_spring": "creep",
    "quadratic_drag": "creep",
    "stribeck_friction": "creep",
    "torque_offset": "creep",
    "viscous_friction": "creep",
    "load_dependent_friction": "sweep",
    "supply_sag": "sweep",
    "thermal_drift": "sweep",
    "cross_coupling": "solo",
}
"""Excitation that shows an effect best; "steps" for all other effects."""
_MIN_DURATION_S = {"thermal_drift": 300.0, "supply_sag": 60.0}
"""s; effects that need a longer recording."""
_EXCITATION_OF_SIGNAL = {
    "t": "sweep",
    "q": "creep",
    "dq": "creep",
    "ddq": "chirp",
    "q_des": "steps",
    "tau": "sweep",
}
"""Excitation that varies a signal most."""


def propose(report: Mapping[str, Any], robot: str = "") -> list[Proposal]:
    """Propose excitations that would settle what a report leaves open.

    Args:
        report: Content of report.json.
        robot: Name or folder of the robot; "" for the one of the report.

    Returns:
        One proposal for each excitation; empty if all effects are distinguished and the residual
        is white.
    """
    found: list[Proposal] = []
    if not robot and set(report["joints"]) & set(JOINT_NAMES):
        robot = report.get("robot", DEFAULT_ROBOT)
        robot = robot if robot in shipped_robots() else f"<folder of {robot}>"
    for effect in report["effects"]:
        names = (effect["name"], *effect["indistinguishable"])
        if len(names) > 1:
            kinds = dict.fromkeys(_BEST_EXCITATION.get(name, "steps") for name in names)
            found += [_make_proposal(kind, names, robot) for kind in kinds]
    unexplained = report["unexplained"]
    if unexplained["verdict"] == "structured":
        for signal in unexplained["depends_on"]:
            found.append(
                _make_proposal(_excitation_for_signal(signal), (f"what depends on {signal}",), robot)
            )
    return _merge_by_excitation(found)


def _excitation_for_signal(signal: str) -> str:
    """The excitation that varies a signal (q, tau@history, FR_thigh_joint/dq, ...) most."""
    if "/" in signal:
        return "solo"
    return "chirp" if "@" in signal else _EXCITATION_OF_SIGNAL.get(signal, "steps")


def _make_proposal(kind: str, separates: tuple[str, ...], robot: str) -> Proposal:
    """A proposal with the usual duration, or a longer one for slow effects."""
    usual: float = attrs.fields_dict(EXCITATIONS[kind])["seconds"].default  # type: ignore[assignment]
    slow = [_MIN_DURATION_S[name] for name in separates if kind == "sweep" and name in _MIN_DURATION_S]
    return Proposal(kind, max([usual, *slow]), separates, _REASONS[kind], robot)


def _merge_by_excitation(proposals: list[Proposal]) -> list[Proposal]:
    """Merge proposals of the same excitation, in the order of the first."""
    merged: dict[str, Proposal] = {}
    for new in proposals:
        old = merged.setdefault(new.excitation, new)
        names = tuple(dict.fromkeys((*old.separates, *new.separates)))
        merged[new.excitation] = attrs.evolve(old, separates=names, seconds=max(old.seconds, new.seconds))
    return list(merged.values())
