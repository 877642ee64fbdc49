"""Parameters of the empirical actuator model and their YAML file.

`quadvel_actuator.model` computes torques from these parameters. The shipped default is
Table 4 of the paper.
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
DEFAULT_JOINT_COUNT = 12
PROBABLE_ERROR_RATIO = 1.5  # pairs below this multiple of the least error are probable (Section 3.1)

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
    """Whether a value is a finite int or float; booleans are not numbers here."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _raise_invalid(field: str, value: Any, expected: str) -> None:
    """Raise a ValueError that names the field, the value found and the expected one."""
    raise ValueError(f"{field}: found {value!r}, expected {expected}")


def _number(expected: str, at_least: float = -np.inf, above: float = -np.inf) -> Any:
    """Build a validator for a finite number that is at least `at_least` and above `above`."""

    def check(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        if not _is_number(value) or value < at_least or value <= above:
            _raise_invalid(attribute.name, value, expected)

    return check


def _per_joint(expected: str, above: float = -np.inf) -> Any:
    """Build a validator for 1, 3 (hip, thigh, calf) or one number per joint, above a bound."""

    def check(instance: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        values = list(value) if isinstance(value, tuple) else [value]
        joints = len(instance.joints) or DEFAULT_JOINT_COUNT
        if isinstance(value, tuple) and len(value) not in (3, joints):
            _raise_invalid(attribute.name, value, f"a number, 3 numbers or {joints} numbers")
        for one in values:
            if not _is_number(one) or one <= above:
                _raise_invalid(attribute.name, one, expected)

    return check


def _text(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Validate a string that is not empty."""
    if not isinstance(value, str) or not value:
        _raise_invalid(attribute.name, value, "a name")


def _tuple_if_list(value: Any) -> Any:
    """Convert lists, which YAML gives, to tuples."""
    return tuple(value) if isinstance(value, list) else value


@attrs.frozen
class DelayPair:
    """One pair of delays and the error of the model that has them.

    Attributes:
        input_delay_s: s, delay of the command on its way to the drive, t_i of Eq. 1.
        output_delay_s: s, delay from the drive's torque to the torque on the joint, t_o of Eq. 1.
        mse: N^2 m^2, mean squared torque error of a model with these delays.
    """

    input_delay_s: float = attrs.field(validator=_number("a delay of 0 s or more", at_least=0.0))
    output_delay_s: float = attrs.field(validator=_number("a delay of 0 s or more", at_least=0.0))
    mse: float = attrs.field(validator=_number("an error of 0 or more", at_least=0.0))


def _mapping(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Validate a mapping."""
    if not isinstance(value, Mapping):
        _raise_invalid(attribute.name, value, "a mapping from parameter names")


def _names(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Validate a tuple of joint names that is not empty."""
    if not isinstance(value, tuple) or not value or not all(isinstance(name, str) for name in value):
        _raise_invalid(attribute.name, value, "a list of joint names")


@attrs.frozen
class Effect:
    """One effect beyond the PD law, as an entry of the parameter file.

    Attributes:
        name: name in the registry (`quadvel_actuator.effects.registry`).
        joints: names of the joints that the effect acts on.
        parameters: values by name: one number for all of these joints, or one per joint; and the
            settings of the effect, which are words.
        units: unit of each parameter, for readers of the file.
        intervals: [low, high] by parameter name, or one such pair per joint. Domain randomisation
            draws from them.
    """

    name: str = attrs.field(validator=_text)
    joints: tuple[str, ...] = attrs.field(converter=_tuple_if_list, validator=_names)
    parameters: Mapping[str, Any] = attrs.field(validator=_mapping)
    units: Mapping[str, str] = attrs.field(factory=dict, validator=_mapping)
    intervals: Mapping[str, Any] = attrs.field(factory=dict, validator=_mapping)


def _names_or_none(instance: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Validate a tuple of joint names, which may be empty."""
    if value != ():
        _names(instance, attribute, value)


def _build_record(cls: Any, values: Any) -> Any:
    """Build an instance of the attrs class `cls` from a mapping with exactly its fields."""
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


def _build_records(field: str, cls: Any, values: Any) -> tuple[Any, ...]:
    """Build a tuple of instances of `cls` from a list of mappings or of instances."""
    if not isinstance(values, (list, tuple)):
        raise ValueError(f"{field}: found {values!r}, expected a list")
    records = []
    for number, value in enumerate(values):
        try:
            records.append(value if isinstance(value, cls) else _build_record(cls, value))
        except ValueError as error:
            raise ValueError(f"{field}[{number}].{error}") from None
    return tuple(records)


def _pairs(values: Any) -> tuple[DelayPair, ...]:
    """Convert the list of delay pairs of a file."""
    return _build_records("pairs", DelayPair, values)


def _effects(values: Any) -> tuple[Effect, ...]:
    """Convert the list of effects of a file."""
    return _build_records("effects", Effect, values)


def _not_empty(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Validate a list with at least one pair."""
    if not value:
        _raise_invalid(attribute.name, value, "at least one pair")


def _known_schema(_: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
    """Validate the version of the file format."""
    if value != SCHEMA or isinstance(value, bool):
        _raise_invalid(attribute.name, value, str(SCHEMA))


@attrs.frozen
class ActuatorParameters:
    """Parameters of the empirical actuator model (Eq. 1 and 2 of the paper), in SI units.

    A wrong value raises a ValueError that names the field, the value found and the expected one.
    `data/aliengo.yaml` is an example of the file.

    Attributes:
        schema: version of the file format, `SCHEMA`.
        name: name of the actuators, for people.
        kp_ref: N m/rad, proportional gain at which the deviations were identified.
        kd_ref: N m s/rad, derivative gain at which the deviations were identified.
        delta_kp: N m/rad, deviation of the proportional gain at `kp_ref`: one number, three (hip,
            thigh, calf) or one per joint.
        delta_kd: N m s/rad, deviation of the derivative gain at `kd_ref`; shape as `delta_kp`.
        pairs: delays with their errors, at least one.
        torque_noise: N^2 m^2, variance of the torque noise.
        torque_limit: N m, largest torque; shape as `delta_kp`.
        effects: what the model adds to the PD law.
        joints: joint names in order; empty for those of the AlienGo.
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
        """Pair of delays with the least error; the first of several."""
        return min(self.pairs, key=lambda pair: pair.mse)

    @property
    def probable_pairs(self) -> tuple[DelayPair, ...]:
        """Pairs for randomisation: error below 1.5 times the least one (Section 3.1)."""
        least = self.best_pair.mse
        return tuple(
            pair for pair in self.pairs if pair.mse < PROBABLE_ERROR_RATIO * least or pair.mse == least
        )

    @classmethod
    def load(cls, path: str | Path) -> ActuatorParameters:
        """Read a parameter file.

        Args:
            path: YAML file.

        Returns:
            The parameters.

        Raises:
            ValueError: the file is no valid parameter file; the message names the file, the field,
                the value found and the expected one.
        """
        content = read_yaml(Path(path), "a YAML file of actuator parameters")
        try:
            parameters: ActuatorParameters = _build_record(cls, content)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return parameters

    def save(self, path: str | Path) -> None:
        """Write the parameters as YAML with units in comments; `load` is the inverse.

        Args:
            path: file to write.
        """
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
        """Return the parameters of the AlienGo that ship with the package.

        Returns:
            Table 4 of the paper.
        """
        return cls.load(_DEFAULT_FILE)

    @classmethod
    def ideal(cls) -> ActuatorParameters:
        """Return the parameters of a plain PD law.

        Returns:
            The default without delay, gain deviation and noise; the torque limit stays.
        """
        at_once = DelayPair(0.0, 0.0, 0.0)
        return attrs.evolve(
            cls.default(), name="ideal", delta_kp=0.0, delta_kd=0.0, pairs=(at_once,), torque_noise=0.0
        )
