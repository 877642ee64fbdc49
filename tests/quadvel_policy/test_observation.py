"""The observation and the action of a policy, and the metadata that carries their meaning."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.symmetry import mirror_observation
from quadvel_policy.observation import (
    ActionMap,
    MetadataError,
    ObservationSpec,
    PolicyMetadata,
    build_observation,
    default_observation,
)
from tests.helpers.robots import ALIENGO

VALUES: dict[str, Any] = {
    "command": [0.5, -0.2, 0.8, 0.0],
    "quaternion": [0.8462836255, 0.1806369692, -0.1265691004, 0.4849273898],  # roll 0.2, pitch -0.4, yaw 1
    "q": [0.1, 0.6435, -1.287, 0.0, 0.7435, -1.287, 0.0, 0.6435, -1.187, -0.1, 0.6435, -1.387],
    "dq": [1.0, -2.0, 3.0, 0.0, 0.0, 0.0, 10.0, 0.0, 200.0, 0.0, 0.0, -200.0],
    "linear_velocity": [0.4, -0.1, 0.05],
    "angular_velocity": [0.2, -0.4, 1.0],
    "previous_action": [0.0, 1.0, -1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 11.0],
}
# fmt: off
GOLDEN = [
    0.5, -0.2, 0.8, 0.0,                                              # command
    0.4, -0.8,                                                        # 2 (roll, pitch)
    0.2, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.2, -0.2, 0.0, -0.2,     # 2 (q - nominal)
    0.1, -0.2, 0.3, 0.0, 0.0, 0.0, 1.0, 0.0, 10.0, 0.0, 0.0, -10.0,   # 0.1 dq, within 10
    0.4, -0.1, 0.05,                                                  # linear velocity
    0.1, -0.2, 0.5,                                                   # 0.5 angular velocity
    0.0, 1.0, -1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 10.0,     # previous action, within 10
]
# fmt: on


def test_the_whole_observation_is_the_one_worked_out_by_hand() -> None:
    observation = build_observation(default_observation(ALIENGO), **VALUES)
    assert observation.dtype == np.float32
    assert observation.shape == (48,)
    np.testing.assert_allclose(observation, GOLDEN, atol=1e-6)


def test_leading_axes_give_the_same_numbers_and_out_is_filled() -> None:
    batch = {name: np.broadcast_to(value, (3, 2, len(value))) for name, value in VALUES.items()}
    out = np.full((3, 2, 48), np.nan, np.float32)
    returned = build_observation(default_observation(ALIENGO), out=out, **batch)
    assert returned is out
    np.testing.assert_allclose(out, np.broadcast_to(GOLDEN, (3, 2, 48)), atol=1e-6)


def test_roll_and_pitch_may_be_given_instead_of_the_quaternion() -> None:
    values = {name: value for name, value in VALUES.items() if name != "quaternion"}
    observation = build_observation(default_observation(ALIENGO), roll_pitch=[0.2, -0.4], **values)
    np.testing.assert_allclose(observation, GOLDEN, atol=1e-6)
    with pytest.raises(TypeError, match="exactly one of quaternion and roll_pitch"):
        build_observation(default_observation(ALIENGO), **values)


def test_the_order_follows_the_specification() -> None:
    reverse = ObservationSpec(default_observation(ALIENGO).terms[::-1])
    observation = build_observation(reverse, **VALUES)
    np.testing.assert_allclose(observation[:12], GOLDEN[-12:], atol=1e-6)
    np.testing.assert_allclose(observation[-4:], GOLDEN[:4], atol=1e-6)


def test_nan_stays_visible_in_the_observation() -> None:
    observation = build_observation(
        default_observation(ALIENGO), **VALUES | {"linear_velocity": [np.nan, 0.0, 0.0]}
    )
    assert np.isnan(observation).sum() == 1


def test_the_mirrored_robot_sees_the_mirrored_observation() -> None:
    mirrored = VALUES | {
        "command": [0.5, 0.2, -0.8, 0.0],
        "quaternion": [0.8462836255, -0.1806369692, -0.1265691004, -0.4849273898],
        "q": [0.0, 0.7435, -1.287, -0.1, 0.6435, -1.287, 0.1, 0.6435, -1.387, 0.0, 0.6435, -1.187],
        "dq": [0.0, 0.0, 0.0, -1.0, -2.0, 3.0, 0.0, 0.0, -200.0, -10.0, 0.0, 200.0],
        "linear_velocity": [0.4, 0.1, 0.05],
        "angular_velocity": [-0.2, -0.4, -1.0],
        "previous_action": [-0.5, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 11.0, 0.0, 0.0, 0.0],
    }
    seen = build_observation(default_observation(ALIENGO), **mirrored)
    np.testing.assert_allclose(seen, mirror_observation(np.array(GOLDEN)), atol=1e-6)


def test_targets_are_offset_plus_scale_times_the_clipped_action() -> None:
    action = np.array([0.1, -0.2, 9.0] * 4)
    plain = ActionMap(ALIENGO.nominal_q, 0.25, clip=2.0).targets(action)
    np.testing.assert_allclose(plain[:3], [0.025, 0.6435 - 0.05, -1.287 + 0.5])
    pair = ActionMap(ALIENGO.nominal_q, 0.25, clip=(-0.1, 1.0)).targets(np.stack([action, -action]))
    np.testing.assert_allclose(pair[0, :3], [0.025, 0.6435 - 0.025, -1.287 + 0.25])
    np.testing.assert_allclose(pair[1, :3], [-0.025, 0.6435 + 0.05, -1.287 - 0.025])


def test_metadata_survives_its_json(metadata: PolicyMetadata) -> None:
    text = metadata.to_json()
    again = PolicyMetadata.from_json(text)
    assert again.to_json() == text
    assert again.joint_names == JOINT_NAMES
    assert again.kp == (30.0,) * 12
    assert again.command_limits["vx"] == (-1.0, 1.5)
    assert (again.limits.low, again.limits.high) == ((-1.0, -0.5, -1.0), (1.5, 0.5, 1.0))
    assert again.limits.curve is None
    np.testing.assert_allclose(build_observation(again.observation, **VALUES), GOLDEN, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("schema", 2, "metadata field schema is 2, expected 1"),
        (
            "joint_names",
            [*JOINT_NAMES[:3], "FL_knee", *JOINT_NAMES[4:]],
            r"joint_names\[3\] is 'FL_knee', expected",
        ),
        ("joint_names", ["FR_hip_joint"], "joint_names is .* expected 12 names"),
        ("nominal_q", [0.0] * 11, "nominal_q is .* expected a finite number or 12 of them"),
        ("action_offset", [0.0] * 11 + [None], "action_offset is"),
        ("action_scale", "big", "action_scale is 'big', expected a finite number"),
        ("action_clip", [1.0, -1.0], r"action_clip is \[1.0, -1.0\], expected a positive bound"),
        ("kp", -1.0, "kp is -1.0, expected gains from 0 to 500"),
        ("kd", 4000.0, "kd is 4000.0, expected gains from 0 to 20"),
        ("kd", True, "kd is True, expected a finite number"),
        ("rate_hz", 0.0, "rate_hz is 0.0, expected a rate above 0"),
        ("observation", [], r"observation is \[\], expected a list"),
        ("observation", [{"name": "height", "size": 1, "offset": 0, "scale": 1, "clip": None}], "'height'"),
        ("observation", [{"name": "q", "size": 11, "offset": 0, "scale": 1, "clip": None}], "size 11"),
        ("curve_limit", -1.0, "curve_limit is -1.0"),
        ("command_limits", {"vx": 1.0}, "command_limits is .* for each of vx, vy, wz"),
        ("command_limits", {"vx": (0.5, 1.0), "vy": 1.0, "wz": 1.0}, "command_limits.vx is .* zero between"),
        ("command_limits", {"vx": None, "vy": 1.0, "wz": 1.0}, "command_limits.vx is None"),
        ("state_shape", [1, 0], "state_shape is .* whole numbers above 0"),
        ("commit", None, "commit is None, expected a text"),
    ],
)
def test_metadata_that_does_not_fit_is_refused_by_name(
    metadata: PolicyMetadata, field: str, value: Any, sentence: str
) -> None:
    data = json.loads(metadata.to_json()) | {field: value}
    with pytest.raises(MetadataError, match=sentence):
        PolicyMetadata.from_json(json.dumps(data))


def test_missing_and_unknown_fields_are_named(metadata: PolicyMetadata) -> None:
    data = json.loads(metadata.to_json())
    with pytest.raises(MetadataError, match="metadata field gain is unknown"):
        PolicyMetadata.from_fields(data | {"gain": 1.0})
    del data["kd"]
    with pytest.raises(MetadataError, match="metadata field kd is missing"):
        PolicyMetadata.from_fields(data)


@pytest.mark.parametrize("text", ["", "[1]", "{"])
def test_metadata_that_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(MetadataError, match="expected an object"):
        PolicyMetadata.from_json(text)
