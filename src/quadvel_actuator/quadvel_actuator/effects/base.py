"""Base classes of actuator effects: an effect maps what the EAM predicts to what the joint gives.

An effect is written once and runs in two ways: over whole series (identification) and step by step
(`ActuatorModel`). Values broadcast, so the same lines serve rows (N, J), a batch (B, N, J) of
parameter guesses, and one step of (J,) or (environments, J). Effects act in the order of `Stage`.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

Params = Mapping[str, Array]
Errors = tuple[Array, Array]
"""Errors that enter the PD law: q_des - q (rad) and dq_des - dq (rad/s)"""


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

    They come from rows of a log (`quadvel_sysid.data.signals.Signals`) or from one step of a running
    model.
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
    def sent(self) -> Any:
        """Position targets of all commands in the order of sending, rad."""

    @property
    def packet(self) -> Any:
        """Index into `sent` of the command in force."""

    @property
    def row(self) -> Any:
        """Index of the row in the log."""

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
        low: lower bound.
        high: upper bound.
        scale: usual size, which numerical derivatives need.
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
    return property(lambda law: stages[getattr(law, field)])


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


InitialGuess = Mapping[str, Any]
"""Guess of every parameter that is not in `linear`: a number, or one per joint (J,)"""


@attrs.frozen(eq=False)
class EffectLaw(ABC):
    """Actuator effect, an entry of the registry.

    Subclass `ErrorLaw`, `TorqueLaw`, `AddedLaw` or `MemoryLaw` instead of this class.

    Attributes:
        name: name in the registry, in parameter files and reports.
        stage: where in the drive it acts.
        parameters: its numbers, in order.
        signal: signal over which the residual shows the shape of the effect.
        shifts: whether it resembles a delay.
        has_memory: whether it depends on other rows than the one it acts on.
        acts_between_rows: whether it also depends on what happens between the rows of a log.
        confounded_with_gain: whether the effect on all joints equals a deviation of a gain or of
            delays. At least one joint has to be free of it.
        all_joints_together: whether it happens to all joints of a robot at the same time.
        shared_by_joints: whether it has one cause for all joints, so that they share its values.
        motion: motion to record in order to distinguish it from other effects.
        at: where an added torque acts: in the drive, so that it passes the output delay, or at the
            joint without delay.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]]
    signal: ClassVar[str] = "tau"
    shifts: ClassVar[bool] = False
    has_memory: ClassVar[bool] = False
    acts_between_rows: ClassVar[bool] = False
    confounded_with_gain: ClassVar[bool] = False
    all_joints_together: ClassVar[bool] = False
    shared_by_joints: ClassVar[bool] = False
    motion: ClassVar[str] = "richer motion"
    at: str = attrs.field(default=DRIVE, kw_only=True, validator=one_of(DRIVE, JOINT))

    @classmethod
    def variants(cls, about: Any) -> Sequence[EffectLaw]:
        """List the forms to try on a log.

        Args:
            about: data of the log, a `quadvel_sysid.search.library.Context`.

        Returns:
            Forms of the effect; empty where it cannot act.
        """
        return (cls(), cls(at=JOINT)) if cls.stage == Stage.ADDED else (cls(),)

    @property
    def indistinguishable_forms(self) -> tuple[EffectLaw, ...]:
        """Forms that no log distinguishes from this one.

        How far the parameters move between forms widens their intervals.
        """
        return ()

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
        """Return the effect with fewer parameters that this one becomes in a limit.

        Args:
            p: parameters, (J,) each.

        Returns:
            The simpler effect and its parameters (J,), or None.
        """
        return None

    @classmethod
    def parse(cls, given: Mapping[str, Any], joints: Sequence[str]) -> tuple[EffectLaw, dict[str, Any]]:
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
    def from_settings(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectLaw:
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

    @abstractmethod
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        """List starting points for a search of the parameters.

        Args:
            s: signals of the log, (N, J).
            torque: N m, (N, J), prediction without the effect.
            residual: N m, (N, J), measured torque minus `torque`; 0 in rows that are not to be
                explained.

        Returns:
            Guesses; parameters in `linear` are left out.
        """

    def restricted_to(self, active: Bools) -> EffectLaw:
        """Return the form that remains on some of the joints.

        Args:
            active: joints that keep the effect, (J,) bool.

        Returns:
            The form for these joints.
        """
        return self

    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        """Map parameters to the unique representative with the same torque, within the bounds.

        Args:
            p: parameters, (J,) each.

        Returns:
            Equivalent parameters, (J,) each.
        """
        return p

    def excited_joints(self, p: Params, s: View) -> Bools:
        """Find the joints whose motion shows the effect; on the others it passes for another one.

        Args:
            p: parameters, (J,) each.
            s: signals of the log.

        Returns:
            (J,) bool.
        """
        return np.ones(s.q.shape[-1], dtype=bool)

    def sampling_error(self, p: Params, s: View) -> dict[str, Array]:
        """Return half widths of 95 % intervals of parameters that count random events.

        Args:
            p: parameters, (J,) each.
            s: signals of the log.

        Returns:
            Half widths (J,) by parameter; empty for effects without such parameters.
        """
        return {}

    def predictive(self) -> EffectLaw:
        """Return the form without anything inferred from the measured torque, for prediction.

        Returns:
            The predictive form.
        """
        return self

    def record_statistics(self) -> dict[str, float]:
        """Return figures about this log that are no parameters.

        Returns:
            Figures by name.
        """
        return {}

    def runtime_form(self, rng: np.random.Generator) -> EffectLaw:
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


class ErrorLaw(EffectLaw):
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


class TorqueLaw(EffectLaw):
    """Effect on the torque of the PD law."""

    @abstractmethod
    def torque(self, x: Array, s: View, p: Params) -> Array:
        """Compute the changed torque.

        Args:
            x: N m, torque before the effect.
            s: signals.
            p: parameters.

        Returns:
            N m, the torque in place of `x`.
        """


class AddedLaw(EffectLaw):
    """Effect that adds a torque, linear in some of its parameters.

    Attributes:
        stage: always `Stage.ADDED`.
        linear: names of the parameters that the torque is proportional to, term by term.
        depends_on_drive_torque: whether it uses the torque of the drive. If not, it is fitted
            faster.
    """

    stage = Stage.ADDED
    linear: ClassVar[tuple[str, ...]]
    depends_on_drive_torque: ClassVar[bool] = True

    @abstractmethod
    def torque(self, x: Array, s: View, p: Params) -> Array:
        """Compute the torque to add.

        Args:
            x: N m, torque of the drive without the effect.
            s: signals.
            p: parameters.

        Returns:
            N m, the torque to add.
        """


Memory = tuple[Array, ...]


class MemoryLaw(EffectLaw):
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

    def series(self, x: Any, s: Any, p: Params) -> Any:
        """Apply the effect to all rows of a series; override it with a faster way.

        Args:
            x: values before the effect, (..., N, J), or the pair of errors.
            s: signals with `dt` and `start`; the memory is reset to rest where a stretch starts.
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


def smooth_sign(v: Array, width: Array) -> Array:
    """Smooth sign function tanh(v / width).

    Args:
        v: rad/s, velocity.
        width: rad/s, velocity at which the result is 0.76.

    Returns:
        Values from -1 to 1, 0 at rest.
    """
    return evaluate_distinct(lambda each: np.tanh(v / each), width)


def evaluate_distinct(function: Callable[..., Array], *parameters: Array) -> Array:
    """Evaluate a function once for each distinct parameter set of a batch.

    Finite differences move one parameter at a time, so most sets of a batch are equal. Use it for
    functions that take far longer than a copy of their result.

    Args:
        function: function of the parameters.
        *parameters: each (J,) or (B, 1, J).

    Returns:
        The value of `function`, as if it had been called with the whole batch.
    """
    moved = [one for one in parameters if np.ndim(one) == 3]
    if not moved:
        return function(*parameters)
    first, which = distinct_indices(np.concatenate(moved, axis=-1))
    return function(*(one[first] if np.ndim(one) == 3 else one for one in parameters))[which]


def distinct_indices(batch: Array) -> tuple[Indices, Indices]:
    """Find the distinct elements of a batch.

    Args:
        batch: (B, ...).

    Returns:
        Index of the first occurrence of each distinct element, and for each element (B,) which
        distinct one it is.
    """
    met: dict[bytes, int] = {}
    which = np.array([met.setdefault(one.tobytes(), len(met)) for one in batch])
    return np.unique(which, return_index=True)[1], which


def rms(x: Array) -> Array:
    """Root mean square over the rows, plus 1e-9.

    Args:
        x: (N, J).

    Returns:
        (J,), above 0.
    """
    value: Array = np.sqrt(np.mean(x * x, axis=-2)) + 1e-9
    return value
