"""Tests of tracking: identities, covariance, and static objects that are no people."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from quadvel_eval.people.laser import FloorPlan, Laser
from quadvel_eval.people.measure import ScanRecording, identity_scores, scene_scores
from quadvel_eval.people.scenes import Scene, SceneScan, along_walls, crossing, occlusion
from quadvel_follow import LegDetector, PersonTracker, Track, TrackerConfig
from quadvel_sim.walker import Walker

LASER = Laser(rays=540, angle_min=-0.75 * np.pi, angle_increment=np.deg2rad(0.5))
ROOM = FloorPlan([[1.5, -2.0, 0.025], [2.3, -2.0, 0.025]], [[-6.0, 4.0, 9.0, 4.0], [-6.0, -4.0, 9.0, -4.0]])


@pytest.fixture(scope="module")
def detector() -> LegDetector:
    return LegDetector()


def walk(way: list[list[float]], duration: float, still: bool = True, **changes: object) -> Scene:
    """A person on a way, before a scanner at 20 Hz that stands, or drives sideways and turns."""
    moving = iter(np.linspace(0.0, 1.0, 200))

    def pose(_: np.ndarray) -> np.ndarray:
        s = 0.0 if still else next(moving)
        return np.array([0.0, -3.0 * s, 2.0 * s])

    return Scene(LASER, 20.0, ROOM, [Walker(way=way, **changes)], duration, np.random.default_rng(0), pose)  # type: ignore[arg-type]


def track(tracker: PersonTracker, instants: Iterable[SceneScan], posed: bool = True) -> list[list[Track]]:
    return [
        tracker.update(
            i.time, i.ranges, LASER.angle_min, LASER.angle_increment, i.pose.tolist() if posed else None
        )
        for i in instants
    ]


def test_who_walks_is_confirmed_within_two_seconds_with_position_and_velocity(detector: LegDetector) -> None:
    scene = walk([[4.0, -2.0], [4.0, 3.0]], 4.0, speed=1.2)
    instants = list(scene.scans())
    tracks_by_scan = track(PersonTracker(detector=detector), instants)
    confirmed = [[t for t in tracks if t.confirmed] for tracks in tracks_by_scan]
    assert {len(c) for c in confirmed[40:]} == {1}
    last = confirmed[-1][0]
    assert np.hypot(*(last.position - instants[-1].people[0])) < 0.15
    np.testing.assert_allclose(last.velocity, [0.0, 1.2], atol=0.25)
    assert last.covariance.shape == (4, 4)
    assert np.linalg.eigvalsh(last.covariance).min() > 0.0
    assert last.age == pytest.approx(instants[-1].time, abs=0.3)
    assert last.seen == instants[-1].time


@pytest.mark.parametrize("posed", [True, False])
def test_what_stands_about_is_nobody_from_a_robot_that_moves(detector: LegDetector, posed: bool) -> None:
    scene = walk(
        [[2.5, -1.0], [2.5, 0.0]], 6.0, still=False, speed=1e-6
    )  # a person who only stands is none yet
    tracks_by_scan = track(PersonTracker(detector=detector), scene.scans(), posed)
    assert any(tracks_by_scan)
    assert not any(t.confirmed for tracks in tracks_by_scan for t in tracks)


def test_tracks_are_in_the_frame_of_the_pose_and_without_one_in_the_sensor_s(detector: LegDetector) -> None:
    instants = list(walk([[3.0, -2.0], [3.0, 2.0]], 3.0, still=False, speed=1.2).scans())
    world = [t for t in track(PersonTracker(detector=detector), instants)[-1] if t.confirmed]
    own = [t for t in track(PersonTracker(detector=detector), instants, posed=False)[-1] if t.confirmed]
    assert (len(world), len(own)) == (1, 1)
    x, y, yaw = instants[-1].pose
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(world[0].position, instants[-1].people[0], atol=0.2)
    np.testing.assert_allclose(own[0].position, turn @ (instants[-1].people[0] - [x, y]), atol=0.25)


def test_who_was_confirmed_may_stand_still(detector: LegDetector) -> None:
    scene = walk([[3.0, -2.0], [3.0, 0.0]], 6.0, speed=1.2)
    tracks_by_scan = track(PersonTracker(detector=detector), scene.scans())
    assert len({t.id for tracks in tracks_by_scan for t in tracks if t.confirmed}) == 1
    assert np.hypot(*tracks_by_scan[-1][0].velocity) < 0.15


def test_who_leaves_is_forgotten(detector: LegDetector) -> None:
    tracker = PersonTracker(detector=detector)
    instants = list(walk([[3.0, -2.0], [3.0, 2.0]], 2.5, speed=1.2).scans())
    assert any(t.confirmed for t in track(tracker, instants)[-1])
    empty = LASER.scan(ROOM, np.zeros(3), np.random.default_rng(0))
    end = instants[-1].time
    for k in range(1, 80):
        left = tracker.update(end + 0.05 * k, empty, LASER.angle_min, LASER.angle_increment, [0.0, 0.0, 0.0])
    assert not any(t.confirmed for t in left)


@pytest.mark.parametrize("make", [crossing, occlusion, along_walls])
def test_the_right_person_is_kept_in_scenes_in_which_trackers_go_wrong(make, detector: LegDetector) -> None:  # type: ignore[no-untyped-def]
    figures = scene_scores(make, range(2 if make is not along_walls else 1), detector)
    assert figures["kept"] == 1.0
    assert figures["rms"] < 0.15
    assert figures["ghosts"] == 0.0


def test_refused_input_changes_nothing_and_is_named(detector: LegDetector) -> None:
    tracker = PersonTracker(detector=detector)
    scan = (np.ones(90), 0.0, 0.01)
    tracker.update(1.0, *scan, sensor_pose=[0.0, 0.0, 0.0])
    for wrong, message in (
        ((1.0, *scan, [0, 0, 0]), "time is 1.0, expected a later one than that of the scan before, 1.0"),
        ((0.5, *scan, [0, 0, 0]), "time is 0.5, expected a later one"),
        ((np.nan, *scan, [0, 0, 0]), "time is nan, expected a finite time"),
        ((2.0, *scan, [0, np.inf, 0]), "sensor_pose is .*inf.*, expected x, y"),
        ((2.0, *scan, [0, 0]), "sensor_pose is .*, expected x, y"),
        ((2.0, *scan, None), "sensor_pose is None, expected one as for the scans before"),
        ((2.0, np.ones((3, 3)), 0.0, 0.01, [0, 0, 0]), "ranges has the shape"),
    ):
        with pytest.raises(ValueError, match=message):
            tracker.update(*wrong)  # type: ignore[arg-type]
    tracker.update(1.1, *scan, sensor_pose=[0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"acceleration: found -1\.0, expected above 0"):
        TrackerConfig(acceleration=-1.0)


def test_nobody_is_found_in_an_empty_building(scans: Path, detector: LegDetector) -> None:
    assert identity_scores(ScanRecording.load(scans / "legs_none.npz"), detector)["persons_per_minute"] <= 1.1


def test_three_people_who_walk_about_keep_who_they_are(scans: Path, detector: LegDetector) -> None:
    figures = identity_scores(ScanRecording.load(scans / "legs_people_walking.npz"), detector)
    assert (figures["persons"], figures["switches_per_minute"]) == (3, 0.0)
