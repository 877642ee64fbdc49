"""Library of candidate regressors of named signals, and their refinement.

A candidate is a shape of a signal (`quadvel_actuator.effects.shapes`), times a factor (`MULTIPLIERS`
of `quadvel_actuator.effects.basis_regressors`: direction, dq or tau). `candidates` ranks them quickly
and fits the best. Shapes: N rows, C columns, one for each joint or one for all.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import singledispatch

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, JOINT
from quadvel_actuator.effects.shapes import Curve, Filter, Lag, Resonance, Shape, Wave
from quadvel_description.arrays import Array

from .context import Context
from .regressors import DRIVE_SIGNALS, RegressorCandidate, SignalRegressor, read_values

_LAG_TIMES_S = np.geomspace(0.01, 1.0, 8)
_RESONANCE_FREQUENCIES_HZ = np.geomspace(3.0, 110.0, 26)
_DAMPING_RATIOS = 0.02, 0.07, 0.2
_HISTORY_S = 0.02
"""Span of filters over a signal's past, s."""
_WAVE_RATES = np.arange(3.0, 120.0, 0.5)
"""Waves per 2 pi of the joint's angle."""
_CURVE_PIECES = 6
"""Pieces of a curve."""
_FINE_PIECES, _MAX_PIECES = 25, 100
"""Pieces of a fine curve, and of the finest one after refinement."""


def regressor_candidates(context: Context) -> Iterator[RegressorCandidate]:
    """Iterate over the regressors of named signals to screen.

    Args:
        context: Model and data.

    Yields:
        Curves, filters, lags, resonances and waves of the joints' signals and of time.
    """
    make = _RegressorFactory(context)
    for name in ("q", "dq", "ddq", "q_des", "tau", "error", "t"):
        yield make.curve(name, "")
    for times, names in (("direction", ("q", "tau", "t")), ("tau", ("q", "dq", "t")), ("dq", ("q", "t"))):
        for name in names:
            yield make.curve(name, times)
    for name, times in (("q", ""), ("q", "direction"), ("dq", ""), ("t", ""), ("q", "tau")):
        yield make.curve(name, times, _FINE_PIECES)
    rows = max(round(_HISTORY_S / make.dt), 4)
    filter_ages = tuple(make.dt * np.unique(np.round(np.geomspace(1, rows, 7))))
    long_filter_ages = tuple(make.dt * np.unique(np.round(np.linspace(1, 3 * rows, 12))))
    for name in ("tau", "q_des", "q", "dq"):
        yield make(name, "", Filter(filter_ages), DRIVE)
    for name in ("tau", "q"):
        yield from (make(name, "", Lag(float(time))) for time in _LAG_TIMES_S)
        for frequency in _RESONANCE_FREQUENCIES_HZ[0.35 / make.dt > _RESONANCE_FREQUENCIES_HZ]:
            yield from (make(name, "", Resonance(float(frequency), damping)) for damping in _DAMPING_RATIOS)
    for joint in make.joints if len(make.joints) > 1 else ():
        for name in ("q", "dq", "tau"):
            for times in ("", "direction", "tau", "dq"):
                yield make.curve(f"{joint}/{name}", times, _CURVE_PIECES if not times else 3)
        yield make(f"{joint}/tau", "", Filter(long_filter_ages))
        yield make(f"{joint}/q", "", Filter(filter_ages))
        yield from make.angle_waves(joint)
    yield from make.time_waves()


class _RegressorFactory:
    """Creates regressors of the signals of a model."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.joints = context.samples.joints
        self.dt = context.samples.period
        self._ranges: dict[str, Curve] = {}

    def __call__(self, of: str, times: str, shape: Shape, at: str = "") -> RegressorCandidate:
        """Create a regressor: in the drive if signal or factor is one of `DRIVE_SIGNALS`, else at the joint."""
        if not at:
            at = DRIVE if of in DRIVE_SIGNALS or times in DRIVE_SIGNALS else JOINT
        return RegressorCandidate(SignalRegressor(of, times, shape, self.joints, at=at))

    def _read(self, of: str) -> Array:
        """Values of a signal, (N, C)."""
        return read_values(of, self._context.torque, self._context.signals, self.joints)

    def curve(self, of: str, times: str, pieces: int = _CURVE_PIECES) -> RegressorCandidate:
        """Create a smooth curve over the observed range of a signal, a few outliers excepted.

        Args:
            of: Name of the signal.
            times: Name of the factor.
            pieces: Number of pieces of the curve.

        Returns:
            The regressor.
        """
        if of not in self._ranges:
            low, high = np.quantile(self._read(of), (0.005, 0.995), axis=0)
            self._ranges[of] = Curve(low, np.maximum(high, low + 1e-9), pieces)
        return self(of, times, attrs.evolve(self._ranges[of], pieces=pieces))

    def angle_waves(self, joint: str) -> Iterator[RegressorCandidate]:
        """Create a wave along another joint's angle, at the rate of most residual power.

        Args:
            joint: Name of the other joint.

        Yields:
            The regressor, if the angle spans 1.5 periods of some rate.
        """
        u = self._read(f"{joint}/q")
        rates = _WAVE_RATES[1.5 * 2.0 * np.pi / max(float(np.ptp(u)), 1e-3) < _WAVE_RATES]
        if rates.size:
            # Power |sum exp(-i n u) r|^2 of the residual r over the angle u, for each rate n.
            power = np.abs(np.exp(-1j * rates[:, None] * u[:, 0]) @ self._context.residual) ** 2
            yield self(f"{joint}/q", "", Wave(rates[np.argmax(power.max(axis=1))], 2))

    def time_waves(self) -> Iterator[RegressorCandidate]:
        """Create waves at the strongest spectral lines of the residual over time.

        Yields:
            For each of three frequencies a sine, and a sine with two overtones.
        """
        t, left = self._context.signals.t[:, 0], self._context.residual
        span = float(np.ptp(t))
        grid = np.arange(max(2.0, 3.0 / span), 0.45 / self.dt, 0.5 / span)
        # Periodogram of the residual on regular times, the largest of all joints. The resolution is
        # 1 / span, and the grid has half that step.
        even = np.arange(t.min(), t.max(), self.dt)
        order = np.argsort(t, kind="stable")
        power = np.zeros(len(grid))
        for one in left.T:
            spectrum = np.fft.rfft(np.interp(even, t[order], one[order]), 2 * len(even))
            found = np.interp(grid, np.fft.rfftfreq(2 * len(even), self.dt), np.abs(spectrum))
            power = np.maximum(power, found)
        for best in np.argsort(-power)[:3]:
            # Refine each line by |sum_t exp(-2 pi i f t) r(t)|^2 at the true times.
            near = grid[best] + np.linspace(-0.5 / span, 0.5 / span, 21)
            waves = np.exp(-2j * np.pi * np.outer(near, t)) @ left
            frequency = near[int(np.argmax((np.abs(waves) ** 2).sum(axis=1)))]
            yield from (self("t", "", Wave(2.0 * np.pi * frequency, count), JOINT) for count in (1, 3))


def refinements(candidate: RegressorCandidate) -> list[RegressorCandidate]:
    """List variations of a regressor near its present shape.

    Args:
        candidate: The regressor.

    Returns:
        Regressors with a finer curve, another time constant, frequency, damping, or place.
    """
    effect = candidate.effect
    found = [attrs.evolve(effect, shape=one) for one in _near(effect.shape)]
    if effect.of not in ("q_des", "error", "t") and not isinstance(effect.shape, Filter):
        found.append(attrs.evolve(effect, at=DRIVE if effect.at == JOINT else JOINT))
    return [RegressorCandidate(one) for one in found]


@singledispatch
def _near(shape: Shape) -> list[Shape]:
    """Shapes near a shape."""
    return []


@_near.register
def _near_curve(shape: Curve) -> list[Shape]:
    """A finer curve."""
    return [attrs.evolve(shape, pieces=2 * shape.pieces)] if shape.pieces < _MAX_PIECES else []


@_near.register
def _near_lag(shape: Lag) -> list[Shape]:
    """Lags with other time constants."""
    return [Lag(shape.time * by) for by in (0.7, 0.85, 1.18, 1.4)]


@_near.register
def _near_resonance(shape: Resonance) -> list[Shape]:
    """Resonances with another frequency or damping."""
    return [
        *(Resonance(shape.frequency * by, shape.damping) for by in (0.93, 0.97, 1.03, 1.07)),
        *(Resonance(shape.frequency, min(shape.damping * by, 0.9)) for by in (0.6, 1.6)),
    ]
