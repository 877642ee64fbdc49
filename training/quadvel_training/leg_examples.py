"""Examples for the leg classifier, from real scans and simulated scans of any scanner.

`leg_classifier` trains on the examples; `quadvel_follow.clusters` computes their features.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array, Bools
from quadvel_eval.people.laser import FloorPlan, Laser
from quadvel_follow.clusters import FEATURE_COUNT, MAX_CLUSTER_WIDTH_M, Scan, cluster_features, find_clusters
from quadvel_follow.free_space import to_frame
from quadvel_sim.walker import Walker, leg_circles

LABEL_RADIUS_M = 0.12  # between a label and its object
FIXED_RADIUS_M = 0.05  # within which a fixed object is found again
FIXED_SHARE = 0.4  # of the scans that show a fixed object
NEARER_MARGIN_M = 0.3  # in front of the background: a person
RAY_STRIDES = (1, 2, 3)  # keep every n-th ray, as coarser scanners do


@attrs.frozen
class Examples:
    """Objects in scans, and their labels.

    Attributes:
        things: (N, NUMBERS), objects as `describe` returns them.
        legs: (N,) bool, whether each is a leg or a pair of legs.
    """

    things: NDArray[np.float32]
    legs: Bools

    @classmethod
    def concatenate(cls, parts: Sequence[Examples]) -> Examples:
        """Concatenate examples.

        Args:
            parts: any number of them.

        Returns:
            All examples.
        """
        if not parts:
            return cls(np.zeros((0, FEATURE_COUNT), np.float32), np.zeros(0, bool))
        return cls(np.concatenate([p.things for p in parts]), np.concatenate([p.legs for p in parts]))


def read_examples_file(path: Path, rng: np.random.Generator) -> Examples:
    """Extract examples from a file of real scans.

    Objects that cannot be labelled are left out. The file holds labels, or scans of a place without
    people (`none` in its name), or scans of people who walk in front of a scanner that stands
    still.

    Args:
        path: NPZ file.
        rng: source of randomness for subsampled rays and noise.

    Returns:
        The examples.
    """
    content = dict(np.load(path, allow_pickle=False))
    content["ranges"] = np.where(content["ranges"] < content["range_max"], content["ranges"], np.inf)
    if "legs" in content:
        judge = _labelled
    elif "none" in path.stem:
        judge = _empty
    else:
        judge = _walking
    return Examples.concatenate([one for step in RAY_STRIDES for one in judge(content, step, rng)])


def _scans(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Scan]:
    """Yield scans with every `step`th ray, some noise, and some rays lost."""
    increment = float(content["angle_increment"])
    for ranges in content["ranges"].astype(float):
        first = int(rng.integers(step))
        kept = ranges[first::step].copy()
        kept += rng.uniform(0.0, 0.015) * rng.standard_normal(kept.size)
        kept[rng.random(kept.size) < rng.choice([0.0, 0.01])] = np.inf
        yield Scan.validated(kept, float(content["angle_min"]) + first * increment, step * increment)


def _labelled(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Examples]:
    """Yield examples of a file with labels."""
    fixed = _FixedObjects(content)
    for scan, labels in zip(_scans(content, step, rng), content["legs"].astype(float), strict=True):
        clusters = find_clusters(scan)
        labels = labels[np.isfinite(labels[:, 0])]
        named = _nearest(clusters.centre, labels) < LABEL_RADIUS_M
        yield _select_examples(
            scan,
            named,
            named | (fixed(clusters.centre) & (_nearest(clusters.centre, labels) > MAX_CLUSTER_WIDTH_M)),
        )


def _empty(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Examples]:
    """Yield examples of a file without people."""
    for scan in _scans(content, step, rng):
        found = len(find_clusters(scan).centre)
        yield _select_examples(scan, np.zeros(found, bool), np.ones(found, bool))


def _walking(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Examples]:
    """Yield examples of a file with people who walk: what moves in front of the background."""
    ranges = np.where(np.isfinite(content["ranges"]), content["ranges"], 2.0 * content["range_max"])
    usual = np.quantile(ranges, 0.8, axis=0)
    angles = content["angle_min"] + content["angle_increment"] * np.arange(ranges.shape[1])
    fixed = _FixedObjects(content)
    for scan in _scans(content, step, rng):
        clusters = find_clusters(scan)
        bearing = np.arctan2(*clusters.centre.T[::-1])
        nearer = np.interp(bearing, angles, usual) - np.hypot(*clusters.centre.T) > NEARER_MARGIN_M
        still = fixed(clusters.centre)
        person = nearer & ~still & (clusters.width < MAX_CLUSTER_WIDTH_M) & (clusters.count * step >= 4)
        yield _select_examples(scan, person, person | (still & ~nearer))


def _select_examples(scan: Scan, legs: Bools, kept: Bools) -> Examples:
    """Describe the objects of a scan, and select some."""
    return Examples(cluster_features(scan, find_clusters(scan))[kept], legs[kept])


class _FixedObjects:
    """Test for objects that are present in many scans of a scanner that stands still."""

    def __init__(self, content: dict[str, Any]) -> None:
        scans = [
            Scan.validated(ranges, float(content["angle_min"]), float(content["angle_increment"]))
            for ranges in content["ranges"].astype(float)
        ]
        self._seen = [find_clusters(scan).centre for scan in scans[:: max(1, len(scans) // 100)]]

    def __call__(self, centre: Array) -> Bools:
        shares = np.mean([_nearest(centre, seen) < FIXED_RADIUS_M for seen in self._seen], axis=0)
        return shares > FIXED_SHARE


def _nearest(points: Array, others: Array) -> Array:
    """Distance from each point (N, 2) to the nearest of the others, m."""
    if not len(others):
        return np.full(len(points), np.inf)
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(1)


def simulate_examples(scenes: int, rng: np.random.Generator) -> Examples:
    """Simulate scans of rooms with people.

    Each scene has another room and scanner, at ten instants.

    Args:
        scenes: number of scenes.
        rng: source of randomness.

    Returns:
        The examples.
    """
    return Examples.concatenate([one for _ in range(scenes) for one in _scene(rng)])


def _scene(rng: np.random.Generator) -> Iterator[Examples]:
    """Yield examples of one scene."""
    laser, place = _laser(rng), _room(rng)
    people = [_walker(rng) for _ in range(rng.integers(1, 5))]
    for _ in range(10):
        for walker in people:
            walker.step(rng.uniform(0.05, 0.4))
        legs = leg_circles(people)
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi)])
        scan = Scan.validated(
            laser.scan(place.with_circles(legs), pose, rng), laser.angle_min, laser.angle_increment
        )
        clusters = find_clusters(scan)
        named = _nearest(to_frame(clusters.centre, pose), legs[:, :2]) < LABEL_RADIUS_M
        named &= clusters.width < MAX_CLUSTER_WIDTH_M
        unclear = _nearest(to_frame(clusters.centre, pose), legs[:, :2]) < MAX_CLUSTER_WIDTH_M
        yield _select_examples(scan, named, named | ~unclear)


def _laser(rng: np.random.Generator) -> Laser:
    """Draw a scanner."""
    resolution = np.deg2rad(rng.choice([0.25, 0.33, 0.5, 0.72, 1.0]))
    field = rng.choice([np.pi, 1.5 * np.pi, 2.0 * np.pi])
    return Laser(
        rays=int(field / resolution),
        angle_min=-0.5 * field,
        angle_increment=resolution,
        range_max=rng.choice([5.6, 12.0, 30.0]),
        noise=rng.uniform(0.0, 0.03),
        noise_share=rng.uniform(0.0, 0.003),
        lost=rng.choice([0.0, 0.01, 0.03]),
        mixed=rng.choice([0.0, 0.3, 0.7]),
    )


def _walker(rng: np.random.Generator) -> Walker:
    """Draw a person who walks."""
    start = rng.uniform(0.4, 10.0) * _direction(rng)
    walker = Walker(
        way=[start, start + 6.0 * _direction(rng)],
        speed=rng.choice([0.0, 0.6, 1.0, 1.4, 1.8]) + 0.01,
        pace=0.2,
        radius=rng.uniform(0.045, 0.09),
        apart=rng.uniform(0.14, 0.36),
        phase=rng.random(),
    )
    for _ in range(10):
        walker.step(0.1)
    return walker


def _direction(rng: np.random.Generator) -> Array:
    """Draw a unit vector."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _room(rng: np.random.Generator) -> FloorPlan:
    """Draw a room: walls, doors, boxes, tables and chairs on their legs, poles and trees."""
    segments, posts = [], []
    if rng.random() < 0.8:
        a, b = rng.uniform(2.0, 12.0, 2), -rng.uniform(2.0, 12.0, 2)
        corners = np.array([[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]])
        segments += _closed(corners)
    for _ in range(rng.integers(0, 4)):
        segments += _wall_with_doors(rng)
    for _ in range(rng.integers(0, 8)):
        segments += _closed(_rectangle(rng, *rng.uniform(0.2, 1.2, 2)))
    for _ in range(rng.integers(0, 4)):
        size, radius = rng.uniform(0.35, 1.6, 2), rng.uniform(0.008, 0.025)
        posts += [(*corner, radius) for corner in _rectangle(rng, *size)]
    for _ in range(rng.integers(0, 5)):
        posts.append((*(rng.uniform(0.8, 9.0) * _direction(rng)), rng.choice([0.015, 0.15, 0.2, 0.3])))
    return FloorPlan(posts, segments)


def _rectangle(rng: np.random.Generator, a: float, b: float) -> Array:
    """Draw a rectangle of these sizes, m; return its corners (4, 2)."""
    along = _direction(rng)
    across = np.array([-along[1], along[0]])
    centre = rng.uniform(0.4, 9.0) * _direction(rng)
    return np.array(
        [centre + s * a / 2 * along + t * b / 2 * across for s, t in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    )


def _closed(corners: Array) -> list[Array]:
    """Connect corners to a closed polygon."""
    return [np.r_[a, b] for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]


def _wall_with_doors(rng: np.random.Generator) -> list[Array]:
    """Draw a straight wall with gaps, and frames of some centimetres at their ends."""
    along = _direction(rng)
    across = np.array([-along[1], along[0]])
    begin = rng.uniform(0.3, 8.0) * _direction(rng) - 4.0 * along
    pieces, at = [], 0.0
    while at < 8.0:
        length, frame = rng.uniform(0.3, 2.5), rng.uniform(0.02, 0.15)
        a, b = begin + at * along, begin + (at + length) * along
        pieces += [
            np.r_[a, b],
            np.r_[a - frame * across, a + frame * across],
            np.r_[b - frame * across, b + frame * across],
        ]
        at += length + rng.uniform(0.1, 1.2)
    return pieces
