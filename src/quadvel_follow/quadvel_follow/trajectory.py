"""Ways that are written down, and walking them: in open loop, velocity over time, or closed on the odometry. No ROS."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from xml.etree import ElementTree

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .path_smoothing import EXACT_M, FEW_POINTS, NoiseLimits, smooth_path, turns_of

Array = NDArray[np.float64]

STEP = 0.02  # s, between the rows of a trajectory
EARTH = 6371008.8  # m, mean radius
LARGEST = 10_000_000  # bytes of a file
SAME = 1e-6  # m, within which two points are one
TURN_RATE = 1.0  # rad/s, at most, on the spot and in curves
LONGEST = 86_400.0  # s, of a trajectory: a day
FURTHEST = 100_000.0  # m, of a trajectory
LONGEST_STEP = 10_000.0  # m, between two points
LEAP_STEPS, LEAP_M = 20.0, 20.0
"""Usual steps and metres from which a step of a recorded path is a leap"""
TABLE_NOISE = NoiseLimits(least=EXACT_M, few=0.1, many=0.5)
"""Of x and y in a CSV file: odometry, a map, motion capture, radio beacons"""
RECEIVER_NOISE = NoiseLimits(least=0.3, few=1.0, many=5.0, shared=1.0)
"""Of the points of a GPX track; a receiver's error wanders by some 0.3 m even where neighbours agree, and by no less in a mean"""
CORRECTS = np.array([1.0, 1.0, 1.5])  # 1/s, of what the robot is off: ahead, to the left, turned
CORRECTS_AT_MOST = np.array([0.3, 0.3, 0.5])  # m/s, m/s, rad/s
LOST = 1.0  # m, off the way, from which a robot stops
SHIPPED = Path(__file__).parent / "trajectories"
"""zju.csv and eight.csv."""


@attrs.frozen
class Trajectory:
    """A row each `STEP`, from a start at the origin that looks along x.

    pose (n, 3): x, y (m), yaw (rad); velocity (n, 3): vx, vy (m/s), wz (rad/s), body frame.
    """

    pose: Array
    velocity: Array

    noise: float = 0.0
    """m, one axis, of the points of the file, which the trajectory leaves out"""

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return len(self.pose) * STEP

    def summary(self) -> str:
        """Length, duration and turning, in one sentence."""
        speed, turning = np.hypot(*self.velocity[:, :2].T), np.abs(self.velocity[:, 2])
        length, turned = STEP * speed.sum(), STEP * turning.sum()
        on_the_spot = STEP * turning[speed == 0.0].sum()
        noise = f"; position noise of {self.noise:.2f} m is smoothed away" if self.noise > EXACT_M else ""
        return f"{length:.1f} m in {self.seconds:.1f} s, turning {turned:.1f} rad, {on_the_spot:.1f} rad of them on the spot{noise}"

    @classmethod
    def of_commands(cls, seconds: ArrayLike, commands: ArrayLike, step: float = STEP) -> Trajectory:
        """Velocities (k, 3), each for its seconds (k,), in rows of `step` (s). Raises ValueError beyond LONGEST."""
        _refuse_long(float(np.sum(seconds)))
        counts = np.rint(np.asarray(seconds, float) / step).astype(int)
        velocity = np.repeat(np.asarray(commands, float).reshape(-1, 3), counts, axis=0)
        yaw = np.concatenate([[0.0], np.cumsum(velocity[:, 2]) * step])
        middle = yaw[:-1] + 0.5 * step * velocity[:, 2]
        c, s = np.cos(middle), np.sin(middle)
        ahead = np.column_stack(
            [c * velocity[:, 0] - s * velocity[:, 1], s * velocity[:, 0] + c * velocity[:, 1]]
        )
        place = np.vstack([np.zeros(2), np.cumsum(step * ahead, axis=0)])
        return cls(np.column_stack([place, yaw])[:-1], velocity)

    @classmethod
    def of_places(cls, places: ArrayLike, speed: float, noise: NoiseLimits = TABLE_NOISE) -> Trajectory:
        """Along places at a speed, looking where it goes: in curves, and turning on the spot at corners.

        Args:
            places: (k, 2), m, as written or as recorded with noise.
            speed: m/s; less where a curve is so narrow that the robot would turn faster than TURN_RATE.
            noise: what noise to believe.

        Raises:
            ValueError: if there are less than two places, or too long a way.
        """
        points = np.asarray(places, float)
        points = points[np.concatenate([[True], _lengths(points) > SAME])]
        if len(points) < 2:
            raise ValueError("has one place, expected two at least")
        path = smooth_path(points, noise)
        length = sum(float(_lengths(piece).sum()) for piece in path.pieces)
        if not length <= FURTHEST:
            raise ValueError(f"is {length:.3g} m long, expected {FURTHEST:.0f} m at most")
        _refuse_long(length / speed)
        corners = [
            float(turns_of(np.array([before[-1] - before[-2], after[1] - after[0]]))[0])
            for before, after in itertools.pairwise(path.pieces)
        ]
        rows = [_along(piece, speed) for piece in path.pieces]
        for i, turn in reversed(list(enumerate(corners))):
            rows.insert(i + 1, _on_the_spot(turn))
        velocity = np.concatenate(rows)
        walked = cls.of_commands(np.full(len(velocity), STEP), velocity)
        return attrs.evolve(walked, noise=path.noise)


def _along(piece: Array, speed: float) -> Array:
    """Velocities (n, 3), a row each STEP, along points (k, 2) whose bends are walked as arcs from leg to leg."""
    legs = np.diff(piece, axis=0)
    lengths, turns = np.hypot(*legs.T), turns_of(legs)
    cut = 0.5 * np.minimum(lengths[:-1], lengths[1:])  # of both legs, where the arc begins and ends
    half = np.maximum(0.5 * np.abs(turns), 1e-9)
    arcs = 2.0 * cut * half / np.tan(half)
    straights = lengths - np.concatenate([[0.0], cut]) - np.concatenate([cut, [0.0]])
    distance = np.concatenate([np.column_stack([straights[:-1], arcs]).ravel(), straights[-1:]])
    turned = np.concatenate([np.column_stack([np.zeros_like(turns), turns]).ravel(), [0.0]])
    seconds = np.maximum(distance / speed, np.abs(turned) / TURN_RATE)
    _refuse_long(float(seconds.sum()))
    ends = np.cumsum(seconds)
    instants = np.linspace(0.0, ends[-1], max(round(ends[-1] / STEP), 1) + 1)
    ahead, yaw = (
        np.diff(np.interp(instants, [0.0, *ends], [0.0, *np.cumsum(moved)])) for moved in (distance, turned)
    )
    return np.column_stack([ahead, np.zeros_like(ahead), yaw]) / STEP


def _on_the_spot(turn: float) -> Array:
    """Velocities (n, 3), a row each STEP, that turn by that angle, rad."""
    count = max(round(abs(turn) / TURN_RATE / STEP), 1)
    return np.tile([0.0, 0.0, turn / (count * STEP)], (count, 1))


def _refuse_long(seconds: float) -> None:
    """Raises ValueError before a trajectory of that duration takes memory."""
    if not seconds <= LONGEST:
        raise ValueError(f"lasts {seconds:.3g} s, expected a day ({LONGEST:.0f} s) at most")


def load(path: Path, speed: float) -> Trajectory:
    """From a CSV or GPX file; `speed` (m/s) where it holds places.

    CSV: a head of seconds, vx, vy, wz, or of x, y (m). GPX: the points of its tracks and routes, in the plane round the first,
    turned so that the way begins along x. Raises ValueError that names the file.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise ValueError(f"has more than {LARGEST} bytes")
        read = _gpx if path.suffix.lower() == ".gpx" else _csv
        return read(path, speed)
    except OSError as error:
        shipped = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.csv")))
        raise ValueError(
            f"{path}: {error.strerror}, expected a CSV or GPX file or one of {shipped}"
        ) from None
    except (ValueError, csv.Error, ElementTree.ParseError) as error:
        raise ValueError(f"{path}: {error}") from None


def read_table(path: Path) -> tuple[list[str], Array]:
    """The head and the numbers (k, columns) of a CSV file. Raises ValueError if it is no such table."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    head = [name.strip() for name in rows[0]] if rows else []
    if head not in (["seconds", "vx", "vy", "wz"], ["x", "y"]):
        raise ValueError(f"has the head {','.join(head)!r}, expected seconds,vx,vy,wz or x,y")
    numbers = [_numbers(row, line, len(head)) for line, row in enumerate(rows[1:], 2) if row]
    if not numbers:
        raise ValueError(f"has no row below its head, expected {len(head)} finite numbers in each")
    return head, np.array(numbers)


def _numbers(row: list[str], line: int, count: int) -> list[float]:
    try:
        numbers = [float(cell) for cell in row]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"row {line} is {','.join(row)[:80]!r}, expected {count} finite numbers")
    return numbers


def _csv(path: Path, speed: float) -> Trajectory:
    head, numbers = read_table(path)
    if len(head) == 2:
        _refuse_leaps(numbers, _lengths(numbers))
        return Trajectory.of_places(numbers, speed)
    if (numbers[:, 0] <= 0.0).any():
        raise ValueError("has seconds that are not above 0")
    return Trajectory.of_commands(numbers[:, 0], numbers[:, 1:])


def _gpx(path: Path, speed: float) -> Trajectory:
    text = path.read_text()
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("has a document type or entities, which no track needs")
    points = [
        e for e in ElementTree.fromstring(text).iter() if e.tag.rpartition("}")[2] in ("trkpt", "rtept")
    ]
    angles = np.array([[float(e.get("lat", "nan")), float(e.get("lon", "nan"))] for e in points])
    if len(angles) < 2 or not np.isfinite(angles).all():
        raise ValueError("has less than two points with lat and lon")
    if (wrong := np.flatnonzero((np.abs(angles) > [90.0, 360.0]).any(axis=1))).size:
        raise ValueError(
            f"has point {wrong[0] + 1} at {_pair(angles[wrong[0]])}, expected a lat within 90 and a lon within 360 degrees"
        )
    directions = _from_the_centre(np.deg2rad(angles))
    chords = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    _refuse_leaps(angles, 2.0 * EARTH * np.arcsin(np.minimum(0.5 * chords, 1.0)))
    lat, lon = np.deg2rad(angles[0])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    places = EARTH * (directions - directions[0]) @ np.column_stack([east, north])
    is_track = points[0].tag.rpartition("}")[2] == "trkpt"
    return Trajectory.of_places(places, speed, RECEIVER_NOISE if is_track else TABLE_NOISE)


def _from_the_centre(angles: Array) -> Array:
    """Unit vectors (n, 3) from the earth's centre to lat, lon (n, 2), rad: they know no poles and no date line."""
    lat, lon = angles.T
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def _lengths(places: Array) -> Array:
    """Of the steps between places (n, 2), m; infinite where they are beyond all numbers."""
    with np.errstate(over="ignore"):
        return np.asarray(np.hypot(*np.diff(places, axis=0).T))


def _refuse_leaps(points: Array, steps: Array) -> None:
    """Raises ValueError that names the points between which a path leaps.

    Args:
        points: (n, 2), as the file has them.
        steps: (n - 1,), m, between them.
    """
    usual = float(np.median(steps[steps > SAME])) if (steps > SAME).any() else 0.0
    recorded = len(points) >= FEW_POINTS
    most = min(max(LEAP_STEPS * usual, LEAP_M), LONGEST_STEP) if recorded else LONGEST_STEP
    leaps = np.flatnonzero(steps > most)
    if not len(leaps):
        return
    k = leaps[0]
    more = f"; {len(leaps)} steps of the file are such leaps" if len(leaps) > 1 else ""
    raise ValueError(
        f"leaps {steps[k]:.6g} m from point {k + 1} at {_pair(points[k])} to point {k + 2} at {_pair(points[k + 1])}, "
        f"expected {most:.3g} m at most, as a usual step is {usual:.2g} m{more}; remove the wrong points, or fill the gap"
    )


def _pair(numbers: Array) -> str:
    return f"({numbers[0]:.9g}, {numbers[1]:.9g})"


class TrajectoryFollower:
    """What to command at a time, from where the robot was at the first call."""

    def __init__(self, trajectory: Trajectory, closed: bool) -> None:
        """closed: whether what the robot is off, by its odometry, is corrected."""
        self._trajectory, self._closed = trajectory, closed
        self._start: Array | None = None

    def step(self, elapsed: float, pose: ArrayLike | None = None) -> Array | None:
        """vx, vy (m/s), wz (rad/s) after `elapsed` s; None at the end. pose (3,): x, y (m), yaw (rad), where it is closed.

        Raises ValueError where the robot has strayed too far.
        """
        row = int(elapsed / STEP)
        if row >= len(self._trajectory.pose):
            return None
        velocity: Array = self._trajectory.velocity[row]
        if not self._closed:
            return velocity
        now = np.asarray(pose, float)
        if self._start is None:
            self._start = now
        x, y, yaw = _within(self._start, now)
        off = _within(np.array([x, y, yaw]), self._trajectory.pose[row])
        if np.hypot(*off[:2]) > LOST:
            raise ValueError(
                f"the robot is {np.hypot(*off[:2]):.2f} m off its way, expected {LOST} m at most"
            )
        return velocity + np.clip(CORRECTS * off, -CORRECTS_AT_MOST, CORRECTS_AT_MOST)


def _within(frame: Array, pose: Array) -> Array:
    """`pose` as seen from the pose `frame`, (3,) each."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    x, y = pose[:2] - frame[:2]
    turn = (pose[2] - frame[2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.array([c * x + s * y, -s * x + c * y, turn])
