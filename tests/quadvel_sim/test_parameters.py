"""Tests of the node's parameters: the resulting simulation, and refused values."""

from pathlib import Path

import numpy as np
import pytest

from quadvel_actuator import ActuatorParameters
from quadvel_sim.config import SensorNoise
from quadvel_sim.parameters import SimParameters
from quadvel_sim.terrain import Terrain
from tests.helpers.robots import ALIENGO


def test_by_default_they_are_the_nominal_robot() -> None:
    config = SimParameters().config()
    assert (config.terrain, config.noise, config.actuator) == (
        Terrain(),
        SensorNoise(),
        ActuatorParameters.of(ALIENGO),
    )
    np.testing.assert_array_equal(config.friction, 0.8)
    assert SimParameters().period == 5


def test_a_slope_for_which_none_is_given_has_10_degrees() -> None:
    assert SimParameters(terrain="slope").config().terrain.slope == pytest.approx(np.radians(10.0), abs=0.001)
    assert SimParameters(terrain="slope", slope=-0.1).config().terrain.slope == -0.1
    assert SimParameters(terrain="rough").config().terrain.slope == 0.0


def test_each_reaches_the_record_that_it_belongs_to(tmp_path: Path) -> None:
    file = tmp_path / "actuator.yaml"
    ActuatorParameters.ideal(ALIENGO).save(file)
    config = SimParameters(
        seed=4,
        actuator_file=str(file),
        terrain="rough",
        slope=0.1,
        roughness=0.03,
        wavelength=0.8,
        terrain_seed=9,
        friction=(0.5,),
        payload=2.0,
        payload_position=(0.1, 0.0, 0.2),
        hung=True,
        watchdog=0.05,
        watchdog_kd=2.0,
        noise_q=0.0,
        noise_dq=0.1,
        noise_angular_velocity=0.2,
        noise_linear_acceleration=0.3,
        noise_orientation=0.4,
    ).config()
    assert config.terrain == Terrain("rough", slope=0.1, roughness=0.03, wavelength=0.8, seed=9)
    assert config.noise == SensorNoise(0.0, 0.1, 0.2, 0.3, 0.4)
    assert config.actuator == ActuatorParameters.ideal(ALIENGO)
    assert (config.seed, config.payload, config.watchdog, config.watchdog_kd) == (4, 2.0, 0.05, 2.0)
    assert config.suspended
    np.testing.assert_array_equal(config.friction, 0.5)
    np.testing.assert_array_equal(config.payload_position, [0.1, 0.0, 0.2])


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"mode": "slow"}, "mode: found 'slow', expected one of realtime, lockstep, fast"),
        ({"state_rate": 300}, "state_rate is 300 Hz, expected a divisor of 1000, 50 at least"),
        ({"state_rate": 0}, "state_rate is 0 Hz, expected a divisor of 1000, 50 at least"),
        ({"answer_timeout": 0.0}, "answer_timeout is 0.0 s, expected a time above 0"),
        ({"terrain": "moon"}, "SimParameters.terrain: found 'moon', expected one of flat, slope, rough"),
        ({"friction": (0.5, 0.4)}, "SimulatorConfig.friction: found shape"),
        (
            {"actuator_file": "nowhere.yaml"},
            "actuator_file: cannot read nowhere.yaml: No such file",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(fields: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SimParameters(**fields).config()
