"""What an effect is: a law that turns what the EAM asks for into what the joint gives.

A law is written once and runs in two ways: over whole series (identification) and step by step (`ActuatorModel`). Its
values broadcast, so that the same lines serve (N, J) rows, a batch (B, N, J) of parameter guesses, and one step of
(J,) or (environments, J). The order in which laws act is that of the drive: `Stage`.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import attrs
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Params = Mapping[str, Array]
Errors = tuple[Array, Array]
"""q_des - q (rad) and dq_des - dq (rad/s), as the drive sees them"""


class Stage(enum.IntEnum):
    """Where in the drive a law acts; laws of a lower stage act first."""

    ERRORS = 0
    """on the errors of position and velocity that the PD law is given"""
    LIMIT = 1
    """on the asked torque, as a bound"""
    DYNAMICS = 2
    """on how fast the torque follows"""
    GAIN = 3
    """on what the drive's current gives, as a gain: the motor's constant and the gear come after bounds and lags"""
    ADDED = 4
    """a torque beside it: friction, springs, coupling"""


DRIVE, JOINT = "drive", "joint"


class View(Protocol):
    """What a law may look at: `quadvel_sysid.signals.Signals`, or one step of a running model."""

    @property
    def t(self) -> Any: ...
    @property
    def dt(self) -> Any: ...
    @property
    def q(self) -> Array: ...
    @property
    def dq(self) -> Array: ...
    @property
    def ddq(self) -> Array: ...
    @property
    def q_des(self) -> Array: ...
    @property
    def temperature(self) -> Any: ...
    @property
    def voltage(self) -> Any: ...
    @property
    def sent(self) -> Any: ...
    @property
    def packet(self) -> Any: ...
    @property
    def row(self) -> Any: ...
    @property
    def age(self) -> Any: ...
    def shifted(self, name: str, late: Array) -> Array: ...


@attrs.frozen
class Parameter:
    """One number of a law. `low` and `high` bound it; `scale` is its usual size, which numerical slopes need."""

    name: str
    unit: str
    low: float
    high: float
    scale: float


def staged(field: str, **stages: Stage) -> Any:
    """The stage of a law that can act at several: the one that stands here for what its `field` says."""
    return property(lambda law: stages[getattr(law, field)])


def one_of(*words: str) -> Any:
    """A validator: a setting of a law that is one of these words."""

    def check(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        if value not in words:
            raise ValueError(f"{attribute.name}: found {value!r}, expected one of {', '.join(words)}")

    return check


_KINDS: Mapping[str, tuple[type | tuple[type, ...], str]] = {
    "str": (str, "a word"),
    "float": ((int, float), "a number"),
    "tuple[str, ...]": ((list, tuple), "a list with a word for each joint"),
}
"""Of the fields of a law, by what they are annotated with, those that a parameter file may set; and what stands there."""


Start = Mapping[str, Any]
"""a guess of every parameter but the `linear` ones: a number, or one for each joint (J,)"""


@attrs.frozen(eq=False)
class EffectLaw(ABC):
    """An entry of the registry. Subclass `ErrorLaw`, `TorqueLaw`, `AddedLaw` or one with memory, not this one."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]]
    signal: ClassVar[str] = "tau"
    """the signal over which its residual shows its shape"""
    shifts: ClassVar[bool] = False
    """looks like a delay"""
    has_memory: ClassVar[bool] = False
    """looks at other rows than the one that it acts on"""
    acts_between_rows: ClassVar[bool] = False
    """has to follow what happens between the rows of a log, too"""
    confounded_with_gain: ClassVar[bool] = False
    """on all joints together it is a deviation of a gain or of delays: at least one joint is free of it"""
    all_joints_together: ClassVar[bool] = False
    """happens to all joints of a robot at once"""
    shared_by_joints: ClassVar[bool] = False
    """has one cause for all joints, so that they share its values"""
    motion: ClassVar[str] = "richer motion"
    """what to record so that it can be told from others"""
    at: str = attrs.field(default=DRIVE, kw_only=True, validator=one_of(DRIVE, JOINT))
    """where a torque is added: by the drive, so that it comes an output delay late, or at the joint, at once"""

    @classmethod
    def variants(cls, about: Any) -> Sequence[EffectLaw]:
        """The forms of the law to try on the data `about` (`quadvel_sysid.library.Context`); none where they cannot act."""
        return (cls(), cls(at=JOINT)) if cls.stage == Stage.ADDED else (cls(),)

    @property
    def alternatives(self) -> tuple[EffectLaw, ...]:
        """The law in shapes that no log tells from this one; how far its parameters move then adds to their intervals."""
        return ()

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]] | None:
        """The law with fewer parameters that this one becomes at the end of one of them, and its parameters (J,)."""
        return None

    @classmethod
    def read(cls, given: Mapping[str, Any], joints: Sequence[str]) -> tuple[EffectLaw, dict[str, Any]]:
        """The form of the law and its parameters, by name, as a parameter file gives both; the robot's `joints`.

        Raises ValueError, which names the entry, for one that the law does not have or that is of another kind.
        """
        schema, settings = cls.schema(), {}
        for name, value in given.items():
            if name in schema:
                kind, expected = _KINDS[schema[name]]
                if not isinstance(value, kind) or isinstance(value, bool):
                    raise ValueError(f"{name}: found {value!r}, expected {expected}")
                settings[name] = value
        form = cls.configured(settings, joints)
        numbers = {name: value for name, value in given.items() if name not in settings}
        for name in numbers:
            if name not in form.names:
                raise ValueError(f"{name}: unknown, expected one of {', '.join((*form.names, *schema))}")
        return form, numbers

    @classmethod
    def schema(cls) -> dict[str, str]:
        """What of the law a parameter file may set beside its parameters: the annotation of each."""
        fields = {field.name: str(field.type) for field in attrs.fields(cls) if str(field.type) in _KINDS}
        if cls.stage != Stage.ADDED:
            del fields["at"]
        return fields

    @classmethod
    def configured(cls, settings: Mapping[str, Any], joints: Sequence[str]) -> EffectLaw:
        """The form with these settings, each of a kind that `schema` names; the robot's `joints`."""
        return cls(**settings)

    @property
    def settings(self) -> dict[str, Any]:
        """What `configured` needs to make this form again: all that is not as usual."""
        own = {field.name: (getattr(self, field.name), field.default) for field in attrs.fields(type(self))}
        return {name: value for name, (value, usual) in own.items() if value != usual}

    @abstractmethod
    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        """Guesses to search from.

        `torque` (N, J) is what the model without the effect gives, `residual` what is left of the measured torque,
        0 where it is not to be explained.
        """

    def restricted_to(self, active: Bools) -> EffectLaw:
        """The form that is left of it on these joints, (J,)."""
        return self

    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        """Parameters (J,) brought into the order that makes them unique, within the bounds."""
        return p

    def excited_joints(self, p: Params, s: View) -> Bools:
        """Joints (J,) whose motion shows the law with these parameters (J,); on the others it passes for another one."""
        return np.ones(s.q.shape[-1], dtype=bool)

    def sampling_error(self, p: Params, s: View) -> dict[str, Array]:
        """Half widths (J,) of the 95 % intervals of parameters that count what happened at random."""
        return {}

    def predictive(self) -> EffectLaw:
        """The law without what it read off the measured torque: all that it can say before that is known."""
        return self

    def observed(self) -> dict[str, float]:
        """What it says of this record beside its parameters, by name."""
        return {}

    def running(self, rng: np.random.Generator) -> EffectLaw:
        """The law as a running model has it; what happens at random is drawn from `rng`."""
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)


class ErrorLaw(EffectLaw):
    """Changes the errors that the PD law is given."""

    stage = Stage.ERRORS

    @abstractmethod
    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        """The errors that the drive sees instead of `e`."""


class TorqueLaw(EffectLaw):
    """Changes the asked torque."""

    @abstractmethod
    def torque(self, x: Array, s: View, p: Params) -> Array:
        """The torque instead of `x`."""


class AddedLaw(EffectLaw):
    """Adds a torque; it is the sum of terms in proportion to each of the parameters `linear`."""

    stage = Stage.ADDED
    linear: ClassVar[tuple[str, ...]]
    of_drive: ClassVar[bool] = True
    """depends on what the drive gives; a law that says that it does not is fitted more quickly"""

    @abstractmethod
    def torque(self, x: Array, s: View, p: Params) -> Array:
        """The torque to add, `x` being what the drive gives without it."""


Memory = tuple[Array, ...]


class MemoryLaw(EffectLaw):
    """A law with a memory: `advance` is one step of it, and a series is one step after the other.

    At stage ERRORS `x` is the pair of errors, and so is what comes back; at ADDED it is the torque to add.
    """

    has_memory = True
    inputs: ClassVar[tuple[str, ...]] = ()
    """the signals that `advance` is given, by name"""

    @abstractmethod
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        """The memory of a joint that has rested at `x`, `u` since ever."""

    @abstractmethod
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        """The value instead of `x` after `dt` (s), and the new memory."""

    def series(self, x: Any, s: Any, p: Params) -> Any:
        """All rows of a series, one step after the other, memory starting anew with every stretch: give a faster one."""
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
    """-1 to 1, through zero at rest; `width` (rad/s) is where it has come to 0.76."""
    return of_each(lambda each: np.tanh(v / each), width)


def of_each(function: Callable[..., Array], *parameters: Array) -> Array:
    """The function of `parameters`, (J,) or (B, 1, J), computed but once for those of a batch that are equal.

    For functions that take far longer than a copy of what they give. Where slopes are taken one parameter moves at a time.
    """
    moved = [one for one in parameters if np.ndim(one) == 3]
    if not moved:
        return function(*parameters)
    first, which = distinct(np.concatenate(moved, axis=-1))
    return function(*(one[first] if np.ndim(one) == 3 else one for one in parameters))[which]


def distinct(batch: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where the different ones of a batch (B, ...) stand first, and which of them each is (B,)."""
    met: dict[bytes, int] = {}
    which = np.array([met.setdefault(one.tobytes(), len(met)) for one in batch])
    return np.unique(which, return_index=True)[1], which


def rms(x: Array) -> Array:
    """Root mean square over the rows, (J,)."""
    value: Array = np.sqrt(np.mean(x * x, axis=-2)) + 1e-9
    return value
