"""Recorded paths, freed of their noise: from many points with errors to few smooth pieces between true corners. No ROS.

The noise is estimated from the points themselves. Neighbours that noise alone may explain become one place; between corners a
smoothing spline, as stiff as the noise permits, replaces the places. A hand-written path has no noise and keeps its points.
"""

from __future__ import annotations

import itertools

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

Array = NDArray[np.float64]

FEW_POINTS = 12
"""Below this number of points no noise is estimated: these are corners that somebody wrote"""
MANY_POINTS = 100
"""From this number of points on a path is surely recorded, and more noise is believed"""
EXACT_M = 0.002
"""m, noise of a path that has none: far below what a walking robot can follow"""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a plane normal vector of unit variance an axis"""
UNEVEN = 3.0
"""Ratio of the two estimates of the noise above which the points lie at uneven distances"""
CORNER = np.radians(50.0)
"""rad; a sharper turn between two legs is a corner"""
LONE_CORNER = np.radians(25.0)
"""rad; a sharper turn is a corner if it is also twice as sharp as its neighbours, which in a sampled curve it is not"""
LONG_LEG = 3.0
"""Median legs; a longer leg is straight, and gets points of its own so that no spline bulges"""
PINNED = 0.03
"""Share of its error that a corner keeps, so that the pieces before and after it meet there"""
PERMITTED = 1.8
"""Mean squared distance, in variances of the noise, of places from their spline: a bit less than the 2 of two axes"""
FIT_POINTS = 5
"""Least number of points of a smoothing spline"""
STIFFNESS = (-4.0, 12.0)
"""Decades of the spline's penalty, in cubed legs: from interpolation to a straight line"""


@attrs.frozen
class NoiseLimits:
    """Noise (m, one axis) that a kind of file may have: at least, at most with few points, and at most with many.

    `shared` is the share of it that neighbours have in common, which no mean over them takes away.
    """

    least: float
    few: float
    many: float
    shared: float = 0.0


@attrs.frozen
class SmoothPath:
    """Pieces (n, 2), m, each ending where the next begins, at a corner; noise (m, one axis) that was smoothed away."""

    pieces: list[Array]
    noise: float


def smooth_path(points: Array, limits: NoiseLimits) -> SmoothPath:
    """The pieces of a path of points.

    Args:
        points: (n, 2), m, in the order of walking, two at least, neighbours differ.
        limits: what noise to believe.
    """
    found = estimated_noise(points)
    dense = len(points) >= FEW_POINTS
    believed = dense and found <= (limits.many if len(points) >= MANY_POINTS else limits.few)
    noise = max(found, limits.least) if believed else EXACT_M
    shared = limits.shared * noise if believed else 0.0
    places, counts = _merged(points, noise, shared)
    if len(places) < 2:
        places, counts = points[[0, -1]], np.ones(2)
    errors = np.hypot(noise / np.sqrt(counts), shared)
    corners = _corners(places, errors)
    errors[corners] *= PINNED
    ends = [0, *corners, len(places) - 1]
    pieces = [
        _smoothed(places[first : last + 1], errors[first : last + 1])
        for first, last in itertools.pairwise(ends)
    ]
    return SmoothPath(pieces, noise)


def estimated_noise(points: Array) -> float:
    """Standard deviation (m, one axis) of what neighbours on both sides do not predict; 0 for few points.

    Chords that noise lengthens hide a part of it, and points at uneven distances look like noise if they count as even: the
    former estimate holds where the two are far apart.
    """
    if len(points) < FEW_POINTS:
        return 0.0
    by_chords = _unpredicted(points, _chords(points))
    by_numbers = _unpredicted(points, np.arange(len(points), dtype=float))
    return by_numbers if by_numbers < UNEVEN * by_chords else by_chords


def _unpredicted(points: Array, along: Array) -> float:
    """How far (m, one axis) points lie from the cubics through their four neighbours, x and y over `along` (n,).

    The median over the points leaves corners and leaps out.
    """
    middle = np.arange(2, len(points) - 2)
    around = middle[:, None] + [-2, -1, 1, 2]
    nodes, at = along[around], along[middle]
    weights = np.ones_like(nodes)
    for j in range(4):
        for i in set(range(4)) - {j}:
            weights[:, j] *= (at - nodes[:, i]) / (nodes[:, j] - nodes[:, i])
    missed = points[middle] - np.einsum("nj,njk->nk", weights, points[around])
    expected = RAYLEIGH_MEDIAN * np.sqrt(1.0 + np.square(weights).sum(1))
    return float(np.median(np.hypot(*missed.T) / expected))


def _furthest(count: int) -> float:
    """Standard deviations that the largest of so many errors hardly exceeds."""
    return 1.0 + float(np.sqrt(2.0 * np.log(count)))


def _chords(points: Array) -> Array:
    """Length of the polygon up to each point, (n,), m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _merged(points: Array, noise: float, shared: float) -> tuple[Array, Array]:
    """Means of neighbours that noise alone may separate (k, 2), and how many points each is made of (k,).

    `noise` is the error of a point, `shared` (m, one axis) what a mean of points keeps of it.

    The nearest pairs merge first. A robot that stood is one place, whatever its receiver said meanwhile.
    """
    places, counts, same = points, np.ones(len(points)), _furthest(len(points))
    while len(places) > 1:
        apart = np.hypot(*np.diff(places, axis=0).T)
        apart /= np.sqrt(noise**2 * (1.0 / counts[:-1] + 1.0 / counts[1:]) + 2.0 * shared**2)
        padded = np.concatenate([[np.inf], apart, [np.inf]])
        first = np.flatnonzero((apart < same) & (apart <= padded[:-2]) & (apart < padded[2:]))
        if not len(first):
            break
        both = counts[first] + counts[first + 1]
        sums = counts[first, None] * places[first] + counts[first + 1, None] * places[first + 1]
        places, counts = places.copy(), counts.copy()
        places[first], counts[first] = sums / both[:, None], both
        places, counts = np.delete(places, first + 1, axis=0), np.delete(counts, first + 1)
    return places, counts


def _corners(places: Array, errors: Array) -> list[int]:
    """Indices of places at which a path turns sharply, beyond doubt at these errors (m, (k,))."""
    legs = np.diff(places, axis=0)
    turns = turns_of(legs)
    headings = np.hypot(errors[:-1], errors[1:]) / np.hypot(*legs.T)
    doubt = _furthest(len(places)) * np.hypot(headings[:-1], headings[1:])
    sharp = np.abs(turns)
    padded = np.concatenate([[0.0], turns, [0.0]])
    beside = np.maximum(padded[:-2] * np.sign(turns), padded[2:] * np.sign(turns))
    lone = (sharp > LONE_CORNER + doubt) & (sharp > 2.0 * beside)
    return [int(i) + 1 for i in np.flatnonzero((sharp > CORNER + doubt) | lone)]


def turns_of(legs: Array) -> Array:
    """Angles from each of the legs (n, 2) to the next, (n - 1,), rad, to the left positive."""
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    return np.asarray((np.diff(headings) + np.pi) % (2.0 * np.pi) - np.pi)


def _smoothed(places: Array, errors: Array) -> Array:
    """The stiffest spline through the places that their errors (m, one axis) permit, as points (n, 2)."""
    if len(places) < FIT_POINTS:
        return places
    places, errors = _densified(places, errors)
    along = _chords(places)
    weights = 1.0 / errors
    unit = float(np.median(np.diff(along))) ** 3 / float(np.median(errors)) ** 2

    def spline(decade: float) -> BSpline:
        return make_smoothing_spline(along, places, weights, lam=unit * 10.0**decade)

    def is_permitted(decade: float) -> bool:
        missed = np.hypot(*(spline(decade)(along) - places).T) / errors
        return bool(np.mean(missed**2) <= PERMITTED and missed.max() <= _furthest(len(places)))

    soft, stiff = STIFFNESS
    while stiff - soft > 0.25:
        middle = 0.5 * (soft + stiff)
        soft, stiff = (middle, stiff) if is_permitted(middle) else (soft, middle)
    finer = np.interp(np.arange(0.0, len(along) - 0.9, 0.25), np.arange(len(along)), along)
    return np.asarray(spline(soft)(finer))


def _densified(places: Array, errors: Array) -> tuple[Array, Array]:
    """The same with points in between on legs that are long among the others."""
    lengths = np.hypot(*np.diff(places, axis=0).T)
    usual = max(float(np.median(lengths)), 1e-3 * float(lengths.max()))
    parts = np.where(lengths > LONG_LEG * usual, np.ceil(lengths / usual), 1.0).astype(int)
    index = np.arange(len(places), dtype=float)
    finer = np.concatenate([np.concatenate([k + np.arange(n) / n for k, n in enumerate(parts)]), index[-1:]])
    columns = [np.interp(finer, index, column) for column in (*places.T, errors)]
    return np.column_stack(columns[:2]), columns[2]
