"""Offline estimates of a recording, compared with the recorded ones."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.offline import WARM_UP_S, velocity_errors
from quadvel_eval.recording_plot import RecordedRun
from tests.helpers.robots import ALIENGO


def test_the_warm_up_of_an_estimator_does_not_count() -> None:
    time = np.arange(0.0, 2.0, 0.005)
    recorded = np.full((len(time), 3), 0.3)
    found = recorded + np.where(time < WARM_UP_S, 0.1, 0.002)[:, None]
    run = RecordedRun(100.0, {"/velocity_estimate": (time, recorded)}, [], 2.0, ALIENGO)
    assert velocity_errors(run, 100.0 + time, found)["recorded estimate"] == pytest.approx(0.002)


def test_a_recording_shorter_than_the_warm_up_counts_entirely() -> None:
    time = np.arange(0.0, 0.9 * WARM_UP_S, 0.005)
    recorded = np.zeros((len(time), 3))
    run = RecordedRun(0.0, {"/velocity_estimate": (time, recorded)}, [], 0.5, ALIENGO)
    assert velocity_errors(run, time, recorded + 0.1)["recorded estimate"] == pytest.approx(0.1)
