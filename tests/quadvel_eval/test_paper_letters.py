from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.paper.letters import LETTERS, Letters, reference_path

STRAIGHT = ((0.5, 0.0, 0.0), 2.0)
SIDEWAYS = ((0.0, 0.5, 0.0), 1.0)
QUARTER = ((0.0, 0.0, np.pi / 2), 1.0)


def test_the_reference_is_where_the_commands_lead() -> None:
    way = reference_path([STRAIGHT, QUARTER, STRAIGHT, SIDEWAYS])
    assert len(way) == 1200
    np.testing.assert_allclose(way[-1], [0.5, 1.0, np.pi / 2], atol=0.005)


def test_an_arc_of_half_a_turn_ends_a_diameter_aside() -> None:
    way = reference_path([((0.5, 0.0, 0.5), 2 * np.pi)])
    np.testing.assert_allclose(way[-1], [0.0, 2.0, np.pi], atol=0.005)


def test_the_letters_stand_in_a_row_and_are_as_high_as_the_first() -> None:
    way = reference_path(LETTERS)
    assert np.ptp(way[:, 1]) == pytest.approx(1.5, abs=0.02)
    np.testing.assert_allclose(way[-1, :2], [3.3, 0.0], atol=0.03)


def test_deviation_is_the_distance_to_the_reference_at_the_same_instant() -> None:
    section = Letters(strokes=(STRAIGHT,))
    way = reference_path([STRAIGHT]) * [0.8, 1.0, 1.0]
    records = section.to_records([({"policy": "mine", "seed": 0}, (way, True))])
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours["largest deviation"] == pytest.approx(0.2, abs=0.01)
    assert ours["falls"] == 0.0
    section.figure(records)
