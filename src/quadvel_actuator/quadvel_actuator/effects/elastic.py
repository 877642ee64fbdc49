"""Effects of position: offset, spring, cogging, deadband, backlash and hysteresis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools

from . import recurrence
from .base import (
    AddedLaw,
    EffectLaw,
    ErrorLaw,
    Errors,
    InitialGuess,
    Memory,
    MemoryLaw,
    Parameter,
    Params,
    Stage,
    View,
    evaluate_distinct,
    one_of,
    rms,
    stage_from_field,
)

_STIFFNESS_GUESSES = (-10.0, -3.0, -1.0, -0.4, 0.4, 1.0, 2.0, 4.0, 10.0, 30.0)  # N m/rad
_SLOW_REVERSALS = "small slow reversals about many postures, each held for a second"


class TorqueOffset(AddedLaw):
    """Constant torque; an encoder bias times kp looks the same."""

    name = "torque_offset"
    parameters = (Parameter("offset", "N m", -20.0, 20.0, 0.3),)
    linear = ("offset",)
    depends_on_drive_torque = False
    signal = "q"
    motion = (
        "a constant offset and an encoder bias differ only where kp changes: two recordings with different kp"
    )

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[TorqueOffset]:
        return (cls(),)

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{}]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return p["offset"] + 0.0 * s.q


class ParallelSpring(AddedLaw):
    """Spring in parallel with the drive: -k (q - q0)."""

    name = "parallel_spring"
    parameters = (Parameter("k", "N m/rad", -200.0, 200.0, 1.0), Parameter("q0", "rad", -30.0, 30.0, 0.3))
    linear = ("k",)
    depends_on_drive_torque = False
    signal = "q"
    motion = "slow sweeps over the whole range of every joint"

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        """Try stiffnesses of either sign that give the mean residual; gains hide the slope."""
        weight = (residual != 0.0).astype(float)
        n = weight.sum(axis=0) + 1e-9
        q, r = (s.q * weight).sum(axis=0) / n, residual.sum(axis=0) / n
        return [{"q0": q}, *({"q0": np.clip(q + r / k, -25.0, 25.0)} for k in _STIFFNESS_GUESSES)]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]]:
        """Return the constant torque k q0: a weak spring that rests far away."""
        return TorqueOffset(at=self.at), {"offset": p["k"] * p["q0"]}

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["k"] * (s.q - p["q0"])


class Cogging(AddedLaw):
    """Cogging torque: a sin(n q + phi)."""

    name = "cogging"
    parameters = (
        Parameter("a", "N m", -20.0, 20.0, 0.3),
        Parameter("n", "1/rad", 3.0, 400.0, 0.2),
        Parameter("phi", "rad", -20.0, 20.0, 0.3),
    )
    linear = ("a",)
    depends_on_drive_torque = False
    signal = "q"
    motion = "slow sweeps over the whole range of every joint"

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        """Take the four highest peaks of the residual's spectrum over the position."""
        # Fourier sums of the residual r over the position, at wave numbers n:
        #     line(n) = conj(sum_k r[k] exp(i n (q[k] - centre)))
        # n in half turns over the range of motion, so that neighbours are one resolution cell
        # apart.
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
    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        phi = p["phi"] + np.where(p["a"] < 0.0, np.pi, 0.0)
        return p | {"a": np.abs(p["a"]), "phi": np.remainder(phi + np.pi, 2.0 * np.pi) - np.pi}

    @override
    def excited_joints(self, p: Params, s: View) -> Bools:
        """Select joints that moved through a whole period; over less, cogging is any curve."""
        whole: Bools = np.ptp(s.q, axis=0) * p["n"] >= 2.0 * np.pi
        return whole

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return p["a"] * evaluate_distinct(lambda n, phi: np.sin(n * s.q + phi), p["n"], p["phi"])


@attrs.frozen(eq=False)
class Deadband(ErrorLaw):
    """Deadband of the position error: no response below `width`.

    Beyond it the drive sees the whole error (`edge` hard) or what exceeds `width` (soft).
    """

    name = "deadband"
    parameters = (Parameter("width", "rad", 0.0005, 0.5, 0.01),)
    signal = "q_des"
    motion = _SLOW_REVERSALS
    edge: str = attrs.field(default="soft", validator=one_of("soft", "hard"))

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[Deadband]:
        return cls("soft"), cls("hard")

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        error = np.abs(s.q_des - s.q)
        return [{"width": np.quantile(error, at, axis=0) + 5e-4} for at in np.linspace(0.03, 0.99, 33)]

    @override
    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        beyond = np.abs(e[0]) > p["width"]
        less = p["width"] * np.sign(e[0]) if self.edge == "soft" else 0.0
        return np.where(beyond, e[0] - less, 0.0), e[1]


@attrs.frozen(eq=False)
class Backlash(MemoryLaw):
    """Backlash: the drive sees a signal through a gap of +-`gap`.

    `on` selects the signal: the position `q`, the error q_des - q, or the torque.
    """

    name = "backlash"
    stage = stage_from_field("on", error=Stage.ERRORS, q=Stage.ERRORS, torque=Stage.DYNAMICS)
    on: str = attrs.field(default="error", validator=one_of("error", "q", "torque"))

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        if self.on == "torque":
            return (Parameter("gap", "N m", 0.01, 50.0, 0.3),)
        return (Parameter("gap", "rad", 0.0002, 0.5, 0.01),)

    inputs = ("q",)
    signal = "q@history"
    motion = _SLOW_REVERSALS

    @classmethod
    @override
    def variants(cls, about: Any) -> Sequence[Backlash]:
        return tuple(cls(on) for on in ("error", "q", "torque"))

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        of = {"error": rms(s.q_des - s.q), "q": rms(s.q_des - s.q), "torque": rms(torque)}[self.on]
        return [{"gap": share * of + 2e-4} for share in (0.05, 0.1, 0.2, 0.4, 0.8)]

    def _gap_input(self, x: Any, u: Sequence[Array]) -> Array:
        """Select the signal that enters the gap."""
        if self.on == "q":
            return u[0]
        seen: Array = x if self.on == "torque" else x[0]
        return seen

    def _with_gap_output(self, x: Any, u: Sequence[Array], follows: Array) -> Any:
        """Insert the output of the gap into the errors or the torque."""
        if self.on == "torque":
            return follows
        return (follows if self.on == "error" else x[0] + u[0] - follows), x[1]

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (self._gap_input(x, u) + 0.0 * p["gap"],)

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        follows = recurrence.backlash_step(memory[0], self._gap_input(x, u), p["gap"])
        return self._with_gap_output(x, u, follows), (follows,)

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        return self._with_gap_output(
            x, (s.q,), recurrence.backlash_series(self._gap_input(x, (s.q,)), s.start, p["gap"])
        )


class Hysteresis(MemoryLaw):
    """Bouc-Wen hysteresis: -F z, with a state -1 <= z <= 1.

        dz/dq = (1 - (beta + (1 - beta) sign(z dq)) |z|) / reach

    Source: Wen, Journal of the Engineering Mechanics Division 102 (1976).
    """

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
    motion = _SLOW_REVERSALS

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [
            {"reach": share * rms(s.q - s.q.mean(axis=0)), "beta": 0.5} for share in (0.03, 0.1, 0.25, 0.6)
        ]

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return 0.0 * (u[0] + p["reach"]), u[0]

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        z, before = memory
        z = recurrence.bouc_wen_step(z, (u[0] - before) / p["reach"], p["beta"])
        return -p["F"] * z, (z, u[0])

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        """Apply the effect to a series; z is computed once per distinct curve of a batch."""
        # The torque is proportional to F: solve for z once per distinct (reach, beta) of the batch.
        reach, beta = np.broadcast_arrays(p["reach"], p["beta"])
        if reach.ndim == 1:
            return -p["F"] * recurrence.bouc_wen_series(s.q, s.start, reach, beta)
        curves, which = np.unique(np.concatenate([reach, beta], axis=-1), axis=0, return_inverse=True)
        return (
            -p["F"] * recurrence.bouc_wen_series(s.q, s.start, *np.split(curves, 2, axis=-1))[which.ravel()]
        )


LAWS = (TorqueOffset, ParallelSpring, Cogging, Deadband, Backlash, Hysteresis)
