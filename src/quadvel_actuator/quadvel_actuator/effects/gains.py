"""Gains that vary with torque sign, time, temperature or voltage; coupling between joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools

from .base import (
    DRIVE,
    JOINT,
    AddedLaw,
    EffectLaw,
    InitialGuess,
    Memory,
    MemoryLaw,
    Parameter,
    Params,
    Stage,
    TorqueLaw,
    View,
    one_of,
    stage_from_field,
)
from .dynamics import lag_series, lag_step
from .limits import TorqueSaturation


@attrs.frozen(eq=False)
class GainAsymmetry(TorqueLaw):
    """Gain that depends on the sign of the torque: tau* (1 + a sign(tau*)).

    `commanded` names the direction that has the commanded gain: the `mean` of both, or the `weaker`
    one; then all is divided by 1 - |a|.

    Attributes:
        commanded: `mean` or `weaker`.
    """

    name = "gain_asymmetry"
    stage = Stage.GAIN
    parameters = (Parameter("a", "1", -0.9, 0.9, 0.05),)
    signal = "tau"
    motion = "loads of both signs on every joint"
    commanded: str = attrs.field(default="mean", validator=one_of("mean", "weaker"))

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[GainAsymmetry]:
        return cls("mean"), cls("weaker")

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{"a": a} for a in (-0.2, -0.05, 0.05, 0.2)]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        both = x + p["a"] * np.abs(x)
        return both if self.commanded == "mean" else both / (1.0 - np.abs(p["a"]))


_MIN_TIME_CONSTANT_S = 2.0  # shortest warm-up; what settles sooner is a gain


@attrs.frozen(eq=False)
class ThermalDrift(TorqueLaw):
    """Gain drift with temperature or time: tau* (1 + drift).

        of temperature: drift = rate (temperature - cold)
        of time:        drift = rate tau_t (1 - exp(-t / tau_t))

    Attributes:
        of: `time` or `temperature`.
        cold: degrees Celsius, temperature at which the gain is nominal: the lowest one of the log.
    """

    name = "thermal_drift"
    stage = Stage.GAIN
    signal = "t"
    motion = "one motion repeated from cold until the drives are warm, with their temperature logged"
    of: str = attrs.field(default="time", validator=one_of("time", "temperature"))
    cold: float = 25.0

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        if self.of == "temperature":
            return (Parameter("rate", "1/K", -0.2, 0.2, 0.005),)
        return (
            Parameter("rate", "1/s", -2.0, 2.0, 0.02),
            Parameter("tau_t", "s", _MIN_TIME_CONSTANT_S, 3000.0, 5.0),
        )

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[ThermalDrift]:
        temperature = about.signals.temperature
        if temperature is None or float(np.ptp(temperature)) <= 0.5:
            return (cls("time"),)
        return (cls("time"), cls("temperature", float(np.quantile(temperature, 0.01))))

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        drifts = (-0.15, -0.04, 0.04, 0.15)  # over the log
        if self.of == "temperature":
            warming = max(float(np.max(s.temperature)) - self.cold, 0.5)
            return [{"rate": drift / warming} for drift in drifts]
        span = float(np.max(s.t))
        return [
            {"rate": drift / min(share, 1.0) / span, "tau_t": max(share * span, _MIN_TIME_CONSTANT_S)}
            for drift in drifts
            for share in (0.15, 0.5, 3.0)
        ]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        if self.of == "temperature":
            return x * (1.0 + p["rate"] * (s.temperature - self.cold))
        return x * (1.0 - p["rate"] * p["tau_t"] * np.expm1(-np.maximum(s.t, 0.0) / p["tau_t"]))


_ACTS_ON_GAIN: Any = property(lambda law: law.what == "gain")  # each drive has its own bound


@attrs.frozen(eq=False)
class SupplySag(TorqueLaw):
    """Gain or torque limit that falls with the supply voltage.

    The factor is 1 - sag (1 - V / full). Without a logged voltage V, `PowerSag` uses the power of
    the joints instead.

    Attributes:
        what: `gain` or `bound`.
        full: V, supply voltage without load.
        of: `voltage` or `power`.
    """

    name = "supply_sag"
    stage = stage_from_field("what", gain=Stage.GAIN, bound=Stage.LIMIT)
    signal = "tau"
    motion = "hard accelerations of all joints together, with the supply voltage logged"
    shared_by_joints = _ACTS_ON_GAIN
    what: str = attrs.field(default="gain", validator=one_of("gain", "bound"))
    full: float = 1.0
    of: str = attrs.field(default="voltage", validator=one_of("voltage", "power"))

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        return (Parameter("sag", "1", 0.0, 20.0, 0.3), *_limit_parameters(self.what))

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[EffectLaw]:
        voltage = about.signals.voltage
        if voltage is not None and float(np.ptp(voltage)) > 0.01 * float(np.max(voltage)):
            full = float(np.quantile(voltage, 0.99))
            return tuple(cls(what, full) for what in ("gain", "bound"))
        return tuple(PowerSag(what) for what in ("gain", "bound"))

    @classmethod
    @override
    def from_settings(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectLaw:
        form = cls(**settings)
        return PowerSag(form.what) if form.of == "power" else form

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return _sag_guesses(self.what, self._voltage_drop(s), torque)

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
        return _without_sag(p)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return _apply_sag(self.what, x, self._voltage_drop(s), p)

    def _voltage_drop(self, s: View) -> Array:
        """Return the relative voltage drop, max(1 - V / full, 0)."""
        strain: Array = np.maximum(1.0 - s.voltage / self.full, 0.0)
        return strain


@attrs.frozen(eq=False)
class PowerSag(MemoryLaw):
    """Gain or torque limit that falls by 1 - sag P_f with the power of all joints.

        T dP_f/dt = P - P_f, P = sum over joints of max(tau* dq, 0)

    Attributes:
        what: `gain` or `bound`.
    """

    name = SupplySag.name
    stage = stage_from_field("what", gain=Stage.GAIN, bound=Stage.LIMIT)
    signal = SupplySag.signal
    motion = SupplySag.motion
    shared_by_joints = _ACTS_ON_GAIN
    inputs = ("dq",)
    what: str = attrs.field(default="gain", validator=one_of("gain", "bound"))

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        late = Parameter("T", "s", 0.0005, 0.2, 0.01)
        return (Parameter("sag", "1/W", 0.0, 0.5, 0.0005), late, *_limit_parameters(self.what))

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {"of": "power", "what": self.what}

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        sags = _sag_guesses(self.what, _drawn_power(torque, s.dq), torque)
        return [{**sag, "T": late} for sag in sags for late in (0.002, 0.012)]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
        return _without_sag(p)

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (_drawn_power(x, u[0]),)

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        level = lag_step(memory[0], _drawn_power(x, u[0]), dt, p["T"])
        return _apply_sag(self.what, x, level, p), (level,)

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        return _apply_sag(self.what, x, lag_series(_drawn_power(x, s.dq), s, p["T"]), p)


def _limit_parameters(what: str) -> tuple[Parameter, ...]:
    """Return the torque limit as a parameter if the sag acts on a bound."""
    return () if what == "gain" else (Parameter("limit", "N m", 0.1, 500.0, 10.0),)


def _without_sag(p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
    """Return the constant torque limit that remains without sag; None for a gain."""
    return (TorqueSaturation(), {"limit": p["limit"]}) if "limit" in p else None


def _drawn_power(torque: Array, dq: Array) -> Array:
    """Mechanical power that all joints draw together, W, repeated for each joint (..., J)."""
    power = np.maximum(torque * dq, 0.0)
    return np.broadcast_to(power.sum(axis=-1, keepdims=True), power.shape)


def _sag_guesses(what: str, strain: Array, torque: Array) -> list[InitialGuess]:
    """List starting points of the sag and, for a bound, of the limit."""
    top = float(np.quantile(strain, 0.95)) + 1e-6
    sags: list[InitialGuess] = [{"sag": share / top} for share in (0.05, 0.2, 0.5)]
    if what == "gain":
        return sags
    limits = [np.quantile(np.abs(torque), at, axis=0) for at in (0.9, 0.97, 1.0)]
    return [{**sag, "limit": limit} for sag in sags for limit in limits]


def _apply_sag(what: str, x: Array, strain: Array, p: Params) -> Array:
    """Scale the torque, or its limit, by max(1 - sag strain, 0)."""
    left = np.maximum(1.0 - p["sag"] * strain, 0.0)
    return x * left if what == "gain" else np.clip(x, -p["limit"] * left, p["limit"] * left)


@attrs.frozen(eq=False)
class CrossCoupling(AddedLaw):
    """Coupling to another joint: a times its q, dq or tau; for q plus an offset.

    tau is the torque that the other drive gives without such effects: a measured one would carry
    its noise over.

    Attributes:
        source: signal for each joint, such as `FR_thigh_joint/dq`.
        columns: signal and joint index of each `source`.
    """

    name = "cross_coupling"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("a", "N m per unit of the source", -100.0, 100.0, 0.05),
    )
    linear: ClassVar[tuple[str, ...]] = ("a",)
    motion = "each joint moved alone while the others hold still"
    source: tuple[str, ...] = ()
    columns: tuple[tuple[str, int], ...] = ()

    @property
    @override
    def depends_on_drive_torque(self) -> bool:  # type: ignore[override]
        return any(name == "tau" for name, _ in self.columns)

    @property
    @override
    def signal(self) -> str:  # type: ignore[override]
        return self.source[0] if self.source else "dq"

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {"source": list(self.source)} | ({} if self.at == DRIVE else {"at": self.at})

    @classmethod
    @override
    def from_settings(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectLaw:
        return cls._of(tuple(settings["source"]), joints, settings.get("at", DRIVE))

    @classmethod
    def _of(cls, source: tuple[str, ...], joints: Sequence[str], at: str) -> CrossCoupling:
        """Build the form for these sources."""
        columns = tuple(cls._column(one, joints) for one in source)
        return cls._kind(columns)(source, columns, at=at)

    @staticmethod
    def _kind(columns: Iterable[tuple[str, int]]) -> type[CrossCoupling]:
        """Select the class with an offset if any source is a position."""
        return _PositionCoupling if any(signal == "q" for signal, _ in columns) else CrossCoupling

    @override
    def restricted_to(self, active: Bools) -> CrossCoupling:
        kind = self._kind(one for one, acts in zip(self.columns, active, strict=True) if acts)
        return self if type(self) is kind else kind(self.source, self.columns, at=self.at)

    @staticmethod
    def _column(source: str, joints: Sequence[str]) -> tuple[str, int]:
        """Split `JOINT/SIGNAL` into signal and joint index."""
        joint, signal = source.split("/")
        return signal, list(joints).index(joint)

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[CrossCoupling]:
        """Couple each joint to the neighbour's signal that correlates most with the residual.

        The correlation is partial: what signals of the joint itself explain is removed first.
        """
        found = about.strongest_neighbours()
        return tuple(cls._of(found, about.samples.joints, at) for at in (DRIVE, JOINT)) if found else ()

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{}]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        of = [x[..., k] if name == "tau" else getattr(s, name)[..., k] for name, k in self.columns]
        return p["a"] * np.stack(np.broadcast_arrays(*of), axis=-1)


@attrs.frozen(eq=False)
class _PositionCoupling(CrossCoupling):
    """Coupling with an offset for positions: the zero of a joint angle is a convention."""

    parameters = (*CrossCoupling.parameters, Parameter("offset", "N m", -300.0, 300.0, 0.1))
    linear = ("a", "offset")

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return super().torque(x, s, p) + self._of_positions_only(p["offset"])

    @override
    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        return p | {"offset": self._of_positions_only(p["offset"])}

    def _of_positions_only(self, offset: Any) -> Any:
        """Set the offset of other sources to 0."""
        return offset * np.array([signal == "q" for signal, _ in self.columns])


LAWS = (GainAsymmetry, ThermalDrift, SupplySag, CrossCoupling)
