"""Candidates of the effects of position: offset, spring, cogging, deadband, backlash, hysteresis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator.effects import DRIVE, elastic
from quadvel_description.arrays import Array, Bools

from ...data.signals import Signals
from ...model.effect_candidate import EffectCandidate, InitialGuess

_STIFFNESSES = (-10.0, -3.0, -1.0, -0.4, 0.4, 1.0, 2.0, 4.0, 10.0, 30.0)  # N m/rad
_MIN_PERIODS = 1.4
"""Periods of a cogging torque within the range of motion, at least."""
_SLOW_REVERSALS = "small slow reversals about many postures, each held for a second"
_SLOW_SWEEPS = "slow sweeps over the whole range of every joint"


class OffsetCandidate(EffectCandidate):
    """Constant torque, the same in the drive and at the joint."""

    linear = ("offset",)
    signal = "q"
    motion = (
        "a constant offset and an encoder bias differ only where kp changes: two recordings with different kp"
    )
    depends_on_commands = False
    places = (DRIVE,)


class SpringCandidate(EffectCandidate):
    """Spring in parallel with the drive."""

    linear = ("k",)
    signal = "q"
    motion = _SLOW_SWEEPS
    depends_on_commands = False

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        """Try stiffnesses of either sign that give the mean residual; gains hide the slope."""
        weight = (residual != 0.0).astype(float)
        n = weight.sum(axis=0) + 1e-9
        q, r = (s.q * weight).sum(axis=0) / n, residual.sum(axis=0) / n
        return [{"q0": q}, *({"q0": np.clip(q + r / k, -25.0, 25.0)} for k in _STIFFNESSES)]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectCandidate, Mapping[str, Array]]:
        """Return the constant torque k q0: a weak spring that rests far away."""
        return OffsetCandidate(elastic.TorqueOffset(at=self.at)), {"offset": p["k"] * p["q0"]}


class CoggingCandidate(EffectCandidate):
    """Cogging torque."""

    linear = ("a",)
    signal = "q"
    motion = _SLOW_SWEEPS
    depends_on_commands = False

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        """Take the four highest peaks of the residual's spectrum over the position."""
        # Fourier sums of the residual r over the position, at wave numbers n:
        #     line(n) = conj(sum_k r[k] exp(i n (q[k] - centre)))
        # n in half turns over the range of motion, so that neighbours are one resolution cell apart.
        spread = np.maximum(np.ptp(s.q, axis=0), 1e-3)
        steps = np.arange(1.0, 60.0, 0.5)
        centre = s.q.mean(axis=0)
        wave = np.exp(1j * 2.0 * np.pi * 0.5 * (s.q - centre) / spread)  # half a turn over the range
        lines = np.empty((len(steps), s.q.shape[1]), dtype=complex)
        power = wave * residual
        for i in range(len(steps)):
            power = power * wave
            lines[i] = np.conj(power.sum(axis=0))
        n = 2.0 * np.pi * 0.5 * np.arange(2, len(steps) + 2)[:, None] / spread
        size = np.where((n > 3.0) & (n < 400.0), np.abs(lines), 0.0)
        peak = (size >= np.roll(size, 1, axis=0)) & (size >= np.roll(size, -1, axis=0))
        order = np.argsort(-np.where(peak, size, 0.0), axis=0)
        found = []
        for rank in range(4):
            best = order[rank][None]
            line = np.take_along_axis(lines, best, axis=0)[0]
            turns = np.take_along_axis(np.broadcast_to(n, lines.shape), best, axis=0)[0]
            # residual ~ Re(conj(line) exp(-i n (q - centre))), which is a sine a quarter turn on
            phase = np.angle(line) + np.pi / 2 - turns * centre
            found.append({"n": turns, "phi": np.remainder(phase + np.pi, 2.0 * np.pi) - np.pi})
        return found

    @override
    def excited_joints(self, p: Mapping[str, Array], s: Signals) -> Bools:
        """Select joints that moved through enough periods; over less, cogging is any curve."""
        enough: Bools = np.ptp(s.q, axis=0) * p["n"] >= 2.0 * np.pi * _MIN_PERIODS
        return enough


class DeadbandCandidate(EffectCandidate):
    """Deadband of the position error, soft or hard."""

    signal = "q_des"
    motion = _SLOW_REVERSALS
    settings_to_try = {"edge": "soft"}, {"edge": "hard"}

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        error = np.abs(s.q_des - s.q)
        return [{"width": np.quantile(error, at, axis=0) + 5e-4} for at in np.linspace(0.03, 0.99, 33)]


@attrs.frozen(eq=False)
class BacklashCandidate(EffectCandidate):
    """Backlash of the position, the error or the torque."""

    effect: elastic.Backlash
    signal = "q@history"
    motion = _SLOW_REVERSALS
    settings_to_try = {"on": "error"}, {"on": "q"}, {"on": "torque"}

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        size = _rms(torque) if self.effect.on == "torque" else _rms(s.q_des - s.q)
        return [{"gap": share * size + 2e-4} for share in (0.05, 0.1, 0.2, 0.4, 0.8)]


class HysteresisCandidate(EffectCandidate):
    """Bouc-Wen hysteresis."""

    linear = ("F",)
    signal = "q@history"
    motion = _SLOW_REVERSALS

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        spread = _rms(s.q - s.q.mean(axis=0))
        return [{"reach": share * spread, "beta": 0.5} for share in (0.03, 0.1, 0.25, 0.6)]


def _rms(x: Array) -> Array:
    """Root mean square (J,) of rows (N, J), plus 1e-9."""
    value: Array = np.sqrt(np.mean(x * x, axis=-2)) + 1e-9
    return value


CANDIDATES = {
    elastic.TorqueOffset: OffsetCandidate,
    elastic.ParallelSpring: SpringCandidate,
    elastic.Cogging: CoggingCandidate,
    elastic.Deadband: DeadbandCandidate,
    elastic.Backlash: BacklashCandidate,
    elastic.Hysteresis: HysteresisCandidate,
}
