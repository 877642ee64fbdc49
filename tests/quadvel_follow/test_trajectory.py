"""Tests of trajectories from files and of their execution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadvel_follow.trajectory import (
    RECEIVER_NOISE,
    SHIPPED_FOLDER,
    STEP_S,
    Trajectory,
    TrajectoryFollower,
    load_trajectory,
)

Array = np.ndarray


def walked(follower: TrajectoryFollower, start: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Where a robot ends that moves as commanded plus `drift` (3,), body frame."""
    pose, time = start.copy(), 0.0
    while (velocity := follower.step(time, pose)) is not None:
        vx, vy, wz = velocity + drift
        c, s = np.cos(pose[2] + 0.5 * STEP_S * wz), np.sin(pose[2] + 0.5 * STEP_S * wz)
        pose = pose + STEP_S * np.array([c * vx - s * vy, s * vx + c * vy, wz])
        time += STEP_S * 1.0000001
    return pose


def test_the_figure_of_eight_ends_where_it_began() -> None:
    eight = load_trajectory(SHIPPED_FOLDER / "eight.csv", 0.5)
    np.testing.assert_allclose(eight.pose[-1], 0.0, atol=0.03)
    assert np.ptp(eight.pose[:, 1]) == pytest.approx(4.0, abs=0.01)


def test_places_of_a_csv_are_passed_in_turn(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("x,y\n0,0\n2,0\n2,1\n")
    way = load_trajectory(file, 0.5)
    for place in ((2.0, 0.0), (2.0, 1.0)):
        assert np.hypot(*(way.pose[:, :2] - place).T).min() < 0.02
    assert way.seconds == pytest.approx(4.0 + np.pi / 2 + 2.0, abs=0.1)


def test_a_csv_of_a_spreadsheet_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text("\ufeffseconds,vx,vy,wz\n2,0.5,0,0\n", encoding="utf-8")
    trajectory = load_trajectory(tmp_path / "way.csv", 0.5)
    assert trajectory.pose[-1, 0] == pytest.approx(1.0, abs=0.01)


def test_points_of_a_gpx_are_metres_from_the_first(tmp_path: Path) -> None:
    file = tmp_path / "way.gpx"
    file.write_text(
        '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        '<trkpt lat="60.0" lon="10.0"/><trkpt lat="60.0" lon="10.0001"/></trkseg></trk></gpx>'
    )
    np.testing.assert_allclose(load_trajectory(file, 0.5).pose[-1, :2], [5.56, 0.0], atol=0.02)


def gpx(tmp_path: Path, points: Array) -> Path:
    """A file of a track through lat, lon (n, 2), deg."""
    file = tmp_path / "way.gpx"
    marks = "".join(f'<trkpt lat="{lat:.7f}" lon="{lon:.7f}"/>' for lat, lon in points)
    file.write_text(f"<gpx><trk><trkseg>{marks}</trkseg></trk></gpx>")
    return file


@pytest.mark.parametrize(
    ("first", "last"), [((89.9999, 0.0), (89.9999, 180.0)), ((10.0, 179.9999), (10.0, -179.9999))]
)
def test_neither_a_pole_nor_the_date_line_stretches_a_gpx(
    tmp_path: Path, first: tuple[float, float], last: tuple[float, float]
) -> None:
    way = load_trajectory(gpx(tmp_path, np.array([first, last])), 1.0)
    assert 20.0 < np.hypot(*way.pose[-1, :2]) < 23.0


def arc(radius: float, turns: float, spacing: float) -> Array:
    """Points (n, 2) on a circle to the left, from the origin on."""
    angle = np.arange(0.0, 2.0 * np.pi * turns + 1e-9, spacing / radius)
    return radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def line(length: float, spacing: float) -> Array:
    """Points (n, 2) along x."""
    x = np.arange(0.0, length + 1e-9, spacing)
    return np.column_stack([x, np.zeros_like(x)])


def noisy(points: Array, noise: float, seed: int) -> Array:
    """The same with errors of that standard deviation, m."""
    return points + noise * np.random.default_rng(seed).standard_normal(points.shape)


def on_the_spot(way: Trajectory) -> float:
    """s, in which it turns without walking."""
    return STEP_S * float(np.sum(way.velocity[:, 0] < 1e-9))


def turned(way: Trajectory) -> float:
    """Sum of all turning, rad."""
    return STEP_S * float(np.abs(way.velocity[:, 2]).sum())


EIGHT = np.vstack([arc(2.0, 1.0, 0.1), arc(2.0, 1.0, 0.1)[1:] * [1.0, -1.0]])
SPIRAL_ANGLE = np.arange(np.pi, 6.0 * np.pi, 0.05)[:, None]
SPIRAL = 0.3 * SPIRAL_ANGLE * np.hstack([np.cos(SPIRAL_ANGLE), np.sin(SPIRAL_ANGLE)])


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    ("points", "noise", "length", "turn"),
    [
        pytest.param(arc(2.0, 1.0, 0.001), 0.001, 12.57, 6.28, id="circle of millimetres"),
        pytest.param(arc(2.0, 1.0, 0.05), 0.0, 12.57, 6.28, id="circle"),
        pytest.param(arc(2.0, 1.0, 0.05), 0.01, 12.57, 6.28, id="noisy circle"),
        pytest.param(arc(2.0, 1.0, 0.5), 0.0, 12.57, 6.28, id="circle of half metres"),
        pytest.param(arc(20.0, 1.0, 5.0), 0.05, 125.7, 6.28, id="circle of five metres"),
        pytest.param(EIGHT, 0.01, 25.1, 12.57, id="figure of eight"),
        pytest.param(SPIRAL, 0.01, 51.9, 15.9, id="spiral"),
        pytest.param(line(10.0, 0.02), 0.01, 10.0, 0.0, id="line"),
        pytest.param(line(10.0, 0.005), 0.1, 10.0, 0.0, id="line lost in noise"),
    ],
)
def test_recorded_paths_are_walked_in_curves_and_nowhere_on_the_spot(
    points: Array, noise: float, length: float, turn: float, seed: int
) -> None:
    way = Trajectory.from_points(np.round(noisy(points, noise, seed), 4), 0.9)
    assert way.velocity[:, 0].sum() * STEP_S == pytest.approx(length, rel=0.06)
    assert on_the_spot(way) == 0.0
    assert turned(way) == pytest.approx(turn, rel=0.12, abs=0.4)
    assert np.quantile(way.velocity[:, 0], 0.02) > 0.85


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate", [1, 10])
def test_a_receiver_that_stood_for_minutes_leads_along_the_way_alone(rate: int, seed: int) -> None:
    before, after = line(40.0, 1.0 / rate), line(40.0, 1.0 / rate) @ [[0.0, 1.0], [-1.0, 0.0]] + [40.0, 0.0]
    stop = np.tile([40.0, 0.0], (180 * rate, 1))
    track = noisy(np.vstack([np.zeros((100 * rate, 2)), before, stop, after]), 0.4, seed)
    way = Trajectory.from_points(track, 1.0, RECEIVER_NOISE)
    assert way.velocity[:, 0].sum() * STEP_S == pytest.approx(80.0, abs=6.0)
    assert turned(way) < 1.57 + 1.2
    assert way.noise == pytest.approx(0.4, rel=0.2)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate", [1, 5])
def test_errors_that_neighbours_share_are_not_taken_for_turns(rate: int, seed: int) -> None:
    before, after = np.split(line(72.0, 1.2 / rate), [30 * rate])
    track = np.vstack([before, np.tile([36.0, 0.0], (60 * rate, 1)), after])
    random, wander = np.random.default_rng(seed), np.zeros_like(track)
    for k in range(1, len(track)):
        wander[k] = 0.9 * wander[k - 1] + 0.4 * np.sqrt(1.0 - 0.9**2) * random.normal(size=2)
    way = Trajectory.from_points(track + wander, 1.0, RECEIVER_NOISE)
    assert way.velocity[:, 0].sum() * STEP_S == pytest.approx(72.0, abs=5.0)
    assert turned(way) < 3.0


@pytest.mark.parametrize(
    "corners",
    [
        pytest.param([[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]], id="square"),
        pytest.param([[0, 0], [1.5, 0], [0, 1.5], [1.5, 1.5]], id="letter Z"),
        pytest.param([[x, 0.5 * y] for y in range(20) for x in ((0, 1), (1, 0))[y % 2]], id="lawn mower"),
        pytest.param([[0, 0], [3, 0], [5, 2]], id="half a right angle"),
        pytest.param([[0, 0], [3, 0], [0, 0]], id="back and forth"),
    ],
)
def test_written_corners_are_turned_on_the_spot(corners: list[list[float]]) -> None:
    legs = np.diff(np.array(corners, float), axis=0)
    turns = np.abs((np.diff(np.arctan2(legs[:, 1], legs[:, 0])) + np.pi) % (2.0 * np.pi) - np.pi)
    way = Trajectory.from_points(corners, 0.5)
    assert on_the_spot(way) == pytest.approx(turns.sum(), abs=0.02 * len(corners))
    assert way.seconds == pytest.approx(np.hypot(*legs.T).sum() / 0.5 + turns.sum(), rel=0.01)


def test_dense_points_keep_a_corner() -> None:
    side = line(2.0, 0.05)
    way = Trajectory.from_points(np.vstack([side, side[1:] @ [[0.0, 1.0], [-1.0, 0.0]] + [2.0, 0.0]]), 0.5)
    assert on_the_spot(way) == pytest.approx(np.pi / 2, abs=0.1)
    assert np.hypot(*(way.pose[:, :2] - [2.0, 0.0]).T).min() < 0.02


def test_narrow_curves_are_walked_slower_than_the_robot_turns_fastest() -> None:
    way = Trajectory.from_points(arc(0.4, 2.0, 0.05), 1.0)
    assert np.abs(way.velocity[:, 2]).max() <= 1.001
    assert np.median(way.velocity[:, 0]) == pytest.approx(0.4, abs=0.05)


def test_before_it_sets_off_it_says_length_duration_and_turning() -> None:
    assert (
        Trajectory.from_points([[0, 0], [2, 0], [2, 1]], 0.5)
        .summary()
        .startswith("3.0 m in 7.6 s, turning 1.6")
    )


@pytest.mark.parametrize(
    ("points", "words"),
    [
        pytest.param(
            [(0.0, 0.0)], r"leaps 5\.3\d+e\+06 m from point 1 at \(0, 0\) to point 2", id="no fix first"
        ),
        pytest.param([(46.05, 14.6)] * 3, "leaps .* from point 3 .* to point 4", id="away first"),
    ],
)
def test_a_leap_of_a_gpx_is_refused_by_its_points(
    tmp_path: Path, points: list[tuple[float, float]], words: str
) -> None:
    track = [(46.05 + 2e-5 * k, 14.5) for k in range(30)]
    with pytest.raises(ValueError, match=rf"way\.gpx: {words}"):
        load_trajectory(gpx(tmp_path, np.array([*points, *track])), 0.5)
    middle = gpx(tmp_path, np.array([*track[:20], (46.06, 14.5), *track[20:], (46.07, 14.5)]))
    with pytest.raises(ValueError, match=r"from point 20 .* to point 21 .*; 3 steps of the file"):
        load_trajectory(middle, 0.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y\n0,0\n300000,0\n", "leaps 300000 m from point 1"),
        ("x,y\n0,0\n1e308,0\n-1e308,0\n", "leaps 1e\\+308 m from point 1"),
        ("x,y\n" + "".join(f"{9000 * k},0\n" for k in range(20)), "is 1.71e\\+05 m long, expected 100000 m"),
        ("x,y\n" + "".join(f"{9000 * k},0\n" for k in range(9)), "lasts 1.44e\\+05 s, expected a day"),
        ("seconds,vx,vy,wz\n1e12,0.1,0,0\n", "lasts 1e\\+12 s, expected a day"),
        ("x,y\n" + "".join(f"{0.05 * k},0\n" for k in range(99)) + "500,0\n", "leaps 495.1 m from point 99"),
    ],
)
def test_ways_that_are_too_long_are_refused_before_they_take_memory(
    tmp_path: Path, text: str, words: str
) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"way\.csv: .*{words}"):
        load_trajectory(file, 0.5)


def test_a_gpx_beyond_the_poles_is_refused_by_its_point(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"point 2 at \(91"):
        load_trajectory(gpx(tmp_path, np.array([[90.0, 0.0], [91.0, 0.0]])), 0.5)


@pytest.mark.parametrize(
    "bad",
    ['lat="nan" lon="nan"', 'lat="60" lon="nan"', 'lat="inf" lon="10"', 'lat="60"', "", 'lat="60,1" lon="x"'],
)
@pytest.mark.parametrize("place", [0, 5, 19])
def test_a_bad_point_of_a_gpx_is_named(tmp_path: Path, bad: str, place: int) -> None:
    marks = [f'<trkpt lat="60.0" lon="{10.0 + 1e-4 * k}"/>' for k in range(20)]
    marks[place] = f"<trkpt {bad}/>"
    file = tmp_path / "way.gpx"
    file.write_text(f"<gpx><trk><trkseg>{''.join(marks)}</trkseg></trk></gpx>")
    with pytest.raises(ValueError, match=rf"way\.gpx: has point {place + 1} at .*, expected a lat"):
        load_trajectory(file, 0.5)


@pytest.mark.parametrize("marks", ["", '<trkpt lat="60" lon="10"/>'])
def test_a_gpx_of_less_than_two_points_is_refused_with_their_count(tmp_path: Path, marks: str) -> None:
    file = tmp_path / "way.gpx"
    file.write_text(f"<gpx><trk><trkseg>{marks}</trkseg></trk></gpx>")
    with pytest.raises(ValueError, match=rf"has {int(bool(marks))} points, expected 2"):
        load_trajectory(file, 0.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has the head '', expected"),
        ("a,b\n1,2\n", "has the head 'a,b'"),
        ("x,y\n1,1\n1,two\n", "row 3 is '1,two'"),
        ("x,y\n1,1\n1\n", "row 3 is '1'"),
        ("x,y\n", "no row"),
        ("x,y\n1,nan\n2,2\n", "row 2 is '1,nan', expected 2 finite numbers"),
        ("x,y\n1,1\n", "one place"),
        ("seconds,vx,vy,wz\n-1,0,0,0\n", "duration that is not above 0"),
    ],
)
def test_files_that_are_no_way_are_refused_by_name(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"way\.csv: .*({words})"):
        load_trajectory(file, 0.5)


@pytest.mark.parametrize("name", ["missing.csv", "missing.gpx", "."])
def test_a_file_that_cannot_be_read_is_refused_with_the_shipped_names(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="eight, zju") as refused:
        load_trajectory(tmp_path / name, 0.5)
    assert str(refused.value).startswith(f"{tmp_path / name}: ")
    assert "Errno" not in str(refused.value)


def test_a_gpx_with_entities_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "way.gpx"
    file.write_text('<!DOCTYPE gpx [<!ENTITY a "b">]><gpx/>')
    with pytest.raises(ValueError, match="entities"):
        load_trajectory(file, 0.5)


def test_closed_on_odometry_a_drift_is_corrected_that_open_loop_keeps() -> None:
    way = Trajectory.from_points([[0.0, 0.0], [4.0, 0.0]], 0.5)
    start, drift = np.array([3.0, 1.0, np.pi / 2]), np.array([0.0, 0.05, 0.0])
    end = start[:2] + np.array([0.0, 4.0])
    assert np.hypot(*(walked(TrajectoryFollower(way, False), start, drift)[:2] - end)) > 0.35
    assert np.hypot(*(walked(TrajectoryFollower(way, True), start, drift)[:2] - end)) < 0.1


@pytest.mark.parametrize(("distance", "shown"), [(2.0, "2.00"), (1.0001, "1.01")])
def test_a_robot_far_off_its_way_is_given_up(distance: float, shown: str) -> None:
    follower = TrajectoryFollower(load_trajectory(SHIPPED_FOLDER / "eight.csv", 0.5), True)
    follower.step(0.0, np.zeros(3))
    with pytest.raises(ValueError, match=f"is {shown} m off its way"):
        follower.step(0.0, np.array([0.0, distance, 0.0]))
