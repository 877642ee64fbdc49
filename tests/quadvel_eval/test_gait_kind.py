from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.gait_kind import GaitKind, gait_frequency

PERIOD = 0.005
TROT, PACE, BOUND, PRONK = (  # phase of FR, FL, RR, RL
    np.array(phases) for phases in ((0, 0.5, 0.5, 0), (0, 0.5, 0, 0.5), (0, 0, 0.5, 0.5), (0, 0, 0, 0))
)


def contacts(phases: np.ndarray, frequency: float, ratio: float, seconds: float = 4.0) -> np.ndarray:
    """Contacts (n, 4) of feet that are down for `ratio` of a cycle."""
    return (frequency * PERIOD * np.arange(round(seconds / PERIOD))[:, None] + phases) % 1.0 < ratio


@pytest.mark.parametrize(
    ("phases", "diagonal", "side"), [(TROT, 1.0, 0.0), (PACE, 0.0, 1.0), (BOUND, 0.0, 0.0), (PRONK, 1.0, 1.0)]
)
@pytest.mark.parametrize("frequency", [1.7, 4.1])
def test_contact_agreement_identifies_the_gait(
    phases: np.ndarray, diagonal: float, side: float, frequency: float
) -> None:
    kind = GaitKind.of(contacts(phases, frequency, 0.5), np.zeros(800), PERIOD)
    assert kind.diagonal == pytest.approx(diagonal, abs=0.02)
    assert kind.side == pytest.approx(side, abs=0.02)
    assert kind.frequency == pytest.approx(frequency, rel=0.01)
    assert kind.contact_ratio == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("ratio", [0.35, 0.7])
def test_feet_of_one_side_are_alike_in_a_trot_where_all_are_down_or_all_up(ratio: float) -> None:
    kind = GaitKind.of(contacts(TROT, 2.0, ratio), np.zeros(800), PERIOD)
    assert kind.side == pytest.approx(abs(2 * ratio - 1), abs=0.02)
    assert kind.diagonal == 1.0


def test_sway_leaves_out_the_mean_of_the_sideways_velocity() -> None:
    time = PERIOD * np.arange(800)
    sideways = 0.4 + 0.1 * np.sqrt(2.0) * np.sin(2 * np.pi * 2.0 * time)
    assert GaitKind.of(contacts(TROT, 2.0, 0.5), sideways, PERIOD).sway == pytest.approx(0.1, rel=0.01)


def test_feet_that_stand_have_no_frequency() -> None:
    assert gait_frequency(np.ones((800, 4), bool), PERIOD) == 0.0
