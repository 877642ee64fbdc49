"""Fields of records: bounds, choices, arrays, and what their errors say."""

from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_description.fields import field


@attrs.frozen(kw_only=True)
class Example:
    speed: float = field(1.0, "speed, m/s", at_least=0.0, at_most=3.0)
    gain: float = field(1.0, "gain, N m/rad", above=0.0)
    shift: float = field(0.0, "shift, m", at_least=-np.inf)
    count: int = field(3, "number of robots", at_least=1, whole=True)
    limits: tuple[float, ...] = field((1.0, 2.0), "limits, N m", above=0.0)
    kind: str = field("a", "kind", one_of=("a", "b"))
    size: np.ndarray = field(1.0, "size, m", size=3, at_least=0.1)
    width: float | None = field(None, "width, m", at_most=2.0)


def test_values_become_floats_and_read_only_arrays() -> None:
    example = Example(speed=2, size=[1, 2, 3], width=1)
    assert [type(one) for one in (example.speed, example.width, example.count)] == [float, float, int]
    np.testing.assert_array_equal(example.size, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(Example(size=2.0).size, [2.0, 2.0, 2.0])
    assert not example.size.flags.writeable


def test_description_and_bounds_are_metadata() -> None:
    assert dict(attrs.fields(Example).speed.metadata) == {"description": "speed, m/s", "bounds": (0.0, 3.0)}


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("speed", 4.0, "found 4.0, expected 0 to 3"),
        ("speed", float("nan"), "found nan, expected 0 to 3"),
        ("speed", "fast", "found 'fast', expected 0 to 3"),
        ("speed", True, "found True, expected 0 to 3"),
        ("gain", 0.0, "found 0.0, expected above 0"),
        ("shift", float("inf"), "found inf, expected a finite number"),
        ("count", 0, "found 0, expected a whole number, at least 1"),
        ("count", 1.5, "found 1.5, expected a whole number, at least 1"),
        ("limits", (1.0, -1.0), "found (1.0, -1.0), expected finite numbers, above 0"),
        ("kind", "c", "found 'c', expected one of a, b"),
        ("size", [1.0, 2.0], "found shape (2,), expected one number or a list of 3"),
        ("size", "large", "found 'large', expected one number or a list of 3"),
        ("size", [1.0, 2.0, 0.0], "found [1.0, 2.0, 0.0], expected finite numbers, at least 0.1"),
        ("width", 3.0, "found 3.0, expected at most 2"),
    ],
)
def test_a_wrong_value_is_refused_by_record_field_and_expectation(
    name: str, value: Any, expected: str
) -> None:
    with pytest.raises(ValueError, match="expected") as refused:
        Example(**{name: value})
    assert str(refused.value) == f"Example.{name}: {expected}"
