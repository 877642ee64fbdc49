"""A policy read from its file: runs as the network's equations say, or is refused in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from quadvel_description.network_file import NetworkFileError
from quadvel_policy.observation import PolicyMetadata
from quadvel_policy.policy_file import PolicyFile
from tests.helpers.robots import ALIENGO

WritePolicy = Callable[..., Path]


def reference(path: Path, observations: np.ndarray) -> np.ndarray:
    """The file's LSTM in NumPy (ONNX gate order: input, output, forget, cell)."""
    stored = onnx.load(path).graph.initializer
    weights = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in stored}
    bias = np.sum(np.split(weights["B"][0], 2), axis=0)
    h, c = np.zeros((2, len(weights["head"])))
    actions = []
    for x in observations:
        i, o, f, g = np.split(weights["W"][0] @ x + weights["R"][0] @ h + bias, 4)
        i, o, f = (1.0 / (1.0 + np.exp(-gate)) for gate in (i, o, f))
        c = f * c + i * np.tanh(g)
        h = o * np.tanh(c)
        actions.append(h @ weights["head"])
    return np.array(actions)


def test_steps_carry_the_memory_as_the_lstm_equations_say(write_policy: WritePolicy) -> None:
    path = write_policy()
    policy = PolicyFile(ALIENGO, path)
    observations = np.random.default_rng(1).normal(size=(20, 48)).astype(np.float32)
    actions = np.array([policy.step(o) for o in observations])
    assert actions.shape == (20, 12)
    np.testing.assert_allclose(actions, reference(path, observations), atol=1e-5)


def test_a_reset_clears_the_memory(write_policy: WritePolicy) -> None:
    policy = PolicyFile(ALIENGO, write_policy())
    observations = np.random.default_rng(2).normal(size=(5, 48)).astype(np.float32)
    first = [policy.step(o) for o in observations]
    policy.reset()
    np.testing.assert_array_equal([policy.step(o) for o in observations], first)


def test_the_metadata_comes_with_the_file(write_policy: WritePolicy, metadata: PolicyMetadata) -> None:
    assert PolicyFile(ALIENGO, write_policy()).metadata.to_json() == metadata.to_json()


def test_an_output_that_is_not_finite_is_an_error(write_policy: WritePolicy) -> None:
    policy = PolicyFile(ALIENGO, write_policy(exponent=1.0))
    with pytest.raises(FloatingPointError, match=r"policy\.onnx.* not finite"):
        policy.step(np.full(48, 1e3, np.float32))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(NetworkFileError, match=r"absent\.onnx: no such file"):
        PolicyFile(ALIENGO, tmp_path / "absent.onnx")


def test_a_file_that_is_no_onnx_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(NetworkFileError, match=r"text\.onnx: is not an ONNX network"):
        PolicyFile(ALIENGO, tmp_path / "text.onnx")


def test_a_foreign_onnx_without_metadata_is_refused(write_policy: WritePolicy) -> None:
    with pytest.raises(NetworkFileError, match=r"policy\.onnx: has no metadata under the key 'quadvel'"):
        PolicyFile(ALIENGO, write_policy(properties={"author": "someone"}))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"output": "velocity"}, "list of outputs"),
        ({"inputs": 47}, "length of input obs is 47, expected 48"),
        ({"actions": 11}, r"shape of output actions is \(1, 11\), expected \(1, 12\)"),
        ({"exponent": np.nan}, "not finite for an input of zeros"),
    ],
)
def test_a_network_of_another_form_is_refused(
    write_policy: WritePolicy, changes: dict, sentence: str
) -> None:
    with pytest.raises(NetworkFileError, match=rf"policy\.onnx.*{sentence}"):
        PolicyFile(ALIENGO, write_policy(**changes))


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("robot", "go2", "robot is 'go2', expected 'aliengo'"),
        ("joint_names", ["a"] * 12, "joint_names"),
        ("rate_hz", 50.0, "rate_hz is 50.0, expected 200.0"),
        ("kp", "stiff", "kp is 'stiff'"),
        ("state_shape", [1, 1, 4], "h_in"),
    ],
)
def test_metadata_that_does_not_fit_is_refused_with_the_files_name(
    write_policy: WritePolicy, metadata: PolicyMetadata, field: str, value: object, sentence: str
) -> None:
    text = json.dumps(json.loads(metadata.to_json()) | {field: value})
    with pytest.raises(NetworkFileError, match=rf"policy\.onnx: .*{sentence}"):
        PolicyFile(ALIENGO, write_policy(properties={"quadvel": text}))


def test_a_policy_without_a_name_is_that_of_the_aliengo(
    write_policy: WritePolicy, metadata: PolicyMetadata
) -> None:
    fields = json.loads(metadata.to_json())
    del fields["robot"]
    assert (
        PolicyFile(ALIENGO, write_policy(properties={"quadvel": json.dumps(fields)})).metadata.robot
        == "aliengo"
    )
