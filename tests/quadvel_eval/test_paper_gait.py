from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.gait_kind import gait_frequency, touchdowns
from quadvel_eval.paper.gait import Gait, debounce_contacts
from quadvel_eval.walk import Walk

PERIOD = 0.005


def trot(frequency: float, ratio: float, seconds: float = 4.0) -> np.ndarray:
    """Contacts (n, 4) of a trot."""
    phase = frequency * PERIOD * np.arange(round(seconds / PERIOD))[:, None] + np.array([0.0, 0.5, 0.5, 0.0])
    return phase % 1.0 < ratio


def walk(contact: np.ndarray, vx: float) -> Walk:
    n = len(contact)
    return Walk(
        time=np.arange(n) * PERIOD,
        position=np.zeros((n, 3)),
        velocity=np.tile([vx, 0.0, 0.0], (n, 1)),
        commanded=np.tile([vx, 0.0, 0.0], (n, 1)),
        heading=np.zeros(n),
        contact=contact,
        targets=np.zeros((n, 12)),
        joint_velocity=np.zeros((n, 12)),
        torque=np.zeros((n, 12)),
        power=np.zeros(n),
        estimate_errors={},
        estimate_drifts={},
    )


@pytest.mark.parametrize("frequency", [2.0, 3.3])
def test_gait_frequency_is_that_of_the_touchdowns(frequency: float) -> None:
    assert gait_frequency(trot(frequency, 0.55), PERIOD) == pytest.approx(frequency, rel=0.01)


def test_a_robot_that_stands_has_no_gait() -> None:
    assert gait_frequency(np.ones((400, 4), dtype=bool), PERIOD) == 0.0


def test_bounces_are_no_steps() -> None:
    bounced = trot(2.0, 0.5)
    bounced[10] = ~bounced[10]  # a gap and a touch of one tick
    assert gait_frequency(debounce_contacts(bounced), PERIOD) == pytest.approx(2.0, rel=0.01)
    assert len(touchdowns(debounce_contacts(bounced)[:, 1])) == len(touchdowns(trot(2.0, 0.5)[:, 1]))


def test_the_table_holds_frequency_and_contact_ratio_of_the_end_of_the_ramp() -> None:
    section = Gait()
    standing = np.ones((400, 4), dtype=bool)
    records = section.to_records(
        [({"policy": "mine"}, (walk(np.vstack([standing, trot(3.0, 0.4, 8.0)]), 3.2), True))]
    )
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours["velocity at the end of the ramp"] == pytest.approx(3.2)
    assert ours["gait frequency at the end"] == pytest.approx(3.0, rel=0.02)
    assert ours["contact ratio, standing"] == 1.0
    assert ours["contact ratio at the end"] == pytest.approx(0.4, abs=0.02)
    assert ours["fell during the ramp"] == 0.0


def test_the_table_holds_the_kind_of_gait_at_each_speed_of_the_ramp() -> None:
    section = Gait(slope=0.25, hold=0.0)
    pacing, trotting = trot(3.0, 0.5, 4.0), trot(2.0, 0.6, 5.0)
    pacing[:, [1, 2, 3]] = pacing[:, [1, 0, 1]]  # feet of one side together
    ramped = walk(np.vstack([pacing, trotting]), 1.0)
    time = ramped.time
    ramped.velocity[:, 1] = 0.3 + 0.1 * np.sqrt(2.0) * np.sin(2 * np.pi * 3.0 * time)
    ours = {
        row.what: row.ours.get("mine")
        for row in section.rows(section.to_records([({"policy": "mine"}, (ramped, True))]))
    }
    assert ours["0.5 m/s: feet of one side alike"] == pytest.approx(100.0, abs=1.0)
    assert ours["0.5 m/s: diagonal feet alike"] == pytest.approx(0.0, abs=2.0)
    assert ours["0.5 m/s: gait frequency"] == pytest.approx(3.0, rel=0.02)
    assert ours["0.5 m/s: sway"] == pytest.approx(0.1, rel=0.05)
    assert ours["1 m/s: diagonal feet alike"] == pytest.approx(50.0, abs=10.0)  # the change lies in its span
    assert ours["2 m/s: diagonal feet alike"] == pytest.approx(100.0, abs=1.0)
    assert ours["2 m/s: feet of one side alike"] == pytest.approx(20.0, abs=2.0)
    assert ours["2.75 m/s: diagonal feet alike"] is None  # the ramp ends before
