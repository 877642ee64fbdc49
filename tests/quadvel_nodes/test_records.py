"""Parameters of a node from records that contain records."""

from __future__ import annotations

import attrs
import pytest

from quadvel_nodes.parameters import make_record, parameter_fields


def positive(_: object, field: attrs.Attribute[float], value: float) -> None:
    if value <= 0.0:
        raise ValueError(f"{field.name} is {value}, expected above 0")


@attrs.frozen
class Wheel:
    radius: float = attrs.field(default=0.3, validator=positive)


@attrs.frozen
class Cart:
    wheel: Wheel = Wheel()
    name: str = "cart"


def test_the_parameters_of_a_record_are_its_fields_and_those_of_its_records_in_order() -> None:
    assert [(name, field.default) for name, field in parameter_fields(Cart).items()] == [
        ("radius", 0.3),
        ("name", "cart"),
    ]


def test_a_record_is_made_of_parameters_with_defaults_for_the_others() -> None:
    assert make_record(Cart, {}) == Cart()
    assert make_record(Cart, {"radius": 0.5}) == Cart(Wheel(0.5), "cart")


def test_a_wrong_value_is_refused_by_the_record_that_has_it() -> None:
    with pytest.raises(ValueError, match=r"radius is -1\.0, expected above 0"):
        make_record(Cart, {"radius": -1.0})
