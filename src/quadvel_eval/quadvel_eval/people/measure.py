"""Scores leg detection and person tracking on recorded scans and in simulated scenes.

`scenes` simulates the scenes; `quadvel_follow` holds the detector and the tracker that are scored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from time import process_time
from typing import Any
from zipfile import BadZipFile

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_follow.leg_detector import LegDetector
from quadvel_follow.person_tracker import PersonTracker, Track

from .scenes import SCENES, Scene

LABEL_RADIUS_M = 0.25  # between a label and a detected leg
SWITCH_LIMITS = (1.0, 3.0)  # m and s, between the end of a track and the start of another
MATCH_RADIUS_M = 0.75  # between a person and their track
GHOST_DISTANCE_M = 1.5  # from all people


@attrs.frozen
class ScanRecording:
    """Recorded scans of a sensor at rest.

    Attributes:
        name: Name of the file.
        ranges: Ranges (N, rays), m; inf without an echo.
        angle_min: Angle of the first ray, rad.
        angle_increment: Angle between rays, rad.
        stamp: Times (N,), s.
        legs: Labelled legs (N, K, 2), m, padded with NaN; None without labels.
    """

    name: str
    ranges: Array
    angle_min: float
    angle_increment: float
    stamp: Array
    legs: Array | None

    @classmethod
    def load(cls, path: Path) -> ScanRecording:
        """Read an NPZ file.

        Args:
            path: The file.

        Returns:
            The scans.

        Raises:
            ValueError: The file holds no scans; the message names it.
        """
        try:
            with np.load(path, allow_pickle=False) as content:
                found: dict[str, Any] = dict(content)
            ranges = found["ranges"].astype(float)
            ranges = np.where(ranges < found["range_max"], ranges, np.inf)
            angles = float(found["angle_min"]), float(found["angle_increment"])
            return cls(path.stem, ranges, *angles, found["stamp"].astype(float), found.get("legs"))
        except (OSError, KeyError, ValueError, BadZipFile) as error:
            raise ValueError(
                f"{path}: {error}; expected NPZ with ranges (N, rays), angle_min, angle_increment, range_max and stamp (N,)"
            ) from None

    def tracks(self, detector: LegDetector) -> Iterator[tuple[float, Array, list[Track]]]:
        """Track people through the scans.

        Args:
            detector: Leg detector.

        Yields:
            Time (s), ranges (rays,) and tracks of each scan.
        """
        tracker = PersonTracker(detector=detector)
        for time, ranges in zip(self.stamp, self.ranges, strict=True):
            yield time, ranges, tracker.update(time, ranges, self.angle_min, self.angle_increment)

    @property
    def minutes(self) -> float:
        """Duration, min."""
        return float(self.stamp[-1] - self.stamp[0]) / 60.0


def detection_scores(recording: ScanRecording, detector: LegDetector) -> dict[str, float]:
    """Score the leg detector against labels.

    Labels mark one person, while the scans show others, too. Therefore false detections count only
    within the rectangle around all labels of the file.

    Args:
        recording: Scans with labels.
        detector: Leg detector.

    Returns:
        `recall`: share of labels with a detected leg within LABEL_RADIUS_M; `precision`: share of
        the counted detections with a label within LABEL_RADIUS_M.
    """
    assert recording.legs is not None
    every = recording.legs[np.isfinite(recording.legs[..., 0])]
    low, high = every.min(0) - LABEL_RADIUS_M, every.max(0) + LABEL_RADIUS_M
    missed = right = wrong = 0
    for ranges, labels in zip(recording.ranges, recording.legs, strict=True):
        labels = labels[np.isfinite(labels[:, 0])]
        legs = detector.detect(ranges, recording.angle_min, recording.angle_increment)
        near = np.linalg.norm(legs[:, None] - labels[None], axis=2) < LABEL_RADIUS_M
        missed += int((~near.any(0)).sum())
        right += int(near.any(1).sum())
        wrong += int((~near.any(1) & ((low < legs) & (legs < high)).all(1)).sum())
    return {"recall": 1.0 - missed / len(every), "precision": right / max(right + wrong, 1)}


def identity_scores(recording: ScanRecording, detector: LegDetector) -> dict[str, float]:
    """Count confirmed tracks and identity switches in scans without labels.

    A switch is a track that begins within SWITCH_LIMITS of the place and time at which another
    ended.

    Args:
        recording: The scans.
        detector: Leg detector.

    Returns:
        `persons`: number of confirmed tracks; `persons_per_minute`; `switches_per_minute`.
    """
    first: dict[int, tuple[float, Array]] = {}
    last: dict[int, tuple[float, Array]] = {}
    for time, _, tracks in recording.tracks(detector):
        for track in tracks:
            first.setdefault(track.id, (time, track.position))
            if track.confirmed and track.seen == time:
                last[track.id] = (time, track.position)
    switches = sum(any(_is_switch(last[b], first[a]) for b in last if b != a) for a in last)
    return {"persons": len(last), "persons_per_minute": len(last) / recording.minutes,
            "switches_per_minute": switches / recording.minutes}  # fmt: skip


def _is_switch(end: tuple[float, Array], begin: tuple[float, Array]) -> bool:
    """Return whether a track begins within SWITCH_LIMITS of the end of another."""
    return (
        abs(begin[0] - end[0]) < SWITCH_LIMITS[1] and float(np.hypot(*(begin[1] - end[1]))) < SWITCH_LIMITS[0]
    )


def scene_scores(
    make: Callable[[int], Scene], seeds: Iterable[int], detector: LegDetector
) -> dict[str, float]:
    """Score the tracker on simulated scenes of one kind.

    Args:
        make: Function from a seed to a scene.
        seeds: Seeds of the scenes.
        detector: Leg detector.

    Returns:
        `kept`: share of scenes in which every person has the first track at the end; `rms`: error
        of that track's position, also while hidden, m; `ghosts`: confirmed tracks per scene
        farther than GHOST_DISTANCE_M from all people; `ms`: mean CPU time of an update.
    """
    kept: list[bool] = []
    errors: list[float] = []
    took: list[float] = []
    ghosts = 0
    for seed in seeds:
        scene = make(seed)
        tracker = PersonTracker(detector=detector)
        first: dict[int, int] = {}  # track id by person: of the first match, and of the last scan
        now: dict[int, int] = {}
        ghost_ids: set[int] = set()
        for instant in scene.scans():
            start = process_time()
            tracks = tracker.update(
                instant.time,
                instant.ranges,
                scene.laser.angle_min,
                scene.laser.angle_increment,
                instant.pose.tolist(),
            )
            took.append(process_time() - start)
            confirmed = [track for track in tracks if track.confirmed]
            now = {}
            for person, position in enumerate(instant.people):
                distances = {t.id: float(np.hypot(*(t.position - position))) for t in confirmed}
                nearest = min(distances, key=distances.__getitem__, default=None)
                if nearest is not None and distances[nearest] < MATCH_RADIUS_M:
                    now[person] = nearest
                    if first.setdefault(person, nearest) == nearest:
                        errors.append(distances[nearest])
            ghost_ids |= {
                t.id for t in confirmed if np.hypot(*(instant.people - t.position).T).min() > GHOST_DISTANCE_M
            }
        kept.append(len(first) == len(scene.walkers) and first == now)
        ghosts += len(ghost_ids)
    return {
        "kept": float(np.mean(kept)),
        "rms": float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan"),
        "ghosts": ghosts / len(kept),
        "ms": 1e3 * float(np.mean(took)),
    }


def measure_files(folder: Path, detector: LegDetector) -> Mapping[str, dict[str, float]]:
    """Score each recording in a folder, with `detection_scores` if it has labels.

    Args:
        folder: Folder with files legs_*.npz.
        detector: Leg detector.

    Returns:
        Scores by name of the file.

    Raises:
        ValueError: The folder has no such file.
    """
    paths = sorted(folder.glob("legs_*.npz"))
    if not paths:
        raise ValueError(f"{folder}: has no file legs_*.npz, expected scans")
    recordings = [ScanRecording.load(path) for path in paths]
    return {
        r.name: (identity_scores if r.legs is None else detection_scores)(r, detector) for r in recordings
    }


def measure_scenes(runs: int, detector: LegDetector) -> Mapping[str, dict[str, float]]:
    """Score each kind of simulated scene.

    Args:
        runs: Number of scenes of each kind.
        detector: Leg detector.

    Returns:
        Scores by kind of scene.
    """
    return {name: scene_scores(make, range(runs), detector) for name, make in SCENES.items()}
