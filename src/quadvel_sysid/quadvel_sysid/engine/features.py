"""What is tried for what no law explains: shapes of named signals, and a model's rows as they see them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, JOINT
from quadvel_actuator.effects.terms import Curve, Filter, Lag, Resonance, Shape, Wave, factor, inputs, read
from quadvel_actuator.running import SLOPE

from .delays import jacobian_with_delays
from .judging import Judge
from .model import Model, Slots
from .signals import Array, Bools, Signals

EVERY = slice(None)

_HISTORY = 0.02  # s
_FREQUENCIES = np.geomspace(3.0, 110.0, 26)  # Hz
_DAMPING = (0.02, 0.07, 0.2)
_LAGS = np.geomspace(0.01, 1.0, 8)  # s
_RATES = np.arange(3.0, 120.0, 0.5)  # rad/rad
_COARSE, _MIDDLE, _FINE, _FINEST = 3, 6, 25, 70  # pieces of a curve
_COMMANDED = "q_des", "error", "tau"


@attrs.frozen(eq=False)
class Feature:
    """A shape of a signal, times something; what commands move is first looked for in the drive, all else at the joint.

    A filter of what is the joint's own stays in the drive: beside gains that see the signal an output delay earlier, it
    would be a slope of it.
    """

    signal: str
    times: str
    shape: Shape
    at: str = attrs.field()
    """where its torque is added, DRIVE or JOINT"""

    @at.default
    def _usual_place(self) -> str:
        fixed = not self.movable and self.signal != "t"
        return DRIVE if fixed or self.signal in _COMMANDED or self.times in _COMMANDED else JOINT

    @property
    def movable(self) -> bool:
        """Can it act at the other place, too? At the joint nothing of commands is known but the torque that they made."""
        return self.signal not in ("q_des", "error", "t") and not isinstance(self.shape, Filter)

    @property
    def key(self) -> tuple[str, ...]:
        """Features with the same one stand for each other: the best of them comes into question."""
        return inputs(self.signal, self.times, self.shape)

    @property
    def family(self) -> tuple[str, str, str, int] | None:
        """The same of other neighbours; None of what is the joint's own."""
        owner, _, plain = self.signal.rpartition("/")
        return (plain, self.times, self.shape.kind, self.shape.count) if owner else None

    @property
    def size(self) -> tuple[int, int]:
        """How much it says: signals, then numbers."""
        return len(self.key), self.shape.count


class Scene:
    """A model's rows as terms see them: the signals, what is left, and how that moves with the model's parameters."""

    def __init__(self, model: Model, judge: Judge) -> None:
        self.model, self.judge = model, judge
        self.joints: Sequence[str] = model.samples.joints
        self.rows = judge.fit | judge.judge
        self.asked = model.predict()  # (N, J)
        self.residual = np.where(self.rows, model.samples.tau - self.asked, 0.0)
        self.dt = model.samples.period
        self.start = model.samples.start
        self.views = {at: _past_only(model.seen(at), self.dt) for at in (DRIVE, JOINT)}
        self._taken: dict[Feature, dict[int, Array]] = {}
        self._factors: dict[tuple[str, str], Array | float] = {}

    @cached_property
    def _jacobian(self) -> tuple[Array, Slots]:
        return jacobian_with_delays(self.model)[1:]

    @property
    def slopes(self) -> Array:
        """Of the prediction along every slot and the delays, (J, A, N)."""
        return self._jacobian[0]

    @property
    def slots(self) -> Slots:
        """The unknowns that the slopes go along."""
        return self._jacobian[1]

    def taken(self, feature: Feature, joints: Bools) -> dict[int, Array]:
        """The same of each of these joints, (N, K); kept, as few features are taken and these are asked for often."""
        kept = self._taken.setdefault(feature, {})
        for j in np.flatnonzero(joints).tolist():
            if j not in kept:
                kept[j] = self.column(feature, j)
        return kept

    def column(self, feature: Feature, joint: int) -> Array:
        """What the feature is a sum of on one joint, (N, K): of all joints at once it takes hundreds of MB."""
        u, shape = self._read(feature), feature.shape
        if u.shape[1] > 1:
            u, shape = u[:, [joint]], shape.at(np.array([joint]))
        columns: Array = shape.columns(u, self.start, self.dt)[:, :, 0]
        by = self._factor(feature)
        return columns if isinstance(by, float) else columns * by[:, joint, None]

    def _read(self, feature: Feature) -> Array:
        return read(feature.signal, self.views[feature.at], self.asked, self.joints)

    def _factor(self, feature: Feature) -> Array | float:
        key = feature.at, feature.times
        if key not in self._factors:
            self._factors[key] = factor(feature.times, self.views[feature.at], self.asked)
        return self._factors[key]

    def columns(self, feature: Feature, rows: slice = EVERY) -> Array:
        """What the feature is a sum of, (N, K, J), at some rows."""
        u = self._read(feature)
        if feature.shape.history:
            columns = feature.shape.columns(u, self.start, self.dt)[rows]
        else:
            columns = feature.shape.columns(u[rows], self.start[rows], self.dt)
        by = self._factor(feature)
        return columns if isinstance(by, float) else columns * by[rows, None]


def _past_only(s: Signals, dt: float) -> Signals:
    """The signals with an acceleration that a running model can have, too."""
    back = max(1, round(SLOPE / dt))
    n = np.arange(len(s.dq))
    began = np.maximum.accumulate(np.where(s.start[:, 0], n, 0))
    slope = (s.dq - s.dq[np.maximum(n - back, began)]) / (back * dt)
    return attrs.evolve(s, slope=lambda name: slope)


def library(scene: Scene, left: Array) -> Iterator[Feature]:
    """Everything that is tried on what is left (N, J)."""
    curve = _Curves(scene)
    for name in ("q", "dq", "ddq", "q_des", "tau", "error", "t"):
        yield curve(name, "", _MIDDLE)
    for times, names in (("direction", ("q", "tau", "t")), ("tau", ("q", "dq", "t")), ("dq", ("q", "t"))):
        for name in names:
            yield curve(name, times, _MIDDLE)
    for times in ("", "direction", "dq"):
        yield curve("q", times, _FINE)
    yield from (curve(name, times, _FINE) for name, times in (("dq", ""), ("t", ""), ("q", "tau")))
    yield from (curve(name, times, _FINEST) for name, times in (("q", ""), ("q", "direction"), ("dq", "")))
    rows = max(round(_HISTORY / scene.dt), 4)
    edges = tuple(scene.dt * np.unique(np.round(np.geomspace(1, rows, 7))))
    long = tuple(scene.dt * np.unique(np.round(np.linspace(1, 3 * rows, 12))))
    for name in ("tau", "q_des", "q", "dq"):
        yield Feature(name, "", Filter(edges))
    for name in ("tau", "q"):  # a lag of dq is what q has more than a lag of its own
        yield from (Feature(name, "", Lag(float(time))) for time in _LAGS)
    for name in ("tau", "q"):
        for frequency in _FREQUENCIES[0.35 / scene.dt > _FREQUENCIES]:
            yield from (Feature(name, "", Resonance(float(frequency), damping)) for damping in _DAMPING)
    for joint in scene.joints if len(scene.joints) > 1 else ():
        for name in ("q", "dq", "tau"):
            yield curve(f"{joint}/{name}", "", _MIDDLE)
            yield from (curve(f"{joint}/{name}", times, _COARSE) for times in ("direction", "tau", "dq"))
        yield curve(f"{joint}/q", "", _FINE)
        yield curve(f"{joint}/tau", "direction", _FINE)
        yield from (Feature(f"{joint}/{name}", "", Filter(edges)) for name in ("q", "tau"))
        yield Feature(f"{joint}/tau", "", Filter(long))
        yield from _ripples(scene, left, f"{joint}/q")
    yield from lines(scene, left)


class _Curves:
    """Makes curves over the range that a signal had."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._ranges: dict[str, Curve] = {}

    def __call__(self, signal: str, times: str, pieces: int) -> Feature:
        if signal not in self._ranges:
            u = read(signal, self._scene.views[DRIVE], self._scene.asked, self._scene.joints)
            self._ranges[signal] = Curve.over(u, pieces)
        return Feature(signal, times, attrs.evolve(self._ranges[signal], pieces=pieces))


def _ripples(scene: Scene, left: Array, signal: str) -> Iterator[Feature]:
    """A wave along the angle of another joint: the rate with which most of what is left goes."""
    u = read(signal, scene.views[JOINT], scene.asked, scene.joints)
    least = 2.0 * np.pi / max(float(np.ptp(u)), 1e-3)
    rates = _RATES[1.5 * least < _RATES]
    if rates.size:
        power = np.abs(np.exp(-1j * rates[:, None] * u[:, 0]) @ np.where(scene.judge.fit, left, 0.0)) ** 2
        yield Feature(signal, "", Wave(rates[np.argmax(power.max(axis=1))], 2))


def lines(scene: Scene, left: Array) -> Iterator[Feature]:
    """The strongest lines of the spectrum in time of what is left, each alone and with two overtones."""
    t = scene.views[JOINT].t[:, 0]
    span, period = float(np.ptp(t)), scene.dt
    grid = np.arange(max(2.0, 3.0 / span), 0.45 / period, 0.5 / span)
    even = np.arange(t.min(), t.max(), period)
    order = np.argsort(t, kind="stable")
    fitted = np.where(scene.judge.fit, left, 0.0)
    power = np.zeros(len(grid))
    for one in fitted.T:
        spectrum = np.fft.rfft(np.interp(even, t[order], one[order]), 2 * len(even))
        power = np.maximum(power, np.interp(grid, np.fft.rfftfreq(2 * len(even), period), np.abs(spectrum)))
    for best in np.argsort(-power)[:3]:
        near = grid[best] + np.linspace(-0.5 / span, 0.5 / span, 21)
        waves = np.exp(-2j * np.pi * np.outer(near, t)) @ fitted
        frequency = near[int(np.argmax((np.abs(waves) ** 2).sum(axis=1)))]
        yield from (Feature("t", "", Wave(2.0 * np.pi * frequency, count)) for count in (1, 3))
