"""Whether named laws are given up for terms of signals while more of them are sought."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from quadvel_sysid.engine.simplest import Alone

FLOOR = 1.0


def model(laws: int, above: float) -> Any:
    """So many laws that leave `above` the noise."""
    return SimpleNamespace(applied=("law",) * laws, above=above)


class Given(Alone):
    """Terms, so many a joint, that leave so much above the noise; `asked` are the numbers of terms that were enough."""

    def __init__(self, terms: int, above: float) -> None:
        judge = SimpleNamespace(judge=np.ones((10, 1), dtype=bool))
        super().__init__(model(0, 9.0), judge, np.array([FLOOR]))  # type: ignore[arg-type]
        one = SimpleNamespace(active=np.array([True]))
        self._terms = SimpleNamespace(model=model(0, above), terms=(one,) * terms)
        self.asked: list[float] = []

    def _learned(self, enough: float) -> Any:
        self.asked.append(enough)
        return self._terms

    def _above(self, model: Any, terms: Any) -> float:
        return float(model.above)


@pytest.mark.parametrize(
    ("laws", "left", "before", "given_up"),
    [
        (3, 3.0, 3.5, True),  # the third takes next to nothing, terms leave next to nothing
        (3, 2.0, 3.5, False),  # it comes nearer
        (3, 0.9, 1.0, False),  # terms leave a good part of what the laws do
        (2, 3.0, 3.5, False),  # two may be a part of more
    ],
)
def test_many_terms_replace_laws_that_grow_in_number_and_come_no_nearer(laws, left, before, given_up):
    alone = Given(terms=4, above=0.2)
    assert (alone.says_more(model(laws, left), model(laws - 1, before)) is not None) == given_up


def test_laws_that_no_other_one_joins_are_not_hopeless():
    laws = model(3, 3.0)
    assert Given(terms=4, above=0.0).says_more(laws, laws) is None


@pytest.mark.parametrize(("left", "given_up"), [(0.9, True), (0.7, False)])
def test_two_laws_give_way_to_one_term_that_leaves_a_quarter(left, given_up):
    alone = Given(terms=1, above=0.2)
    assert (alone.says_more(model(2, left), model(1, 9.0)) is not None) == given_up


def test_no_more_terms_are_sought_than_would_make_a_short_account():
    alone = Given(terms=1, above=0.5)
    alone.says_more(model(4, 1.0), model(3, 9.0))
    assert alone.asked == [2.0]  # a term says as much as two laws
