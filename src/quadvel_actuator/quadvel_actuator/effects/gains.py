"""Effects that scale the drive's torque, by its sign, time, temperature, voltage or power; coupling of joints.

A gain is here the ratio of delivered to commanded torque. The deviations of kp and kd are
`delta_kp` and `delta_kd` of `parameters`.

The identification that finds them in logs is a package of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from .base import (
    DRIVE,
    AddedEffect,
    EffectModel,
    Memory,
    MemoryEffect,
    Parameter,
    Params,
    Stage,
    TorqueEffect,
    View,
    one_of,
    stage_from_field,
)
from .dynamics import lag_series, lag_step


@attrs.frozen(eq=False)
class GainAsymmetry(TorqueEffect):
    """Gain that depends on the sign of the torque: tau* (1 + a sign(tau*)).

    The commanded gain is the mean of both directions (`commanded: mean`), or that of the weaker one
    (`weaker`), which divides the torque by 1 - |a|.

    Attributes:
        commanded: `mean` or `weaker`.
    """

    name = "gain_asymmetry"
    stage = Stage.GAIN
    parameters = (Parameter("a", "1", -0.9, 0.9, 0.05),)
    commanded: str = attrs.field(default="mean", validator=one_of("mean", "weaker"))

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        both = x + p["a"] * np.abs(x)
        return both if self.commanded == "mean" else both / (1.0 - np.abs(p["a"]))


MIN_TIME_CONSTANT_S = 2.0  # shortest warm-up; what settles sooner is a gain


@attrs.frozen(eq=False)
class ThermalDrift(TorqueEffect):
    """Gain drift with temperature or time: tau* (1 + drift).

        of temperature: drift = rate (temperature - cold)
        of time:        drift = rate tau_t (1 - exp(-t / tau_t))

    Attributes:
        of: `time` or `temperature`.
        cold: degrees Celsius, temperature at which the gain is nominal; the identification sets it to the
            lowest one of the log.
    """

    name = "thermal_drift"
    stage = Stage.GAIN
    of: str = attrs.field(default="time", validator=one_of("time", "temperature"))
    cold: float = 25.0

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:
        if self.of == "temperature":
            return (Parameter("rate", "1/K", -0.2, 0.2, 0.005),)
        return (
            Parameter("rate", "1/s", -2.0, 2.0, 0.02),
            Parameter("tau_t", "s", MIN_TIME_CONSTANT_S, 3000.0, 5.0),
        )

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        if self.of == "temperature":
            return x * (1.0 + p["rate"] * (s.temperature - self.cold))
        return x * (1.0 - p["rate"] * p["tau_t"] * np.expm1(-np.maximum(s.t, 0.0) / p["tau_t"]))


@attrs.frozen(eq=False)
class SupplySag(TorqueEffect):
    """Gain or torque limit that falls with the supply voltage.

    The factor is 1 - sag (1 - V / full). Without a logged voltage V, `PowerSag` uses the power of
    the joints instead.

    Attributes:
        what: `gain` or `bound`.
        full: V, supply voltage without load.
        of: `voltage` or `power`; with `power`, `from_settings` returns a `PowerSag`.
    """

    name = "supply_sag"
    stage = stage_from_field("what", gain=Stage.GAIN, bound=Stage.LIMIT)
    what: str = attrs.field(default="gain", validator=one_of("gain", "bound"))
    full: float = 1.0
    of: str = attrs.field(default="voltage", validator=one_of("voltage", "power"))

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sag", "1", 0.0, 20.0, 0.3), *_limit_parameters(self.what))

    @classmethod
    @override
    def from_settings(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectModel:
        form = cls(**settings)
        return PowerSag(form.what) if form.of == "power" else form

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return _apply_sag(self.what, x, self.voltage_drop(s), p)

    def voltage_drop(self, s: View) -> Array:
        """Return the relative voltage drop, max(1 - V / full, 0).

        Args:
            s: signals with the voltage.

        Returns:
            The drop, of the shape of the voltage.
        """
        drop: Array = np.maximum(1.0 - s.voltage / self.full, 0.0)
        return drop


@attrs.frozen(eq=False)
class PowerSag(MemoryEffect):
    """Gain or torque limit that falls as 1 - sag P_f; P_f (W) is the filtered mechanical power of all joints.

        T dP_f/dt = P - P_f, P = sum over joints of max(tau* dq, 0)

    Attributes:
        what: `gain` or `bound`.
    """

    name = SupplySag.name
    stage = stage_from_field("what", gain=Stage.GAIN, bound=Stage.LIMIT)
    inputs = ("dq",)
    what: str = attrs.field(default="gain", validator=one_of("gain", "bound"))

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:
        late = Parameter("T", "s", 0.0005, 0.2, 0.01)
        return (Parameter("sag", "1/W", 0.0, 0.5, 0.0005), late, *_limit_parameters(self.what))

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {"of": "power", "what": self.what}

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (drawn_power(x, u[0]),)

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        level = lag_step(memory[0], drawn_power(x, u[0]), dt, p["T"])
        return _apply_sag(self.what, x, level, p), (level,)

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        return _apply_sag(self.what, x, lag_series(drawn_power(x, s.dq), s, p["T"]), p)


def _limit_parameters(what: str) -> tuple[Parameter, ...]:
    """Return the torque limit as a parameter if the sag acts on a bound."""
    return () if what == "gain" else (Parameter("limit", "N m", 0.1, 500.0, 10.0),)


def drawn_power(torque: Array, dq: Array) -> Array:
    """Compute the mechanical power that all joints draw together.

    Args:
        torque: N m, (..., J).
        dq: rad/s, (..., J).

    Returns:
        W, repeated for each joint, (..., J).
    """
    power = np.maximum(torque * dq, 0.0)
    return np.broadcast_to(power.sum(axis=-1, keepdims=True), power.shape)


def _apply_sag(what: str, x: Array, drop: Array, p: Params) -> Array:
    """Scale the torque, or its limit, by max(1 - sag drop, 0)."""
    factor = np.maximum(1.0 - p["sag"] * drop, 0.0)
    return x * factor if what == "gain" else np.clip(x, -p["limit"] * factor, p["limit"] * factor)


@attrs.frozen(eq=False)
class CrossCoupling(AddedEffect):
    """Coupling: adds a times q, dq or tau of another joint, and for q an offset.

    tau is the other drive's torque before added effects, because a measured torque would add its
    noise.

    Attributes:
        source: for each joint with the effect, the other joint's signal, such as `FR_thigh_joint/dq`.
        columns: signal and joint index of each `source`.
    """

    name = "cross_coupling"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("a", "N m per unit of the source", -100.0, 100.0, 0.05),
    )
    source: tuple[str, ...] = ()
    columns: tuple[tuple[str, int], ...] = ()

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {"source": list(self.source)} | ({} if self.at == DRIVE else {"at": self.at})

    @classmethod
    @override
    def from_settings(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> CrossCoupling:
        source = tuple(settings["source"])
        columns = tuple(cls._column(one, joints) for one in source)
        kind = PositionCoupling if any(signal == "q" for signal, _ in columns) else CrossCoupling
        return kind(source, columns, at=settings.get("at", DRIVE))

    @staticmethod
    def _column(source: str, joints: Sequence[str]) -> tuple[str, int]:
        """Split `JOINT/SIGNAL` into signal and joint index."""
        joint, signal = source.split("/")
        return signal, list(joints).index(joint)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        of = [x[..., k] if name == "tau" else getattr(s, name)[..., k] for name, k in self.columns]
        return p["a"] * np.stack(np.broadcast_arrays(*of), axis=-1)


@attrs.frozen(eq=False)
class PositionCoupling(CrossCoupling):
    """Coupling with an offset for positions: the zero of a joint angle is a convention."""

    parameters = (*CrossCoupling.parameters, Parameter("offset", "N m", -300.0, 300.0, 0.1))

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return super().torque(x, s, p) + self._of_positions_only(p["offset"])

    @override
    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        return p | {"offset": self._of_positions_only(p["offset"])}

    def _of_positions_only(self, offset: Any) -> Any:
        """Set the offset of other sources to 0."""
        return offset * np.array([signal == "q" for signal, _ in self.columns])


EFFECTS = (GainAsymmetry, ThermalDrift, SupplySag, CrossCoupling)
