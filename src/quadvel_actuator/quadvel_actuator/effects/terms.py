"""Terms of named signals: what stands for an effect that has no law, over whole series and step by step.

A term is a shape of one signal (a smooth curve, a wave along it, a filter of its recent past, a lag behind it, a resonance
that it excites), alone or times the direction of motion, the speed, or the torque. Its torque stays within what it was
where it was fitted. Signals are named as in the report: `q`, `dq`, `ddq`, `q_des`, `tau` (what the model gives without
terms), `t`, besides `error` for q_des - q, and `FR_thigh_joint/q` for another joint's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .base import DRIVE, JOINT, Array, Memory, View, smooth_sign

NAME = "learned_residual"
"""Under which terms stand in reports and parameter files."""

SIGNALS = ("q", "dq", "ddq", "q_des", "tau", "error", "t")
TIMES = ("", "direction", "dq", "tau")

_AT_REST = np.array(0.05)
"""rad/s, where the direction of motion has come to 0.76 of +-1"""


def _array(values: Any) -> Array:
    return np.atleast_1d(np.asarray(values, dtype=float))


@attrs.frozen(eq=False)
class Shape(ABC):
    """What is made of a signal: `columns` of a series, whose weighted sum is the term, or the sum itself, by steps."""

    kind: ClassVar[str]
    history: ClassVar[bool] = False
    each: ClassVar[tuple[str, ...]] = ()
    """the numbers that every column of the signal has its own of, (C,)"""

    @property
    @abstractmethod
    def count(self) -> int:
        """Columns."""

    @property
    def penalty(self) -> Array:
        """What a fit adds to the columns' second moments, (K, K), in shares of the mean one."""
        return 1e-5 * np.eye(self.count)

    @abstractmethod
    def columns(self, u: Array, start: NDArray[np.bool_], dt: float) -> Array:
        """Of a series (N, C) whose stretches begin at `start` (N,), rows `dt` s apart: (N, K, C)."""

    def rest(self, u: Array, dt: float) -> Memory:
        """The memory where `u` has not changed since ever."""
        return ()

    @abstractmethod
    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        """One step: the sum of columns times `weights` (K, J), and the new memory."""

    def at(self, columns: NDArray[np.intp]) -> Shape:
        """The shape for these columns of the signal."""
        return attrs.evolve(self, **{name: getattr(self, name)[columns] for name in self.each})


@attrs.frozen(eq=False)
class Curve(Shape):
    """A cubic spline over `low` to `high` (C,), at its end values outside."""

    kind: ClassVar[str] = "curve"
    each: ClassVar[tuple[str, ...]] = ("low", "high")
    low: Array = attrs.field(converter=_array)
    high: Array = attrs.field(converter=_array)
    pieces: int

    @classmethod
    def over(cls, u: Array, pieces: int) -> Curve:
        """Over the range that a signal (N, C) had, but for a few outliers."""
        low, high = np.quantile(u, (0.005, 0.995), axis=0)
        return cls(low, np.maximum(high, low + 1e-9), pieces)

    @property
    def count(self) -> int:
        return self.pieces + 3

    @property
    def penalty(self) -> Array:
        bend = np.diff(np.eye(self.count), 2, axis=0)
        penalty: Array = 100.0 * bend.T @ bend + 1e-3 * np.eye(self.count)
        return penalty

    def _placed(self, u: Array) -> tuple[NDArray[np.intp], list[Array]]:
        """The first of the four columns that are not 0 at `u`, and their values."""
        x = np.clip((u - self.low) / (self.high - self.low), 0.0, 1.0) * self.pieces
        first = np.minimum(x.astype(np.intp), self.pieces - 1)
        f = x - first
        rest, square = 1.0 - f, f * f
        cube = square * f
        return first, [
            rest * rest * rest / 6.0,
            (3.0 * cube - 6.0 * square + 4.0) / 6.0,
            (-3.0 * cube + 3.0 * square + 3.0 * f + 1.0) / 6.0,
            cube / 6.0,
        ]

    def columns(self, u: Array, start: NDArray[np.bool_], dt: float) -> Array:
        first, values = self._placed(u)
        rows, count = u.shape
        out = np.zeros(rows * self.count * count)
        at = (np.arange(rows)[:, None] * self.count + first) * count + np.arange(count)
        for k, value in enumerate(values):
            out[at + k * count] = value
        return out.reshape(rows, self.count, count)

    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        first, values = self._placed(u)
        joint = np.arange(weights.shape[1])
        total: Array = sum(value * weights[first + k, joint] for k, value in enumerate(values))  # type: ignore[assignment]
        return total, ()


@attrs.frozen(eq=False)
class Wave(Shape):
    """Sines and cosines along the signal: `rate` (C,) radians a unit of it, and whole multiples of that."""

    kind: ClassVar[str] = "wave"
    each: ClassVar[tuple[str, ...]] = ("rate",)
    rate: Array = attrs.field(converter=_array)
    overtones: int

    @property
    def count(self) -> int:
        return 2 * self.overtones

    def _parts(self, u: Array) -> list[Array]:
        angles = [k * self.rate * u for k in range(1, self.overtones + 1)]
        return [*(np.sin(a) for a in angles), *(np.cos(a) for a in angles)]

    def columns(self, u: Array, start: NDArray[np.bool_], dt: float) -> Array:
        return np.stack(self._parts(u), axis=1)

    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        total: Array = sum(w * part for w, part in zip(weights, self._parts(u), strict=True))
        return total, ()


@attrs.frozen(eq=False)
class Filter(Shape):
    """The signal itself, and its means over past stretches less its present value; `edges` (s) bound the stretches."""

    kind: ClassVar[str] = "filter"
    history: ClassVar[bool] = True
    edges: tuple[float, ...] = attrs.field(converter=tuple)

    @property
    def count(self) -> int:
        return len(self.edges)

    def _stretches(self, dt: float) -> list[tuple[int, int]]:
        rows = [max(round(edge / dt), 1) for edge in self.edges]
        return [(near, max(far, near + 1)) for near, far in pairwise(rows)]

    def columns(self, u: Array, start: NDArray[np.bool_], dt: float) -> Array:
        n = np.arange(len(u))
        began = np.maximum.accumulate(np.where(start, n, 0))
        sums = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u, axis=0)])
        columns = [u]
        for near, far in self._stretches(dt):
            a, b = np.maximum(n - far + 1, began), np.maximum(n - near + 1, began)
            before = (far - near - (b - a))[:, None]  # rows before the stretch began, where it rested
            columns.append((sums[b] - sums[a] + before * u[began]) / (far - near) - u)
        return np.stack(columns, axis=1)

    def rest(self, u: Array, dt: float) -> Memory:
        return (u,) * self._stretches(dt)[-1][1]

    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        memory = (u, *memory[:-1])
        total = weights[0] * u
        for weight, (near, far) in zip(weights[1:], self._stretches(dt), strict=True):
            total = total + weight * (sum(memory[near:far]) / (far - near) - u)
        return total, memory


@attrs.frozen(eq=False)
class Lag(Shape):
    """The signal, and what follows it with a time constant `time` (s)."""

    kind: ClassVar[str] = "lag"
    history: ClassVar[bool] = True
    time: float

    @property
    def count(self) -> int:
        return 2

    def columns(self, u: Array, start: NDArray[np.bool_], dt: float) -> Array:
        kept = float(np.exp(-dt / self.time))
        half = 0.5 * (1.0 - kept)
        z = np.empty_like(u)
        for first, last in pairwise([*np.flatnonzero(start), len(u)]):
            begin = (kept + half) * u[first : first + 1]
            z[first:last] = lfilter([half, half], [1.0, -kept], u[first:last], axis=0, zi=begin)[0]
        return np.stack([u, z], axis=1)

    def rest(self, u: Array, dt: float) -> Memory:
        return u, u

    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        kept = float(np.exp(-dt / self.time))
        last, z = memory
        z = kept * z + 0.5 * (1.0 - kept) * (last + u)
        return weights[0] * u + weights[1] * z, (u, z)


@attrs.frozen(eq=False)
class Resonance(Shape):
    """The signal, and place and speed of a mass on a damped spring that it pushes, scaled to its units."""

    kind: ClassVar[str] = "resonance"
    history: ClassVar[bool] = True
    frequency: float  # Hz, undamped
    damping: float  # of the critical one

    @property
    def count(self) -> int:
        return 3

    def _pole(self, dt: float) -> tuple[complex, complex]:
        """Factor and gain of one step of z' = l z + |l| u, u linear in between."""
        size = 2.0 * np.pi * self.frequency
        pole = size * complex(-self.damping, np.sqrt(1.0 - self.damping**2))
        factor = np.exp(pole * dt)
        return factor, (factor - 1.0) / pole * size

    def columns(self, u: Array, start: NDArray[np.bool_], dt: float) -> Array:
        factor, gain = self._pole(dt)
        z = np.empty(u.shape, dtype=complex)
        edges = [*np.flatnonzero(start), len(u)]
        for first, last in pairwise(edges):
            part = u[first:last]
            rest = gain * part[:1] / (1.0 - factor)
            begin = factor * rest + 0.5 * gain * part[:1]
            z[first:last] = lfilter([0.5 * gain, 0.5 * gain], [1.0, -factor], part, axis=0, zi=begin)[0]
        return np.stack([u, z.real, z.imag], axis=1)

    def rest(self, u: Array, dt: float) -> Memory:
        factor, gain = self._pole(dt)
        z: Any = gain * u / (1.0 - factor)  # complex
        return u, z

    def advance(self, u: Array, dt: float, weights: Array, memory: Memory) -> tuple[Array, Memory]:
        factor, gain = self._pole(dt)
        last = memory[0]
        z: Any = factor * memory[1] + 0.5 * gain * (last + u)
        return weights[0] * u + weights[1] * z.real + weights[2] * z.imag, (u, z)


SHAPES: dict[str, type[Shape]] = {one.kind: one for one in (Curve, Wave, Filter, Lag, Resonance)}


def read(name: str, view: View, tau: Array, joints: Sequence[str]) -> Array:
    """The signal of this name, (..., J), or (..., 1) where it is the same for all joints."""
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


def factor(times: str, view: View, tau: Array) -> Array | float:
    """What a shape is multiplied with."""
    if times == "direction":
        return smooth_sign(view.dq, _AT_REST)
    if times == "dq":
        return view.dq
    return tau if times == "tau" else 1.0


@attrs.frozen(eq=False)
class Term:
    """A shape of a signal, times something, at work on some of J joints."""

    signal: str
    times: str
    shape: Shape
    active: NDArray[np.bool_]  # (J,)
    weights: Array  # (K, J)
    bound: Array  # (J,), N m
    at: str = DRIVE
    """where it is added: by the drive, so that it comes an output delay late, or at the joint, at once"""

    def rest(self, view: View, tau: Array, joints: Sequence[str], dt: float) -> Memory:
        """The memory of joints that have rested."""
        return self.shape.rest(read(self.signal, view, tau, joints), dt)

    def advance(
        self, view: View, tau: Array, joints: Sequence[str], dt: float, memory: Memory
    ) -> tuple[Array, Memory]:
        """Its torque (..., J), N m, and the new memory."""
        torque, memory = self.shape.advance(read(self.signal, view, tau, joints), dt, self.weights, memory)
        return np.clip(torque * factor(self.times, view, tau), -self.bound, self.bound), memory

    @property
    def own(self) -> bool:
        """Has every joint its own column of the signal?"""
        return "/" not in self.signal and self.signal != "t"

    def saved(self, joints: Sequence[str]) -> dict[str, Any]:
        """As an entry of a parameter file."""
        on = np.flatnonzero(self.active)
        shape = self.shape.at(on) if self.own else self.shape
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


def loaded(entry: Any, joints: Sequence[str]) -> Term:
    """A term from its entry of a parameter file; ValueError says what is wrong with it."""
    if not isinstance(entry, Mapping):
        raise ValueError(f"found {entry!r}, expected a mapping")
    rest = dict(entry)
    rest.setdefault("at", DRIVE)
    kind, signal, times, at = (_word(rest, name) for name in ("kind", "signal", "times", "at"))
    owner, _, plain = signal.rpartition("/")
    for field, value, known in (
        ("kind", kind, SHAPES), ("times", times, TIMES), ("at", at, (DRIVE, JOINT)), ("signal", plain, SIGNALS),
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
    for name in shape.each:
        if len(getattr(shape, name)) != wide:
            raise ValueError(f"{name}: found {len(getattr(shape, name))} numbers, expected {wide}")
    if own:
        every_joint = np.zeros(len(joints), dtype=np.intp)
        every_joint[on] = np.arange(len(on))
        shape = shape.at(every_joint)
    if weights.shape != (len(on), shape.count) or bound.shape != (len(on),):
        raise ValueError(
            f"weights, bound: found shapes {weights.shape} and {bound.shape}, "
            f"expected {(len(on), shape.count)} and {(len(on),)}"
        )
    every = np.zeros((shape.count, len(joints))), np.zeros(len(joints))
    every[0][:, on], every[1][on] = weights.T, bound
    return Term(signal, times, shape, np.isin(np.arange(len(joints)), on), *every, at)


def all_loaded(entries: Any, joints: Sequence[str]) -> list[Term]:
    """Terms from their entries; ValueError says what is wrong with which."""
    if not isinstance(entries, (list, tuple)):
        raise ValueError(f"terms: found {entries!r}, expected a list")
    terms = []
    for number, entry in enumerate(entries):
        try:
            terms.append(loaded(entry, joints))
        except ValueError as error:
            raise ValueError(f"terms[{number}]/{error}") from None
    return terms


def _word(entry: dict[str, Any], name: str) -> str:
    value = entry.pop(name, None)
    if not isinstance(value, str):
        raise ValueError(f"{name}: found {value!r}, expected a word")
    return value


def _numbers(value: Any, name: str) -> Any:
    """A number as it is, a list as an array."""
    try:
        found = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: found {value!r}, expected numbers") from None
    if value is None or not np.isfinite(found).all():
        raise ValueError(f"{name}: found {value!r}, expected finite numbers")
    return found if found.ndim else value


class RunningTerms:
    """Terms of a model at work, step by step, on top of its torque."""

    def __init__(self, terms: Sequence[Term], joints: Sequence[str], dt: float) -> None:
        self.terms, self._joints, self._dt = terms, joints, dt
        self.memory: tuple[Memory, ...] = ()

    def act(self, tau: Array, now: View, new: NDArray[np.bool_] | None) -> Array | float:
        """The torque to add to `tau` (..., J); environments that are `new` start from rest."""
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


def inputs(signal: str, times: str, shape: Shape) -> tuple[str, ...]:
    """The signals behind a term, as the report names them."""
    names: tuple[str, ...] = ("q_des", "q") if signal == "error" else (signal,)
    if shape.history:
        names = tuple(f"{name}@history" for name in names)
    return (*names, *({"": (), "direction": ("dq",), "dq": ("dq",), "tau": ("tau",)}[times]))
