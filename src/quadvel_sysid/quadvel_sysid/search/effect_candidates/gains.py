"""Candidates of gains that vary, and of coupling between joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator.effects import EffectModel, gains
from quadvel_actuator.effects.limits import TorqueSaturation
from quadvel_description.arrays import Array, Bools

from ...data.signals import Signals
from ...model.effect_candidate import EffectCandidate, FormContext, InitialGuess
from .limits import SaturationCandidate


class GainAsymmetryCandidate(EffectCandidate):
    """Gain that depends on the sign of the torque."""

    motion = "loads of both signs on every joint"
    settings_to_try = {"commanded": "mean"}, {"commanded": "weaker"}
    guesses = tuple({"a": a} for a in (-0.2, -0.05, 0.05, 0.2))


@attrs.frozen(eq=False)
class ThermalDriftCandidate(EffectCandidate):
    """Gain drift with temperature or time."""

    effect: gains.ThermalDrift
    signal = "t"
    motion = "one motion repeated from cold until the drives are warm, with their temperature logged"

    @classmethod
    @override
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[EffectCandidate]:
        temperature = context.signals.temperature
        if temperature is None or float(np.ptp(temperature)) <= 0.5:
            return (cls(gains.ThermalDrift("time")),)
        cold = float(np.quantile(temperature, 0.01))
        return cls(gains.ThermalDrift("time")), cls(gains.ThermalDrift("temperature", cold))

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        drifts = (-0.15, -0.04, 0.04, 0.15)  # over the log
        if self.effect.of == "temperature" and s.temperature is not None:
            warming = max(float(np.max(s.temperature)) - self.effect.cold, 0.5)
            return [{"rate": drift / warming} for drift in drifts]
        span = float(np.max(s.t))
        return [
            {"rate": drift / min(share, 1.0) / span, "tau_t": max(share * span, gains.MIN_TIME_CONSTANT_S)}
            for drift in drifts
            for share in (0.15, 0.5, 3.0)
        ]


@attrs.frozen(eq=False)
class SupplySagCandidate(EffectCandidate):
    """Gain or torque limit that falls with the supply voltage, or with the power where none is logged."""

    effect: gains.SupplySag | gains.PowerSag
    motion = "hard accelerations of all joints together, with the supply voltage logged"
    possible_on_one_joint = False  # all drives have the same supply

    @property
    @override
    def shared_by_joints(self) -> bool:
        return self.effect.what == "gain"  # each drive has its own bound

    @classmethod
    @override
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[EffectCandidate]:
        voltage = context.signals.voltage
        if voltage is not None and float(np.ptp(voltage)) > 0.01 * float(np.max(voltage)):
            full = float(np.quantile(voltage, 0.99))
            return tuple(cls(gains.SupplySag(what, full)) for what in ("gain", "bound"))
        return tuple(cls(gains.PowerSag(what)) for what in ("gain", "bound"))

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        if isinstance(self.effect, gains.SupplySag):
            return self._guesses(self.effect.voltage_drop(s), torque)
        sags = self._guesses(gains.drawn_power(torque, s.dq), torque)
        return [{**sag, "T": late} for sag in sags for late in (0.002, 0.012)]

    def _guesses(self, strain: Array, torque: Array) -> list[InitialGuess]:
        """List starting points of the sag and, for a bound, of the limit."""
        top = float(np.quantile(strain, 0.95)) + 1e-6
        sags: list[InitialGuess] = [{"sag": share / top} for share in (0.05, 0.2, 0.5)]
        if self.effect.what == "gain":
            return sags
        limits = [np.quantile(np.abs(torque), at, axis=0) for at in (0.9, 0.97, 1.0)]
        return [{**sag, "limit": limit} for sag in sags for limit in limits]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectCandidate, Mapping[str, Array]] | None:
        """Return the constant torque limit that remains without sag; None for a gain."""
        return (SaturationCandidate(TorqueSaturation()), {"limit": p["limit"]}) if "limit" in p else None


@attrs.frozen(eq=False)
class CrossCouplingCandidate(EffectCandidate):
    """Coupling to another joint."""

    effect: gains.CrossCoupling
    motion = "each joint moved alone while the others hold still"

    @property
    @override
    def linear(self) -> tuple[str, ...]:
        return self.names

    @property
    @override
    def depends_on_commands(self) -> bool:
        return any(name == "tau" for name, _ in self.effect.columns)

    @property
    @override
    def signal(self) -> str:
        return self.effect.source[0] if self.effect.source else "dq"

    @override
    def restricted_to(self, active: Bools) -> CrossCouplingCandidate:
        """Return the form without an offset if no source of these joints is a position."""
        columns = zip(self.effect.columns, active, strict=True)
        kind = (
            gains.PositionCoupling
            if any(acts and name == "q" for (name, _), acts in columns)
            else gains.CrossCoupling
        )
        if type(self.effect) is kind:
            return self
        return CrossCouplingCandidate(kind(self.effect.source, self.effect.columns, at=self.at))

    @classmethod
    @override
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[EffectCandidate]:
        """Couple each joint to the neighbour's signal that correlates most with the residual.

        The correlation is partial: what signals of the joint itself explain is removed first.
        """
        source = context.strongest_neighbours()
        if not source:
            return ()
        joints, every = context.samples.joints, ({"source": source, "at": at} for at in cls.places)
        return [cls(gains.CrossCoupling.from_settings(settings, joints)) for settings in every]


CANDIDATES = {
    gains.GainAsymmetry: GainAsymmetryCandidate,
    gains.ThermalDrift: ThermalDriftCandidate,
    gains.SupplySag: SupplySagCandidate,
    gains.CrossCoupling: CrossCouplingCandidate,
}
