"""Ways from files, and a robot that walks them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadvel_follow.trajectory import SHIPPED, STEP, Trajectory, TrajectoryFollower, load


def walked(follower: TrajectoryFollower, start: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Where a robot ends that moves as commanded plus `drift` (3,), body frame."""
    pose, time = start.copy(), 0.0
    while (velocity := follower.step(time, pose)) is not None:
        vx, vy, wz = velocity + drift
        c, s = np.cos(pose[2] + 0.5 * STEP * wz), np.sin(pose[2] + 0.5 * STEP * wz)
        pose = pose + STEP * np.array([c * vx - s * vy, s * vx + c * vy, wz])
        time += STEP * 1.0000001
    return pose


def test_the_figure_of_eight_ends_where_it_began() -> None:
    eight = load(SHIPPED / "eight.csv", 0.5)
    np.testing.assert_allclose(eight.pose[-1], 0.0, atol=0.03)
    assert np.ptp(eight.pose[:, 1]) == pytest.approx(4.0, abs=0.01)


def test_places_of_a_csv_are_passed_in_turn(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("x,y\n0,0\n2,0\n2,1\n")
    way = load(file, 0.5)
    for place in ((2.0, 0.0), (2.0, 1.0)):
        assert np.hypot(*(way.pose[:, :2] - place).T).min() < 0.02
    assert way.seconds == pytest.approx(4.0 + np.pi / 2 + 2.0, abs=0.1)


def test_points_of_a_gpx_are_metres_from_the_first(tmp_path: Path) -> None:
    file = tmp_path / "way.gpx"
    file.write_text(
        '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        '<trkpt lat="60.0" lon="10.0"/><trkpt lat="60.0" lon="10.0001"/></trkseg></trk></gpx>'
    )
    np.testing.assert_allclose(load(file, 0.5).pose[-1, :2], [5.56, 0.0], atol=0.02)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has the head '', expected"),
        ("a,b\n1,2\n", "has the head 'a,b'"),
        ("x,y\n1,two\n", "could not convert"),
        ("x,y\n1\n", "inhomogeneous|rows that are not"),
        ("x,y\n1,nan\n2,2\n", "rows that are not 2 finite numbers"),
        ("x,y\n1,1\n", "one place"),
        ("seconds,vx,vy,wz\n-1,0,0,0\n", "seconds that are not above 0"),
    ],
)
def test_files_that_are_no_way_are_refused_by_name(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"way\.csv: .*({words})"):
        load(file, 0.5)


def test_a_gpx_with_entities_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "way.gpx"
    file.write_text('<!DOCTYPE gpx [<!ENTITY a "b">]><gpx/>')
    with pytest.raises(ValueError, match="entities"):
        load(file, 0.5)


def test_closed_on_odometry_a_drift_is_corrected_that_open_loop_keeps() -> None:
    way = Trajectory.of_places([[0.0, 0.0], [4.0, 0.0]], 0.5)
    start, drift = np.array([3.0, 1.0, np.pi / 2]), np.array([0.0, 0.05, 0.0])
    end = start[:2] + np.array([0.0, 4.0])
    assert np.hypot(*(walked(TrajectoryFollower(way, False), start, drift)[:2] - end)) > 0.35
    assert np.hypot(*(walked(TrajectoryFollower(way, True), start, drift)[:2] - end)) < 0.1


def test_a_robot_far_off_its_way_is_given_up() -> None:
    follower = TrajectoryFollower(load(SHIPPED / "eight.csv", 0.5), True)
    follower.step(0.0, np.zeros(3))
    with pytest.raises(ValueError, match=r"2\.00 m off its way"):
        follower.step(0.0, np.array([0.0, 2.0, 0.0]))
