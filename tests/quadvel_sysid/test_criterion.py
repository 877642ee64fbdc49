"""Clusters, score test, noise variance and whiteness tests."""

import attrs
import numpy as np
import pytest

from quadvel_sysid.data.noise import noise_variance
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.data.split import DataSplit, cluster_starts
from quadvel_sysid.logs.log import Log
from quadvel_sysid.statistics.criterion import (
    SIGNIFICANCE_LEVEL,
    WHITENESS_LEVEL,
    compare_residuals,
    normality_p_values,
    whiteness_p_values,
)
from tests.quadvel_sysid.simulated_joints import parameters, record

BEGIN, END = 2.0, 4.0  # s, of a stand


def starts_of(log: Log) -> np.ndarray:
    return cluster_starts(Samples.of([log]))


def standing(log: Log, sway: float, rate: float) -> Log:
    """The log with a stand: encoder noise, and one joint that sways (rad, Hz)."""
    rng = np.random.default_rng(1)
    still = ((log.t >= BEGIN) & (log.t < END))[:, None]
    stand = log.q[int(BEGIN * 1000)] + 0.5e-3 * rng.normal(size=log.q.shape)
    stand[:, 0] += sway * np.sin(2.0 * np.pi * rate * log.t)
    return attrs.evolve(log, q=np.where(still, stand, log.q))


def test_a_stand_is_one_cluster_and_motion_is_one_cluster_each_tenth_of_a_second() -> None:
    log = record(parameters(), joints=2, seconds=5.0)
    moving, stood = starts_of(log), starts_of(standing(log, 0.0, 1.0))
    assert len(moving) == 50
    at = log.t[stood]
    assert len(at) == 31
    assert not ((at > BEGIN + 0.05) & (at < END - 0.05)).any()


def test_a_disturbance_of_all_joints_counts_once() -> None:
    """With noise shared by joints, 1 % of unrelated changes are significant at the 1 % level."""
    rng, rows = np.random.default_rng(0), np.ones((5000, 6), dtype=bool)
    parts = DataSplit(rows, rows, rows, np.arange(0, 5000, 100))

    def slow() -> np.ndarray:
        return np.repeat(rng.normal(size=(50, 1)), 100, axis=0)

    significant = 0
    for _ in range(400):
        before = slow() + rng.normal(size=(5000, 6))
        significant += (
            compare_residuals(parts, before, before - 0.05 * slow(), rows).p_value < SIGNIFICANCE_LEVEL
        )
    assert significant <= 12


def test_quantised_torque_has_rounding_noise_and_constant_torque_the_noise_of_other_joints() -> None:
    log = record(parameters(), joints=3, seconds=2.0)
    tau = log.tau.copy()
    tau[:, 1] = np.round(tau[:, 1] / 4.0) * 4.0
    tau[:, 2] = 0.0
    samples = Samples.of([attrs.evolve(log, tau=tau)])
    noise = noise_variance(samples, samples.evaluated, samples.tau)
    assert noise[1] == pytest.approx(4.0**2 / 12.0, rel=1e-6)
    assert noise[2] == np.mean(noise[:2])


def test_a_fast_sway_around_one_posture_is_motion() -> None:
    log = record(parameters(), joints=2, seconds=5.0)
    assert len(starts_of(standing(log, 0.03, 20.0))) == 50


def test_whiteness_and_normality_are_tested_for_each_joint() -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(3000, 3))
    noise[:, 1] += 0.3 * np.sin(np.arange(3000) / 20.0)
    noise[::150, 2] += 4.0
    rows, start = np.ones(noise.shape, dtype=bool), np.arange(3000) == 0
    assert (whiteness_p_values(noise, rows, start) < WHITENESS_LEVEL).tolist() == [False, True, False]
    assert (normality_p_values(noise, rows) < WHITENESS_LEVEL).tolist() == [False, False, True]


def test_the_noise_variance_needs_no_model() -> None:
    samples = Samples.of([record(parameters(), joints=2, seconds=5.0)])
    found = noise_variance(samples, samples.evaluated, samples.tau)
    np.testing.assert_allclose(found, 0.066, rtol=0.15)
