"""The estimator's input vector, number by number, and its description in the network file."""

import json

import numpy as np
import pytest

from quadvel_description.network_input import InputLayout
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.state import RobotState
from quadvel_estimator import features
from tests.helpers.robots import ALIENGO

LAYOUT = features.default_layout(ALIENGO)


def some_state() -> RobotState:
    """Numbers that are all different; the body is rolled by +90 degrees, so that down is along -y."""
    return RobotState(
        time=1.0,
        tick=5,
        q=ALIENGO.nominal_q + 0.01 * np.arange(1, 13),
        dq=np.arange(1.0, 13.0),
        tau=np.arange(-6.0, 6.0),
        quaternion=np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]),
        angular_velocity=np.array([0.2, -0.4, 0.6]),
        linear_acceleration=np.array([0.981, 9.81, -1.962]),
        foot_force=np.full(4, 99.0),
    )


GOLDEN = np.array(
    [
        *[0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 0.10, 0.11, 0.12],  # q
        *[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2],  # dq
        *[0.1, -0.2, 0.3],  # angular velocity
        *[0.1, 1.0, -0.2],  # acceleration in units of gravity
        *[0.0, -1.0, 0.0],  # gravity
        *[-0.6, -0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5],  # previous action
        *[-0.3, -0.25, -0.2, -0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.15, 0.2, 0.25],  # torque
        # half of the velocity of each leg, from finite differences of its contact point
        *[0.58533, -0.31295, 0.22090],
        *[1.61624, -0.92220, 0.09208],
        *[2.50133, -1.42758, 0.67370],
        *[3.57053, -1.97075, -0.24417],
    ]
)


def test_the_input_is_these_69_numbers() -> None:
    vector = features.build(ALIENGO, some_state(), np.arange(-6, 6) / 10, LAYOUT)
    assert vector.dtype == np.float32
    np.testing.assert_allclose(vector, GOLDEN, atol=1e-5)


def test_a_batch_gives_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(0)
    batch = some_state()
    sizes = {"q": 12, "dq": 12, "tau": 12, "quaternion": 4, "angular_velocity": 3, "linear_acceleration": 3}
    for name, size in sizes.items():
        setattr(batch, name, rng.normal(size=(2, 5, size)))
    batch.quaternion /= np.linalg.norm(batch.quaternion, axis=-1, keepdims=True)
    action = rng.normal(size=(2, 5, 12))
    whole = features.build(ALIENGO, batch, action, LAYOUT)
    assert whole.shape == (2, 5, 69)
    one = some_state()
    for name in sizes:
        setattr(one, name, getattr(batch, name)[1, 3])
    np.testing.assert_array_equal(whole[1, 3], features.build(ALIENGO, one, action[1, 3], LAYOUT))


def test_a_shock_is_clipped() -> None:
    state = some_state()
    state.linear_acceleration = np.array([1e4, 0.0, -1e4])
    np.testing.assert_array_equal(
        features.build(ALIENGO, state, np.zeros(12), LAYOUT)[27:30], [5.0, 0.0, -5.0]
    )


def test_the_metadata_carries_the_layout_through_json() -> None:
    data = json.loads(
        json.dumps(features.metadata(ALIENGO, (1, 1, 64), recipe={"lr": 1e-3}, commit="abc", layout=LAYOUT))
    )
    assert data["kind"] == "velocity_estimator"
    assert data["joint_names"] == list(JOINT_NAMES)
    assert data["state_shape"] == [1, 1, 64]
    layout = InputLayout.from_metadata(data["inputs"], features.KNOWN_INPUTS)
    assert layout.terms == LAYOUT.terms


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"name": "heading"}, "holds 'heading' with size 12, expected one of q (12), dq (12)"),
        ({"size": 11}, "holds 'q' with size 11, expected one of q (12)"),
        ({"offset": [0.0, 1.0]}, "q: offset has 2 numbers, expected 1 or 12"),
        ({"clip": -1.0}, "q: clip is -1.0, expected a bound above 0 or null"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused_by_name(change: dict, sentence: str) -> None:
    entries = LAYOUT.to_metadata()
    entries[0] |= change
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        InputLayout.from_metadata(entries, features.KNOWN_INPUTS)
    assert sentence in str(refused.value)
