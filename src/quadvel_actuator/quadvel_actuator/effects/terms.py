"""Generic regressors of named signals, for deviations that no effect of the registry explains.

A term is a shape of one signal: a smooth curve, a wave along it, a filter of its past, a lag, or a
resonance that it excites. It may be multiplied by the direction of motion, the speed or the torque.
Its torque is bounded by what it was on the training rows. Like effects, terms run over whole series
and step by step.

Signals have the names of the report: `q`, `dq`, `ddq`, `q_des`, `error` (q_des - q), `t`, `tau`
(prediction without terms), and `FR_thigh_joint/q` for those of another joint.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar

import attrs
import numpy as np
from scipy.signal import lfilter
from typing_extensions import override

from quadvel_description.arrays import Array, Bools, Indices

from .base import DRIVE, JOINT, Memory, View, smooth_sign

LEARNED_RESIDUAL = "learned_residual"
"""Name of terms in reports and parameter files"""

SIGNALS = ("q", "dq", "ddq", "q_des", "tau", "error", "t")
MULTIPLIERS = ("", "direction", "dq", "tau")

_DIRECTION_WIDTH_RAD_S = np.array(0.05)
"""Velocity, rad/s, at which the smooth direction of motion is 0.76"""


def _array(values: Any) -> Array:
    """Convert numbers to a 1-D array of floats."""
    return np.atleast_1d(np.asarray(values, dtype=float))


@attrs.frozen(eq=False)
class Shape(ABC):
    """Basis functions of a signal; a weighted sum of them is a term.

    C is the number of columns of the signal (joints, or 1), K the number of basis functions.

    Attributes:
        kind: name in parameter files.
        history: whether it depends on the past of the signal.
        per_column_fields: names of fields with one number per column of the signal, (C,).
    """

    kind: ClassVar[str]
    history: ClassVar[bool] = False
    per_column_fields: ClassVar[tuple[str, ...]] = ()

    @property
    @abstractmethod
    def count(self) -> int:
        """Number K of basis functions."""

    @property
    def penalty(self) -> Array:
        """Ridge penalty (K, K) that a fit adds to the second moments, in units of their mean."""
        return 1e-5 * np.eye(self.count)

    @abstractmethod
    def columns(self, u: Array, start: Bools, dt: float) -> Array:
        """Evaluate the basis functions over a series.

        Args:
            u: signal, (N, C).
            start: rows where a stretch starts, (N,).
            dt: s, time between rows.

        Returns:
            (N, K, C).
        """

    def rest(self, u: Array, dt: float) -> Memory:
        """Return the memory of a signal at rest.

        Args:
            u: value that has been constant for all earlier times.
            dt: s, duration of a step.

        Returns:
            The memory.
        """
        return ()

    @abstractmethod
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        """Advance by one step.

        Args:
            u: signal, (..., C).
            dt: s, duration of the step.
            weights: (K, J).
            memory: memory after the step before.

        Returns:
            Sum of the basis functions times their weights, (..., J), and the new memory.
        """

    def for_columns(self, columns: Indices) -> Shape:
        """Select columns of the signal.

        Args:
            columns: their indices.

        Returns:
            The shape with the numbers of these columns.
        """
        return attrs.evolve(self, **{name: getattr(self, name)[columns] for name in self.per_column_fields})


@attrs.frozen(eq=False)
class Curve(Shape):
    """Cubic B-spline over `low` to `high`, constant outside.

    Attributes:
        low: (C,), lower end, in the unit of the signal.
        high: (C,), upper end.
        pieces: number of polynomial pieces; there are three more basis functions.
    """

    kind: ClassVar[str] = "curve"
    per_column_fields: ClassVar[tuple[str, ...]] = ("low", "high")
    low: Array = attrs.field(converter=_array)
    high: Array = attrs.field(converter=_array)
    pieces: int

    @classmethod
    def over(cls, u: Array, pieces: int) -> Curve:
        """Fit the range of a curve to a signal, a few outliers excepted.

        Args:
            u: signal, (N, C).
            pieces: number of polynomial pieces.

        Returns:
            A curve from the 0.5 % to the 99.5 % quantile.
        """
        low, high = np.quantile(u, (0.005, 0.995), axis=0)
        return cls(low, np.maximum(high, low + 1e-9), pieces)

    @property
    @override
    def count(self) -> int:
        return self.pieces + 3

    @property
    @override
    def penalty(self) -> Array:
        """Penalise the second difference of the weights (a P-spline), and slightly their size."""
        bend = np.diff(np.eye(self.count), 2, axis=0)
        penalty: Array = 100.0 * bend.T @ bend + 1e-3 * np.eye(self.count)
        return penalty

    def _basis_at(self, u: Array) -> tuple[Indices, list[Array]]:
        """Return the first of the four basis functions that are not 0 at `u`, and their values."""
        x = np.clip((u - self.low) / (self.high - self.low), 0.0, 1.0) * self.pieces
        first = np.minimum(x.astype(np.intp), self.pieces - 1)
        f = x - first
        # Uniform cubic B-splines of the fraction f within a piece (de Boor, A Practical Guide to
        # Splines):
        #     (1 - f)^3 / 6, (3 f^3 - 6 f^2 + 4) / 6, (-3 f^3 + 3 f^2 + 3 f + 1) / 6, f^3 / 6
        rest, square = 1.0 - f, f * f
        cube = square * f
        return first, [
            rest * rest * rest / 6.0,
            (3.0 * cube - 6.0 * square + 4.0) / 6.0,
            (-3.0 * cube + 3.0 * square + 3.0 * f + 1.0) / 6.0,
            cube / 6.0,
        ]

    @override
    def columns(self, u: Array, start: Bools, dt: float) -> Array:
        first, values = self._basis_at(u)
        rows, count = u.shape
        out = np.zeros(rows * self.count * count)
        at = (np.arange(rows)[:, None] * self.count + first) * count + np.arange(count)
        for k, value in enumerate(values):
            out[at + k * count] = value
        return out.reshape(rows, self.count, count)

    @override
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        first, values = self._basis_at(u)
        joint = np.arange(weights.shape[1])
        total: Array = sum(value * weights[first + k, joint] for k, value in enumerate(values))  # type: ignore[assignment]
        return total, ()


@attrs.frozen(eq=False)
class Wave(Shape):
    """Sines and cosines of the signal: sin(k rate u), cos(k rate u), k = 1 to `overtones`.

    Attributes:
        rate: (C,), wave number, rad per unit of the signal.
        overtones: number of harmonics.
    """

    kind: ClassVar[str] = "wave"
    per_column_fields: ClassVar[tuple[str, ...]] = ("rate",)
    rate: Array = attrs.field(converter=_array)
    overtones: int

    @property
    @override
    def count(self) -> int:
        return 2 * self.overtones

    def _basis(self, u: Array) -> list[Array]:
        """Return sines, then cosines."""
        angles = [k * self.rate * u for k in range(1, self.overtones + 1)]
        return [*(np.sin(a) for a in angles), *(np.cos(a) for a in angles)]

    @override
    def columns(self, u: Array, start: Bools, dt: float) -> Array:
        return np.stack(self._basis(u), axis=1)

    @override
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        total: Array = sum(w * part for w, part in zip(weights, self._basis(u), strict=True))
        return total, ()


@attrs.frozen(eq=False)
class Filter(Shape):
    """Finite impulse response: the signal, and its means over past windows minus its present value.

    Attributes:
        edges: s, ages that bound the windows.
    """

    kind: ClassVar[str] = "filter"
    history: ClassVar[bool] = True
    edges: tuple[float, ...] = attrs.field(converter=tuple)

    @property
    @override
    def count(self) -> int:
        return len(self.edges)

    def _windows(self, dt: float) -> list[tuple[int, int]]:
        """Return the windows as half-open ranges of ages in rows."""
        rows = [max(round(edge / dt), 1) for edge in self.edges]
        return [(near, max(far, near + 1)) for near, far in pairwise(rows)]

    @override
    def columns(self, u: Array, start: Bools, dt: float) -> Array:
        # Sliding means from a cumulative sum; the signal counts as constant before its stretch
        # began.
        n = np.arange(len(u))
        began = np.maximum.accumulate(np.where(start, n, 0))
        sums = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u, axis=0)])
        columns = [u]
        for near, far in self._windows(dt):
            a, b = np.maximum(n - far + 1, began), np.maximum(n - near + 1, began)
            before = (far - near - (b - a))[:, None]  # rows before the stretch began, where it rested
            columns.append((sums[b] - sums[a] + before * u[began]) / (far - near) - u)
        return np.stack(columns, axis=1)

    @override
    def rest(self, u: Array, dt: float) -> Memory:
        return (u,) * self._windows(dt)[-1][1]

    @override
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        memory = (u, *memory[:-1])
        total = weights[0] * u
        for weight, (near, far) in zip(weights[1:], self._windows(dt), strict=True):
            total = total + weight * (sum(memory[near:far]) / (far - near) - u)
        return total, memory


@attrs.frozen(eq=False)
class Lag(Shape):
    """The signal, and its first-order lag.

    Attributes:
        time: s, time constant T of T dz/dt = u - z.
    """

    kind: ClassVar[str] = "lag"
    history: ClassVar[bool] = True
    time: float

    @property
    @override
    def count(self) -> int:
        return 2

    @override
    def columns(self, u: Array, start: Bools, dt: float) -> Array:
        # Exact pole, trapezoidal input: z[k] = d z[k-1] + (1 - d) (u[k-1] + u[k]) / 2, d = exp(-dt
        # / T)
        kept = float(np.exp(-dt / self.time))
        half = 0.5 * (1.0 - kept)
        z = np.empty_like(u)
        for first, last in pairwise([*np.flatnonzero(start), len(u)]):
            begin = (kept + half) * u[first : first + 1]
            z[first:last] = lfilter([half, half], [1.0, -kept], u[first:last], axis=0, zi=begin)[0]
        return np.stack([u, z], axis=1)

    @override
    def rest(self, u: Array, dt: float) -> Memory:
        return u, u

    @override
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        kept = float(np.exp(-dt / self.time))
        last, z = memory
        z = kept * z + 0.5 * (1.0 - kept) * (last + u)
        return weights[0] * u + weights[1] * z, (u, z)


@attrs.frozen(eq=False)
class Resonance(Shape):
    """The signal, and position and velocity of a damped oscillator that it drives.

    Attributes:
        frequency: Hz, undamped natural frequency.
        damping: ratio to critical damping, below 1.
    """

    kind: ClassVar[str] = "resonance"
    history: ClassVar[bool] = True
    frequency: float
    damping: float

    @property
    @override
    def count(self) -> int:
        return 3

    def _discretised(self, dt: float) -> tuple[complex, complex]:
        """Return factor and gain of one step."""
        # Complex form of z'' + 2 damping w z' + w^2 z = w^2 u, with w = 2 pi frequency:
        #     dz/dt = l z + |l| u, l = w (-damping + i sqrt(1 - damping^2))
        #     z(t + dt) = exp(l dt) z + |l| (exp(l dt) - 1) / l u
        size = 2.0 * np.pi * self.frequency
        pole = size * complex(-self.damping, np.sqrt(1.0 - self.damping**2))
        factor = np.exp(pole * dt)
        return factor, (factor - 1.0) / pole * size

    @override
    def columns(self, u: Array, start: Bools, dt: float) -> Array:
        factor, gain = self._discretised(dt)
        z = np.empty(u.shape, dtype=complex)
        edges = [*np.flatnonzero(start), len(u)]
        for first, last in pairwise(edges):
            part = u[first:last]
            rest = gain * part[:1] / (1.0 - factor)
            begin = factor * rest + 0.5 * gain * part[:1]
            z[first:last] = lfilter([0.5 * gain, 0.5 * gain], [1.0, -factor], part, axis=0, zi=begin)[0]
        return np.stack([u, z.real, z.imag], axis=1)

    @override
    def rest(self, u: Array, dt: float) -> Memory:
        factor, gain = self._discretised(dt)
        z: Any = gain * u / (1.0 - factor)  # complex
        return u, z

    @override
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        factor, gain = self._discretised(dt)
        last = memory[0]
        z: Any = factor * memory[1] + 0.5 * gain * (last + u)
        return weights[0] * u + weights[1] * z.real + weights[2] * z.imag, (u, z)


SHAPES: dict[str, type[Shape]] = {one.kind: one for one in (Curve, Wave, Filter, Lag, Resonance)}


def read_signal(name: str, view: View, tau: Array, joints: Sequence[str]) -> Array:
    """Read a signal by name.

    Args:
        name: such as `q` or `FR_thigh_joint/q`.
        view: signals of all joints.
        tau: N m, prediction without terms, (..., J).
        joints: J joint names.

    Returns:
        (..., J), or (..., 1) if all joints share it.
    """
    owner, _, plain = name.rpartition("/")
    if plain == "tau":
        u = tau
    elif plain == "error":
        u = view.q_des - view.q
    else:
        u = np.asarray(getattr(view, plain))
    if not owner:
        return u
    k = list(joints).index(owner)
    return u[..., k : k + 1]


def multiplier(times: str, view: View, tau: Array) -> Array | float:
    """Return the factor that multiplies a shape.

    Args:
        times: one of `MULTIPLIERS`.
        view: signals of all joints.
        tau: N m, prediction without terms, (..., J).

    Returns:
        Sign of the velocity, velocity (rad/s), torque (N m), or 1.
    """
    if times == "direction":
        return smooth_sign(view.dq, _DIRECTION_WIDTH_RAD_S)
    if times == "dq":
        return view.dq
    return tau if times == "tau" else 1.0


@attrs.frozen(eq=False)
class Term:
    """A shape of a signal, times a multiplier, added to the torque of some of J joints.

    Attributes:
        signal: name of the signal.
        times: multiplier, one of `MULTIPLIERS`.
        shape: basis functions of the signal.
        active: (J,), joints that have the term.
        weights: (K, J), weight of each basis function.
        bound: (J,), N m, largest torque.
        at: where it is added: in the drive, so that it passes the output delay, or at the joint
            without delay.
    """

    signal: str
    times: str
    shape: Shape
    active: Bools
    weights: Array
    bound: Array
    at: str = DRIVE

    def rest(self, view: View, tau: Array, joints: Sequence[str], dt: float) -> Memory:
        """Return the memory of joints at rest.

        Args:
            view: signals of all joints.
            tau: N m, prediction without terms, (..., J).
            joints: J joint names.
            dt: s, duration of a step.

        Returns:
            The memory.
        """
        return self.shape.rest(read_signal(self.signal, view, tau, joints), dt)

    def advance(
        self, view: View, tau: Array, joints: Sequence[str], dt: float, memory: Memory
    ) -> tuple[Array, Memory]:
        """Advance by one step.

        Args:
            view: signals of all joints.
            tau: N m, prediction without terms, (..., J).
            joints: J joint names.
            dt: s, duration of the step.
            memory: memory after the step before.

        Returns:
            N m, torque to add, (..., J), and the new memory.
        """
        torque, memory = self.shape.advance(
            read_signal(self.signal, view, tau, joints), dt, self.weights, memory
        )
        return np.clip(torque * multiplier(self.times, view, tau), -self.bound, self.bound), memory

    @property
    def is_per_joint(self) -> bool:
        """Whether each joint has its own column of the signal."""
        return "/" not in self.signal and self.signal != "t"

    def to_entry(self, joints: Sequence[str]) -> dict[str, Any]:
        """Convert to an entry of a parameter file; `load_term` is the inverse.

        Args:
            joints: J joint names.

        Returns:
            The entry, with the joints that have the term.
        """
        on = np.flatnonzero(self.active)
        shape = self.shape.for_columns(on) if self.is_per_joint else self.shape
        return {
            "kind": shape.kind,
            "signal": self.signal,
            "times": self.times,
            "at": self.at,
            "joints": [joints[int(j)] for j in on],
            **{k: np.asarray(v).tolist() for k, v in attrs.asdict(shape, recurse=False).items()},
            "weights": self.weights[:, on].T.tolist(),
            "bound": self.bound[on].tolist(),
        }


def load_term(entry: Any, joints: Sequence[str]) -> Term:
    """Build a term from its entry in a parameter file.

    Args:
        entry: a mapping as `Term.to_entry` returns it.
        joints: J joint names of the robot.

    Returns:
        The term.

    Raises:
        ValueError: the entry is wrong; the message names the field, the value found and the
            expected one.
    """
    if not isinstance(entry, Mapping):
        raise ValueError(f"found {entry!r}, expected a mapping")
    rest = dict(entry)
    rest.setdefault("at", DRIVE)
    kind, signal, times, at = (_word(rest, name) for name in ("kind", "signal", "times", "at"))
    owner, _, plain = signal.rpartition("/")
    for field, value, known in (
        ("kind", kind, SHAPES), ("times", times, MULTIPLIERS), ("at", at, (DRIVE, JOINT)), ("signal", plain, SIGNALS),
        ("signal", owner, ("", *joints)),
    ):  # fmt: skip
        if value not in known:
            raise ValueError(f"{field}: found {value!r}, expected one of {', '.join(known)}")
    named = rest.pop("joints", [])
    unknown = [name for name in named if name not in joints]
    if unknown or not named:
        raise ValueError(f"joints: found {named!r}, expected some of {', '.join(joints)}")
    on = np.array([list(joints).index(name) for name in named])
    weights, bound = (_numbers(rest.pop(name, None), name) for name in ("weights", "bound"))
    try:
        shape = SHAPES[kind](**{name: _numbers(value, name) for name, value in rest.items()})
    except TypeError as error:
        raise ValueError(f"{kind}: {error}") from None
    own = not owner and plain != "t"
    wide = len(on) if own else 1
    for name in shape.per_column_fields:
        if len(getattr(shape, name)) != wide:
            raise ValueError(f"{name}: found {len(getattr(shape, name))} numbers, expected {wide}")
    if own:
        every_joint = np.zeros(len(joints), dtype=np.intp)
        every_joint[on] = np.arange(len(on))
        shape = shape.for_columns(every_joint)
    if weights.shape != (len(on), shape.count) or bound.shape != (len(on),):
        raise ValueError(
            f"weights, bound: found shapes {weights.shape} and {bound.shape}, "
            f"expected {(len(on), shape.count)} and {(len(on),)}"
        )
    every = np.zeros((shape.count, len(joints))), np.zeros(len(joints))
    every[0][:, on], every[1][on] = weights.T, bound
    return Term(signal, times, shape, np.isin(np.arange(len(joints)), on), *every, at)


def load_terms(entries: Any, joints: Sequence[str]) -> list[Term]:
    """Build the terms of a list of entries.

    Args:
        entries: list of entries.
        joints: J joint names of the robot.

    Returns:
        The terms.

    Raises:
        ValueError: an entry is wrong; the message names it.
    """
    if not isinstance(entries, (list, tuple)):
        raise ValueError(f"terms: found {entries!r}, expected a list")
    terms = []
    for number, entry in enumerate(entries):
        try:
            terms.append(load_term(entry, joints))
        except ValueError as error:
            raise ValueError(f"terms[{number}]/{error}") from None
    return terms


def _word(entry: dict[str, Any], name: str) -> str:
    """Remove a string from an entry."""
    value = entry.pop(name, None)
    if not isinstance(value, str):
        raise ValueError(f"{name}: found {value!r}, expected a word")
    return value


def _numbers(value: Any, name: str) -> Any:
    """Return a number unchanged, a list as an array."""
    try:
        found = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: found {value!r}, expected numbers") from None
    if value is None or not np.isfinite(found).all():
        raise ValueError(f"{name}: found {value!r}, expected finite numbers")
    return found if found.ndim else value


class RunningTerms:
    """Terms of a running model, step by step.

    Attributes:
        terms: the terms.
        memory: memory of each term.
    """

    def __init__(self, terms: Sequence[Term], joints: Sequence[str], dt: float) -> None:
        """Create the terms without memory.

        Args:
            terms: the terms.
            joints: J joint names of the robot.
            dt: s, duration of a step.
        """
        self.terms, self._joints, self._dt = terms, joints, dt
        self.memory: tuple[Memory, ...] = ()

    def step(self, tau: Array, now: View, new: Bools | None) -> Array | float:
        """Advance all terms by one step.

        Args:
            tau: N m, prediction without terms, (..., J).
            now: signals of this step.
            new: environments that start from rest, (...,) bool, or None.

        Returns:
            N m, torque to add, (..., J), or 0 without terms.
        """
        if not self.terms:
            return 0.0
        if new is not None:
            rest = tuple(one.rest(now, tau, self._joints, self._dt) for one in self.terms)
            whole = not self.memory or bool(new.all())
            self.memory = rest if whole else tuple(
                tuple(np.where(new[..., None], fresh, old) for fresh, old in zip(*both, strict=True))
                for both in zip(rest, self.memory, strict=True)
            )  # fmt: skip
        total, memory = np.zeros_like(tau), []
        for one, kept in zip(self.terms, self.memory, strict=True):
            torque, after = one.advance(now, tau, self._joints, self._dt, kept)
            total += torque
            memory.append(after)
        self.memory = tuple(memory)
        return total


def input_signals(signal: str, times: str, shape: Shape) -> tuple[str, ...]:
    """List the signals behind a term, as the report names them.

    Args:
        signal: name of the signal.
        times: its multiplier.
        shape: its shape.

    Returns:
        Names, with `@history` where the past matters.
    """
    names: tuple[str, ...] = ("q_des", "q") if signal == "error" else (signal,)
    if shape.history:
        names = tuple(f"{name}@history" for name in names)
    return (*names, *({"": (), "direction": ("dq",), "dq": ("dq",), "tau": ("tau",)}[times]))
