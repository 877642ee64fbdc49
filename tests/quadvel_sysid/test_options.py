"""Options of an identification: every field is documented, and values beyond its bounds are refused."""

from pathlib import Path

import attrs
import pytest

import quadvel_sysid
from quadvel_sysid.options import SEARCH_DEFAULTS, IdentifyOptions, SearchOptions


@pytest.mark.parametrize(
    "field", [*attrs.fields(SearchOptions), *attrs.fields(IdentifyOptions)], ids=lambda f: f.name
)
def test_a_field_states_its_description_and_keeps_its_bounds(field: attrs.Attribute) -> None:
    assert field.metadata["description"]
    if isinstance(field.default, (int, float)) and not isinstance(field.default, bool):
        low, high = field.metadata["bounds"]
        owner = SearchOptions if hasattr(SEARCH_DEFAULTS, field.name) else IdentifyOptions
        for value in (low - 1, high + 1):
            with pytest.raises(ValueError, match=field.name):
                owner(**{field.name: value})


@pytest.mark.parametrize(
    "field", [*attrs.fields(SearchOptions), *attrs.fields(IdentifyOptions)], ids=lambda f: f.name
)
def test_a_field_is_read_by_the_engine(field: attrs.Attribute) -> None:
    package = Path(quadvel_sysid.__file__).parent
    readers = [path for path in package.rglob("*.py") if f"options.{field.name}" in path.read_text()]
    assert readers, f"nothing reads options.{field.name}"
