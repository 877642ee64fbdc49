"""Records from mappings: nested records, and errors that name file, place, value and expectation."""

from collections.abc import Sequence
from pathlib import Path

import attrs
import numpy as np
import pytest

from quadvel_description.arrays import Array
from quadvel_description.fields import field
from quadvel_description.records import read_document, structure_record


@attrs.frozen(kw_only=True)
class Wheel:
    radius: float = field(at_least=0.1)
    spoke_count: int = 8


@attrs.frozen(kw_only=True)
class Cart:
    name: str = "cart"
    centre: Array = field(0.0, size=2)
    open: bool = False
    wheels: Sequence[Wheel] = ()
    spare: Wheel | None = None


def test_nested_mappings_become_records() -> None:
    content = {"centre": [1, 2], "wheels": [{"radius": "1e0"}, {"radius": 2, "spoke_count": 5}]}
    cart = structure_record(Cart, content)
    np.testing.assert_array_equal(cart.centre, [1.0, 2.0])
    assert list(cart.wheels) == [Wheel(radius=1.0), Wheel(radius=2.0, spoke_count=5)]
    assert cart.spare is None


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ([1], "found [1], expected fields with their values"),
        ({"weels": []}, "found the field 'weels', expected one of name, centre, open, wheels, spare"),
        ({"wheels": 3}, "wheels: found 3, expected a list"),
        ({"wheels": [3]}, "wheels[0]: found 3, expected fields with their values"),
        ({"wheels": [{}]}, "wheels[0].radius: found nothing, expected a value"),
        ({"wheels": [{"radius": "big"}]}, "wheels[0].radius: found 'big', expected a number"),
        ({"wheels": [{"radius": 0.0}]}, "wheels[0]: Wheel.radius: found 0.0, expected at least 0.1"),
        (
            {"spare": {"radius": 1.0, "spoke_count": 1.5}},
            "spare.spoke_count: found 1.5, expected a whole number",
        ),
        ({"open": "no"}, "open: found 'no', expected true or false"),
        ({"name": 3}, "name: found 3, expected a text"),
        ({"centre": [1, 2, 3]}, "Cart.centre: found shape (3,), expected one number or a list of 2"),
    ],
)
def test_wrong_content_is_refused_with_its_place(content: object, expected: str) -> None:
    with pytest.raises(ValueError, match="expected") as refused:
        structure_record(Cart, content, Path("my.yaml"))
    assert str(refused.value) == f"my.yaml: {expected}"


def test_a_file_of_another_kind_is_refused_as_a_whole() -> None:
    @attrs.frozen
    class Model:
        name: str
        gain: float
        delay: float

    with pytest.raises(
        ValueError, match=r"found the fields a, b, c, d and 1 more, expected name, gain, delay$"
    ):
        structure_record(Model, dict.fromkeys("abcde", 1))
    with pytest.raises(ValueError, match="delay: found nothing, expected a value"):
        structure_record(Model, {"name": "x", "gain": 1.0})


@pytest.mark.parametrize(
    ("text", "expected"),
    [("- 1", r"found \[1\], expected fields"), ("schema: 2", "schema: found 2, expected 1")],
)
def test_a_document_states_its_schema(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"my\.yaml: {expected}"):
        read_document(path, "a cart", 1)
    path.write_text("{schema: 1, name: x}")
    assert read_document(path, "a cart", 1) == {"name": "x"}
