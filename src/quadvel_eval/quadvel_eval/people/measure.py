"""How well legs are found and persons tracked: on files of real scans, with or without labels, and in simulated scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from time import process_time
from typing import Any
from zipfile import BadZipFile

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_follow.leg_detector import LegDetector
from quadvel_follow.person_tracker import PersonTracker, Track

from .scenes import SCENES, Scene

Array = NDArray[np.float64]

FOUND = 0.25  # m, from a label to a leg that is found
AGAIN = (1.0, 3.0)  # m and s, within which a track that begins goes on with one that ended: a switch
NEAR = 0.75  # m, from a person to its track
APART = 1.5  # m, from any person to what is no person's track


@attrs.frozen
class Recording:
    """Real scans: ranges (N, rays) in m, inf where there is none; stamp (N,) in s; legs (N, K, 2) in m, NaN if fewer, or None."""

    name: str
    ranges: Array
    angle_min: float
    angle_increment: float
    stamp: Array
    legs: Array | None

    @classmethod
    def load(cls, path: Path) -> Recording:
        """From an NPZ file. Raises ValueError, with its name, where it holds no scans."""
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

    def tracked(self, detector: LegDetector) -> Iterator[tuple[float, Array, list[Track]]]:
        """Time, ranges and tracks of each scan."""
        tracker = PersonTracker(detector=detector)
        for time, ranges in zip(self.stamp, self.ranges, strict=True):
            yield time, ranges, tracker.update(time, ranges, self.angle_min, self.angle_increment)

    @property
    def minutes(self) -> float:
        """That it lasts."""
        return float(self.stamp[-1] - self.stamp[0]) / 60.0


def labelled(recording: Recording, detector: LegDetector) -> dict[str, float]:
    """recall: share of labels with a leg within `FOUND`; precision: share of the legs with a label as near, of those where
    people are, in the rectangle round the file's labels, as labels are of one person and the scans show others, too.
    """
    assert recording.legs is not None
    every = recording.legs[np.isfinite(recording.legs[..., 0])]
    low, high = every.min(0) - FOUND, every.max(0) + FOUND
    missed = right = wrong = 0
    for ranges, labels in zip(recording.ranges, recording.legs, strict=True):
        labels = labels[np.isfinite(labels[:, 0])]
        legs = detector.detect(ranges, recording.angle_min, recording.angle_increment)
        near = np.linalg.norm(legs[:, None] - labels[None], axis=2) < FOUND
        missed += int((~near.any(0)).sum())
        right += int(near.any(1).sum())
        wrong += int((~near.any(1) & ((low < legs) & (legs < high)).all(1)).sum())
    return {"recall": 1.0 - missed / len(every), "precision": right / max(right + wrong, 1)}


def persons(recording: Recording, detector: LegDetector) -> dict[str, float]:
    """persons: tracks that were confirmed; switches: those that began within `AGAIN` of where and when another ended."""
    first: dict[int, tuple[float, Array]] = {}
    last: dict[int, tuple[float, Array]] = {}
    for time, _, tracks in recording.tracked(detector):
        for track in tracks:
            first.setdefault(track.id, (time, track.position))
            if track.confirmed and track.seen == time:
                last[track.id] = (time, track.position)
    switches = sum(any(_goes_on(last[b], first[a]) for b in last if b != a) for a in last)
    return {"persons": len(last), "persons_per_minute": len(last) / recording.minutes,
            "switches_per_minute": switches / recording.minutes}  # fmt: skip


def _goes_on(end: tuple[float, Array], begin: tuple[float, Array]) -> bool:
    return abs(begin[0] - end[0]) < AGAIN[1] and float(np.hypot(*(begin[1] - end[1]))) < AGAIN[0]


def simulated(make: Callable[[int], Scene], seeds: Iterable[int], detector: LegDetector) -> dict[str, float]:
    """kept: share of the scenes in which each person has at the end the track that it had first; rms: m, of that track's
    position, out of sight too; ghosts: confirmed tracks a scene that are nobody's; ms: processor time of an update, mean.
    """
    kept: list[bool] = []
    errors: list[float] = []
    took: list[float] = []
    ghosts = 0
    for seed in seeds:
        scene = make(seed)
        tracker = PersonTracker(detector=detector)
        first: dict[int, int] = {}
        now: dict[int, int] = {}
        nobodys: set[int] = set()
        for instant in scene.instants():
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
            for person, position in enumerate(instant.persons):
                distances = {t.id: float(np.hypot(*(t.position - position))) for t in confirmed}
                nearest = min(distances, key=distances.__getitem__, default=None)
                if nearest is not None and distances[nearest] < NEAR:
                    now[person] = nearest
                    if first.setdefault(person, nearest) == nearest:
                        errors.append(distances[nearest])
            nobodys |= {t.id for t in confirmed if np.hypot(*(instant.persons - t.position).T).min() > APART}
        kept.append(len(first) == len(scene.walkers) and first == now)
        ghosts += len(nobodys)
    return {
        "kept": float(np.mean(kept)),
        "rms": float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan"),
        "ghosts": ghosts / len(kept),
        "ms": 1e3 * float(np.mean(took)),
    }


def measure_files(folder: Path, detector: LegDetector) -> Mapping[str, dict[str, float]]:
    """Of each file of scans in a folder, `labelled` or `persons`. Raises ValueError where there is none."""
    paths = sorted(folder.glob("legs_*.npz"))
    if not paths:
        raise ValueError(f"{folder}: has no file legs_*.npz, expected scans")
    recordings = [Recording.load(path) for path in paths]
    return {r.name: (persons if r.legs is None else labelled)(r, detector) for r in recordings}


def measure_scenes(runs: int, detector: LegDetector) -> Mapping[str, dict[str, float]]:
    """Of each kind of scene, `runs` of them."""
    return {name: simulated(make, range(runs), detector) for name, make in SCENES.items()}
