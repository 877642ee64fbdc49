from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from quadvel_eval.robot_loop import RobotLoop
from quadvel_eval.walk import (
    Setup,
    cost_of_transport,
    dead_reckoning_error,
    drive_power,
    jitter,
    make_simulator,
    record_until_fall,
    record_walk,
)

G = 9.81


def test_power_counts_heat_and_work_and_gives_nothing_back() -> None:
    torque, speed = np.zeros(12), np.zeros(12)
    torque[:3], speed[:3] = [10.0, -5.0, 2.0], [1.0, -2.0, -9.0]
    # 0.2 * 100 + 10; 0.2 * 25 + 10; 0.2 * 4 - 18 < 0
    assert drive_power(torque, speed) == pytest.approx(30.0 + 15.0)
    assert drive_power(np.tile(torque, (7, 1)), speed).shape == (7,)


@pytest.mark.parametrize(
    ("command", "mean", "pace"),
    [
        ((1.0, 0.0, 0.0), (0.5, 0.3, 0.2), 0.5),
        ((0.0, -1.0, 0.0), (0.5, -0.3, 0.0), 0.3),
        ((3.0, 4.0, 1.0), (1.0, 1.0, 0.0), 1.4),
        ((0.0, 0.0, -1.0), (0.1, 0.0, -0.5), 0.555 * 0.5),
    ],
)
def test_cost_of_transport_follows_the_commanded_direction(
    command: tuple[float, ...], mean: tuple[float, ...], pace: float
) -> None:
    cost = cost_of_transport(200.0, 25.0, np.array(command), np.array(mean))
    assert cost == pytest.approx(200.0 / (25.0 * G * pace))


@pytest.mark.parametrize("command", [(0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_no_cost_of_transport_where_the_robot_does_not_go_where_it_should(command: tuple[float, ...]) -> None:
    assert cost_of_transport(200.0, 25.0, np.array(command), np.array([0.2, 0.0, -0.1])) is None


def test_jitter_of_a_parabola_is_its_second_difference_and_of_a_line_zero() -> None:
    k = np.arange(50.0)
    assert jitter(np.tile((0.5 * 0.01 * k**2)[:, None], (1, 12))) == pytest.approx(0.01)
    assert jitter(np.tile(3.0 * k[:, None], (1, 12))) == pytest.approx(0.0)


def test_drift_is_the_distance_of_integrated_and_true_position() -> None:
    time = np.arange(201) * 0.005
    position = np.column_stack([np.sin(time), time, 0.1 * time])  # 1 s
    velocity = np.column_stack([np.cos(time) + 0.03, np.full(201, 1.0 - 0.04), np.full(201, 9.0)])
    assert dead_reckoning_error(velocity, position) == pytest.approx(0.05, abs=1e-4)


def test_a_standing_robot_is_recorded_from_the_first_command_on(make_loop: Callable[..., RobotLoop]) -> None:
    walk = record_walk(make_loop(), [((0.0, 0.0, 0.0), 0.3), ((0.1, 0.0, 0.0), 0.2)])
    assert walk is not None
    np.testing.assert_allclose(walk.time, np.arange(100) * 0.005, atol=1e-9)
    assert walk.targets.shape == (100, 12)
    assert np.abs(walk.velocity).max() < 0.2
    assert np.abs(walk.estimate_errors["kalman"]).max() < 0.2
    assert walk.estimate_drifts["kalman"] < 0.01
    assert walk.power.min() > 0.0


def test_a_robot_that_falls_leaves_no_walk(make_loop: Callable[..., RobotLoop]) -> None:
    loop = make_loop()
    loop.simulator.push("trunk", (0.0, 600.0, 0.0), duration=0.4)
    assert record_walk(loop, [((0.5, 0.0, 0.0), 3.0)]) is None


def test_seeds_draw_the_plant_only_if_randomised() -> None:
    def friction(randomised: bool, seed: int) -> list[float]:
        return make_simulator(Setup(randomised=randomised), seed).config.friction.tolist()

    assert friction(False, 1) == friction(False, 2) == [0.8] * 4
    assert len({*friction(True, 1), *friction(True, 2)}) == 8
    assert friction(True, 1) == friction(True, 1)


@pytest.mark.parametrize("terrain", ["flat", "rough", "slope"])
def test_the_robot_starts_on_its_feet_on_every_terrain(terrain: str) -> None:
    simulator = make_simulator(Setup(terrain=terrain), seed=1)
    assert simulator.config.terrain.kind == terrain
    assert not simulator.fallen


def test_an_unknown_terrain_is_refused() -> None:
    with pytest.raises(ValueError, match="sand"):
        Setup(terrain="sand")


def test_given_plant_fields_override_drawn_ones() -> None:
    config = make_simulator(Setup(randomised=True, plant={"payload": 4.0}), seed=1).config
    assert config.payload == 4.0
    assert config.friction.tolist() == make_simulator(Setup(randomised=True), seed=1).config.friction.tolist()


def test_a_walk_is_kept_up_to_the_fall(make_loop: Callable[..., RobotLoop]) -> None:
    loop = make_loop()
    loop.simulator.push("trunk", (0.0, 600.0, 0.0), duration=0.4)
    walk, stood = record_until_fall(loop, [((0.0, 0.0, 0.0), 3.0)])
    assert not stood
    assert walk is not None
    assert 0.1 < walk.time[-1] < 2.0
    assert walk.torque.shape == walk.joint_velocity.shape == (len(walk.time), 12)
    assert walk.contact[0].all()
    assert not walk.contact[-1].all()
