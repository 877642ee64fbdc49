"""The delays against MuJoCo's own delayed actuators: a pendulum moves the same with either."""

import attrs
import mujoco
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters, DelayPair
from tests.helpers.robots import ALIENGO

KP, KD = 30.0, 0.5
TARGET = 0.3 * np.sin(np.arange(600) * 0.02) * (np.arange(600) > 20)  # rad, at rest at first


def _pendulum(actuator: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="0.001" integrator="Euler"/>
          <worldbody>
            <body>
              <joint name="joint" axis="0 1 0"/>
              <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
            </body>
          </worldbody>
          <actuator>{actuator}</actuator>
        </mujoco>""")


def _model(input_delay: float, output_delay: float) -> ActuatorModel:
    pair = DelayPair(input_delay, output_delay, 0.0)
    parameters = attrs.evolve(ActuatorParameters.ideal(ALIENGO), pairs=(pair,), torque_limit=40.0)
    return ActuatorModel(parameters, (1,))


def _motion(actuator: str, model: ActuatorModel | None) -> np.ndarray:
    """Joint angle (rad) every ms; the control is the target, or the torque of `model`."""
    plant = _pendulum(actuator)
    data = mujoco.MjData(plant)
    angles = []
    for target in TARGET:
        data.ctrl[:] = target if model is None else model.step(data.qpos, data.qvel, target, KP, KD)
        mujoco.mj_step(plant, data)
        angles.append(data.qpos[0])
    return np.array(angles)


@pytest.mark.parametrize("delay", [0.001, 0.007, 0.0073])
def test_the_input_delay_is_that_of_a_position_servo_with_delay(delay):
    servo = f'<position joint="joint" kp="{KP}" kv="{KD}" delay="{delay}" nsample="12" interp="linear"/>'
    ours = _motion('<motor joint="joint"/>', _model(delay, 0.0))
    np.testing.assert_allclose(ours, _motion(servo, None), atol=1e-9)
    assert np.abs(ours - _motion('<motor joint="joint"/>', _model(delay + 1e-4, 0.0))).max() > 1e-5


@pytest.mark.parametrize("delay", [0.001, 0.002, 0.0013])
def test_the_output_delay_is_that_of_a_motor_with_delay(delay):
    motor = f'<motor joint="joint" delay="{delay}" nsample="5" interp="linear"/>'
    ours = _motion('<motor joint="joint"/>', _model(0.0, delay))
    np.testing.assert_allclose(ours, _motion(motor, _model(0.0, 0.0)), atol=1e-9)
    assert np.abs(ours - _motion('<motor joint="joint"/>', _model(0.0, delay + 1e-4))).max() > 1e-5
