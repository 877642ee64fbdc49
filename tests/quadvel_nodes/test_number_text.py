"""Numbers for people."""

from __future__ import annotations

import pytest

from quadvel_nodes.number_text import number_text


@pytest.mark.parametrize("value", [None, float("nan"), float("inf"), -float("inf")])
def test_a_number_that_is_not_there_is_a_dash(value: float | None) -> None:
    assert number_text(value, ".2f") == "–"


def test_a_number_that_is_there_is_formatted() -> None:
    assert number_text(1.005, "+.1f") == "+1.0"
