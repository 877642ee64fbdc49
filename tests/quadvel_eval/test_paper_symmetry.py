from __future__ import annotations

import attrs
import numpy as np
import pytest

from quadvel_description.quadruped import LEFT, LEGS
from quadvel_description.symmetry import JOINTS as MIRROR
from quadvel_eval.paper.symmetry import PHASES_PER_CYCLE, Symmetry, leg_curves, resample_cycles
from quadvel_eval.walk import Walk

PERIOD, FREQUENCY = 0.005, 2.5
N = round(7.0 / PERIOD)


def trot(right: float = 1.0) -> Walk:
    """A trot whose right legs follow the left ones by half a cycle, with `right` times the torque."""
    phase = FREQUENCY * PERIOD * np.arange(N)
    legs = phase[:, None] + np.array([0.5, 0.0, 0.0, 0.5])  # FR FL RR RL
    curves = np.sin(2 * np.pi * legs)[:, :, None] * np.array([2.0, 5.0, 9.0]) + np.array([1.0, 0.0, 3.0])
    torque = curves * np.where([LEFT[leg] > 0 for leg in LEGS], 1.0, right)[:, None]
    joints = torque.reshape(N, 12)
    sides = np.where(np.repeat([LEFT[leg] > 0 for leg in LEGS], 3), 1.0, MIRROR.sign)
    return Walk(
        time=np.arange(N) * PERIOD,
        position=np.zeros((N, 3)),
        velocity=np.zeros((N, 3)),
        commanded=np.zeros((N, 3)),
        heading=np.zeros(N),
        contact=legs % 1.0 < 0.5,
        targets=joints * sides,
        joint_velocity=joints * sides,
        torque=joints * sides,
        power=np.zeros(N),
        estimate_errors={},
        estimate_drifts={},
    )


def asymmetry(walk: Walk) -> float | None:
    section = Symmetry()
    records = section.to_records([({"policy": "mine", "speed": 1.0}, walk)])
    section.figure(records)
    return section.rows(records)[0].ours["mine"]


def test_a_symmetric_gait_has_no_asymmetry() -> None:
    assert asymmetry(trot()) == pytest.approx(0.0, abs=0.01)


def test_a_lame_side_shows_as_its_share() -> None:
    # curves c and 0.5 c: difference 0.5 c, mean 0.75 c
    assert asymmetry(trot(right=0.5)) == pytest.approx(0.5 / 0.75, abs=0.02)


def test_a_robot_that_does_not_step_has_no_gait_cycle() -> None:
    standing = attrs.evolve(trot(), contact=np.ones((N, 4), dtype=bool))
    assert leg_curves(standing, "FL") is None


def test_a_cycle_runs_from_touchdown_to_touchdown() -> None:
    values = np.arange(100.0)[:, None]
    found = resample_cycles(np.array([20, 60, 90]), values)
    assert found.shape == (2, PHASES_PER_CYCLE, 1)
    np.testing.assert_allclose(found[:, 0, 0], [20.0, 60.0])
    np.testing.assert_allclose(found[0, PHASES_PER_CYCLE // 2, 0], 40.0)
