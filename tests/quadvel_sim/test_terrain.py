"""Tests of the ground: the function equals MuJoCo's geom, and rough ground has its parameters."""

import mujoco
import numpy as np
import pytest

from quadvel_sim import Terrain
from quadvel_sim.terrain import perlin

TERRAINS = {
    "flat": Terrain(),
    "a ramp of 0 degrees": Terrain("slope", level=1.0),
    "uphill": Terrain("slope", slope=0.3),
    "downhill": Terrain("slope", slope=-0.2),
    "rough": Terrain("rough", size=8.0, seed=3),
    "rough slope": Terrain("rough", slope=0.15, size=8.0, seed=4),
    "hills": Terrain("rough", hills=1.0, size=8.0, seed=5),
    "slope to the left": Terrain("slope", slope=0.3, direction=0.5 * np.pi),
    "slope askew": Terrain("slope", slope=-0.3, direction=-2.5),
    "ramp up": Terrain("slope", slope=0.3, level=1.0, size=8.0),
    "ramp down, to the right": Terrain("slope", slope=-0.3, direction=-0.5 * np.pi, level=1.0, size=8.0),
}


def model_of(terrain: Terrain) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.add_material(name="ground")
    terrain.add_to(spec)
    return spec.compile()


@pytest.mark.parametrize("name", TERRAINS)
def test_height_is_where_a_vertical_ray_hits_the_ground(name: str) -> None:
    terrain = TERRAINS[name]
    model = model_of(terrain)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points = np.random.default_rng(0).uniform(-3.9, 3.9, (500, 2))
    geom = np.zeros(1, dtype=np.int32)
    hits = [
        20.0 - mujoco.mj_ray(model, data, [x, y, 20.0], [0.0, 0.0, -1.0], None, 1, -1, geom)
        for x, y in points
    ]
    np.testing.assert_allclose(terrain.height(points[:, 0], points[:, 1]), hits, atol=1e-6)


@pytest.mark.parametrize("name", TERRAINS)
def test_tilt_is_the_orientation_of_the_ground_at_the_origin(name: str) -> None:
    terrain = TERRAINS[name]
    up = np.zeros(3)
    mujoco.mju_rotVecQuat(up, [0.0, 0.0, 1.0], terrain.tilt)
    rise = [terrain.height(0.1, 0.0) / 0.1, terrain.height(0.0, 0.1) / 0.1]
    assert -up[:2] / up[2] == pytest.approx(rise, abs=1e-9)


def test_a_ramp_begins_after_level_ground_and_rises_along_its_direction() -> None:
    ramp = Terrain("slope", slope=np.radians(20.0), direction=0.5 * np.pi, level=1.0)
    np.testing.assert_allclose(ramp.height(3.0, [-2.0, 0.0, 1.0]), 0.0, atol=1e-12)
    assert ramp.height(-1.0, 2.5) == pytest.approx(1.5 * np.tan(np.radians(20.0)))


def test_rough_ground_is_bounded_and_fills_its_bound() -> None:
    terrain = Terrain("rough", roughness=0.08, size=20.0)
    axis = np.linspace(-10.0, 10.0, 801)
    heights = terrain.height(*np.meshgrid(axis, axis))
    assert 0.9 * 0.08 < np.abs(heights).max() <= 0.08
    assert abs(heights.mean()) < 0.005


def test_hills_are_far_apart_under_the_noise() -> None:
    x = np.linspace(-19.0, 19.0, 3801)
    hills, alone = (Terrain("rough", roughness=0.04, hills=h).height(x, 2.0) for h in (1.5, 0.0))
    np.testing.assert_array_less(np.abs(hills), 1.54)
    assert np.ptp(hills) > 0.75
    steepness = np.degrees(np.arctan(np.gradient(hills - alone, x)))
    assert 8.0 < np.abs(steepness).max() < 35.0


def test_equal_seeds_give_equal_ground_and_others_another() -> None:
    x = np.linspace(-3.5, -1.5, 50)
    heights = [Terrain("rough", size=8.0, seed=seed).height(x, x) for seed in (5, 5, 6)]
    np.testing.assert_array_equal(heights[0], heights[1])
    assert np.abs(heights[0] - heights[2]).max() > 0.02


def test_rough_ground_is_level_where_the_robot_is_put_down() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    heights = Terrain("rough", size=8.0).height(0.42 * np.cos(angle), 0.42 * np.sin(angle))
    np.testing.assert_array_equal(heights, 0.0)


def test_perlin_noise_vanishes_on_its_lattice_and_is_smooth_between() -> None:
    column, row = np.meshgrid(np.arange(20.0), np.arange(20.0))
    np.testing.assert_allclose(perlin(0.7 * column, 0.7 * row, 0.7, seed=1), 0.0, atol=1e-12)
    x = np.linspace(0.0, 10.0, 20001)
    noise = perlin(x, np.full_like(x, 3.3), 0.7, seed=1)
    slope = np.gradient(noise, x)
    assert np.abs(np.diff(slope)).max() < 0.05  # no kink where cells meet
    assert np.abs(slope).max() > 0.5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"kind": "hilly"}, "Terrain.kind: found 'hilly', expected one of flat, slope, rough"),
        ({"slope": 0.1}, "Terrain.slope: found 0.1 rad with kind 'flat', expected 0"),
        ({"kind": "slope", "slope": float("nan")}, "Terrain.slope: found nan, expected -0.8 to 0.8"),
        ({"kind": "rough", "roughness": 0.0}, "Terrain.roughness: found 0.0, expected 0.001 to 1"),
        ({"kind": "rough", "seed": -1}, "Terrain.seed: found -1, expected a whole number, at least 0"),
    ],
)
def test_bad_ground_is_refused_by_name(arguments: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        Terrain(**arguments)


def test_the_ground_that_people_see_is_the_ground_that_carries() -> None:
    terrain = Terrain(kind="rough", seed=3)
    corners = terrain.triangles(4.0, 0.5)
    assert corners.shape == (8 * 8 * 2 * 3, 3)
    assert corners[:, 2] == pytest.approx(terrain.height(corners[:, 0], corners[:, 1]))
    first, second, third = corners.reshape(-1, 3, 3).transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    assert (normals[:, 2] > 0.0).all()  # seen from above
    assert np.abs(normals[:, 2]).sum() / 2 == pytest.approx(16.0)
