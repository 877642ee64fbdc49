"""Motions that make the joints show what they are: joint targets over time, and which one to record next.

Pure arrays; who sends them and records the answer is `quadvel excite`. Every excitation gives its targets on the
grid of `PERIOD`, held to the joints' range and speed; the torque is bounded where the state is known, by
`within_torque`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description import robot
from quadvel_description.command_range import clip_to_command_range
from quadvel_description.kinematics import HIPS, foot_jacobians, inverse_kinematics

Array = NDArray[np.float64]

PERIOD = 0.001  # s, between two commands
TORQUE_SHARE = 0.7  # of the torque limit, that a target may ask for
_SIDE = np.array([robot.LEFT[leg] for leg in robot.LEGS], float)
_HEIGHT = -0.4  # m, of the feet below the hips, standing
_LEG_PHASE = np.array([0.0, 2.0, 2.0, 0.0])  # k_{i,0} of Eq. 9: diagonal legs together


def _seconds(default: float) -> Any:
    return attrs.field(default=default, validator=[attrs.validators.gt(0.0), attrs.validators.lt(3600.0)])


@attrs.frozen
class Excitation(ABC):
    """A motion of `seconds`.

    hung: to be done with the robot hung, its feet in the air. kp (N m/rad), kd (N m s/rad): the gains it is made
    for, the policy's own unless a motion says why it takes others.
    """

    hung: ClassVar[bool] = True
    kp: ClassVar[float] = robot.KP
    kd: ClassVar[float] = robot.KD
    seconds: float

    def targets(self) -> Array:
        """Joint targets within the limits, (n, 12) rad, one row each PERIOD."""
        return within_speed(clip_to_command_range(self._motion(self._times())))

    def support(self) -> Array:
        """Joint torque (n, 12) N m that carries the robot on its feet, a row each PERIOD; zero for motions in the air."""
        return np.zeros((len(self._times()), 12))

    def _times(self) -> Array:
        return PERIOD * np.arange(round(self.seconds / PERIOD), dtype=np.float64)

    @abstractmethod
    def _motion(self, t: Array) -> Array:
        """Joint targets (n, 12) rad at the times (n,)."""


def lift(k: ArrayLike) -> Array:
    """Share of the lifting height at the phase k (1), Eq. 9: up over [0, 1), down over [1, 2), else on the ground."""
    k = np.asarray(k, float)
    up, down = -2 * k**3 + 3 * k**2, 2 * k**3 - 9 * k**2 + 12 * k - 4
    shape: Array = np.where(k < 1.0, up, np.where(k < 2.0, down, 0.0))
    return shape


@attrs.frozen
class OnGround(Excitation):
    """Diagonal feet lifted in turn, straight up, from a stand on the ground.

    Two feet carry the robot at any time, and it tips about the line between them until the next two come down. These
    right it only where they do not give way: with the policy's gains the legs sag by 0.1 m, and the trunk tips over
    within 3 s. So the gains are those with which this robot stands up, and the legs carry the weight by
    feed-forward torque, so that the feet are where Eq. 9 has them.
    """

    hung: ClassVar[bool] = False
    kp: ClassVar[float] = 150.0
    kd: ClassVar[float] = 4.0

    @abstractmethod
    def _lifting(self, t: Array) -> tuple[Array, Array]:
        """At the times (n,): the share of its height that each foot is lifted by (n, 4), and that height (n,) m."""

    def _motion(self, t: Array) -> Array:
        share, height = self._lifting(t)
        feet = np.empty((len(t), 4, 3))
        feet[...] = HIPS
        feet[..., 1] += robot.THIGH_OFFSET * _SIDE
        feet[..., 2] = _HEIGHT + height[:, None] * share
        return inverse_kinematics(feet)

    def support(self) -> Array:
        """A foot carries the more of the weight the less it is lifted."""
        down = 1.0 - self._lifting(self._times())[0]
        force = robot.MASS * robot.GRAVITY * down / down.sum(axis=1, keepdims=True)
        jacobians = foot_jacobians(self._motion(self._times()))
        return -(jacobians[:, :, 2] * force[..., None]).reshape(-1, 12)


def _lift_of_feet(phase: Array) -> Array:
    """Shares of the height (n, 4) at the common phase (n,)."""
    return lift((phase[:, None] + _LEG_PHASE) % 4.0)


@attrs.frozen
class FootLifting(OnGround):
    """The paper's trajectory, Eq. 9: diagonal feet lifted in turn by `height` (m), phase `rate` (1/s)."""

    seconds: float = _seconds(5.0)
    rate: float = 8.0
    height: float = 0.1

    def _lifting(self, t: Array) -> tuple[Array, Array]:
        return _lift_of_feet(self.rate * t), np.full(len(t), self.height)


@attrs.frozen
class Sweep(OnGround):
    """Foot lifting whose rate and height rise and fall: loads and speeds in many combinations."""

    seconds: float = _seconds(20.0)
    rates: tuple[float, float] = (5.0, 9.0)  # 1/s
    heights: tuple[float, float] = (0.03, 0.1)  # m

    def _lifting(self, t: Array) -> tuple[Array, Array]:
        rate = _between(self.rates, np.sin(2 * np.pi * 2 * t / self.seconds))
        height = _between(self.heights, np.sin(2 * np.pi * 5 * t / self.seconds))
        return _lift_of_feet(np.cumsum(rate) * PERIOD), height


@attrs.frozen
class Chirp(Excitation):
    """All joints swing at once, each at its own pace, from slow to fast: lags, delays and inertias differ."""

    seconds: float = _seconds(20.0)
    frequencies: tuple[float, float] = (0.3, 20.0)  # Hz
    amplitude: float = 0.35  # rad, less where the speed limit asks for it

    def _motion(self, t: Array) -> Array:
        low, high = self.frequencies
        growth = np.log(high / low) / self.seconds
        frequency = low * np.exp(growth * t)[:, None] * np.linspace(0.75, 1.25, 12)
        fastest = 0.5 * robot.VELOCITY_LIMIT / (2 * np.pi * frequency)
        swing = np.minimum(self.amplitude, fastest) * np.sin(
            2 * np.pi * np.cumsum(frequency, axis=0) * PERIOD
        )
        return robot.NOMINAL_Q + _eased(t) * swing


@attrs.frozen
class Solo(Excitation):
    """One joint swings at a time while the others hold still: what one joint does to another shows."""

    seconds: float = _seconds(36.0)
    amplitude: float = 0.4  # rad

    def _motion(self, t: Array) -> Array:
        turn = self.seconds / 12
        targets = np.tile(robot.NOMINAL_Q, (len(t), 1))
        for joint in range(12):
            mine = (joint * turn <= t) & (t < (joint + 1) * turn)
            s = (t[mine] - joint * turn) / turn
            window = np.sin(np.pi * s) ** 2
            targets[mine, joint] += self.amplitude * window * np.sin(2 * np.pi * (2 * s + 6 * s**2))
        return targets


@attrs.frozen
class RandomSteps(Excitation):
    """Steps of all sizes at random times: bounds of torque where they are large, play and deadband where small."""

    seconds: float = _seconds(20.0)
    sizes: tuple[float, float] = (0.01, 0.6)  # rad, drawn evenly in the logarithm
    holds: tuple[float, float] = (0.08, 0.5)  # s
    seed: int = 0

    def _motion(self, t: Array) -> Array:
        n = len(t)
        rng = np.random.default_rng(self.seed)
        targets = np.empty((n, 12))
        for joint in range(12):
            row, offset = 0, 0.0
            while row < n:
                hold = round(rng.uniform(*self.holds) / PERIOD)
                targets[row : row + hold, joint] = robot.NOMINAL_Q[joint] + offset
                row += hold
                size = np.exp(rng.uniform(*np.log(self.sizes)))
                offset = np.clip(offset - np.copysign(size, offset) * rng.choice([1, 1, -1]), -0.5, 0.5)
        return targets


@attrs.frozen
class Creep(Excitation):
    """Slow back and forth through a wide range: friction at standstill, cogging, springs, rubbing."""

    seconds: float = _seconds(40.0)
    amplitude: float = 0.5  # rad
    periods: tuple[float, float] = (4.0, 11.0)  # s, of the fastest and the slowest joint

    def _motion(self, t: Array) -> Array:
        period = np.linspace(*self.periods, 12)
        triangle = 2 * np.abs(2 * ((t[:, None] / period + 0.25) % 1.0) - 1.0) - 1.0
        return robot.NOMINAL_Q - _eased(t) * self.amplitude * triangle


EXCITATIONS: dict[str, Callable[..., Excitation]] = {
    "foot-lifting": FootLifting,
    "sweep": Sweep,
    "chirp": Chirp,
    "steps": RandomSteps,
    "creep": Creep,
    "solo": Solo,
}


def _between(bounds: tuple[float, float], wave: Array) -> Array:
    low, high = bounds
    return low + (high - low) * 0.5 * (1.0 + wave)


def _eased(t: Array) -> Array:
    """From 0 to 1 over the first second, (n, 1)."""
    s = np.minimum(t, 1.0)[:, None]
    return s * s * (3.0 - 2.0 * s)


def within_speed(targets: Array) -> Array:
    """`targets` (n, 12) with steps stretched so that no target moves faster than its joint may."""
    slowed = targets.copy()
    reach = robot.VELOCITY_LIMIT * PERIOD
    for row in range(1, len(slowed)):
        before = slowed[row - 1]
        slowed[row] = np.minimum(np.maximum(slowed[row], before - reach), before + reach)
    return slowed


def within_torque(target: Array, q: Array, dq: Array, kp: float, kd: float, tau: ArrayLike = 0.0) -> Array:
    """`target` (12,) rad held to what asks for TORQUE_SHARE of the torque limit at the state q, dq (12,).

    tau: feed-forward torque (12,) N m that goes with it.
    """
    bound = TORQUE_SHARE * robot.TORQUE_LIMIT
    clip_to_command_range = kd * dq - np.asarray(tau)
    return np.clip(target, q + (clip_to_command_range - bound) / kp, q + (clip_to_command_range + bound) / kp)


@attrs.frozen
class Proposal:
    """What to record next, and what that would tell apart."""

    excitation: str
    """a key of EXCITATIONS"""
    seconds: float
    separates: tuple[str, ...]
    reason: str

    @property
    def command(self) -> str:
        """As it is typed."""
        return f"quadvel excite {self.excitation} --seconds {self.seconds:g}"


_REASONS = {
    "chirp": "fast swings, in which a lag, a delay, a filter and an inertia turn the phase differently",
    "creep": "slow motion through the range and its turning points: angle and sign of the speed count alone",
    "steps": "large and small steps from rest, in which torque, speed and size of the error come apart",
    "sweep": "many loads at every speed, for long enough that heat and supply change",
    "solo": "one joint at a time: what the resting ones show comes from the one that moves",
}
_REVEALING = {
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
"""The excitation that shows an effect best; "steps", which hold most, for all others."""
_LONG = {"thermal_drift": 300.0, "supply_sag": 60.0}  # s
_BY_SIGNAL = {
    "t": "sweep",
    "q": "creep",
    "dq": "creep",
    "ddq": "chirp",
    "q_des": "steps",
    "tau": "sweep",
}


def propose(report: Mapping[str, Any]) -> list[Proposal]:
    """Which excitations would separate what the report (the content of report.json) lists as not told apart.

    Nothing where all effects stand alone and the rest is white.
    """
    found: list[Proposal] = []
    for effect in report["effects"]:
        names = (effect["name"], *effect["indistinguishable"])
        if len(names) > 1:
            kinds = dict.fromkeys(_REVEALING.get(name, "steps") for name in names)
            found += [_proposal(kind, names) for kind in kinds]
    unexplained = report["unexplained"]
    if unexplained["verdict"] == "structured":
        for signal in unexplained["depends_on"]:
            found.append(_proposal(_showing(signal), (f"what depends on {signal}",)))
    return _merged(found)


def _showing(signal: str) -> str:
    """The excitation that moves a signal (q, tau@history, FR_thigh_joint/dq, ...) in the most ways."""
    if "/" in signal:
        return "solo"
    return "chirp" if "@" in signal else _BY_SIGNAL.get(signal, "steps")


def _proposal(kind: str, separates: tuple[str, ...]) -> Proposal:
    usual = EXCITATIONS[kind]().seconds
    slow = [_LONG[name] for name in separates if kind == "sweep" and name in _LONG]
    return Proposal(kind, max([usual, *slow]), separates, _REASONS[kind])


def _merged(proposals: list[Proposal]) -> list[Proposal]:
    """One proposal an excitation, in the order of the first, for all that it separates."""
    merged: dict[str, Proposal] = {}
    for new in proposals:
        old = merged.setdefault(new.excitation, new)
        names = tuple(dict.fromkeys((*old.separates, *new.separates)))
        merged[new.excitation] = attrs.evolve(old, separates=names, seconds=max(old.seconds, new.seconds))
    return list(merged.values())
