"""Gains that change: with the torque's sign, with time or temperature, with the supply; and coupling."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import attrs
import numpy as np

from .base import (
    DRIVE,
    JOINT,
    AddedLaw,
    Array,
    Bools,
    EffectLaw,
    Memory,
    MemoryLaw,
    Parameter,
    Params,
    Stage,
    Start,
    TorqueLaw,
    View,
    one_of,
    staged,
)
from .dynamics import lag, lagged
from .limits import TorqueSaturation


@attrs.frozen(eq=False)
class GainAsymmetry(TorqueLaw):
    """tau* (1 + a sign(tau*)); where the weaker way is the one as `commanded`, all of it over 1 - |a|"""

    name = "gain_asymmetry"
    stage = Stage.GAIN
    parameters = (Parameter("a", "1", -0.9, 0.9, 0.05),)
    signal = "tau"
    motion = "loads of both signs on every joint"
    commanded: str = attrs.field(default="mean", validator=one_of("mean", "weaker"))

    @classmethod
    def variants(cls, about: Any) -> Sequence[GainAsymmetry]:
        return cls("mean"), cls("weaker")

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"a": a} for a in (-0.2, -0.05, 0.05, 0.2)]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        both = x + p["a"] * np.abs(x)
        return both if self.commanded == "mean" else both / (1.0 - np.abs(p["a"]))


_QUICKEST = 2.0  # s, in which a drive warms up; what settles at once is a gain


@attrs.frozen(eq=False)
class ThermalDrift(TorqueLaw):
    """tau* (1 + drift): with temperature, drift = rate (temperature - `cold`), else rate tau_t (1 - exp(-t / tau_t))

    `cold` is the least temperature of the log: the gains are those of a drive as cold as that, whichever of them warms.
    """

    name = "thermal_drift"
    stage = Stage.GAIN
    signal = "t"
    motion = "one motion repeated from cold until the drives are warm, with their temperature logged"
    of: str = attrs.field(default="time", validator=one_of("time", "temperature"))
    cold: float = 25.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        if self.of == "temperature":
            return (Parameter("rate", "1/K", -0.2, 0.2, 0.005),)
        return (Parameter("rate", "1/s", -2.0, 2.0, 0.02), Parameter("tau_t", "s", _QUICKEST, 3000.0, 5.0))

    @classmethod
    def variants(cls, about: Any) -> Sequence[ThermalDrift]:
        temperature = about.signals.temperature
        if temperature is None or float(np.ptp(temperature)) <= 0.5:
            return (cls("time"),)
        return (cls("time"), cls("temperature", float(np.quantile(temperature, 0.01))))

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        drifts = (-0.15, -0.04, 0.04, 0.15)  # over the log
        if self.of == "temperature":
            warming = max(float(np.max(s.temperature)) - self.cold, 0.5)
            return [{"rate": drift / warming} for drift in drifts]
        span = float(np.max(s.t))
        return [
            {"rate": drift / min(share, 1.0) / span, "tau_t": max(share * span, _QUICKEST)}
            for drift in drifts
            for share in (0.15, 0.5, 3.0)
        ]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        if self.of == "temperature":
            return x * (1.0 + p["rate"] * (s.temperature - self.cold))
        return x * (1.0 - p["rate"] * p["tau_t"] * np.expm1(-np.maximum(s.t, 0.0) / p["tau_t"]))


_OF_ONE_SUPPLY: Any = property(lambda law: law.what == "gain")  # a bound is each drive's own


@attrs.frozen(eq=False)
class SupplySag(TorqueLaw):
    """Gain or bound falls with the logged voltage, by 1 - sag (1 - V / `full`), or with the joints' power (`PowerSag`)"""

    name = "supply_sag"
    stage = staged("what", gain=Stage.GAIN, bound=Stage.LIMIT)
    signal = "tau"
    motion = "hard accelerations of all joints together, with the supply voltage logged"
    shared_by_joints = _OF_ONE_SUPPLY
    what: str = attrs.field(default="gain", validator=one_of("gain", "bound"))
    full: float = 1.0
    of: str = attrs.field(default="voltage", validator=one_of("voltage", "power"))

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        return (Parameter("sag", "1", 0.0, 20.0, 0.3), *_limit(self.what))

    @classmethod
    def variants(cls, about: Any) -> Sequence[EffectLaw]:
        voltage = about.signals.voltage
        if voltage is not None and float(np.ptp(voltage)) > 0.01 * float(np.max(voltage)):
            full = float(np.quantile(voltage, 0.99))
            return tuple(cls(what, full) for what in ("gain", "bound"))
        return tuple(PowerSag(what) for what in ("gain", "bound"))

    @classmethod
    def configured(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectLaw:
        form = cls(**settings)
        return PowerSag(form.what) if form.of == "power" else form

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return _sags(self.what, self._strain(s), torque)

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
        return _unsagged(p)

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return _sagging(self.what, x, self._strain(s), p)

    def _strain(self, s: View) -> Array:
        strain: Array = np.maximum(1.0 - s.voltage / self.full, 0.0)
        return strain


@attrs.frozen(eq=False)
class PowerSag(MemoryLaw):
    """Gain or bound falls by 1 - sag P, where P is the power that the joints draw together, T s late (first order)"""

    name = SupplySag.name
    stage = staged("what", gain=Stage.GAIN, bound=Stage.LIMIT)
    signal = SupplySag.signal
    motion = SupplySag.motion
    shared_by_joints = _OF_ONE_SUPPLY
    inputs = ("dq",)
    what: str = attrs.field(default="gain", validator=one_of("gain", "bound"))

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        late = Parameter("T", "s", 0.0005, 0.2, 0.01)
        return (Parameter("sag", "1/W", 0.0, 0.5, 0.0005), late, *_limit(self.what))

    @property
    def settings(self) -> dict[str, Any]:
        return {"of": "power", "what": self.what}

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        sags = _sags(self.what, _power(torque, s.dq), torque)
        return [{**sag, "T": late} for sag in sags for late in (0.002, 0.012)]

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
        return _unsagged(p)

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (_power(x, u[0]),)

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        level = lag(memory[0], _power(x, u[0]), dt, p["T"])
        return _sagging(self.what, x, level, p), (level,)

    def series(self, x: Any, s: Any, p: Params) -> Any:
        return _sagging(self.what, x, lagged(_power(x, s.dq), s, p["T"]), p)


def _limit(what: str) -> tuple[Parameter, ...]:
    return () if what == "gain" else (Parameter("limit", "N m", 0.1, 500.0, 10.0),)


def _unsagged(p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
    """The constant bound that is left where the supply does not sag; None of a gain."""
    return (TorqueSaturation(), {"limit": p["limit"]}) if "limit" in p else None


def _power(torque: Array, dq: Array) -> Array:
    """Mechanical power that the joints draw together, W, for each of them (..., J)."""
    power = np.maximum(torque * dq, 0.0)
    return np.broadcast_to(power.sum(axis=-1, keepdims=True), power.shape)


def _sags(what: str, strain: Array, torque: Array) -> list[Start]:
    top = float(np.quantile(strain, 0.95)) + 1e-6
    sags: list[Start] = [{"sag": share / top} for share in (0.05, 0.2, 0.5)]
    if what == "gain":
        return sags
    limits = [np.quantile(np.abs(torque), at, axis=0) for at in (0.9, 0.97, 1.0)]
    return [{**sag, "limit": limit} for sag in sags for limit in limits]


def _sagging(what: str, x: Array, strain: Array, p: Params) -> Array:
    left = np.maximum(1.0 - p["sag"] * strain, 0.0)
    return x * left if what == "gain" else np.clip(x, -p["limit"] * left, p["limit"] * left)


@attrs.frozen(eq=False)
class CrossCoupling(AddedLaw):
    """a times q, dq or tau of another joint: `source` names one for each joint, as in FR_thigh_joint/dq; of q, plus an offset

    tau is what that joint's drive gives without such effects: a measured one would carry its noise over.
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
    def of_drive(self) -> bool:  # type: ignore[override]
        return any(name == "tau" for name, _ in self.columns)

    @property
    def signal(self) -> str:  # type: ignore[override]
        return self.source[0] if self.source else "dq"

    @property
    def settings(self) -> dict[str, Any]:
        return {"source": list(self.source)} | ({} if self.at == DRIVE else {"at": self.at})

    @classmethod
    def configured(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectLaw:
        return cls._of(tuple(settings["source"]), joints, settings.get("at", DRIVE))

    @classmethod
    def _of(cls, source: tuple[str, ...], joints: Sequence[str], at: str) -> CrossCoupling:
        columns = tuple(cls._column(one, joints) for one in source)
        return cls._kind(columns)(source, columns, at=at)

    @staticmethod
    def _kind(columns: Iterable[tuple[str, int]]) -> type[CrossCoupling]:
        return _PositionCoupling if any(signal == "q" for signal, _ in columns) else CrossCoupling

    def restricted_to(self, active: Bools) -> CrossCoupling:
        kind = self._kind(one for one, acts in zip(self.columns, active, strict=True) if acts)
        return self if type(self) is kind else kind(self.source, self.columns, at=self.at)

    @staticmethod
    def _column(source: str, joints: Sequence[str]) -> tuple[str, int]:
        joint, signal = source.split("/")
        return signal, list(joints).index(joint)

    @classmethod
    def variants(cls, about: Any) -> Sequence[CrossCoupling]:
        """For each joint the other's signal that the residual goes with most, beside what the joint's own explain."""
        found = about.strongest_neighbours()
        return tuple(cls._of(found, about.samples.joints, at) for at in (DRIVE, JOINT)) if found else ()

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        of = [x[..., k] if name == "tau" else getattr(s, name)[..., k] for name, k in self.columns]
        return p["a"] * np.stack(np.broadcast_arrays(*of), axis=-1)


@attrs.frozen(eq=False)
class _PositionCoupling(CrossCoupling):
    """The same with an offset where it is of q: where a joint's angle is zero is a convention."""

    parameters = (*CrossCoupling.parameters, Parameter("offset", "N m", -300.0, 300.0, 0.1))
    linear = ("a", "offset")

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return super().torque(x, s, p) + self._own(p["offset"])

    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        return p | {"offset": self._own(p["offset"])}

    def _own(self, offset: Any) -> Any:
        return offset * np.array([signal == "q" for signal, _ in self.columns])


LAWS = (GainAsymmetry, ThermalDrift, SupplySag, CrossCoupling)
