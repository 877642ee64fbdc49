"""Smoothing of recorded paths: noisy points become few smooth pieces between true corners. No ROS.

The noise is estimated from the points. Neighbours that noise may explain merge into one place.
Between corners a smoothing spline, as stiff as the noise permits, replaces the places. A path
without noise, such as a hand-written one, keeps its points.
"""

from __future__ import annotations

import itertools

import attrs
import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline

from quadvel_description.arrays import Array

FEW_POINTS = 12
"""With fewer points no noise is estimated: these are hand-written corners."""
MANY_POINTS = 100
"""With at least this number of points the path is recorded and may have more noise."""
EXACT_NOISE_M = 0.002
"""Noise in m of an exact path: far below what a walking robot can follow."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a plane normal vector of unit variance an axis"""
UNEVEN_RATIO = 3.0
"""Ratio of the two estimates of the noise above which the points lie at uneven distances"""
CORNER_RAD = np.radians(50.0)
"""A sharper turn between two legs is a corner."""
LONE_CORNER_RAD = np.radians(25.0)
"""A sharper turn is a corner if it is twice as sharp as its neighbours (no sampled curve)."""
LONG_LEG_RATIO = 3.0
"""A leg of more median lengths is straight; it gets additional points, so that no spline bulges."""
CORNER_ERROR_SHARE = 0.03
"""Factor of a corner's error, so that the adjacent pieces meet there."""
MAX_MEAN_SQUARE = 1.8
"""Largest mean squared residual of the spline in noise variances: below the 2 of two axes."""
MIN_SPLINE_POINTS = 5
"""Least number of points of a smoothing spline"""
PENALTY_DECADES = (-4.0, 12.0)
"""Decades of the spline's penalty, in cubed legs: from interpolation to a straight line"""


@attrs.frozen
class NoiseLimits:
    """Position noise (m, standard deviation per axis) that a kind of file may have.

    Attributes:
        least: Lower bound.
        few: Upper bound for a path of few points.
        many: Upper bound for a path of many points.
        shared: Share of the noise that neighbours have in common and averaging does not remove.
    """

    least: float
    few: float
    many: float
    shared: float = 0.0


@attrs.frozen
class SmoothPath:
    """Smoothed path.

    Attributes:
        pieces: Pieces, (n, 2) each, m; each ends where the next begins, at a corner.
        noise: Removed noise, m, standard deviation per axis.
    """

    pieces: list[Array]
    noise: float


def smooth_path(points: Array, limits: NoiseLimits) -> SmoothPath:
    """Smooth a path.

    Args:
        points: Points in the order of walking, (n, 2), m, n >= 2, no point repeated directly.
        limits: Bounds of the noise.

    Returns:
        Pieces between corners.
    """
    found = estimate_noise(points)
    dense = len(points) >= FEW_POINTS
    believed = dense and found <= (limits.many if len(points) >= MANY_POINTS else limits.few)
    noise = max(found, limits.least) if believed else EXACT_NOISE_M
    shared = limits.shared * noise if believed else 0.0
    places, counts = _merge_places(points, noise, shared)
    if len(places) < 2:
        places, counts = points[[0, -1]], np.ones(2)
    errors = np.hypot(noise / np.sqrt(counts), shared)
    corners = _find_corners(places, errors)
    errors[corners] *= CORNER_ERROR_SHARE
    ends = [0, *corners, len(places) - 1]
    pieces = [
        _smooth_piece(places[first : last + 1], errors[first : last + 1])
        for first, last in itertools.pairwise(ends)
    ]
    return SmoothPath(pieces, noise)


def estimate_noise(points: Array) -> float:
    """Estimate the position noise as what neighbours on both sides do not predict.

    Two parameters along the path are used. Chord lengths hide noise that lengthens the chords;
    point numbers mistake uneven spacing for noise. If both results differ much, chord lengths are
    right.

    Args:
        points: Points, (n, 2), m.

    Returns:
        Standard deviation per axis, m; 0 for fewer than FEW_POINTS points.
    """
    if len(points) < FEW_POINTS:
        return 0.0
    by_chords = _prediction_error(points, _chord_lengths(points))
    by_numbers = _prediction_error(points, np.arange(len(points), dtype=float))
    return by_numbers if by_numbers < UNEVEN_RATIO * by_chords else by_chords


def _prediction_error(points: Array, along: Array) -> float:
    """Return the median error (m, per axis) of cubics through four neighbours, over `along` (n,).

    The median ignores corners and leaps.
    """
    # Lagrange weights of the cubic through the neighbours -2, -1, 1, 2 at the middle point:
    # w_j = prod_{i != j} (s - s_i) / (s_j - s_i). With noise sigma the residual is a 2-D normal
    # vector of deviation sigma sqrt(1 + sum w_j^2) per axis; its length is Rayleigh distributed.
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


def _outlier_bound(count: int) -> float:
    """Return a bound, in standard deviations, of the largest of `count` normal errors."""
    return 1.0 + float(np.sqrt(2.0 * np.log(count)))


def _chord_lengths(points: Array) -> Array:
    """Return the length of the polyline up to each point, (n,), m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _merge_places(points: Array, noise: float, shared: float) -> tuple[Array, Array]:
    """Merge neighbours that noise alone may separate; return places (k, 2) and point counts (k,).

    The closest pairs merge first, so a robot that stood becomes one place.

    Args:
        points: Points, (n, 2), m.
        noise: Noise of a point, m, per axis.
        shared: Part of the noise that averaging does not remove, m, per axis.
    """
    places, counts, same = points, np.ones(len(points)), _outlier_bound(len(points))
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


def _find_corners(places: Array, errors: Array) -> list[int]:
    """Return indices of places with a sharp turn that their errors (k,) in m cannot explain."""
    legs = np.diff(places, axis=0)
    turns = turn_angles(legs)
    headings = np.hypot(errors[:-1], errors[1:]) / np.hypot(*legs.T)
    doubt = _outlier_bound(len(places)) * np.hypot(headings[:-1], headings[1:])
    sharp = np.abs(turns)
    padded = np.concatenate([[0.0], turns, [0.0]])
    neighbours = np.maximum(padded[:-2] * np.sign(turns), padded[2:] * np.sign(turns))
    lone = (sharp > LONE_CORNER_RAD + doubt) & (sharp > 2.0 * neighbours)
    return [int(i) + 1 for i in np.flatnonzero((sharp > CORNER_RAD + doubt) | lone)]


def turn_angles(legs: Array) -> Array:
    """Compute the angles between consecutive legs.

    Args:
        legs: Vectors, (n, 2).

    Returns:
        Angles, (n - 1,), rad, positive to the left.
    """
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    return np.asarray((np.diff(headings) + np.pi) % (2.0 * np.pi) - np.pi)


def _smooth_piece(places: Array, errors: Array) -> Array:
    """Return the stiffest spline that the errors (m, per axis) permit, as points (n, 2)."""
    if len(places) < MIN_SPLINE_POINTS:
        return places
    places, errors = _densify(places, errors)
    along = _chord_lengths(places)
    weights = 1.0 / errors
    unit = float(np.median(np.diff(along))) ** 3 / float(np.median(errors)) ** 2

    def spline(decade: float) -> BSpline:
        return make_smoothing_spline(along, places, weights, lam=unit * 10.0**decade)

    def is_permitted(decade: float) -> bool:
        missed = np.hypot(*(spline(decade)(along) - places).T) / errors
        return bool(np.mean(missed**2) <= MAX_MEAN_SQUARE and missed.max() <= _outlier_bound(len(places)))

    # Bisection over the exponent of the penalty: the largest one whose residuals fit the noise.
    soft, stiff = PENALTY_DECADES
    while stiff - soft > 0.25:
        middle = 0.5 * (soft + stiff)
        soft, stiff = (middle, stiff) if is_permitted(middle) else (soft, middle)
    finer = np.interp(np.arange(0.0, len(along) - 0.9, 0.25), np.arange(len(along)), along)
    return np.asarray(spline(soft)(finer))


def _densify(places: Array, errors: Array) -> tuple[Array, Array]:
    """Add points on legs that are much longer than the median."""
    lengths = np.hypot(*np.diff(places, axis=0).T)
    usual = max(float(np.median(lengths)), 1e-3 * float(lengths.max()))
    parts = np.where(lengths > LONG_LEG_RATIO * usual, np.ceil(lengths / usual), 1.0).astype(int)
    index = np.arange(len(places), dtype=float)
    finer = np.concatenate([np.concatenate([k + np.arange(n) / n for k, n in enumerate(parts)]), index[-1:]])
    columns = [np.interp(finer, index, column) for column in (*places.T, errors)]
    return np.column_stack(columns[:2]), columns[2]
