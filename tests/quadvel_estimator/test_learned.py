"""The learned estimator at run time: what it returns, and which files it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from quadvel_description.network_file import NetworkFileError
from quadvel_description.network_input import InputLayout
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.state import RobotState
from quadvel_estimator import features
from quadvel_estimator.learned import LearnedEstimator
from tests.helpers.robots import ALIENGO

WriteEstimator = Callable[..., Path]
State = Callable[..., RobotState]
Array = NDArray[np.floating]
ACTION = np.linspace(-0.3, 0.3, 12)


def test_velocity_and_covariance_are_the_scaled_outputs(
    write_estimator: WriteEstimator, standing: State, weights: Array, variance: Array
) -> None:
    estimator = LearnedEstimator(ALIENGO, write_estimator(output_scale=0.5))
    state = standing(0.0, dq=np.linspace(-1.0, 1.0, 12))
    product = features.build(ALIENGO, state, ACTION, features.default_layout(ALIENGO)) @ weights
    for step in range(3):
        velocity, covariance = estimator.update(state, ACTION)
        np.testing.assert_allclose(velocity, 0.5 * (product + step), atol=1e-5)
        np.testing.assert_allclose(covariance, 0.25 * np.diag(variance), rtol=1e-6)


def test_a_reset_clears_the_memory(write_estimator: WriteEstimator, standing: State) -> None:
    estimator = LearnedEstimator(ALIENGO, write_estimator())
    first, _ = estimator.update(standing(0.0), ACTION)
    second, _ = estimator.update(standing(0.005), ACTION)
    estimator.reset()
    again, _ = estimator.update(standing(1.0), ACTION)
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, again)


def test_the_layout_in_the_file_decides_over_the_default(
    write_estimator: WriteEstimator, standing: State, weights: Array
) -> None:
    backwards = InputLayout(features.default_layout(ALIENGO).terms[::-1])
    state = standing(0.0, dq=np.linspace(-1.0, 1.0, 12))
    estimator = LearnedEstimator(ALIENGO, write_estimator(inputs=backwards.to_metadata(), output_scale=1.0))
    expected = features.build(ALIENGO, state, ACTION, backwards) @ weights
    np.testing.assert_allclose(estimator.update(state, ACTION)[0], expected, atol=1e-5)


def test_an_input_that_is_not_finite_shows_as_an_error(
    write_estimator: WriteEstimator, standing: State
) -> None:
    estimator = LearnedEstimator(ALIENGO, write_estimator())
    with pytest.raises(FloatingPointError, match=r"estimator\.onnx.* velocity is not finite"):
        estimator.update(standing(0.0, q=np.full(12, np.nan)), ACTION)


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(NetworkFileError, match=r"nowhere\.onnx: no such file"):
        LearnedEstimator(ALIENGO, tmp_path / "nowhere.onnx")


def test_a_file_that_is_no_network_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "notes.onnx").write_text("hello")
    with pytest.raises(NetworkFileError, match=r"notes\.onnx: is not an ONNX network"):
        LearnedEstimator(ALIENGO, tmp_path / "notes.onnx")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"kind": "policy"}, "metadata field kind is 'policy', expected 'velocity_estimator'"),
        ({"schema": 2}, "metadata field schema is 2, expected 1"),
        ({"rate_hz": 50}, "metadata field rate_hz is 50, expected 200"),
        ({"robot": "go2"}, "metadata field robot is 'go2', expected 'aliengo'"),
        ({"joint_names": ["a_joint", *JOINT_NAMES[1:]]}, "metadata field joint_names is ['a_joint'"),
        ({"nominal_q": [0.0] * 12}, "metadata field nominal_q is [0.0"),
        ({"state_shape": [1, 1, 8]}, "shape of input h_in is [1, 1, 3], expected [1, 1, 8]"),
        ({"output_scale": "1"}, "metadata field output_scale is '1', expected 'a positive number'"),
        ({"inputs": []}, "metadata field inputs is [], expected a list of inputs"),
        ({"size": 42}, "length of input obs is 42, expected 69"),
        ({"metadata": "[]"}, "metadata 'quadvel' is '[]', expected a JSON object"),
        ({"metadata": "{}"}, "metadata 'quadvel' lacks schema, joint_names, state_shape, kind, nominal_q"),
        (
            {"outputs": ("speed", "log_variance")},
            "list of outputs is ['speed', 'log_variance', 'h_out', 'c_out']",
        ),
        ({"width": 2}, "shape of output velocity is (1, 2), expected (1, 3)"),
    ],
)
def test_a_foreign_file_is_refused_in_one_sentence(
    write_estimator: WriteEstimator, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(NetworkFileError) as refused:
        LearnedEstimator(ALIENGO, write_estimator(**changes))
    assert sentence in str(refused.value)
    assert "estimator.onnx: " in str(refused.value)
    assert "\n" not in str(refused.value)
