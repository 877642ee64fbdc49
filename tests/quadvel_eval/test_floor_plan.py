"""Simulated scanner and walkers against closed-form solutions."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.people.laser import FloorPlan, Laser
from quadvel_sim.walker import Walker

QUIET = Laser(rays=8, angle_increment=np.pi / 4, noise=0.0, noise_share=0.0, lost=0.0, mixed=0.0)


def test_rays_end_on_the_near_side_of_circles_and_on_walls() -> None:
    plan = FloorPlan([[3.0, 0.0, 0.5]], [[-2.0, -5.0, -2.0, 5.0]])
    ranges = QUIET.scan(plan, np.zeros(3), np.random.default_rng(0))
    wall, diagonal = 2.0, 2.0 * np.sqrt(2.0)
    np.testing.assert_allclose(
        ranges, [wall, diagonal, np.inf, np.inf, 2.5, np.inf, np.inf, diagonal], atol=1e-12
    )


def test_a_scan_is_made_from_the_sensor_s_pose() -> None:
    ranges = QUIET.scan(
        FloorPlan([[3.0, 1.0, 0.5]]), np.array([3.0, -1.0, np.pi / 2]), np.random.default_rng(0)
    )
    assert ranges[4] == pytest.approx(1.5)
    assert np.isinf(np.delete(ranges, 4)).all()


def test_scanner_faults_have_the_configured_frequency() -> None:
    noisy = Laser(
        rays=20000, angle_increment=1e-4, noise=0.02, noise_share=0.0, lost=0.1, mixed=0.0, no_return=0.0
    )
    ranges = noisy.scan(
        FloorPlan(segments=[[-50, -50, 50, -50]]), np.array([0, -45, 0.0]), np.random.default_rng(1)
    )
    hit = FloorPlan(segments=[[-50, -50, 50, -50]]).cast([0.0, -45.0], noisy.angles)
    near = hit < 11.5
    assert np.mean(ranges[near] == 0.0) == pytest.approx(0.1, abs=0.01)
    seen = near & (ranges > 0.0)
    assert np.std(ranges[seen] - hit[seen]) == pytest.approx(0.02, rel=0.05)
    assert (ranges[hit > 12.5] == 0.0).all()


def test_a_walker_goes_its_way_at_its_speed_and_stands_where_it_stops() -> None:
    walker = Walker(way=[[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]], speed=1.0, stops=[(1.0, 2.0)])
    places = []
    for _ in range(600):
        walker.step(0.01)
        places.append(walker.position)
    np.testing.assert_allclose(places[199], [1.0, 0.0], atol=0.02)
    np.testing.assert_allclose(places[399], [2.0, 1.0], atol=0.02)
    np.testing.assert_allclose(places[-1], [2.0, 3.0], atol=0.02)


def test_a_foot_on_the_ground_rests_while_the_body_passes_over_it() -> None:
    walker = Walker(way=[[0.0, 0.0], [20.0, 0.0]], speed=1.2)
    legs, bodies = [], []
    for _ in range(400):
        walker.step(0.01)
        legs.append(walker.legs[:, :2])
        bodies.append(walker.position)
    speeds = np.diff(np.array(legs)[200:, :, 0], axis=0) / 0.01
    assert np.median(speeds.min(1)) < 0.5  # a shin's, which turns about the foot
    assert speeds.max() > 2.0
    assert np.abs(np.mean(legs, axis=(0, 1)) - np.mean(bodies, axis=0)).max() < 0.05
