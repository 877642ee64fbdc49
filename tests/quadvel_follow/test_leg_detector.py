"""Tests of leg detection in single scans of several scanners; malformed scans are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadvel_eval.people.laser import FloorPlan, Laser
from quadvel_eval.people.measure import ScanRecording, detection_scores
from quadvel_follow import LegDetector

ROOM = [[-4.0, -3.0, 6.0, -3.0], [6.0, -3.0, 6.0, 3.0], [6.0, 3.0, -4.0, 3.0], [-4.0, 3.0, -4.0, -3.0]]
LEGS = np.array([[2.0, 0.6], [2.1, 0.9]])


@pytest.fixture(scope="module")
def detector() -> LegDetector:
    return LegDetector()


def scanned(laser: Laser, legs: np.ndarray = LEGS, seed: int = 0) -> np.ndarray:
    circles = [[*leg, 0.06] for leg in legs]
    return laser.scan(FloorPlan(circles, ROOM), np.zeros(3), np.random.default_rng(seed))


def around(degrees: float, **changes: float) -> Laser:
    return Laser(rays=round(360 / degrees), angle_increment=np.deg2rad(degrees), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("degrees", [0.25, 0.33, 0.5, 1.0])
def test_both_legs_are_found_at_any_resolution(detector: LegDetector, degrees: float) -> None:
    laser = around(degrees)
    found = detector.detect(scanned(laser), laser.angle_min, laser.angle_increment)
    distances = np.linalg.norm(found[:, None] - LEGS[None], axis=2)
    assert (distances.min(0) < 0.08).all()
    assert (distances.min(1) < 0.25).all()


@pytest.mark.parametrize("nothing", [0.0, -np.inf, np.inf, np.nan, 12.0])
def test_however_a_scanner_says_that_there_was_nothing(detector: LegDetector, nothing: float) -> None:
    laser = around(0.5, no_return=nothing, lost=0.02)
    circles = [[*leg, 0.06] for leg in LEGS]
    ranges = laser.scan(FloorPlan(circles), np.zeros(3), np.random.default_rng(0))
    found = detector.detect(ranges, laser.angle_min, laser.angle_increment)
    assert len(found) >= 1
    assert (np.linalg.norm(found[:, None] - LEGS[None], axis=2).min(1) < 0.25).all()


def test_a_person_where_the_scan_begins_and_ends_is_seen_whole(detector: LegDetector) -> None:
    laser = around(0.5)
    legs = np.array([[-2.0, 0.0], [-2.0, 0.3]])
    found = detector.detect(scanned(laser, legs), laser.angle_min, laser.angle_increment)
    distances = np.linalg.norm(found - legs[0], axis=1)
    assert np.count_nonzero(distances < 0.15) == 1  # not its two halves
    assert distances.min() < 0.03


def test_a_scanner_that_turns_the_other_way_sees_the_same(detector: LegDetector) -> None:
    laser = around(0.5)
    ranges, last = scanned(laser), laser.angles[-1]
    one = detector.detect(ranges, laser.angle_min, laser.angle_increment)
    other = detector.detect(ranges[::-1], last, -laser.angle_increment)
    np.testing.assert_allclose(np.sort(one, axis=0), np.sort(other, axis=0), atol=1e-9)


def test_scans_without_a_reading_have_nobody(detector: LegDetector) -> None:
    for value in (np.nan, np.inf, 0.0):
        assert detector.detect(np.full(180, value), -np.pi / 2, np.deg2rad(1.0)).shape == (0, 2)


@pytest.mark.parametrize(
    ("ranges", "angle_min", "angle_increment", "message"),
    [
        (np.ones((2, 90)), 0.0, 0.01, r"ranges has the shape \(2, 90\), expected \(rays,\)"),
        ([], 0.0, 0.01, "expected .* at least one ray"),
        (["far"], 0.0, 0.01, "ranges is .*, expected .* numbers"),
        (np.ones(90), np.nan, 0.01, "angle_min is nan, expected a finite angle"),
        (np.ones(90), 0.0, 0.0, "angle_increment is 0.0, expected a step other than 0"),
        (np.ones(720), 0.0, 0.01, "720 rays make one turn at most"),
    ],
)
def test_what_is_no_scan_is_refused(
    detector: LegDetector, ranges: object, angle_min: float, angle_increment: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        detector.detect(ranges, angle_min, angle_increment)  # type: ignore[arg-type]


def test_another_file_is_refused_by_its_name(tmp_path: Path) -> None:
    file = tmp_path / "legs.onnx"
    with pytest.raises(ValueError, match=r"legs\.onnx: no such file"):
        LegDetector(file)
    file.write_bytes(b"no network")
    with pytest.raises(ValueError, match=r"legs\.onnx: is not an ONNX network"):
        LegDetector(file)


@pytest.mark.parametrize("name", ["legs_positive_1", "legs_positive_6"])
def test_labelled_legs_of_real_people_are_found(detector: LegDetector, scans: Path, name: str) -> None:
    recording = ScanRecording.load(scans / f"{name}.npz")
    figures = detection_scores(recording, detector)
    assert figures["recall"] > 0.9
    assert figures["precision"] > 0.85
