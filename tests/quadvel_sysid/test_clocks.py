"""Clocks of recordings: jittering stamps, and offsets between states and commands."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
import pytest

from quadvel_sysid.data.clocks import (
    align_commands,
    align_heldout,
    choose_stamps,
    clock_findings,
    remove_drift,
)
from quadvel_sysid.data.dataset import Dataset
from quadvel_sysid.data.plain_model import fit_eam
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.data.split import block_length, reported_rows
from quadvel_sysid.logs.check_log import CheckedLog
from quadvel_sysid.logs.log import Log
from quadvel_sysid.options import SEARCH_DEFAULTS
from tests.quadvel_sysid.simulated_joints import parameters, record

WINDOWS = (0.001,)


def dataset(*train: Log, heldout: Sequence[Log] = ()) -> Dataset:
    checked = [[CheckedLog(log, ()) for log in logs] for logs in (train, heldout)]
    return Dataset.prepare(*checked, 60_000)


def recording(seed: int, command_offset: float = 0.0, jitter: float = 0.0) -> Log:
    """Three seconds of two joints whose command stamps are late, and whose states' stamps jitter."""
    log = record(parameters(joints=2), 2, 3.0, 500, seed=seed)
    moved = np.random.default_rng(seed).uniform(0.0, jitter, len(log.t))
    return attrs.evolve(log, t=log.t + moved, t_cmd=log.t_cmd - command_offset)


def test_offsets_of_the_command_clocks_are_found_and_removed() -> None:
    logs = dataset(recording(1, 0.001), recording(2, -0.001), heldout=[recording(3, 0.0015)])
    aligned, clocks = align_commands(
        logs,
        choose_stamps(logs, WINDOWS, block_length(logs), SEARCH_DEFAULTS)[1],
        WINDOWS,
        block_length(logs),
    )
    assert [one.offset_s for one in clocks] == pytest.approx([0.001, -0.001, 0.0015], abs=2e-4)
    for before, after, clock in zip(logs.logs, aligned.logs, clocks, strict=True):
        np.testing.assert_allclose(after.t_cmd - before.t_cmd, clock.offset_s, atol=1e-9)
    assert sum("act" in finding.text for _, finding in clock_findings(aligned, clocks)) == 3


def test_equal_clocks_are_left_alone() -> None:
    logs = dataset(recording(1, 1e-7), recording(2, 1e-7))
    clocks = choose_stamps(logs, WINDOWS, block_length(logs), SEARCH_DEFAULTS)[1]
    aligned, clocks = align_commands(logs, clocks, WINDOWS, block_length(logs))
    assert all(abs(one.offset_s or 0.0) <= one.half_width_s for one in clocks)
    assert [one.t_cmd[0] for one in aligned.logs] == [one.t_cmd[0] for one in logs.logs]


@pytest.mark.parametrize("drift", [6e-4, -6e-4])
def test_command_stamps_of_a_clock_that_drifts_are_put_on_that_of_the_states(drift: float) -> None:
    log = record(parameters(joints=2), 2, 10.0, 500, seed=1)
    logs = dataset(attrs.evolve(log, t_cmd=log.t_cmd * (1.0 - drift)))
    clocks = choose_stamps(logs, WINDOWS, block_length(logs), SEARCH_DEFAULTS)[1]
    corrected, (clock,) = remove_drift(logs, clocks, WINDOWS, block_length(logs))
    assert abs(clock.drift - drift) < clock.drift_half_width < 1e-4
    late = corrected.logs[0].t_cmd - log.t_cmd
    assert np.ptp(late) < 5e-4  # a constant offset is left
    assert any(
        "the clock of the commands falls behind" in one.text for _, one in clock_findings(corrected, [clock])
    )


@pytest.mark.parametrize("seed", range(4))
def test_clocks_that_do_not_drift_are_left_alone(seed: int) -> None:
    log = record(parameters(joints=2), 2, 6.0, 500, seed=seed)
    logs = dataset(attrs.evolve(log, t_cmd=log.t_cmd - 1e-3))
    clocks = choose_stamps(logs, WINDOWS, block_length(logs), SEARCH_DEFAULTS)[1]
    same, found = remove_drift(logs, clocks, WINDOWS, block_length(logs))
    assert found == clocks
    assert same.logs[0] is logs.logs[0]


@pytest.mark.parametrize("late", [0.0, 0.0012, -0.0012])
def test_a_held_out_recording_is_aligned_as_the_judged_model_sees_it(late: float) -> None:
    logs = dataset(recording(1, 1e-7), heldout=[recording(2, 1e-7)])
    samples = Samples.of(logs.logs)
    held = (samples.log_of_row == 1)[:, None]
    eam = fit_eam(samples, samples.evaluated & ~held, windows=WINDOWS)
    moved = samples.with_shifted_commands([1], late)
    aligned, shift = align_heldout(eam.predict, moved, [1], samples.evaluated & held)
    assert shift == pytest.approx(-late, abs=2e-4)
    errors = [np.mean((one.tau - eam.predict(one)) ** 2, where=held) for one in (samples, aligned)]
    assert errors[1] < 1.1 * errors[0]


def test_one_log_says_that_its_clocks_cannot_be_told_from_the_delay() -> None:
    logs = dataset(recording(1, 0.001))
    clocks = choose_stamps(logs, WINDOWS, block_length(logs), SEARCH_DEFAULTS)[1]
    assert align_commands(logs, clocks, WINDOWS, block_length(logs)) == (logs, clocks)
    (finding,) = (one for _, one in clock_findings(logs, clocks))
    assert "one log cannot separate" in finding.text


def test_each_recording_decides_on_its_own_stamps() -> None:
    logs = dataset(recording(1, jitter=0.0015), recording(2))
    chosen, clocks = choose_stamps(logs, WINDOWS, block_length(logs), SEARCH_DEFAULTS)
    assert [one.even for one in clocks] == [True, False]
    assert np.ptp(np.diff(chosen.logs[0].t)) < 0.2 * np.ptp(np.diff(logs.logs[0].t))
    assert chosen.logs[1] is logs.logs[1]


def test_rows_that_correct_the_stamps_of_a_held_out_log_are_not_reported() -> None:
    logs = dataset(recording(1, 0.001), heldout=[recording(2)])
    t = logs.heldout[0].t
    reported = reported_rows(logs, 1, t, block_length(logs))
    assert 0.78 < reported.mean() < 0.82
    assert not reported_rows(logs, 0, logs.train[0].t, block_length(logs)).any()


def test_each_of_several_logs_can_be_held_out() -> None:
    logs = dataset(*(record(parameters(joints=2), 2, 1.0, 100, seed=seed) for seed in (1, 2, 3)))
    left = logs.hold_out(1)
    assert [one.name for one in left.logs] == ["simulated-1", "simulated-3", "simulated-2"]
    assert [left.is_heldout(k) for k in range(3)] == [False, False, True]
