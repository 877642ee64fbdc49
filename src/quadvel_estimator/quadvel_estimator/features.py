"""Input features and file metadata of the learned velocity estimator, for training and run time.

This module needs neither torch, onnxruntime nor ROS. Body frame: x forward, y left, z up. Joint
order: FR, FL, RR, RL.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotation_matrix
from quadvel_description.network_input import InputLayout, InputTerm
from quadvel_description.quadruped import GRAVITY, JOINT_NAMES
from quadvel_description.robot import NOMINAL_Q
from quadvel_description.state import MODE_SERVO, RobotState

from .odometry import leg_velocity

RATE_HZ = 200
KIND = "velocity_estimator"
METADATA_FIELDS = ("kind", "nominal_q", "rate_hz", "inputs", "output_scale")
OUTPUTS = {"velocity": 3, "log_variance": 3}
"""Outputs of the network and their lengths, besides the recurrent state (`recurrent_network`)."""

# Clips lie beyond all values of walking. They limit the effect of a shock on the recurrent state.
DEFAULT_LAYOUT = InputLayout(
    [
        InputTerm("q", 12, offset=NOMINAL_Q, clip=4.0),  # rad
        InputTerm("dq", 12, scale=0.1, clip=4.0),  # rad/s
        InputTerm("angular_velocity", 3, scale=0.5, clip=5.0),  # rad/s, body frame
        InputTerm("linear_acceleration", 3, scale=1.0 / GRAVITY, clip=5.0),  # m/s^2, body, with gravity
        InputTerm("gravity", 3),  # unit vector pointing down, body frame
        InputTerm("previous_action", 12, clip=4.0),  # rad, joint targets minus NOMINAL_Q
        InputTerm("torque", 12, scale=0.05, clip=4.0),  # N m
        InputTerm("leg_velocity", 12, scale=0.5, clip=4.0),  # m/s, trunk velocity from each leg, if planted
    ]
)
KNOWN_INPUTS = {term.name: term.size for term in DEFAULT_LAYOUT.terms}


def _leg_velocity(state: RobotState, action: ArrayLike, rotation: Array) -> ArrayLike:
    return leg_velocity(state, rotation).reshape(*np.shape(state.q)[:-1], 12)


_QUANTITIES: dict[str, Callable[[RobotState, ArrayLike, Array], ArrayLike]] = {
    "q": lambda state, action, rotation: state.q,
    "dq": lambda state, action, rotation: state.dq,
    "angular_velocity": lambda state, action, rotation: state.angular_velocity,
    "linear_acceleration": lambda state, action, rotation: state.linear_acceleration,
    "gravity": lambda state, action, rotation: -rotation[..., 2, :],
    "previous_action": lambda state, action, rotation: action,
    "torque": lambda state, action, rotation: state.tau,
    "leg_velocity": _leg_velocity,
}
"""Each quantity of a state, a previous action, and the rotation matrix from body to world."""


def build(
    state: RobotState, previous_action: ArrayLike, layout: InputLayout = DEFAULT_LAYOUT
) -> NDArray[np.float32]:
    """Build the network input from a state, whose arrays may have leading batch axes (...).

    Each term is clip((value - offset) * scale), as `layout` defines it.

    Args:
        state: The state, arrays (..., 12), (..., 4), (..., 3).
        previous_action: Joint targets in force when the state was measured, minus `NOMINAL_Q`,
            (..., 12), rad; that is, the answer to the previous state.
        layout: Terms of the input.

    Returns:
        The input, (..., layout.size), float32; size 69 for the default layout.
    """
    rotation = rotation_matrix(state.quaternion)
    return layout.build({name: _QUANTITIES[name](state, previous_action, rotation) for name in layout.names})


def previous_action(q_target: ArrayLike, mode: int) -> Array:
    """Compute the `previous_action` of `build` from the last joint command.

    Args:
        q_target: Joint targets, (12,), rad.
        mode: Mode of the command.

    Returns:
        Targets minus `NOMINAL_Q`, (12,), rad; zeros in damping mode.
    """
    return np.asarray(q_target, np.float64) - NOMINAL_Q if mode == MODE_SERVO else np.zeros(12)


def metadata(
    state_shape: tuple[int, int, int],
    recipe: Any,
    commit: str,
    output_scale: float = 1.0,
    layout: InputLayout = DEFAULT_LAYOUT,
) -> dict[str, Any]:
    """Build the metadata of an estimator's ONNX file, see `quadvel_description.recurrent_network`.

    Args:
        state_shape: Shape of `h_in` and `c_in`: (layers, 1, hidden).
        recipe: How the network was trained, as JSON.
        commit: Commit of the training code.
        output_scale: s, with velocity = s * output (m/s) and variance = s^2 exp(log_variance)
            ((m/s)^2).
        layout: Terms of the input.

    Returns:
        The JSON object.
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
