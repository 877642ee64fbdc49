"""Dynamic similarity: robots of another size move alike at equal Froude numbers."""

from __future__ import annotations

from types import SimpleNamespace

import attrs
import numpy as np
import pytest

pytest.importorskip("mujoco.batch", reason="training needs MuJoCo's batch")

from quadvel_training import scripted_trot
from quadvel_training.gait_clock import GaitClock, duty_factor, step_frequency
from quadvel_training.similarity import REFERENCE_HEIGHT_M, Size
from tests.helpers.robots import ALIENGO, GO2


def test_the_size_is_that_of_the_height_of_the_hips_in_the_nominal_posture():
    # thigh and calf of the Go2: 0.213 m each, at 0.8 and -0.8 rad to the vertical
    assert Size.of(GO2).length == pytest.approx(2 * 0.213 * np.cos(0.8) / REFERENCE_HEIGHT_M, rel=1e-6)
    assert Size.of(ALIENGO).length == pytest.approx(1.0, rel=1e-5)


def test_velocities_that_are_alike_have_the_same_froude_number():
    small, velocity = Size(0.25), np.array([[1.0, -0.5, 2.0]])
    alike = small.as_reference(velocity)
    height = np.array([0.25, 0.25]) * REFERENCE_HEIGHT_M
    assert alike[0, :2] ** 2 / REFERENCE_HEIGHT_M == pytest.approx(velocity[0, :2] ** 2 / height)
    assert alike[0, 2] ** 2 * REFERENCE_HEIGHT_M == pytest.approx(velocity[0, 2] ** 2 * height[0])


def test_a_robot_of_a_quarter_of_the_size_steps_twice_as_often_at_half_the_speed():
    small, large = GaitClock(2, Size(0.25)), GaitClock(2)
    large.velocity = np.array([[1.2, 0.0, 0.5], [0.0, 0.4, 0.0]])
    small.velocity = large.velocity * [0.5, 0.5, 2.0]
    assert small.frequency == pytest.approx(2.0 * step_frequency(large.velocity))
    assert small.duty == pytest.approx(duty_factor(large.velocity))
    assert small.shortest_swing == pytest.approx(0.5 * large.shortest_swing)


def test_its_plan_reaches_the_speed_that_is_alike_in_half_the_time():
    small, large, none = GaitClock(1, Size(0.25)), GaitClock(1), np.zeros((1, 4), bool)
    command = np.array([[1.0, 0.5, 2.0, 0.0]])
    for _ in range(7):
        large.advance(command, np.zeros(1), none, 0.02)
        small.advance(command * [0.5, 0.5, 2.0, 1.0], np.zeros(1), none, 0.01)
    assert small.velocity == pytest.approx(large.velocity * [0.5, 0.5, 2.0])
    assert small.phase == pytest.approx(large.phase)


def test_the_script_moves_robots_of_all_sizes_alike(monkeypatch):
    """Lengths grow with the length L, speeds and times with its root; the angles of the joints stay."""
    rng = np.random.default_rng(0)
    size, n, lead = Size(0.25), 40, scripted_trot.LEAD_S
    lengths = ("hips", "lateral", "links", "thigh", "calf")
    legs = attrs.evolve(ALIENGO.legs, **{name: size.length * getattr(ALIENGO.legs, name) for name in lengths})
    small = SimpleNamespace(nominal_q=ALIENGO.nominal_q, legs=legs)
    state = {
        "roll_pitch": rng.normal(0.0, 0.1, (n, 2)),
        "ground_slope": rng.normal(0.0, 0.1, (n, 2)),
        "ground_lean": rng.normal(0.0, 0.1, (n, 2)),
        "angular_velocity": rng.normal(0.0, 1.0, (n, 3)),
        "planar_velocity": rng.normal(0.0, 1.0, (n, 3)),
        "height": rng.uniform(0.3, 0.5, n),
        "stand_q": ALIENGO.nominal_q + 0.1,
    }
    large = SimpleNamespace(robot=ALIENGO, size=Size(), **state)
    lag, turn, clock = rng.normal(0.0, 0.1, (n, 2)), rng.normal(0.0, 0.2, n), GaitClock(n)
    clock.velocity, clock.phase = rng.normal(0.0, 1.0, (n, 3)), rng.uniform(0.0, 1.0, n)
    clock.walking[:] = True
    steady = np.full(n, 0.5)
    past = SimpleNamespace(clock=clock, steady=steady, lag=lag, turn_correction=turn)
    expected = scripted_trot.joint_offsets(large, past)

    speeds, rates = np.array([size.time, size.time, 1 / size.time]), 1 / size.time
    alike = state | {
        "angular_velocity": state["angular_velocity"] * rates,
        "planar_velocity": state["planar_velocity"] * speeds,
        "height": state["height"] * size.length,
    }
    its_clock = GaitClock(n, size)
    its_clock.velocity, its_clock.phase = clock.velocity * speeds, clock.phase
    its_clock.walking[:] = True
    # the lead is that of the drives, which does not scale
    monkeypatch.setattr(scripted_trot, "LEAD_S", lead * size.time)
    its_past = SimpleNamespace(
        clock=its_clock, steady=steady, lag=lag * size.length, turn_correction=turn / size.time
    )
    found = scripted_trot.joint_offsets(SimpleNamespace(robot=small, size=size, **alike), its_past)
    np.testing.assert_allclose(found, expected, atol=1e-12)
