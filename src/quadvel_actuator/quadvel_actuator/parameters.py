"""The parameters of the empirical actuator model and their YAML file.

They say how the joints of one robot answer; `quadvel_actuator.model` computes with them. Identification,
which writes such files from measured logs, lives elsewhere. The shipped default is Table 4 of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml

from quadvel_description.bounded_yaml import read_yaml

SCHEMA = 1
JOINTS = 12
PROBABLE = 1.5  # a pair whose error is below this many times the least one is probable (Section 3.1)

_DEFAULT_FILE = Path(__file__).parent / "data" / "aliengo.yaml"

_COMMENTS = {
    "kp_ref": "Gains at which the deviations were identified (N m/rad, N m s/rad).",
    "delta_kp": "Deviation of the gains, Eq. 2: one number, one per hip, thigh and calf, or one per joint "
    "(N m/rad, N m s/rad).",
    "pairs": "Delays of command and torque (s), and the pair's mean squared torque error (N^2 m^2).",
    "torque_noise": "Variance of the torque noise (N^2 m^2).",
    "torque_limit": "Largest torque: one number, one per hip, thigh and calf, or one per joint (N m).",
    "joints": "Names of the joints in order; without them those of the AlienGo.",
    "effects": "What the model adds to the PD law: name, joints, parameters, units and intervals of each.",
}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _refuse(field: str, value: Any, expected: str) -> None:
    raise ValueError(f"{field}: found {value!r}, expected {expected}")


def _number(expected: str, at_least: float = -np.inf, above: float = -np.inf) -> Any:
    """A validator: a finite number, `at_least` or `above` a bound; `expected` says it in words."""

    def check(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        if not _is_number(value) or value < at_least or value <= above:
            _refuse(attribute.name, value, expected)

    return check


def _per_joint(expected: str, above: float = -np.inf) -> Any:
    """A validator: a number, or a tuple (3: hip, thigh, calf; else every joint), each `above` a bound."""

    def check(instance: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        values = list(value) if isinstance(value, tuple) else [value]
        joints = len(instance.joints) or JOINTS
        if isinstance(value, tuple) and len(value) not in (3, joints):
            _refuse(attribute.name, value, f"a number, 3 numbers or {joints} numbers")
        for one in values:
            if not _is_number(one) or one <= above:
                _refuse(attribute.name, one, expected)

    return check


def _text(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    if not isinstance(value, str) or not value:
        _refuse(attribute.name, value, "a name")


def _tuple_if_list(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


@attrs.frozen
class DelayPair:
    """Input and output delay (s), and the mean squared torque error (N^2 m^2) of a model with them."""

    input_delay_s: float = attrs.field(validator=_number("a delay of 0 s or more", at_least=0.0))
    output_delay_s: float = attrs.field(validator=_number("a delay of 0 s or more", at_least=0.0))
    mse: float = attrs.field(validator=_number("an error of 0 or more", at_least=0.0))


def _mapping(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    if not isinstance(value, Mapping):
        _refuse(attribute.name, value, "a mapping from parameter names")


def _names(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    if not isinstance(value, tuple) or not value or not all(isinstance(name, str) for name in value):
        _refuse(attribute.name, value, "a list of joint names")


@attrs.frozen
class Effect:
    """One torque effect beyond the PD law: the joints it acts on, its parameters, units and intervals."""

    name: str = attrs.field(validator=_text)
    joints: tuple[str, ...] = attrs.field(converter=_tuple_if_list, validator=_names)
    parameters: Mapping[str, Any] = attrs.field(validator=_mapping)
    units: Mapping[str, str] = attrs.field(factory=dict, validator=_mapping)
    intervals: Mapping[str, Any] = attrs.field(factory=dict, validator=_mapping)


def _names_or_none(instance: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    if value != ():
        _names(instance, attribute, value)


def _record(cls: Any, values: Any) -> Any:
    """`values`, a mapping with exactly the fields of the attrs class `cls`, as an instance of it."""
    if not isinstance(values, Mapping):
        raise ValueError(f"found {values!r}, expected a mapping")
    fields = attrs.fields_dict(cls)
    unknown = [key for key in values if key not in fields]
    if unknown:
        raise ValueError(f"{unknown[0]}: unknown field, expected one of {', '.join(fields)}")
    missing = [key for key, field in fields.items() if field.default is attrs.NOTHING and key not in values]
    if missing:
        raise ValueError(f"{missing[0]}: the field is missing")
    return cls(**values)


def _records(field: str, cls: Any, values: Any) -> tuple[Any, ...]:
    """A list of mappings (or of instances) as a tuple of instances of the attrs class `cls`."""
    if not isinstance(values, (list, tuple)):
        raise ValueError(f"{field}: found {values!r}, expected a list")
    records = []
    for number, value in enumerate(values):
        try:
            records.append(value if isinstance(value, cls) else _record(cls, value))
        except ValueError as error:
            raise ValueError(f"{field}[{number}].{error}") from None
    return tuple(records)


def _pairs(values: Any) -> tuple[DelayPair, ...]:
    return _records("pairs", DelayPair, values)


def _effects(values: Any) -> tuple[Effect, ...]:
    return _records("effects", Effect, values)


def _not_empty(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    if not value:
        _refuse(attribute.name, value, "at least one pair")


def _known_schema(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    if value != SCHEMA or isinstance(value, bool):
        _refuse(attribute.name, value, str(SCHEMA))


@attrs.frozen
class ActuatorParameters:
    """The empirical actuator model (Eq. 1 and 2) in numbers; SI units, see `data/aliengo.yaml`.

    The deviations `delta_kp`, `delta_kd` and `torque_limit` are one number, three (hip, thigh, calf) or
    twelve. Building one with a wrong value raises ValueError that names the field, the value found and what
    was expected.
    """

    schema: int = attrs.field(validator=_known_schema)
    name: str = attrs.field(validator=_text)
    kp_ref: float = attrs.field(validator=_number("a gain above 0", above=0.0))
    kd_ref: float = attrs.field(validator=_number("a gain above 0", above=0.0))
    delta_kp: float | tuple[float, ...] = attrs.field(
        converter=_tuple_if_list, validator=_per_joint("a finite number")
    )
    delta_kd: float | tuple[float, ...] = attrs.field(
        converter=_tuple_if_list, validator=_per_joint("a finite number")
    )
    pairs: tuple[DelayPair, ...] = attrs.field(converter=_pairs, validator=_not_empty)
    torque_noise: float = attrs.field(validator=_number("a variance of 0 or more", at_least=0.0))
    torque_limit: float | tuple[float, ...] = attrs.field(
        converter=_tuple_if_list, validator=_per_joint("a torque above 0", above=0.0)
    )
    effects: tuple[Effect, ...] = attrs.field(converter=_effects, default=())
    joints: tuple[str, ...] = attrs.field(converter=_tuple_if_list, validator=_names_or_none, default=())

    @property
    def best_pair(self) -> DelayPair:
        """The pair of delays with the least error, the first of these."""
        return min(self.pairs, key=lambda pair: pair.mse)

    @property
    def probable_pairs(self) -> tuple[DelayPair, ...]:
        """The pairs that randomisation draws from: error under 1.5 times the least one (Section 3.1)."""
        least = self.best_pair.mse
        return tuple(pair for pair in self.pairs if pair.mse < PROBABLE * least or pair.mse == least)

    @classmethod
    def load(cls, path: str | Path) -> ActuatorParameters:
        """Read a parameter file; ValueError names file, field, the value found and what was expected."""
        content = read_yaml(Path(path), "a YAML file of actuator parameters")
        try:
            parameters: ActuatorParameters = _record(cls, content)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return parameters

    def save(self, path: str | Path) -> None:
        """Write the parameters as YAML, with the units in comments; `load` reads them back unchanged."""
        lines: list[str] = []
        for key, value in attrs.asdict(self).items():
            if key in _COMMENTS:
                lines += ["", f"# {_COMMENTS[key]}"]
            flow = None if isinstance(value, list) else False  # a list: one line for each of its elements
            text = yaml.safe_dump({key: value}, default_flow_style=flow, sort_keys=False, width=110)
            lines.append(text.rstrip())
        Path(path).write_text("\n".join(lines) + "\n")

    @classmethod
    def default(cls) -> ActuatorParameters:
        """The shipped AlienGo actuators, Table 4."""
        return cls.load(_DEFAULT_FILE)

    @classmethod
    def ideal(cls) -> ActuatorParameters:
        """A plain PD law: no delay, no deviation, no noise; the torque limit stays."""
        at_once = DelayPair(0.0, 0.0, 0.0)
        return attrs.evolve(
            cls.default(), name="ideal", delta_kp=0.0, delta_kd=0.0, pairs=(at_once,), torque_noise=0.0
        )
