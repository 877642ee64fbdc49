"""Signals of selected rows, and of each joint at its own delays."""

import attrs
import numpy as np
import pytest

from quadvel_actuator.effects.elastic import Deadband
from quadvel_sysid.data.signals import Samples, scattered_rows
from quadvel_sysid.search.effect_candidates.elastic import DeadbandCandidate
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = NAMES[:2]


def _log(seconds=3.0, seed=2):
    truth = parameters((), input_delay=0.009, output_delay=0.003)
    return record(attrs.evolve(truth, joints=JOINTS), 2, seconds, 500, seed=seed)


def test_signals_of_few_rows_are_those_of_all():
    samples = Samples.of([_log(), _log(seed=3)])
    rows = np.arange(0, len(samples.t), 7)
    few = samples.take_rows(rows)
    assert len(few.t) == len(rows) < len(samples.t) / 6
    for name in ("t", "q", "q_des", "ddq", "packet"):
        whole = getattr(samples.at(0.004, 0.001, 0.001), name)
        np.testing.assert_array_equal(getattr(few.at(0.004, 0.001, 0.001), name), whole[rows])


@pytest.mark.parametrize("every", [2, 5, 10])
def test_few_rows_lie_at_all_places_between_two_commands(every):
    """Commands at 200 Hz, rows at 500 or 1000 Hz: even steps would show few of the places, and hide a wrong delay."""
    rows = scattered_rows(4000, every)
    assert len(rows) == pytest.approx(4000 / every, abs=1)
    assert np.diff(rows).min() > 0
    counts = np.bincount(rows % 10)
    assert counts.min() > 0.8 * len(rows) / 10
    assert counts.max() < 1.2 * len(rows) / 10


def test_each_joint_reads_signals_at_its_own_delays():
    samples = Samples.of([_log()])
    mixed = samples.at(np.array([0.004, 0.009]), np.array([0.001, 0.003]), 0.001)
    for joint, pair in enumerate(((0.004, 0.001), (0.009, 0.003))):
        for name in ("q", "dq", "q_des", "kp"):
            own = getattr(samples.at(*pair, 0.001), name)[:, joint]
            np.testing.assert_array_equal(getattr(mixed, name)[:, joint], own)


def test_grid_of_deadbands_leaves_few_errors_between_its_values():
    """Each error between two values is a jump of the torque that a slope along the width misses."""
    samples = Samples.of([_log(seconds=1.0)])
    s = samples.at(0.009, 0.003, 0.0)
    starts = DeadbandCandidate(Deadband("hard")).initial_guesses(s, samples.tau, samples.tau)
    widths = np.array([one["width"] for one in starts])
    share = (np.abs(s.q_des - s.q) < widths[:, None]).mean(axis=1)
    assert np.diff(share, axis=0).max() < 0.05
    assert (share[-1] > 0.95).all()


def test_slower_log_is_evaluated_as_well():
    fast, slow = _log(seconds=2.0), _log(seconds=2.0, seed=3)
    every = np.arange(len(slow.t)) % 4 == 0
    samples = Samples.of([fast, slow.select_rows(every)])
    assert samples.evaluated[samples.log_of_row == 1].mean() > 0.9
    assert samples.start[samples.log_of_row == 1].sum() == 1


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_the_noise_of_encoders_is_that_of_the_log_also_where_they_are_averaged(rows):
    """rows: on either side of the average of q and dq."""
    log, rng = _log(seconds=20.0), np.random.default_rng(4)
    noise = 0.3 * rng.standard_normal(log.dq.shape)
    sources = Samples.of([attrs.evolve(log, dq=log.dq + noise)], rows * log.period).sources
    assert sources.encoder_noise[1] == pytest.approx(0.3**2, rel=0.1)
    count = 2 * rows + 1
    averaged = np.lib.stride_tricks.sliding_window_view(noise, count, axis=0).mean(axis=-1)
    halfway = 0.5 * (averaged[1:] + averaged[:-1])
    removed = averaged.var(axis=0) - halfway.var(axis=0)
    assert 0.5 * sources.interpolated_noise[1] == pytest.approx(removed, rel=0.25)
