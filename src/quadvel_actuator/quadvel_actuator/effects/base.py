"""Base classes of actuator effects: an effect maps what the EAM predicts to what the joint gives.

An effect is written once and runs in two ways: over whole series (identification) and step by step
(`ActuatorModel`). Values broadcast, so the same lines serve rows (N, J), a batch (B, N, J) of
parameter guesses, and one step of (J,) or (environments, J). Effects act in the order of `Stage`.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools

Params = Mapping[str, Array]
Errors = tuple[Array, Array]
"""Errors that enter the PD law: q_des - q (rad) and dq_des - dq (rad/s)"""
Memory = tuple[Array, ...]


class Stage(enum.IntEnum):
    """Place in the drive where an effect acts; lower stages act first.

    Attributes:
        ERRORS: on the position and velocity errors that enter the PD law.
        LIMIT: on the PD torque, as a bound.
        DYNAMICS: on how fast the torque follows.
        GAIN: on the torque after bounds and lags, as a gain: motor constant and gear.
        ADDED: a torque added to it: friction, springs, coupling.
    """

    ERRORS = 0
    LIMIT = 1
    DYNAMICS = 2
    GAIN = 3
    ADDED = 4


DRIVE, JOINT = "drive", "joint"


class View(Protocol):
    """Signals that an effect may use.

    They come from the rows of a log, or from one step of a running model.
    """

    @property
    def t(self) -> Any:
        """Time since the start, s."""

    @property
    def dt(self) -> Any:
        """Time since the row before, s."""

    @property
    def q(self) -> Array:
        """Joint positions, rad."""

    @property
    def dq(self) -> Array:
        """Joint velocities, rad/s."""

    @property
    def ddq(self) -> Array:
        """Joint accelerations, rad/s^2."""

    @property
    def q_des(self) -> Array:
        """Position targets in force, rad."""

    @property
    def temperature(self) -> Any:
        """Drive temperature, degrees Celsius."""

    @property
    def voltage(self) -> Any:
        """Supply voltage, V."""

    @property
    def age(self) -> Any:
        """Time since the command in force arrived, s."""

    def shifted(self, name: str, late: Array) -> Array:
        """Interpolate `q` or `dq` in time.

        Args:
            name: `q` or `dq`.
            late: s, age of the value, per joint.

        Returns:
            The signal `late` s ago.
        """


@attrs.frozen
class Parameter:
    """One number of an effect.

    Attributes:
        name: name in files and reports.
        unit: its unit.
        low: lower bound, in `unit`.
        high: upper bound, in `unit`.
        scale: usual size, in `unit`; numerical derivatives need it.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: float


def stage_from_field(field: str, **stages: Stage) -> Any:
    """Build a property `stage` for an effect that can act at several stages.

    Args:
        field: name of the setting that decides.
        **stages: stage by value of the setting.

    Returns:
        A property for the class body.
    """
    return property(lambda effect: stages[getattr(effect, field)])


def one_of(*words: str) -> Any:
    """Build a validator for a setting that is one of some words.

    Args:
        *words: allowed values.

    Returns:
        A validator for `attrs.field`; it raises ValueError for another value.
    """

    def check(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        if value not in words:
            raise ValueError(f"{attribute.name}: found {value!r}, expected one of {', '.join(words)}")

    return check


_SETTING_TYPES: Mapping[str, tuple[type | tuple[type, ...], str]] = {
    "str": (str, "a word"),
    "float": ((int, float), "a number"),
    "tuple[str, ...]": ((list, tuple), "a list with a word for each joint"),
}
"""Annotations of settings that a parameter file may give: accepted types, and a description"""


@attrs.frozen(eq=False)
class EffectModel(ABC):
    """Actuator effect, an entry of the registry.

    Subclass `ErrorEffect`, `TorqueEffect`, `AddedEffect` or `MemoryEffect` instead of this class.

    Attributes:
        name: name in the registry, in parameter files and reports.
        stage: where in the drive it acts.
        at: where an added torque acts: in the drive, so that it passes the output delay, or at the
            joint without delay.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    at: str = attrs.field(default=DRIVE, kw_only=True, validator=one_of(DRIVE, JOINT))

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Its numbers, in order; a class attribute unless they depend on a setting."""

    @property
    def has_memory(self) -> bool:
        """Whether it depends on the past, so that a row depends on the rows before."""
        return False

    @classmethod
    def parse(cls, given: Mapping[str, Any], joints: Sequence[str]) -> tuple[EffectModel, dict[str, Any]]:
        """Read form and parameters from the mapping in a parameter file.

        Args:
            given: settings and parameters by name.
            joints: joint names of the robot.

        Returns:
            The form, and its parameters by name.

        Raises:
            ValueError: an entry is unknown or of the wrong type; the message names it.
        """
        schema, settings = cls.setting_types(), {}
        for name, value in given.items():
            if name in schema:
                kind, expected = _SETTING_TYPES[schema[name]]
                if not isinstance(value, kind) or isinstance(value, bool):
                    raise ValueError(f"{name}: found {value!r}, expected {expected}")
                settings[name] = value
        form = cls.from_settings(settings, joints)
        numbers = {name: value for name, value in given.items() if name not in settings}
        for name in numbers:
            if name not in form.names:
                raise ValueError(f"{name}: unknown, expected one of {', '.join((*form.names, *schema))}")
        return form, numbers

    @classmethod
    def setting_types(cls) -> dict[str, str]:
        """List the settings that a parameter file may give in addition to the parameters.

        Returns:
            Type annotation by setting.
        """
        fields = {
            field.name: str(field.type) for field in attrs.fields(cls) if str(field.type) in _SETTING_TYPES
        }
        if cls.stage != Stage.ADDED:
            del fields["at"]
        return fields

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectModel:
        """Build the form with some settings.

        Args:
            settings: values by name, of the types in `setting_types`.
            joints: joint names of the robot.

        Returns:
            The form of the effect.
        """
        return cls(**settings)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that are not the default; `from_settings` builds the same form from them."""
        own = {field.name: (getattr(self, field.name), field.default) for field in attrs.fields(type(self))}
        return {name: value for name, (value, usual) in own.items() if value != usual}

    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        """Map parameters to the unique representative with the same torque, within the bounds.

        Args:
            p: parameters, (J,) each.

        Returns:
            Equivalent parameters, (J,) each.
        """
        return p

    def runtime_form(self, rng: np.random.Generator) -> EffectModel:
        """Return the form that a running model uses.

        Args:
            rng: source of randomness for effects that act at random.

        Returns:
            The form for step by step use.
        """
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @abstractmethod
    def series(self, x: Any, s: View, p: Params) -> Any:
        """Apply the effect to all rows of a series.

        Args:
            x: values before the effect, (..., N, J): the errors, a pair of arrays, at stage ERRORS,
                else the torque in N m.
            s: signals of the rows.
            p: parameters, (J,) or (B, 1, J).

        Returns:
            The values in place of `x`; at stage ADDED the torque to add, N m.
        """

    def step(self, x: Any, now: View, p: Params, memory: Memory, new: Bools | None) -> tuple[Any, Memory]:
        """Advance a running model by one step.

        Args:
            x: values before the effect, (..., J); see `series`.
            now: signals of this step.
            p: parameters, (J,) or (..., J).
            memory: memory after the step before.
            new: environments that start from rest, (...,) bool, or None.

        Returns:
            The values in place of `x`, and the new memory.
        """
        return self.series(x, now, p), memory


class ErrorEffect(EffectModel):
    """Effect on the errors that enter the PD law."""

    stage = Stage.ERRORS

    @abstractmethod
    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        """Compute the errors that the drive sees.

        Args:
            e: (q_des - q, dq_des - dq), rad and rad/s.
            s: signals.
            p: parameters.

        Returns:
            The errors in place of `e`.
        """

    @override
    def series(self, x: Errors, s: View, p: Params) -> Errors:
        return self.errors(x, s, p)


class TorqueEffect(EffectModel):
    """Effect on the torque."""

    @abstractmethod
    def torque(self, x: Array, s: View, p: Params) -> Array:
        """Compute the changed torque.

        Args:
            x: N m, torque of the drive before the effect.
            s: signals.
            p: parameters.

        Returns:
            N m, the torque in place of `x`; at stage ADDED the torque to add.
        """

    @override
    def series(self, x: Array, s: View, p: Params) -> Array:
        return self.torque(x, s, p)


class AddedEffect(TorqueEffect):
    """Effect that adds a torque: `torque` returns the torque to add, N m."""

    stage = Stage.ADDED


class MemoryEffect(EffectModel):
    """Effect with a memory: `advance` is one step, a series is one step after the other.

    At stage ERRORS `x` and the result are the pair of errors. At stage ADDED the result is the
    torque to add.

    Attributes:
        has_memory: always True.
        inputs: names of the signals that `advance` receives.
    """

    has_memory = True
    inputs: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        """Return the memory of a joint at rest.

        Args:
            x: value that has been constant for all earlier times.
            u: `inputs`, constant as well.
            p: parameters.

        Returns:
            The memory.
        """

    @abstractmethod
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        """Advance by one step.

        Args:
            x: value before the effect.
            u: `inputs` of this step.
            dt: s, duration of the step.
            p: parameters.
            memory: memory after the step before.

        Returns:
            The value in place of `x`, and the new memory.
        """

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        """Apply the effect to all rows, one step after the other; override it with a faster way.

        The memory is reset to rest where a stretch starts.

        Args:
            x: values before the effect, (..., N, J), or the pair of errors.
            s: signals with `dt` and `start`.
            p: parameters, (J,) or (B, 1, J).

        Returns:
            The values in place of `x`.
        """
        pair = isinstance(x, tuple)
        xs = [np.moveaxis(one, -2, 0) for one in (x if pair else (x,))]
        us = [np.moveaxis(getattr(s, name), -2, 0) for name in self.inputs]
        p = {name: value[..., 0, :] if np.ndim(value) > 1 else value for name, value in p.items()}
        memory: Memory = ()
        made = []
        for k, (dt, start) in enumerate(zip(s.dt, s.start, strict=True)):
            here, u = (tuple(one[k] for one in xs) if pair else xs[0][k]), [one[k] for one in us]
            memory = self.rest(here, u, p) if k == 0 or start.any() else memory
            now, memory = self.advance(here, u, dt, p, memory)
            made.append(now if pair else (now,))
        series = tuple(np.stack(np.broadcast_arrays(*one), axis=-2) for one in zip(*made, strict=True))
        return series if pair else series[0]

    @override
    def step(self, x: Any, now: View, p: Params, memory: Memory, new: Bools | None) -> tuple[Any, Memory]:
        u = [getattr(now, name) for name in self.inputs]
        if new is not None:
            memory = reset_memory(memory, self.rest(x, u, p), new)
        return self.advance(x, u, now.dt, p, memory)


def reset_memory(memory: Memory, rest: Memory, new: Bools) -> Memory:
    """Reset the memory of some environments.

    Args:
        memory: memory after the step before, or ().
        rest: memory of joints at rest.
        new: environments that start from rest, (...,) bool.

    Returns:
        The memory, at rest in these environments.
    """
    if not memory or new.all():
        return rest
    return tuple(np.where(new[..., None], fresh, old) for fresh, old in zip(rest, memory, strict=True))
