"""Tests of worlds: laser, people, touches, and refused files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import mujoco
import numpy as np
import pytest
import yaml

from quadvel_description.kinematics import rotate, yaw
from quadvel_description.state import MODE_SERVO, JointCommand
from quadvel_eval.people.laser import FloorPlan
from quadvel_eval.robot_loop import RobotLoop, TrueVelocity
from quadvel_follow import PersonTracker
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim import Simulator, SimulatorConfig, Terrain, World
from quadvel_sim.laser import Laser
from quadvel_sim.persons import Persons
from quadvel_sim.simulator import build_model
from quadvel_sim.world import SHIPPED_WORLDS
from quadvel_sim.world_parts import Box, Hill, Patch, Person, Table, Trees, Wall
from tests.helpers.robots import ALIENGO

QUIET = {"noise": 0.0, "noise_share": 0.0, "lost": 0.0, "mixed": 0.0}
AT_TRUNK = Laser(position=(0.0, 0.0, 0.0), field_of_view=360.0, rays=720, range_max=30.0, **QUIET)


def standing(world: World, **config: Any) -> Simulator:
    """The robot in its nominal posture at the origin, time zero."""
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, world=world, **config))
    simulator.reset("stand")
    return simulator


def turned(simulator: Simulator, x: float, z: float, quaternion: list[float]) -> None:
    """Put the trunk there, at rest, joints in the nominal posture."""
    truth = attrs.evolve(
        simulator.truth(),
        position=np.array([x, 0.0, z]),
        quaternion=np.array(quaternion),
        linear_velocity=np.zeros(3),
        angular_velocity=np.zeros(3),
    )
    simulator.set_state(truth, ALIENGO.nominal_q, np.zeros(12))


def about_y(angle: float) -> list[float]:
    return [float(np.cos(0.5 * angle)), 0.0, float(np.sin(0.5 * angle)), 0.0]


def ranges_of(simulator: Simulator) -> np.ndarray:
    scan = simulator.scan()
    assert scan is not None
    return scan.ranges


def test_a_scan_is_what_a_floor_plan_of_the_world_gives() -> None:
    table = Table(position=[-2.0, 2.0], yaw=20.0)
    world = World(
        laser=AT_TRUNK,
        walls=[Wall(points=[[4.0, -3.0], [4.0, 3.0]], thickness=0.2)],
        trees=[Trees(positions=[[2.0, 1.0], [-1.5, -2.0]], radius=0.2)],
        tables=[table],
    )
    ranges = ranges_of(standing(world))
    circles = [[2.0, 1.0, 0.2], [-1.5, -2.0, 0.2], *([x, y, 0.025] for x, y in table.legs)]
    corners = np.array([[3.9, -3.1], [4.1, -3.1], [4.1, 3.1], [3.9, 3.1]])
    plan = FloorPlan(circles, np.hstack([corners, np.roll(corners, -1, 0)]))
    np.testing.assert_allclose(ranges, plan.cast([0.0, 0.0], AT_TRUNK.scanner.angles), atol=1e-9)
    assert ranges[360] == pytest.approx(3.9)  # straight ahead
    assert np.isfinite(ranges).sum() > 150


def test_a_laser_on_the_trunk_is_turned_and_moved_as_it_is_mounted() -> None:
    mounted = attrs.evolve(AT_TRUNK, position=(0.3, 0.1, 0.05), rotation=(0.0, 0.0, 90.0))
    world = World(laser=mounted, walls=[Wall(points=[[-9.0, 3.05], [9.0, 3.05]])])
    assert ranges_of(standing(world))[360] == pytest.approx(3.0 - 0.1)


def test_a_trunk_that_pitches_by_10_degrees_sees_the_ground_and_only_before_it() -> None:
    simulator = standing(World(laser=attrs.evolve(AT_TRUNK, position=(0.2, 0.0, 0.1))))
    pitch, trunk = np.radians(10.0), 0.45
    turned(simulator, 0.0, trunk, about_y(pitch))
    height = trunk - 0.2 * np.sin(pitch) + 0.1 * np.cos(pitch)
    ranges = ranges_of(simulator)
    assert ranges[360] == pytest.approx(height / np.sin(pitch))
    angles = AT_TRUNK.scanner.angles
    down = np.sin(pitch) * np.cos(angles)
    with np.errstate(divide="ignore"):
        ground = np.where(down > 0.0, height / down, np.inf)
    np.testing.assert_allclose(ranges, np.where(ground < 30.0, ground, np.inf), rtol=1e-6)


def test_a_scan_is_due_once_a_period_and_the_robot_is_not_in_it() -> None:
    simulator = standing(
        World(laser=attrs.evolve(AT_TRUNK, rate=40.0, position=(0.0, 0.0, -0.2))), suspended=True
    )
    times = []
    for _ in range(40):
        if (scan := simulator.scan()) is not None:
            times.append(scan.time)
            assert np.isinf(scan.ranges).all()
        simulator.step(5)
    np.testing.assert_allclose(times, 0.025 * np.arange(8))


def test_readings_have_the_faults_that_were_asked_for() -> None:
    laser = attrs.evolve(AT_TRUNK, rays=4000, field_of_view=60.0, noise=0.02, lost=0.1)
    ranges = ranges_of(standing(World(laser=laser, walls=[Wall(points=[[5.05, -9.0], [5.05, 9.0]])])))
    seen = np.isfinite(ranges)
    assert np.mean(~seen) == pytest.approx(0.1, abs=0.02)
    errors = (ranges - 5.0 / np.cos(laser.scanner.angles))[seen]
    assert np.std(errors) == pytest.approx(0.02, rel=0.1)
    assert abs(np.mean(errors)) < 0.002


def seen_of(seed: int, look: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return last scan, people and the robot's state after 0.2 s in the corridor."""
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, world=World.load("corridor"), seed=seed))
    for _ in range(4):
        if look:
            simulator.scan()
            simulator.persons()
        simulator.step(50)
    return ranges_of(simulator), simulator.persons(), simulator.data.qpos.copy()


def test_equal_seeds_see_and_walk_the_same_whoever_looks_and_others_have_other_noise() -> None:
    first, again, other = seen_of(0, look=True), seen_of(0, look=False), seen_of(1, look=True)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first[1], other[1])
    assert (first[0] != other[0]).any()


def test_persons_are_tracked_where_they_are() -> None:
    persons = [
        Person(way=[[2.0, -2.0], [2.5, 3.0]], led=True, speed=0.9),
        Person(way=[[5.0, 2.0], [3.0, -3.0]], pace=0.2),
    ]
    laser = Laser(field_of_view=180.0, rays=540)
    world = World(laser=laser, persons=persons, trees=[Trees(positions=[[4.0, 3.5], [3.0, -4.0]])])
    simulator, tracker, errors = Simulator(SimulatorConfig(robot=ALIENGO, world=world)), PersonTracker(), []
    offset = world.laser.position
    for k in range(60):
        scan, truth = simulator.scan(), simulator.truth()
        assert scan is not None
        place = truth.position + rotate(truth.quaternion, offset)
        pose = [place[0], place[1], float(yaw(truth.quaternion))]
        tracks = tracker.update(scan.time, scan.ranges, scan.angle_min, scan.angle_increment, pose)
        found = np.array([track.position for track in tracks if track.confirmed]).reshape(-1, 2)
        if k >= 30:
            errors += [
                np.hypot(*(found - person[:2]).T).min(initial=np.inf) for person in simulator.persons()
            ]
        simulator.step(50)
    assert np.quantile(errors, 0.9) < 0.1


def test_a_person_waits_before_the_robot_and_goes_on_once_it_is_gone() -> None:
    world = World(persons=[Person(way=[[2.0, 0.0], [-4.0, 0.0]], speed=1.5)])
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, world=world))
    simulator.step(2000)
    x = simulator.persons()[0, 0]
    assert 0.4 + 0.45 < x < 0.4 + 0.51
    turned(simulator, 5.0, 1.0, about_y(0.0))
    simulator.step(200)
    assert simulator.persons()[0, 0] < x - 0.1
    assert not simulator.touch_counts


def test_a_person_walks_rounds_with_its_stops_and_paces() -> None:
    square = [[2.0, 0.0], [6.0, 0.0], [6.0, 4.0], [2.0, 4.0]]
    person = Person(
        way=square,
        closed=True,
        speed=1.0,
        stops=[[4.0, 2.0]],
        speeds=[[8.0, 0.5], [0.0, 1.0]][::-1],
        turn=0.0,
    )
    world = World(persons=[person])
    model = build_model(SimulatorConfig(robot=ALIENGO, world=world))
    data, persons = mujoco.MjData(model), Persons(model, world)
    persons.reset(data)
    seconds = 4 + 2 + 4 + 16 + 3  # to the stop, the stop, on, slowly, and three metres of the next round
    for _ in range(100 * seconds):
        persons.step(data)
    assert persons.travelled[0] == pytest.approx(16.0 + 3.0, abs=0.1)
    np.testing.assert_allclose(persons.poses[0], [5.0, 0.0, 0.0], atol=0.1)


def test_the_height_of_the_ground_is_where_a_vertical_ray_hits_it() -> None:
    hill = Hill(position=[6.0, 1.0], size=[8.0, 6.0], height=0.5, slope=15.0, sides=30.0, yaw=40.0)
    world = World(hills=[hill])
    simulator = standing(world)
    simulator.truth()
    points = np.random.default_rng(0).uniform([1.0, -4.0], [11.0, 6.0], (200, 2))
    geom = np.zeros(1, dtype=np.int32)
    groups = np.array([0, 0, 1, 0, 0, 0], dtype=np.uint8)
    hits = [
        9.0
        - mujoco.mj_ray(simulator.model, simulator.data, [x, y, 9.0], [0.0, 0.0, -1.0], groups, 1, -1, geom)
        for x, y in points
    ]
    np.testing.assert_allclose(world.height(*points.T), hits, atol=1e-6)
    assert np.max(hits) == pytest.approx(0.5)


def hold(simulator: Simulator, seconds: float) -> None:
    """Hold the nominal posture, firmly."""
    command = JointCommand(
        q=ALIENGO.nominal_q,
        dq=np.zeros(12),
        tau=np.zeros(12),
        kp=np.full(12, 120.0),
        kd=np.full(12, 2.0),
        mode=MODE_SERVO,
        tick=0,
    )
    for _ in range(round(seconds / 0.005)):
        simulator.command(command)
        simulator.step(5)


def on_slope(simulator: Simulator, degrees: float, x: float) -> None:
    """Put the robot onto a slope that rises along x from the origin."""
    slope = np.radians(degrees)
    turned(simulator, x, x * np.tan(slope) + ALIENGO.nominal_height / np.cos(slope), about_y(-slope))


def test_a_hill_carries_the_robot_as_an_endless_slope_does() -> None:
    hill = Hill(position=[10.0, 0.0], size=[20.0, 10.0], height=1.0, slope=15.0)
    plane = Simulator(SimulatorConfig(robot=ALIENGO, terrain=Terrain("slope", slope=np.radians(15.0))))
    found = []
    for simulator in (standing(World(hills=[hill])), plane):
        on_slope(simulator, 15.0, 1.8)
        hold(simulator, 0.1)
        found.append(simulator.truth())
        assert not simulator.touch_counts
    assert found[0].contact.all()
    np.testing.assert_allclose(found[0].position, found[1].position, atol=1e-4)
    np.testing.assert_allclose(found[0].contact_force, found[1].contact_force, atol=1.0)


def test_the_robot_stands_on_a_slope_of_15_degrees_under_its_policy() -> None:
    hill = Hill(position=[10.0, 0.0], size=[20.0, 10.0], height=1.0, slope=15.0)
    simulator = standing(World(hills=[hill]))
    on_slope(simulator, 15.0, 1.8)
    loop = RobotLoop(simulator, Supervisor(ALIENGO, PolicyFile(ALIENGO)), TrueVelocity(simulator))
    loop.start_walking()
    before = simulator.truth()
    samples = [loop.tick() for _ in range(200)]
    assert not any(sample.fallen for sample in samples)
    assert np.hypot(*(simulator.truth().position - before.position)[:2]) < 0.2


def test_a_patch_has_the_friction_of_its_surface_and_bumps_above_the_ground() -> None:
    heights = []
    for friction, bumps in ((0.9, 0.05), (0.1, 0.006)):
        patch = Patch(surface="grass", position=[0.0, 0.0], size=[6.0, 6.0], friction=friction, bumps=bumps)
        simulator = standing(World(patches=[patch]))
        turned(simulator, 0.0, ALIENGO.nominal_height + bumps, about_y(0.0))
        hold(simulator, 0.5)
        contact = simulator.data.contact
        assert np.allclose(contact.friction[:, 0], friction)
        heights.append(contact.pos[:, 2].max())
    assert 0.006 < heights[0] < 0.05
    assert heights[1] < 0.01


def test_what_the_robot_touches_is_counted_by_name_and_pushes_back() -> None:
    world = World(boxes=[Box(position=[0.3235 + 0.25 - 0.004, 0.0], size=[0.5, 0.5, 1.0])])
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, world=world))
    simulator.step(300)
    assert dict(simulator.touch_counts) == {"box_0": 1}
    assert simulator.truth().position[0] < -0.001
    assert not simulator.fallen
    simulator.reset()
    assert not simulator.touch_counts


def test_without_a_world_there_is_no_scan_and_nobody() -> None:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO))
    with pytest.raises(ValueError, match="scan: found no world"):
        simulator.scan()
    assert simulator.persons().shape == (0, 3)


def test_a_world_brings_its_own_ground() -> None:
    with pytest.raises(ValueError, match=r"SimulatorConfig.terrain: found 'rough' in a world"):
        SimulatorConfig(robot=ALIENGO, world=World(), terrain=Terrain("rough"))


@pytest.mark.parametrize("name", SHIPPED_WORLDS)
def test_a_shipped_world_leads_a_person_who_walks_where_nothing_stands(name: str) -> None:
    world = World.load(name)
    led, *others = world.persons
    assert led.led
    assert others
    way = np.vstack([led.path, led.path[:1]]) if led.closed else led.path
    length = np.hypot(*np.diff(way, axis=0).T)
    if name == "campus":
        assert led.closed
        assert 600.0 < length.sum() < 1000.0
        assert max(hill.slope for hill in world.hills) == 15.0
        assert {patch.surface for patch in world.patches} == {"grass", "gravel"}
    begins = np.concatenate([[0.0], np.cumsum(length)])
    along = np.arange(0.0, begins[-1], 0.25)
    places = np.column_stack([np.interp(along, begins, way[:, k]) for k in (0, 1)])
    for trees in world.trees:
        gaps = np.linalg.norm(places[:, None] - trees.positions[None], axis=2) - trees.radius
        assert gaps.min() > 0.8
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, world=world))
    simulator.step(100)
    assert not simulator.touch_counts
    assert np.hypot(*simulator.persons()[0, :2]) < 2.5


REFUSED = {
    "no mapping": ([1], r"found \[1\], expected fields"),
    "no schema": ({}, r"schema: found None, expected 1"),
    "unknown part": (
        {"schema": 1, "wals": []},
        r"found the field 'wals', expected one of name, seed",
    ),
    "no list": ({"schema": 1, "walls": 3}, r"walls: found 3, expected a list"),
    "missing field": ({"schema": 1, "walls": [{}]}, r"walls\[0\]\.points: found nothing"),
    "one point": (
        {"schema": 1, "walls": [{"points": [[1, 2]]}]},
        r"Wall.points: found .*, expected 2 or more",
    ),
    "a word": (
        {"schema": 1, "boxes": [{"position": [0, 0], "size": [1, 1, 1], "yaw": "north"}]},
        r"boxes\[0\]\.yaw: found 'north', expected a number",
    ),
    "too steep": (
        {"schema": 1, "hills": [{"position": [9, 0], "size": [8, 8], "height": 0.2, "slope": 16}]},
        r"hills\[0\]: Hill.slope: found 16.0, expected 1 to 15",
    ),
    "too high": (
        {"schema": 1, "hills": [{"position": [9, 0], "size": [8, 8], "height": 2, "slope": 10}]},
        r"Hill.height: found 2, expected at most 0.691",
    ),
    "hill at the start": (
        {"schema": 1, "hills": [{"position": [0, 0], "size": [8, 8], "height": 0.2, "slope": 10}]},
        r"hills: found one at the origin",
    ),
    "surface": (
        {"schema": 1, "patches": [{"surface": "ice", "position": [0, 0], "size": [2, 2]}]},
        r"patches\[0\]: Patch.surface: found 'ice', expected one of grass, gravel",
    ),
    "rate": (
        {"schema": 1, "laser": {"rate": 30}},
        r"laser: Laser.rate: found 30 Hz, expected .* 10, 20, 25, 40",
    ),
    "too fast": ({"schema": 1, "laser": {"rate": 50}}, r"Laser.rate: found 50.0, expected 10 to 40"),
    "stops": (
        {"schema": 1, "persons": [{"way": [[0, 1], [2, 3]], "stops": [3]}]},
        r"persons\[0\]\.stops\[0\]: found 3, expected a list",
    ),
    "two led": (
        {"schema": 1, "persons": [{"way": [[0, 1], [2, 3]], "led": True}] * 2},
        r"persons: found `led` at indices \[0, 1\], expected index 0 or none",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_holds_no_world_is_refused_by_file_field_and_value(case: str, tmp_path: Path) -> None:
    content, expected = REFUSED[case]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=rf"mine\.yaml: .*{expected}"):
        World.load(path)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"trees": [Trees(positions=[[float(k), 5.0] for k in range(100_000)])]}, "100000 parts"),
        ({"walls": [Wall(points=[[float(k), 5.0] for k in range(100_000)])]}, "99999 parts"),
        ({"boxes": [Box(position=(5.0, 0.0), size=1.0)] * 3_000}, "3000 parts"),
        ({"tables": [Table(position=(5.0, 0.0))] * 500}, "2500 parts"),
        ({"persons": [Person(way=[[1.0, 1.0], [2.0, 2.0]])] * 60}, "60 persons"),
        ({"patches": [Patch(surface="grass", position=(0.0, 0.0), size=(1e5, 1e5))]}, "points of bumps"),
    ],
)
def test_a_world_of_too_many_parts_is_refused_before_it_is_built(parts: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"found .*{words}.*, expected [0-9]+ at most"):
        World(**parts)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"world nowhere: .* expected a YAML file or one of corridor, park, campus"
    ):
        World.load("nowhere")
    (tmp_path / "bad.yaml").write_text("a: [")
    with pytest.raises(ValueError, match=r"bad.yaml: no valid YAML"):
        World.load(tmp_path / "bad.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"binary.yaml: no text"):
        World.load(tmp_path / "binary.yaml")


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        ({"boxes": (Box(position=np.zeros(2), size=np.array([0.5, 0.5, 1.0])),)}, "box_0"),
        ({"walls": (Wall(points=np.array([[-1.0, 0.0], [1.0, 0.0]])),)}, "wall_0"),
    ],
)
def test_an_obstacle_where_the_robot_starts_is_refused_by_name(parts: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}.* where the robot starts"):
        Simulator(SimulatorConfig(robot=ALIENGO, world=World(**parts)))


def test_an_empty_file_is_said_to_hold_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("")
    with pytest.raises(ValueError, match=r"empty\.yaml: found nothing, expected fields with their values"):
        World.load(tmp_path / "empty.yaml")
