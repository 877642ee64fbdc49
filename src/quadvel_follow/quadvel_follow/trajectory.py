"""Ways that are written down, and walking them: in open loop, velocity over time, or closed on the odometry. No ROS."""

from __future__ import annotations

import csv
from pathlib import Path
from xml.etree import ElementTree

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

STEP = 0.02  # s, between the rows of a trajectory
EARTH = 6371008.8  # m, mean radius
LARGEST = 10_000_000  # bytes of a file
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

    @property
    def seconds(self) -> float:
        """That it lasts."""
        return len(self.pose) * STEP

    @classmethod
    def of_commands(cls, seconds: ArrayLike, commands: ArrayLike, step: float = STEP) -> Trajectory:
        """Velocities (k, 3), each for its seconds (k,), in rows of `step` (s)."""
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
    def of_places(cls, places: ArrayLike, speed: float) -> Trajectory:
        """Along places (k, 2), m, at `speed` (m/s), looking where it goes; corners are turned on the spot at 1 rad/s."""
        legs = np.diff(np.asarray(places, float), axis=0)
        legs = legs[np.hypot(*legs.T) > 1e-6]
        if not len(legs):
            raise ValueError("has one place, expected two at least")
        headings = np.arctan2(legs[:, 1], legs[:, 0])
        turns = (np.diff(headings, prepend=headings[0]) + np.pi) % (2.0 * np.pi) - np.pi
        lengths = np.hypot(*legs.T)
        seconds = np.column_stack([np.abs(turns), lengths / speed]).ravel()
        none, ahead = np.zeros(len(legs)), np.full(len(legs), speed)
        commands = (
            np.stack([[none, none, np.sign(turns)], [ahead, none, none]]).transpose(2, 0, 1).reshape(-1, 3)
        )
        # What rounding to whole steps leaves is put into the velocity.
        steps = np.maximum(np.rint(seconds / STEP), seconds > 0.0)
        commands = commands * np.where(steps > 0, seconds / np.maximum(steps * STEP, 1e-9), 0.0)[:, None]
        return cls.of_commands(steps * STEP, commands)


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
    except (OSError, ValueError, csv.Error, ElementTree.ParseError) as error:
        raise ValueError(f"{path}: {error}") from None


def read_table(path: Path) -> tuple[list[str], Array]:
    """The head and the numbers (k, columns) of a CSV file. Raises ValueError if it is no such table."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    head = [name.strip() for name in rows[0]] if rows else []
    if head not in (["seconds", "vx", "vy", "wz"], ["x", "y"]):
        raise ValueError(f"has the head {','.join(head)!r}, expected seconds,vx,vy,wz or x,y")
    numbers = np.array([[float(cell) for cell in row] for row in rows[1:] if row])
    if numbers.ndim != 2 or numbers.shape[1] != len(head) or not np.isfinite(numbers).all():
        raise ValueError(f"has rows that are not {len(head)} finite numbers")
    return head, numbers


def _csv(path: Path, speed: float) -> Trajectory:
    head, numbers = read_table(path)
    if len(head) == 2:
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
    angles = np.deg2rad([[float(e.get("lat", "nan")), float(e.get("lon", "nan"))] for e in points])
    if len(angles) < 2 or not np.isfinite(angles).all():
        raise ValueError("has less than two points with lat and lon")
    off = angles - angles[0]
    places = EARTH * np.column_stack([off[:, 1] * np.cos(angles[0, 0]), off[:, 0]])
    return Trajectory.of_places(places, speed)


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
