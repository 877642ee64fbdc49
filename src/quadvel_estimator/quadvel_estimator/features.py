"""Input features and file metadata of the learned velocity estimator, for training and run time.

This module needs neither torch, onnxruntime nor ROS. Body frame: x forward, y left, z up. Joint
order: FR, FL, RR, RL.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotation_matrix
from quadvel_description.network_input import InputLayout, InputTerm
from quadvel_description.quadruped import GRAVITY, JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_description.state import MODE_SERVO, RobotState

from .odometry import leg_velocity

RATE_HZ = 200
KIND = "velocity_estimator"
METADATA_FIELDS = ("kind", "nominal_q", "rate_hz", "inputs", "output_scale")
OUTPUTS = {"velocity": 3, "log_variance": 3}
"""Outputs of the network and their lengths, besides the recurrent state (`recurrent_network`)."""

KNOWN_INPUTS = {
    "q": 12,  # rad
    "dq": 12,  # rad/s
    "angular_velocity": 3,  # rad/s, body frame
    "linear_acceleration": 3,  # m/s^2, body frame, with gravity
    "gravity": 3,  # unit vector pointing down, body frame
    "previous_action": 12,  # rad, joint targets minus the nominal posture
    "torque": 12,  # N m
    "leg_velocity": 12,  # m/s, trunk velocity from each leg, if planted
}
"""Length of each quantity that a network may read."""
INPUT_SIZE = sum(KNOWN_INPUTS.values())
"""Length of the input of `default_layout`."""


@cache
def default_layout(robot: Robot) -> InputLayout:
    """Create the layout of the shipped estimators.

    Args:
        robot: The robot, whose nominal posture is the offset of the joint positions.

    Returns:
        The layout, of the size INPUT_SIZE.
    """
    # Clips lie beyond all values of walking. They limit the effect of a shock on the recurrent state.
    scaling: dict[str, dict[str, Any]] = {
        "q": {"offset": robot.nominal_q, "clip": 4.0},
        "dq": {"scale": 0.1, "clip": 4.0},
        "angular_velocity": {"scale": 0.5, "clip": 5.0},
        "linear_acceleration": {"scale": 1.0 / GRAVITY, "clip": 5.0},
        "gravity": {},
        "previous_action": {"clip": 4.0},
        "torque": {"scale": 0.05, "clip": 4.0},
        "leg_velocity": {"scale": 0.5, "clip": 4.0},
    }
    return InputLayout([InputTerm(name, size, **scaling[name]) for name, size in KNOWN_INPUTS.items()])


def _leg_velocity(robot: Robot, state: RobotState, action: ArrayLike, rotation: Array) -> ArrayLike:
    return leg_velocity(robot, state, rotation).reshape(*np.shape(state.q)[:-1], 12)


_QUANTITIES: dict[str, Callable[[Robot, RobotState, ArrayLike, Array], ArrayLike]] = {
    "q": lambda robot, state, action, rotation: state.q,
    "dq": lambda robot, state, action, rotation: state.dq,
    "angular_velocity": lambda robot, state, action, rotation: state.angular_velocity,
    "linear_acceleration": lambda robot, state, action, rotation: state.linear_acceleration,
    "gravity": lambda robot, state, action, rotation: -rotation[..., 2, :],
    "previous_action": lambda robot, state, action, rotation: action,
    "torque": lambda robot, state, action, rotation: state.tau,
    "leg_velocity": _leg_velocity,
}
"""Each quantity of a robot, its state, a previous action, and the rotation matrix from body to world."""


def build(
    robot: Robot, state: RobotState, previous_action: ArrayLike, layout: InputLayout
) -> NDArray[np.float32]:
    """Build the network input from a state, whose arrays may have leading batch axes (...).

    Each term is clip((value - offset) * scale), as `layout` defines it.

    Args:
        robot: The robot.
        state: The state, arrays (..., 12), (..., 4), (..., 3).
        previous_action: Joint targets in force when the state was measured, minus the nominal
            posture, (..., 12), rad; that is, the answer to the previous state.
        layout: Terms of the input.

    Returns:
        The input, (..., layout.size), float32.
    """
    rotation = rotation_matrix(state.quaternion)
    return layout.build(
        {name: _QUANTITIES[name](robot, state, previous_action, rotation) for name in layout.names}
    )


def previous_action(robot: Robot, q_target: ArrayLike, mode: int) -> Array:
    """Compute the `previous_action` of `build` from the last joint command.

    Args:
        robot: The robot.
        q_target: Joint targets, (12,), rad.
        mode: Mode of the command.

    Returns:
        Targets minus the nominal posture, (12,), rad; zeros in damping mode.
    """
    return np.asarray(q_target, np.float64) - robot.nominal_q if mode == MODE_SERVO else np.zeros(12)


def metadata(
    robot: Robot,
    state_shape: tuple[int, int, int],
    recipe: Any,
    commit: str,
    layout: InputLayout,
    output_scale: float = 1.0,
) -> dict[str, Any]:
    """Build the metadata of an estimator's ONNX file, see `quadvel_description.recurrent_network`.

    Args:
        robot: The robot that the estimator belongs to.
        state_shape: Shape of `h_in` and `c_in`: (layers, 1, hidden).
        recipe: How the network was trained, as JSON.
        commit: Commit of the training code.
        layout: Terms of the input.
        output_scale: s, with velocity = s * output (m/s) and variance = s^2 exp(log_variance)
            ((m/s)^2).

    Returns:
        The JSON object.
    """
    return {
        "schema": 1,
        "kind": KIND,
        "robot": robot.name,
        "joint_names": list(JOINT_NAMES),
        "nominal_q": [float(q) for q in robot.nominal_q],
        "rate_hz": RATE_HZ,
        "inputs": layout.to_metadata(),
        "output_scale": output_scale,
        "state_shape": list(state_shape),
        "recipe": recipe,
        "commit": commit,
    }
