"""What the learned velocity estimator sees, and how its network file says so; for training and run time.

Nothing here needs torch, onnxruntime or ROS. Body frame x forward, y left, z up; joint order FR, FL, RR, RL.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.kinematics import rotation_matrix
from quadvel_description.network_input import InputLayout, InputTerm
from quadvel_description.robot import GRAVITY, JOINT_NAMES, NOMINAL_Q
from quadvel_description.state import MODE_SERVO, RobotState

from .odometry import leg_velocity

RATE_HZ = 200
KIND = "velocity_estimator"
METADATA_FIELDS = ("kind", "nominal_q", "rate_hz", "inputs", "output_scale")
OUTPUTS = {"velocity": 3, "log_variance": 3}  # and the memory that `recurrent_network` names

# Clips lie beyond anything that walking shows; they only keep a shock from throwing the memory far off.
DEFAULT_LAYOUT = InputLayout(
    [
        InputTerm("q", 12, offset=NOMINAL_Q, clip=4.0),  # rad
        InputTerm("dq", 12, scale=0.1, clip=4.0),  # rad/s
        InputTerm("angular_velocity", 3, scale=0.5, clip=5.0),  # rad/s, body frame
        InputTerm("linear_acceleration", 3, scale=1.0 / GRAVITY, clip=5.0),  # m/s^2, body, with gravity
        InputTerm("gravity", 3),  # unit vector pointing down, body frame
        InputTerm("previous_action", 12, clip=4.0),  # rad, joint targets minus NOMINAL_Q
        InputTerm("torque", 12, scale=0.05, clip=4.0),  # N m
        InputTerm("leg_velocity", 12, scale=0.5, clip=4.0),  # m/s, the trunk's by each leg if it is planted
    ]
)
KNOWN_INPUTS = {term.name: term.size for term in DEFAULT_LAYOUT.terms}


def _gravity(state: RobotState, action: ArrayLike) -> ArrayLike:
    return -rotation_matrix(state.quaternion)[..., 2, :]


def _leg_velocity(state: RobotState, action: ArrayLike) -> ArrayLike:
    return leg_velocity(state).reshape(*np.shape(state.q)[:-1], 12)


_QUANTITIES: dict[str, Callable[[RobotState, ArrayLike], ArrayLike]] = {
    "q": lambda state, action: state.q,
    "dq": lambda state, action: state.dq,
    "angular_velocity": lambda state, action: state.angular_velocity,
    "linear_acceleration": lambda state, action: state.linear_acceleration,
    "gravity": _gravity,
    "previous_action": lambda state, action: action,
    "torque": lambda state, action: state.tau,
    "leg_velocity": _leg_velocity,
}


def build(
    state: RobotState, previous_action: ArrayLike, layout: InputLayout = DEFAULT_LAYOUT
) -> NDArray[np.float32]:
    """The network input (..., 69) of a state whose arrays carry leading axes (...); other layouts, other sizes.

    `previous_action` (..., 12) is the joint targets in force when the state was taken, minus `NOMINAL_Q`, in
    rad: the answer to the state before this one.
    """
    return layout.build({name: _QUANTITIES[name](state, previous_action) for name in layout.names})


def previous_action(q_target: ArrayLike, mode: int) -> NDArray[np.float64]:
    """What `build` takes, from joint targets (12,) and mode of the last command; zeros while damping."""
    return np.asarray(q_target, np.float64) - NOMINAL_Q if mode == MODE_SERVO else np.zeros(12)


def metadata(
    state_shape: tuple[int, int, int],
    recipe: Any,
    commit: str,
    output_scale: float = 1.0,
    layout: InputLayout = DEFAULT_LAYOUT,
) -> dict[str, Any]:
    """The JSON object that an estimator's ONNX file carries, see `quadvel_description.recurrent_network`.

    `state_shape` is the shape of `h_in` and of `c_in` (layers, 1, hidden); `output_scale` turns the network's
    `velocity` into m/s, and its square the exponential of `log_variance` into (m/s)^2.
    """
    return {
        "schema": 1,
        "kind": KIND,
        "joint_names": list(JOINT_NAMES),
        "nominal_q": [float(q) for q in NOMINAL_Q],
        "rate_hz": RATE_HZ,
        "inputs": layout.to_metadata(),
        "output_scale": output_scale,
        "state_shape": list(state_shape),
        "recipe": recipe,
        "commit": commit,
    }
