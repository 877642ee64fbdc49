"""Shapes of basis regressors: functions of a signal over whole series and step by step.

A shape is a smooth curve of the signal, a wave along it, a filter of its past, a lag, or a resonance
that it excites.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Any, ClassVar

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools, Indices

from .base import Memory


def _array(values: Any) -> Array:
    """Convert numbers to a 1-D array of floats."""
    return np.atleast_1d(np.asarray(values, dtype=float))


@attrs.frozen(eq=False)
class Shape(ABC):
    """Basis functions of a signal; a weighted sum of them is a basis regressor.

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

    @property
    @override
    def count(self) -> int:
        return self.pieces + 3

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
    """Finite impulse response: the signal and, for each past window, its mean there minus its present value.

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
        rested = u.take(began, axis=0)
        columns = np.empty((self.count, *u.shape))
        columns[0] = u
        for column, (near, far) in zip(columns[1:], self._windows(dt), strict=True):
            a, b = np.maximum(n - far + 1, began), np.maximum(n - near + 1, began)
            before = (far - near - (b - a))[:, None]  # rows before the stretch began, where it rested
            np.subtract(sums.take(b, axis=0), sums.take(a, axis=0), out=column)
            column += before * rested
            column /= far - near
            column -= u
        return np.moveaxis(columns, 0, 1)

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


def _filtered(u: Any, gain: complex, factor: complex, memory: Any) -> Any:
    """Filter z[k] = factor z[k-1] + gain (u[k-1] + u[k]) over the rows, from its memory before them."""
    from scipy.signal import lfilter  # nodes, which do not filter rows, start without SciPy

    return lfilter([gain, gain], [1.0, -factor], u, axis=0, zi=memory)[0]


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
            z[first:last] = _filtered(u[first:last], half, kept, begin)
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
    """The signal, and both parts of the state of a damped oscillator that it drives.

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
        # Complex form of x'' + 2 damping w x' + w^2 x = w^2 u, with w = 2 pi frequency:
        #     dz/dt = l z + |l| u, l = w (-damping + i sqrt(1 - damping^2)),
        #     Re z = x' / w + damping x, Im z = sqrt(1 - damping^2) x
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
            z[first:last] = _filtered(part, 0.5 * gain, factor, begin)
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
