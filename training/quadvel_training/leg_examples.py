"""What the classifier of legs learns from: labelled scans of real people and places, and simulated ones of any scanner."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_eval.people.laser import FloorPlan, Laser
from quadvel_follow.clusters import FEATURE_COUNT, MAX_CLUSTER_WIDTH_M, Scan, cluster_features, find_clusters
from quadvel_follow.free_space import to_frame
from quadvel_sim.walker import Walker, leg_circles

Array = NDArray[np.float64]

SAME = 0.12  # m, between a label and the thing that it names
FIXED = 0.05  # m, within which a thing that does not move is found again
FIXED_SHARE = 0.4  # of a file's scans in which such a thing is found
NEARER = 0.3  # m before what is usually seen in a direction: somebody walks there
THINNING = (1, 2, 3)  # every how manieth ray is kept: what coarser scanners would have seen


@attrs.frozen
class Examples:
    """Things (N, NUMBERS), as `describe` has them, and whether each is a leg or a pair of legs (N,)."""

    things: NDArray[np.float32]
    legs: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[Examples]) -> Examples:
        """All of them."""
        if not parts:
            return cls(np.zeros((0, FEATURE_COUNT), np.float32), np.zeros(0, bool))
        return cls(np.concatenate([p.things for p in parts]), np.concatenate([p.legs for p in parts]))


def from_file(path: Path, rng: np.random.Generator) -> Examples:
    """Of a file of real scans: one with labels, one of a place where nobody is, or one of people who walk before a
    scanner that stands. What can be neither named nor excluded is left out.
    """
    content = dict(np.load(path, allow_pickle=False))
    content["ranges"] = np.where(content["ranges"] < content["range_max"], content["ranges"], np.inf)
    if "legs" in content:
        judge = _labelled
    elif "none" in path.stem:
        judge = _empty
    else:
        judge = _walking
    return Examples.joined([one for step in THINNING for one in judge(content, step, rng)])


def _scans(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Scan]:
    """Every `step`th ray of each scan, with some noise and some rays lost."""
    increment = float(content["angle_increment"])
    for ranges in content["ranges"].astype(float):
        first = int(rng.integers(step))
        kept = ranges[first::step].copy()
        kept += rng.uniform(0.0, 0.015) * rng.standard_normal(kept.size)
        kept[rng.random(kept.size) < rng.choice([0.0, 0.01])] = np.inf
        yield Scan.validated(kept, float(content["angle_min"]) + first * increment, step * increment)


def _labelled(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Examples]:
    fixed = _Fixed(content)
    for scan, labels in zip(_scans(content, step, rng), content["legs"].astype(float), strict=True):
        clusters = find_clusters(scan)
        labels = labels[np.isfinite(labels[:, 0])]
        named = _nearest(clusters.centre, labels) < SAME
        yield _kept(
            scan,
            named,
            named | (fixed(clusters.centre) & (_nearest(clusters.centre, labels) > MAX_CLUSTER_WIDTH_M)),
        )


def _empty(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Examples]:
    for scan in _scans(content, step, rng):
        found = len(find_clusters(scan).centre)
        yield _kept(scan, np.zeros(found, bool), np.ones(found, bool))


def _walking(content: dict[str, Any], step: int, rng: np.random.Generator) -> Iterator[Examples]:
    ranges = np.where(np.isfinite(content["ranges"]), content["ranges"], 2.0 * content["range_max"])
    usual = np.quantile(ranges, 0.8, axis=0)
    angles = content["angle_min"] + content["angle_increment"] * np.arange(ranges.shape[1])
    fixed = _Fixed(content)
    for scan in _scans(content, step, rng):
        clusters = find_clusters(scan)
        bearing = np.arctan2(*clusters.centre.T[::-1])
        nearer = np.interp(bearing, angles, usual) - np.hypot(*clusters.centre.T) > NEARER
        still = fixed(clusters.centre)
        person = nearer & ~still & (clusters.width < MAX_CLUSTER_WIDTH_M) & (clusters.count * step >= 4)
        yield _kept(scan, person, person | (still & ~nearer))


def _kept(scan: Scan, legs: NDArray[np.bool_], kept: NDArray[np.bool_]) -> Examples:
    return Examples(cluster_features(scan, find_clusters(scan))[kept], legs[kept])


class _Fixed:
    """Says of things in a file of a scanner that stands whether they are there in many of its scans."""

    def __init__(self, content: dict[str, Any]) -> None:
        scans = [
            Scan.validated(ranges, float(content["angle_min"]), float(content["angle_increment"]))
            for ranges in content["ranges"].astype(float)
        ]
        self._seen = [find_clusters(scan).centre for scan in scans[:: max(1, len(scans) // 100)]]

    def __call__(self, centre: Array) -> NDArray[np.bool_]:
        shares = np.mean([_nearest(centre, seen) < FIXED for seen in self._seen], axis=0)
        return shares > FIXED_SHARE


def _nearest(points: Array, others: Array) -> Array:
    """From each point (N, 2) to the nearest of the others, m."""
    if not len(others):
        return np.full(len(points), np.inf)
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(1)


def simulated(scenes: int, rng: np.random.Generator) -> Examples:
    """Of rooms with people in them, each scene from another room and scanner, at ten instants."""
    return Examples.joined([one for _ in range(scenes) for one in _scene(rng)])


def _scene(rng: np.random.Generator) -> Iterator[Examples]:
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
        named = _nearest(to_frame(clusters.centre, pose), legs[:, :2]) < SAME
        named &= clusters.width < MAX_CLUSTER_WIDTH_M
        unclear = _nearest(to_frame(clusters.centre, pose), legs[:, :2]) < MAX_CLUSTER_WIDTH_M
        yield _kept(scan, named, named | ~unclear)


def _laser(rng: np.random.Generator) -> Laser:
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
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _room(rng: np.random.Generator) -> FloorPlan:
    """Walls all round, or none; walls with door frames, boxes, tables and chairs on their legs, poles and trees."""
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
    """Corners (4, 2) of one that lies anywhere."""
    along = _direction(rng)
    across = np.array([-along[1], along[0]])
    centre = rng.uniform(0.4, 9.0) * _direction(rng)
    return np.array(
        [centre + s * a / 2 * along + t * b / 2 * across for s, t in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    )


def _closed(corners: Array) -> list[Array]:
    return [np.r_[a, b] for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]


def _wall_with_doors(rng: np.random.Generator) -> list[Array]:
    """A straight wall with gaps, at whose ends frames stand out by some centimetres."""
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
