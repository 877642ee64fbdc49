"""Walking people in a world: mocap bodies of a MuJoCo model that are moved by `Walker`.

Each person follows its path and ignores its surroundings, with one exception: a person waits while
the robot is close ahead of it. `walker` models the gait.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import mujoco
import numpy as np

from quadvel_description.arrays import Array
from quadvel_sim.laser import LASER_VISIBLE_GROUP
from quadvel_sim.walker import Walker
from quadvel_sim.world import World
from quadvel_sim.world_parts import Person

UPDATE_PERIOD_MS = 10
"""Simulated time between two positions of a person."""
WAIT_DISTANCE_M = 0.5
"""Distance to the robot's centre line, ahead of a person, below which the person waits."""
COARSE_DISTANCE_M = 40.0
"""Distance from the robot beyond which a person is updated every `COARSE_PERIOD_S` only."""
COARSE_PERIOD_S = 0.5
_HALF_ROBOT_LENGTH_M = 0.4  # of the centre line, ahead of and behind the trunk's origin
_HIP_HEIGHT_M, _SHOULDER_HEIGHT_M, _HEAD_HEIGHT_M = 0.85, 1.45, 1.65  # m above the ground
_TORSO_RADIUS_M, _HEAD_RADIUS_M = 0.14, 0.11  # m, radii
_CLOTHES_RGBA = {True: (0.15, 0.65, 0.25, 1.0), False: (0.3, 0.4, 0.65, 1.0)}  # followed, others
_SKIN_RGBA = (0.85, 0.7, 0.6, 1.0)
_PARTS = ("body", "left", "right")


def person_name(index: int) -> str:
    """Return the name of a person in a model.

    Args:
        index: Index of the person in the world.

    Returns:
        Prefix of the person's body names.
    """
    return f"person_{index}"


def add_persons(spec: mujoco.MjSpec, persons: Sequence[Person]) -> None:
    """Add three mocap bodies per person: two legs (cylinders), and trunk with head.

    Args:
        spec: Model that is extended.
        persons: People of the world.
    """
    capsule, cylinder = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    for i, person in enumerate(persons):
        parts = {
            part: spec.worldbody.add_body(name=f"{person_name(i)}_{part}", mocap=True) for part in _PARTS
        }
        common = {"contype": 1, "conaffinity": 0, "group": LASER_VISIBLE_GROUP}
        for part in _PARTS[1:]:
            size, middle = [person.radius, 0.5 * _HIP_HEIGHT_M, 0.0], [0.0, 0.0, 0.5 * _HIP_HEIGHT_M]
            name = f"{person_name(i)}_{part}"
            parts[part].add_geom(
                name=name, type=cylinder, size=size, pos=middle, rgba=(0.2, 0.2, 0.25, 1.0), **common
            )
        trunk = [0.0, 0.0, _HIP_HEIGHT_M, 0.0, 0.0, _SHOULDER_HEIGHT_M]
        clothes = _CLOTHES_RGBA[person.led]
        parts["body"].add_geom(
            name=f"{person_name(i)}_body",
            type=capsule,
            size=[_TORSO_RADIUS_M, 0.0, 0.0],
            fromto=trunk,
            rgba=clothes,
            **common,
        )
        parts["body"].add_geom(
            name=f"{person_name(i)}_head",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[_HEAD_RADIUS_M, 0.0, 0.0],
            pos=[0.0, 0.0, _HEAD_HEIGHT_M],
            rgba=_SKIN_RGBA,
            **common,
        )


@attrs.define
class _Actor:
    """State of one person on its path."""

    person: Person
    walker: Walker
    stands_until: float = 0.0  # s, end of the present stop
    next_stop: int = 0
    next_speed: int = 0
    lap: int = 0
    pending_time: float = 0.0  # s, not yet simulated


class Persons:
    """All people of a world in a model; equal motion of the robot gives equal motion of them."""

    def __init__(self, model: mujoco.MjModel, world: World) -> None:
        """Find the mocap bodies of the people.

        Args:
            model: Model that `add_persons` has extended.
            world: World with the people.
        """
        self._world = world
        self._mocap = np.array(
            [
                [model.body(f"{person_name(i)}_{part}").mocapid.item() for part in _PARTS]
                for i in range(len(world.persons))
            ],
            dtype=int,
        ).reshape(-1, len(_PARTS))
        self._actors: list[_Actor] = []
        self._positions = np.zeros((len(world.persons), len(_PARTS), 2))  # body and legs, m
        self._time = 0.0

    def reset(self, data: mujoco.MjData) -> None:
        """Put everybody back to the start.

        Args:
            data: State of the model; the mocap positions are written.
        """
        self._time = 0.0
        self._actors = [_make_actor(person) for person in self._world.persons]
        self._write_positions(data, list(range(len(self._actors))))

    def step(self, data: mujoco.MjData) -> None:
        """Advance everybody by `UPDATE_PERIOD_MS`.

        Args:
            data: State of the model; the robot's pose is in the first 7 values of qpos, the mocap
                positions are written.
        """
        dt = 1e-3 * UPDATE_PERIOD_MS
        self._time += dt
        w, x, y, z = data.qpos[3:7]
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        robot, ahead = data.qpos[:2], np.array([np.cos(yaw), np.sin(yaw)])
        near = np.abs(self._positions[:, 0] - robot).max(1) < COARSE_DISTANCE_M
        moved = []
        for i, actor in enumerate(self._actors):
            actor.pending_time += dt
            if near[i] or actor.pending_time >= COARSE_PERIOD_S:
                actor.walker.waiting = self._is_at_stop(actor) or _is_robot_close_ahead(
                    actor.walker, robot, ahead
                )
                actor.walker.step(actor.pending_time)
                actor.pending_time = 0.0
                moved.append(i)
        self._write_positions(data, moved)

    @property
    def poses(self) -> Array:
        """Pose of each person, (n, 3): x, y in m, heading in rad; the followed person first."""
        return np.column_stack([self._positions[:, 0], [actor.walker.heading for actor in self._actors]])

    @property
    def travelled(self) -> Array:
        """Distance that each person has walked along its path, laps included, (n,), m."""
        return np.array([actor.walker.travelled for actor in self._actors])

    def _is_at_stop(self, actor: _Actor) -> bool:
        """Return whether the person stands at a stop now; update its lap, speed and next stop."""
        person, walker = actor.person, actor.walker
        if walker.closed and walker.travelled >= (actor.lap + 1) * walker.length:
            actor.lap, actor.next_stop, actor.next_speed = actor.lap + 1, 0, 0
        along = walker.travelled - actor.lap * walker.length
        while actor.next_speed < len(person.speeds) and along >= person.speeds[actor.next_speed][0]:
            walker.speed = person.speeds[actor.next_speed][1]
            actor.next_speed += 1
        if actor.next_stop < len(person.stops) and along >= person.stops[actor.next_stop][0]:
            actor.stands_until = self._time + person.stops[actor.next_stop][1]
            actor.next_stop += 1
        return self._time < actor.stands_until

    def _write_positions(self, data: mujoco.MjData, which: list[int]) -> None:
        """Move the mocap bodies of these people to the positions of their walkers."""
        if not which:
            return
        for i in which:
            walker = self._actors[i].walker
            self._positions[i, 0], self._positions[i, 1:] = walker.position, walker.legs[:, :2]
        places, mocap = self._positions[which], self._mocap[which]
        data.mocap_pos[mocap, :2] = places
        data.mocap_pos[mocap, 2] = self._world.height(places[:, :1, 0], places[:, :1, 1])


def _make_actor(person: Person) -> _Actor:
    """Return the state of a person at the start."""
    walker = Walker(
        person.path,
        speed=person.speed,
        pace=person.pace,
        radius=person.radius,
        apart=person.apart,
        travelled=person.begins_at,
        closed=person.closed,
    )
    return _Actor(person, walker, next_stop=sum(at < person.begins_at for at, _ in person.stops))


def _is_robot_close_ahead(walker: Walker, robot: Array, ahead: Array) -> bool:
    """Return whether the robot is close in front of a person.

    The robot is a line segment along `ahead` (2,) around `robot` (2,).
    """
    to_robot = robot - walker.position
    if abs(to_robot[0]) + abs(to_robot[1]) > 2.0 * (_HALF_ROBOT_LENGTH_M + WAIT_DISTANCE_M):
        return False
    along = min(max(-float(to_robot @ ahead), -_HALF_ROBOT_LENGTH_M), _HALF_ROBOT_LENGTH_M)
    nearest = to_robot + along * ahead
    towards = nearest @ [np.cos(walker.heading), np.sin(walker.heading)]
    return bool(towards > 0.0 and np.hypot(*nearest) < WAIT_DISTANCE_M)
