"""Baselines without a model, and the report on a model that they beat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadvel_sysid.cli import error_line
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.report.sanity_checks import contradictions
from quadvel_sysid.statistics.baselines import baseline_errors, explained_share, torque_variance
from tests.quadvel_sysid.servo_logs import recorded


def test_pd_law_leaves_friction_and_linear_filter_leaves_less(tmp_path: Path) -> None:
    given = recorded(3)
    np.savez(tmp_path / "log.npz", **given)
    log = read_log(tmp_path / "log.npz")
    first = np.broadcast_to((log.t < 4.0)[:, None], log.q.shape)
    found = {
        name: one["heldout_mse"] for name, one in baseline_errors(Samples.of([log]), first, ~first).items()
    }
    assert 0.05**2 < found["ridge"] < found["joint_pd"] < 0.6**2
    smooth = given["tau"] + 0.6 * np.tanh(given["dq"] / 0.05)
    np.savez(tmp_path / "log.npz", **given | {"tau": smooth * [1.0, 0.9, 1.1]})
    (error,) = {
        one["joint_pd"]["heldout_mse"]
        for one in [baseline_errors(Samples.of([read_log(tmp_path / "log.npz")]), first, ~first)]
    }
    assert error < 0.1**2


REPORT = {
    "reference_gains": {"kp": 30.0, "kd": 0.5, "commanded": True},
    "pd": {"heldout_mse": 2.0},
    "before": {"heldout_mse": 1.0},
    "after": {"heldout_mse": 0.3, "heldout_q_rms_rad": 0.01},
    "baselines": {"joint_pd": {"heldout_mse": 0.8}, "ridge": {"heldout_mse": 0.5}},
    "effects": [{"name": "armature"}],
    "noise_floor": 0.25,
}


def test_each_error_is_printed_with_its_explained_share() -> None:
    report = REPORT | {"after": {"heldout_mse": 0.3, "heldout_explained": 0.925}}
    assert "corrected model 0.3 (explains 92.5 % of the variance)" in error_line(report)


def test_the_explained_share_is_of_the_variance_about_each_joints_mean() -> None:
    torque = np.random.default_rng(0).normal([5.0, -40.0], [1.0, 2.0], (4000, 2))
    variance = torque_variance(torque, np.ones(torque.shape, bool))
    assert variance == pytest.approx(2.5, rel=0.05)
    assert explained_share(0.25, variance) == pytest.approx(0.9, abs=0.01)
    assert explained_share(0.0, 0.0) is None


def test_error_line_lists_baselines_and_models() -> None:
    assert error_line(REPORT) == (
        "held-out error, N^2 m^2: PD as commanded 2, a PD law of each joint 0.8, a linear filter over 16 ms 0.5, plain EAM 1, "
        "corrected model 0.3 (noise 0.25)"
    )


def test_a_log_without_gains_has_no_commanded_pd_law() -> None:
    reference = {"kp": 1.0, "kd": 1.0, "commanded": False}
    assert "PD as commanded" not in error_line(REPORT | {"reference_gains": reference})


@pytest.mark.parametrize(
    ("after", "sentence"),
    [
        ({"heldout_mse": 0.6}, "a ridge regression over 16 ms has a smaller held-out error, 0.5"),
        ({"heldout_mse": 0.9}, "a PD law of each joint has a smaller held-out error"),
        (
            {"heldout_mse": 0.3, "heldout_explained": 0.49},
            "the corrected model explains 49 % of the torque's variance",
        ),
        ({"heldout_mse": 0.3, "heldout_q_rms_rad": 1.5}, "the replayed commands end 1.5 rad from"),
    ],
)
def test_a_model_that_is_worse_than_a_baseline_gets_a_warning(after: dict[str, float], sentence: str) -> None:
    assert list(contradictions(REPORT)) == []
    assert any(text.startswith(sentence) for text in contradictions(REPORT | {"after": after}))


def test_a_baseline_contradicts_named_effects_alone() -> None:
    worse = REPORT | {"after": {"heldout_mse": 0.9}, "effects": []}
    assert list(contradictions(worse)) == []
