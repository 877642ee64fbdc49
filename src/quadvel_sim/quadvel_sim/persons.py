"""Persons who walk through a world: mocap bodies of a MuJoCo model, moved by `Walker`. How legs swing is `walker`'s matter.

Each walks its way whatever happens around it, with one exception: with the robot close ahead it stands until the robot is gone.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_sim.laser import SEEN
from quadvel_sim.walker import Walker
from quadvel_sim.world import Person, World

Array = NDArray[np.float64]

PERIOD = 10  # ms, from one position of a person to the next
CLEAR = 0.5  # m, from a person to the robot's middle line ahead of it, below which it waits
FAR = 40.0  # m, from the robot, beyond which a person walks on in leaps of `LEAP`
LEAP = 0.5  # s
_HALF_ROBOT = 0.4  # m, of that line before and behind the trunk's origin
_HIPS, _SHOULDERS, _HEAD = 0.85, 1.45, 1.65  # m above the ground
_GIRTH, _SKULL = 0.14, 0.11  # m, radii
_CLOTHES = {True: (0.15, 0.65, 0.25, 1.0), False: (0.3, 0.4, 0.65, 1.0)}  # of who is led, of others
_SKIN = (0.85, 0.7, 0.6, 1.0)
_PARTS = ("body", "left", "right")


def name_of(index: int) -> str:
    """The person's name in a model."""
    return f"person_{index}"


def add_to(spec: mujoco.MjSpec, persons: Sequence[Person]) -> None:
    """Three mocap bodies for each: two legs, each a cylinder, and what is above them."""
    capsule, cylinder = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    for i, person in enumerate(persons):
        parts = {part: spec.worldbody.add_body(name=f"{name_of(i)}_{part}", mocap=True) for part in _PARTS}
        common = {"contype": 1, "conaffinity": 0, "group": SEEN}
        for part in _PARTS[1:]:
            size, middle = [person.radius, 0.5 * _HIPS, 0.0], [0.0, 0.0, 0.5 * _HIPS]
            name = f"{name_of(i)}_{part}"
            parts[part].add_geom(
                name=name, type=cylinder, size=size, pos=middle, rgba=(0.2, 0.2, 0.25, 1.0), **common
            )
        trunk = [0.0, 0.0, _HIPS, 0.0, 0.0, _SHOULDERS]
        clothes = _CLOTHES[person.led]
        parts["body"].add_geom(
            name=f"{name_of(i)}_body",
            type=capsule,
            size=[_GIRTH, 0.0, 0.0],
            fromto=trunk,
            rgba=clothes,
            **common,
        )
        parts["body"].add_geom(
            name=f"{name_of(i)}_head",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[_SKULL, 0.0, 0.0],
            pos=[0.0, 0.0, _HEAD],
            rgba=_SKIN,
            **common,
        )


@attrs.define
class _Actor:
    """One person: how it walks, and what it does next on its way."""

    person: Person
    walker: Walker
    stands_until: float = 0.0  # s
    stops_taken: int = 0
    speeds_taken: int = 0
    round: int = 0
    late: float = 0.0  # s, by which it is behind the time


class Persons:
    """All persons of a world in a model. Equal robots' ways give equal persons' ways."""

    def __init__(self, model: mujoco.MjModel, world: World) -> None:
        self._world = world
        self._mocap = np.array(
            [
                [model.body(f"{name_of(i)}_{part}").mocapid.item() for part in _PARTS]
                for i in range(len(world.persons))
            ],
            dtype=int,
        ).reshape(-1, len(_PARTS))
        self._actors: list[_Actor] = []
        self._places = np.zeros((len(world.persons), len(_PARTS), 2))  # body and legs, m
        self._time = 0.0

    def reset(self, data: mujoco.MjData) -> None:
        """Put everybody to where they begin."""
        self._time = 0.0
        self._actors = [_actor(person) for person in self._world.persons]
        self._place(data, list(range(len(self._actors))))

    def step(self, data: mujoco.MjData) -> None:
        """Walk on for a `PERIOD`; `data` has the robot's position in the first 7 of qpos."""
        dt = 1e-3 * PERIOD
        self._time += dt
        w, x, y, z = data.qpos[3:7]
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        robot, ahead = data.qpos[:2], np.array([np.cos(yaw), np.sin(yaw)])
        near = np.abs(self._places[:, 0] - robot).max(1) < FAR
        moved = []
        for i, actor in enumerate(self._actors):
            actor.late += dt
            if near[i] or actor.late >= LEAP:
                actor.walker.waiting = self._stands(actor) or _blocked(actor.walker, robot, ahead)
                actor.walker.step(actor.late)
                actor.late = 0.0
                moved.append(i)
        self._place(data, moved)

    @property
    def poses(self) -> Array:
        """Where they are and where they walk to, (n, 3): x, y in m, yaw in rad; who is led first."""
        return np.column_stack([self._places[:, 0], [actor.walker.heading for actor in self._actors]])

    @property
    def travelled(self) -> Array:
        """How far along their ways they are, rounds included, (n,), m."""
        return np.array([actor.walker.travelled for actor in self._actors])

    def _stands(self, actor: _Actor) -> bool:
        """Whether it stands now at one of its stops; takes up the speeds that it has come to."""
        person, walker = actor.person, actor.walker
        if walker.closed and walker.travelled >= (actor.round + 1) * walker.length:
            actor.round, actor.stops_taken, actor.speeds_taken = actor.round + 1, 0, 0
        along = walker.travelled - actor.round * walker.length
        while actor.speeds_taken < len(person.speeds) and along >= person.speeds[actor.speeds_taken][0]:
            walker.speed = person.speeds[actor.speeds_taken][1]
            actor.speeds_taken += 1
        if actor.stops_taken < len(person.stops) and along >= person.stops[actor.stops_taken][0]:
            actor.stands_until = self._time + person.stops[actor.stops_taken][1]
            actor.stops_taken += 1
        return self._time < actor.stands_until

    def _place(self, data: mujoco.MjData, which: list[int]) -> None:
        """Bring the bodies of these persons to where their walkers are."""
        if not which:
            return
        for i in which:
            walker = self._actors[i].walker
            self._places[i, 0], self._places[i, 1:] = walker.position, walker.legs[:, :2]
        places, mocap = self._places[which], self._mocap[which]
        data.mocap_pos[mocap, :2] = places
        data.mocap_pos[mocap, 2] = self._world.height(places[:, :1, 0], places[:, :1, 1])


def _actor(person: Person) -> _Actor:
    walker = Walker(
        person.path,
        speed=person.speed,
        pace=person.pace,
        radius=person.radius,
        apart=person.apart,
        travelled=person.begins_at,
        closed=person.closed,
    )
    return _Actor(person, walker, stops_taken=sum(at < person.begins_at for at, _ in person.stops))


def _blocked(walker: Walker, robot: Array, ahead: Array) -> bool:
    """Whether the robot, a line along `ahead` (2,) around `robot` (2,), is close before the person."""
    to_robot = robot - walker.position
    if abs(to_robot[0]) + abs(to_robot[1]) > 2.0 * (_HALF_ROBOT + CLEAR):
        return False
    along = min(max(-float(to_robot @ ahead), -_HALF_ROBOT), _HALF_ROBOT)
    nearest = to_robot + along * ahead
    towards = nearest @ [np.cos(walker.heading), np.sin(walker.heading)]
    return bool(towards > 0.0 and np.hypot(*nearest) < CLEAR)
