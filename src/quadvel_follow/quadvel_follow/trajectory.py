"""Trajectories from files and their execution in open or closed loop. No ROS.

`trajectory_planner` is the ROS node around it. Units: m, rad, s; velocities are in the body frame.
"""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from xml.etree import ElementTree

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

from .path_smoothing import EXACT_NOISE_M, FEW_POINTS, NoiseLimits, smooth_path, turn_angles

STEP_S = 0.02
"""Time between the rows of a trajectory."""
EARTH_RADIUS_M = 6371008.8
"""Mean radius."""
MAX_FILE_BYTES = 10_000_000
SAME_POINT_M = 1e-6
"""Distance within which two points are one."""
MAX_TURN_RATE = 1.0
"""Turn rate on the spot and in curves, rad/s."""
MAX_DURATION_S = 86_400.0
"""A day."""
MAX_LENGTH_M = 100_000.0
MAX_STEP_M = 10_000.0
"""Largest distance between two points."""
LEAP_STEPS, LEAP_M = 20.0, 20.0
"""Multiples of the usual step, and distance, from which a step of a recorded path is a leap."""
TABLE_NOISE = NoiseLimits(least=EXACT_NOISE_M, few=0.1, many=0.5)
"""Noise of x and y in a CSV file: odometry, a map, motion capture, radio beacons."""
RECEIVER_NOISE = NoiseLimits(least=0.3, few=1.0, many=5.0, shared=1.0)
"""Noise of a GPX track; averaging does not remove a receiver's drift of about 0.3 m."""
CORRECTION_GAINS = np.array([1.0, 1.0, 1.5])  # 1/s, for deviations ahead, to the left, in yaw
MAX_CORRECTION = np.array([0.3, 0.3, 0.5])  # m/s, m/s, rad/s
MAX_DEVIATION_M = 1.0
"""Deviation from the trajectory at which the robot stops."""
SHIPPED_FOLDER = Path(__file__).parent / "trajectories"
"""zju.csv and eight.csv."""


@attrs.frozen
class Trajectory:
    """Trajectory with a row every `STEP_S`, from a start at the origin facing along x.

    Attributes:
        pose: Poses, (n, 3): x, y in m, yaw in rad.
        velocity: Velocities in the body frame, (n, 3): vx, vy in m/s, wz in rad/s.
        noise: Position noise of the file that was smoothed away, m, per axis.
    """

    pose: Array
    velocity: Array

    noise: float = 0.0

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return len(self.pose) * STEP_S

    def summary(self) -> str:
        """Describe the trajectory in one sentence.

        Returns:
            Length, duration and turning.
        """
        speed, turning = np.hypot(*self.velocity[:, :2].T), np.abs(self.velocity[:, 2])
        length, turned = STEP_S * speed.sum(), STEP_S * turning.sum()
        on_the_spot = STEP_S * turning[speed == 0.0].sum()
        noise = (
            f"; position noise of {self.noise:.2f} m is smoothed away" if self.noise > EXACT_NOISE_M else ""
        )
        return f"{length:.1f} m in {self.seconds:.1f} s, turning {turned:.1f} rad, {on_the_spot:.1f} rad of them on the spot{noise}"

    @classmethod
    def from_commands(cls, seconds: ArrayLike, commands: ArrayLike, step: float = STEP_S) -> Trajectory:
        """Create a trajectory from velocity commands.

        Args:
            seconds: Duration of each command, (k,), s.
            commands: Velocities, (k, 3): vx, vy in m/s, wz in rad/s.
            step: Time between rows, s.

        Returns:
            The trajectory. ValueError propagates if it is longer than MAX_DURATION_S.
        """
        _check_duration(float(np.sum(seconds)))
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
    def from_points(cls, places: ArrayLike, speed: float, noise: NoiseLimits = TABLE_NOISE) -> Trajectory:
        """Create a trajectory along points: arcs in curves, turns on the spot at corners.

        Args:
            places: Points, (k, 2), m, as written or as recorded with noise.
            speed: Speed, m/s; lower in narrow curves, so that the turn rate is at most
                MAX_TURN_RATE.
            noise: Bounds of the position noise.

        Returns:
            The trajectory.

        Raises:
            ValueError: There are fewer than two points, or the path is too long.
        """
        points = np.asarray(places, float)
        points = points[np.concatenate([[True], _step_lengths(points) > SAME_POINT_M])]
        if len(points) < 2:
            raise ValueError("has one place, expected two at least")
        path = smooth_path(points, noise)
        length = sum(float(_step_lengths(piece).sum()) for piece in path.pieces)
        if not length <= MAX_LENGTH_M:
            raise ValueError(f"is {length:.3g} m long, expected {MAX_LENGTH_M:.0f} m at most")
        _check_duration(length / speed)
        corners = [
            float(turn_angles(np.array([before[-1] - before[-2], after[1] - after[0]]))[0])
            for before, after in itertools.pairwise(path.pieces)
        ]
        rows = [_piece_velocities(piece, speed) for piece in path.pieces]
        for i, turn in reversed(list(enumerate(corners))):
            rows.insert(i + 1, _turn_velocities(turn))
        velocity = np.concatenate(rows)
        walked = cls.from_commands(np.full(len(velocity), STEP_S), velocity)
        return attrs.evolve(walked, noise=path.noise)


def _piece_velocities(piece: Array, speed: float) -> Array:
    """Return velocities (n, 3) every STEP_S along points (k, 2); bends become arcs between legs."""
    legs = np.diff(piece, axis=0)
    lengths, turns = np.hypot(*legs.T), turn_angles(legs)
    cut = 0.5 * np.minimum(lengths[:-1], lengths[1:])  # of both legs, where the arc begins and ends
    half = np.maximum(0.5 * np.abs(turns), 1e-9)
    arcs = 2.0 * cut * half / np.tan(half)
    straights = lengths - np.concatenate([[0.0], cut]) - np.concatenate([cut, [0.0]])
    distance = np.concatenate([np.column_stack([straights[:-1], arcs]).ravel(), straights[-1:]])
    turned = np.concatenate([np.column_stack([np.zeros_like(turns), turns]).ravel(), [0.0]])
    seconds = np.maximum(distance / speed, np.abs(turned) / MAX_TURN_RATE)
    _check_duration(float(seconds.sum()))
    ends = np.cumsum(seconds)
    instants = np.linspace(0.0, ends[-1], max(round(ends[-1] / STEP_S), 1) + 1)
    ahead, yaw = (
        np.diff(np.interp(instants, [0.0, *ends], [0.0, *np.cumsum(moved)])) for moved in (distance, turned)
    )
    return np.column_stack([ahead, np.zeros_like(ahead), yaw]) / STEP_S


def _turn_velocities(turn: float) -> Array:
    """Return velocities (n, 3) every STEP_S that turn by an angle in rad on the spot."""
    count = max(round(abs(turn) / MAX_TURN_RATE / STEP_S), 1)
    return np.tile([0.0, 0.0, turn / (count * STEP_S)], (count, 1))


def _check_duration(seconds: float) -> None:
    """Raise ValueError before a too long trajectory takes memory."""
    if not seconds <= MAX_DURATION_S:
        raise ValueError(f"lasts {seconds:.3g} s, expected a day ({MAX_DURATION_S:.0f} s) at most")


def load_trajectory(path: Path, speed: float) -> Trajectory:
    """Load a trajectory from a CSV or GPX file.

    A CSV file has the columns seconds, vx, vy, wz, or x, y (m). The points of a GPX file are
    projected to the tangent plane of the first one and turned so that the path begins along x.

    Args:
        path: Path of the file.
        speed: Speed for a file of points, m/s.

    Returns:
        The trajectory.

    Raises:
        ValueError: The file is unreadable or malformed; the message names it.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError(f"has more than {MAX_FILE_BYTES} bytes")
        read = _load_gpx if path.suffix.lower() == ".gpx" else _load_csv
        return read(path, speed)
    except OSError as error:
        shipped = ", ".join(sorted(file.stem for file in SHIPPED_FOLDER.glob("*.csv")))
        raise ValueError(
            f"{path}: {error.strerror}, expected a CSV or GPX file or one of {shipped}"
        ) from None
    except (ValueError, csv.Error, ElementTree.ParseError) as error:
        raise ValueError(f"{path}: {error}") from None


def read_table(path: Path) -> tuple[list[str], Array]:
    """Read a CSV file.

    Args:
        path: Path of the file.

    Returns:
        Column names, and numbers (k, columns).

    Raises:
        ValueError: The file is malformed.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = list(csv.reader(file))
    head = [name.strip() for name in rows[0]] if rows else []
    if head not in (["seconds", "vx", "vy", "wz"], ["x", "y"]):
        raise ValueError(f"has the head {','.join(head)!r}, expected seconds,vx,vy,wz or x,y")
    numbers = [_parse_numbers(row, line, len(head)) for line, row in enumerate(rows[1:], 2) if row]
    if not numbers:
        raise ValueError(f"has no row below its head, expected {len(head)} finite numbers in each")
    return head, np.array(numbers)


def _parse_numbers(row: list[str], line: int, count: int) -> list[float]:
    """Return the numbers of a row."""
    try:
        numbers = [float(cell) for cell in row]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"row {line} is {','.join(row)[:80]!r}, expected {count} finite numbers")
    return numbers


def _load_csv(path: Path, speed: float) -> Trajectory:
    """Return the trajectory of a CSV file."""
    head, numbers = read_table(path)
    if len(head) == 2:
        _check_leaps(numbers, _step_lengths(numbers))
        return Trajectory.from_points(numbers, speed)
    if (numbers[:, 0] <= 0.0).any():
        raise ValueError(
            "seconds: found a duration that is not above 0, expected how long each velocity holds"
        )
    return Trajectory.from_commands(numbers[:, 0], numbers[:, 1:])


def _parse_angles(point: ElementTree.Element, number: int) -> tuple[float, float]:
    """Return latitude and longitude of a point of a GPX file, deg."""
    texts = point.get("lat", "none"), point.get("lon", "none")
    try:
        lat, lon = map(float, texts)
    except ValueError:
        lat = lon = np.nan
    if not (abs(lat) <= 90.0 and abs(lon) <= 360.0):
        found = f"has point {number} at ({texts[0][:20]}, {texts[1][:20]})"
        raise ValueError(f"{found}, expected a lat within 90 and a lon within 360 degrees")
    return lat, lon


def _load_gpx(path: Path, speed: float) -> Trajectory:
    """Return the trajectory of a GPX file."""
    text = path.read_text(encoding="utf-8-sig")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("has a document type or entities, which no track needs")
    points = [
        e for e in ElementTree.fromstring(text).iter() if e.tag.rpartition("}")[2] in ("trkpt", "rtept")
    ]
    if len(points) < 2:
        raise ValueError(f"has {len(points)} points, expected 2 or more trkpt or rtept with lat and lon")
    angles = np.array([_parse_angles(point, number) for number, point in enumerate(points, 1)])
    directions = _unit_vectors(np.deg2rad(angles))
    chords = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    _check_leaps(angles, 2.0 * EARTH_RADIUS_M * np.arcsin(np.minimum(0.5 * chords, 1.0)))
    lat, lon = np.deg2rad(angles[0])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    places = EARTH_RADIUS_M * (directions - directions[0]) @ np.column_stack([east, north])
    is_track = points[0].tag.rpartition("}")[2] == "trkpt"
    return Trajectory.from_points(places, speed, RECEIVER_NOISE if is_track else TABLE_NOISE)


def _unit_vectors(angles: Array) -> Array:
    """Return unit vectors (n, 3) from the earth's centre to lat, lon (n, 2) in rad.

    They have no singularity at the poles and the date line.
    """
    lat, lon = angles.T
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def _step_lengths(places: Array) -> Array:
    """Return the distances of consecutive points (n, 2), m; infinite if they overflow."""
    with np.errstate(over="ignore"):
        return np.asarray(np.hypot(*np.diff(places, axis=0).T))


def _check_leaps(points: Array, steps: Array) -> None:
    """Raise ValueError that names the points between which a path leaps.

    Args:
        points: Points as in the file, (n, 2).
        steps: Distances between them, (n - 1,), m.
    """
    usual = float(np.median(steps[steps > SAME_POINT_M])) if (steps > SAME_POINT_M).any() else 0.0
    recorded = len(points) >= FEW_POINTS
    most = min(max(LEAP_STEPS * usual, LEAP_M), MAX_STEP_M) if recorded else MAX_STEP_M
    leaps = np.flatnonzero(steps > most)
    if not len(leaps):
        return
    k = leaps[0]
    more = f"; {len(leaps)} steps of the file are such leaps" if len(leaps) > 1 else ""
    raise ValueError(
        f"leaps {steps[k]:.6g} m from point {k + 1} at {_pair_text(points[k])} to point {k + 2} at {_pair_text(points[k + 1])}, "
        f"expected {most:.3g} m at most, as a usual step is {usual:.2g} m{more}; remove the wrong points, or fill the gap"
    )


def _pair_text(numbers: Array) -> str:
    return f"({numbers[0]:.9g}, {numbers[1]:.9g})"


class TrajectoryFollower:
    """Executes a trajectory from the pose of the robot at the first step."""

    def __init__(self, trajectory: Trajectory, closed: bool) -> None:
        """Start a trajectory.

        Args:
            trajectory: The trajectory.
            closed: Whether deviations of the odometry are corrected.
        """
        self._trajectory, self._closed = trajectory, closed
        self._start: Array | None = None

    def step(self, elapsed: float, pose: ArrayLike | None = None) -> Array | None:
        """Compute the command.

        Args:
            elapsed: Time since the start, s.
            pose: Pose of the robot, (3,): x, y in m, yaw in rad; required in closed loop.

        Returns:
            Command, (3,): vx, vy in m/s, wz in rad/s; None at the end.

        Raises:
            ValueError: The robot has deviated more than MAX_DEVIATION_M.
        """
        row = int(elapsed / STEP_S)
        if row >= len(self._trajectory.pose):
            return None
        velocity: Array = self._trajectory.velocity[row]
        if not self._closed:
            return velocity
        now = np.asarray(pose, float)
        if self._start is None:
            self._start = now
        x, y, yaw = _relative_pose(self._start, now)
        off = _relative_pose(np.array([x, y, yaw]), self._trajectory.pose[row])
        distance = np.hypot(*off[:2])
        if distance > MAX_DEVIATION_M:
            shown = np.ceil(100.0 * distance) / 100.0  # rounded up, so that it exceeds the limit, too
            raise ValueError(f"the robot is {shown:.2f} m off its way, expected {MAX_DEVIATION_M} m at most")
        return velocity + np.clip(CORRECTION_GAINS * off, -MAX_CORRECTION, MAX_CORRECTION)


def _relative_pose(frame: Array, pose: Array) -> Array:
    """Return `pose` (3,) relative to the pose `frame` (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    x, y = pose[:2] - frame[:2]
    turn = (pose[2] - frame[2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.array([c * x + s * y, -s * x + c * y, turn])
