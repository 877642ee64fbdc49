"""Laws of position: offsets, springs, cogging, deadband, and play and hysteresis with their memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from . import recurrence
from .base import (
    AddedLaw,
    Array,
    Bools,
    EffectLaw,
    ErrorLaw,
    Errors,
    Memory,
    MemoryLaw,
    Parameter,
    Params,
    Stage,
    Start,
    View,
    of_each,
    one_of,
    rms,
    staged,
)

_STIFFNESSES = (-10.0, -3.0, -1.0, -0.4, 0.4, 1.0, 2.0, 4.0, 10.0, 30.0)  # N m/rad
_STILL = "small slow reversals about many postures, each held for a second"


class TorqueOffset(AddedLaw):
    """A constant; an encoder bias looks the same"""

    name = "torque_offset"
    parameters = (Parameter("offset", "N m", -20.0, 20.0, 0.3),)
    linear = ("offset",)
    of_drive = False
    signal = "q"
    motion = (
        "a constant offset and an encoder bias differ only where kp changes: two recordings with different kp"
    )

    @classmethod
    def variants(cls, about: Any) -> Sequence[TorqueOffset]:
        return (cls(),)

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return p["offset"] + 0.0 * s.q


class ParallelSpring(AddedLaw):
    """-k (q - q0)"""

    name = "parallel_spring"
    parameters = (Parameter("k", "N m/rad", -200.0, 200.0, 1.0), Parameter("q0", "rad", -30.0, 30.0, 0.3))
    linear = ("k",)
    of_drive = False
    signal = "q"
    motion = "slow sweeps over the whole range of every joint"

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        """Of any stiffness, at rest where it gives the mean of the residual: gains hide the slope of it."""
        weight = (residual != 0.0).astype(float)
        n = weight.sum(axis=0) + 1e-9
        q, r = (s.q * weight).sum(axis=0) / n, residual.sum(axis=0) / n
        return [{"q0": q}, *({"q0": np.clip(q + r / k, -25.0, 25.0)} for k in _STIFFNESSES)]

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]]:
        """A weak spring that rests far away is a constant."""
        return TorqueOffset(at=self.at), {"offset": p["k"] * p["q0"]}

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["k"] * (s.q - p["q0"])


class Cogging(AddedLaw):
    """a sin(n q + phi)"""

    name = "cogging"
    parameters = (
        Parameter("a", "N m", -20.0, 20.0, 0.3),
        Parameter("n", "1/rad", 3.0, 400.0, 0.2),
        Parameter("phi", "rad", -20.0, 20.0, 0.3),
    )
    linear = ("a",)
    of_drive = False
    signal = "q"
    motion = "slow sweeps over the whole range of every joint"

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        """The highest lines of the residual's spectrum over the position."""
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

    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        phi = p["phi"] + np.where(p["a"] < 0.0, np.pi, 0.0)
        return p | {"a": np.abs(p["a"]), "phi": np.remainder(phi + np.pi, 2.0 * np.pi) - np.pi}

    def excited_joints(self, p: Params, s: View) -> Bools:
        """Joints that moved through a whole period: a part of one is any curve over the angle."""
        whole: Bools = np.ptp(s.q, axis=0) * p["n"] >= 2.0 * np.pi
        return whole

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return p["a"] * of_each(lambda n, phi: np.sin(n * s.q + phi), p["n"], p["phi"])


@attrs.frozen(eq=False)
class Deadband(ErrorLaw):
    """No answer to position errors below `width`; beyond it the whole error (`edge` hard), or what exceeds it (soft)"""

    name = "deadband"
    parameters = (Parameter("width", "rad", 0.0005, 0.5, 0.01),)
    signal = "q_des"
    motion = _STILL
    edge: str = attrs.field(default="soft", validator=one_of("soft", "hard"))

    @classmethod
    def variants(cls, about: Any) -> Sequence[Deadband]:
        return cls("soft"), cls("hard")

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        error = np.abs(s.q_des - s.q)
        return [{"width": np.quantile(error, at, axis=0) + 5e-4} for at in np.linspace(0.03, 0.99, 33)]

    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        beyond = np.abs(e[0]) > p["width"]
        less = p["width"] * np.sign(e[0]) if self.edge == "soft" else 0.0
        return np.where(beyond, e[0] - less, 0.0), e[1]


@attrs.frozen(eq=False)
class Backlash(MemoryLaw):
    """Play: the drive sees `on` (the position q, the error q_des - q, or the torque) through a gap of +-`gap`"""

    name = "backlash"
    stage = staged("on", error=Stage.ERRORS, q=Stage.ERRORS, torque=Stage.DYNAMICS)
    on: str = attrs.field(default="error", validator=one_of("error", "q", "torque"))

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        if self.on == "torque":
            return (Parameter("gap", "N m", 0.01, 50.0, 0.3),)
        return (Parameter("gap", "rad", 0.0002, 0.5, 0.01),)

    inputs = ("q",)
    signal = "q@history"
    motion = _STILL

    @classmethod
    def variants(cls, about: Any) -> Sequence[Backlash]:
        return tuple(cls(on) for on in ("error", "q", "torque"))

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        of = {"error": rms(s.q_des - s.q), "q": rms(s.q_des - s.q), "torque": rms(torque)}[self.on]
        return [{"gap": share * of + 2e-4} for share in (0.05, 0.1, 0.2, 0.4, 0.8)]

    def _seen(self, x: Any, u: Sequence[Array]) -> Array:
        if self.on == "q":
            return u[0]
        seen: Array = x if self.on == "torque" else x[0]
        return seen

    def _given(self, x: Any, u: Sequence[Array], follows: Array) -> Any:
        if self.on == "torque":
            return follows
        return (follows if self.on == "error" else x[0] + u[0] - follows), x[1]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (self._seen(x, u) + 0.0 * p["gap"],)

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        follows = recurrence.backlash_step(memory[0], self._seen(x, u), p["gap"])
        return self._given(x, u, follows), (follows,)

    def series(self, x: Any, s: Any, p: Params) -> Any:
        return self._given(x, (s.q,), recurrence.backlash_series(self._seen(x, (s.q,)), s.start, p["gap"]))


class Hysteresis(MemoryLaw):
    """-F z with Bouc-Wen's dz/dq = (1 - (beta + (1 - beta) sign(z dq)) |z|) / reach, -1 <= z <= 1"""

    name = "hysteresis"
    stage = Stage.ADDED
    linear = ("F",)
    parameters = (
        Parameter("F", "N m", 0.0, 30.0, 0.3),
        Parameter("reach", "rad", 0.001, 1.0, 0.03),
        Parameter("beta", "1", 0.0, 1.0, 0.3),
    )
    inputs = ("q",)
    signal = "q@history"
    motion = _STILL

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [
            {"reach": share * rms(s.q - s.q.mean(axis=0)), "beta": 0.5} for share in (0.03, 0.1, 0.25, 0.6)
        ]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return 0.0 * (u[0] + p["reach"]), u[0]

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        z, before = memory
        z = recurrence.bouc_wen_step(z, (u[0] - before) / p["reach"], p["beta"])
        return -p["F"] * z, (z, u[0])

    def series(self, x: Any, s: Any, p: Params) -> Any:
        """In proportion to F: computed once for all guesses with the same curve."""
        reach, beta = np.broadcast_arrays(p["reach"], p["beta"])
        if reach.ndim == 1:
            return -p["F"] * recurrence.bouc_wen_series(s.q, s.start, reach, beta)
        curves, which = np.unique(np.concatenate([reach, beta], axis=-1), axis=0, return_inverse=True)
        return (
            -p["F"] * recurrence.bouc_wen_series(s.q, s.start, *np.split(curves, 2, axis=-1))[which.ravel()]
        )


LAWS = (TorqueOffset, ParallelSpring, Cogging, Deadband, Backlash, Hysteresis)
