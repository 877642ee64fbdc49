"""`ActuatorModel.peek` predicts the next torque and does not change later ones."""

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters, DelayPair
from tests.helpers.robots import ALIENGO

STEPS = 2000


def parameters(input_delay: float, output_delay: float) -> ActuatorParameters:
    return attrs.evolve(ActuatorParameters.of(ALIENGO), pairs=(DelayPair(input_delay, output_delay, 0.0),))


def run(model: ActuatorModel, peek_every: int) -> np.ndarray:
    """Torques under random joint states, with targets constant for 5 ms and gains that change sometimes."""
    rng = np.random.default_rng(7)
    torques = np.zeros((STEPS, 12))
    for k in range(STEPS):
        if k % 5 == 0:
            target, feedforward = rng.normal(size=(2, 12))
        if k % 400 == 0:
            kp, kd = rng.uniform(5.0, 30.0), np.full(12, rng.uniform(0.0, 1.0))
        q, dq = rng.normal(size=(2, 12))
        command = target, kp, kd, 0.0, feedforward
        seen = [model.peek(q, dq, *command) for _ in range(2)] if peek_every and k % peek_every == 0 else []
        torques[k] = model.step(q, dq, *command)
        for torque in seen:
            np.testing.assert_array_equal(torque, torques[k])
        if k == 1000:
            model.reset()
    return torques


@pytest.mark.parametrize("delays", [(0.0, 0.0), (0.007, 0.001), (0.0073, 0.0014), (0.05, 0.05)])
@pytest.mark.parametrize("peek_every", [1, 7])
def test_peek_predicts_the_step_and_does_not_change_the_run(
    delays: tuple[float, float], peek_every: int
) -> None:
    np.testing.assert_array_equal(
        run(ActuatorModel(parameters(*delays), seed=3), peek_every),
        run(ActuatorModel(parameters(*delays), seed=3), 0),
    )
