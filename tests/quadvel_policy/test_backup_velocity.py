"""When the backup filter runs, and that its velocity is new whenever it matters."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from quadvel_description.state import RobotState
from quadvel_policy.backup_velocity import BATCH, THINNING, BackupVelocity

REST = RobotState(
    0.0, 0, *np.zeros((3, 12)), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), np.zeros(4)
)
TOLERANCE = 0.4


class Clock:
    """A filter whose velocity along x is the time of the newest state; it fails at negative times."""

    def __init__(self) -> None:
        self.batches: list[list[float]] = []

    def reset(self) -> None:
        self.batches.clear()

    def update_series(self, times: Sequence[float], states: RobotState) -> tuple[np.ndarray, np.ndarray]:
        assert states.q.shape == (len(times), 12)
        if min(times) < 0.0:
            raise FloatingPointError("a negative time")
        self.batches.append(list(times))
        return np.array([times[-1], 0.0, 0.0]), np.eye(3)


def _add(backup: BackupVelocity, times: Sequence[float]) -> None:
    for time in times:
        backup.add(attrs.evolve(REST, time=time))


def _velocity(backup: BackupVelocity) -> float | None:
    return None if backup.velocity is None else float(backup.velocity[0])


def test_states_wait_while_the_estimate_is_confirmed_and_some_are_skipped() -> None:
    filter = Clock()
    backup = BackupVelocity(filter)
    times = [0.01 * k for k in range(2 * BATCH + 1)]
    for time in times:
        _add(backup, [time])
        backup.confirm(np.zeros(3), TOLERANCE)
    step = slice(THINNING - 1, None, THINNING)
    assert filter.batches == [times[:1], times[1 : BATCH + 1][step], times[BATCH + 1 :][step]]


def test_no_state_is_skipped_while_the_velocity_is_needed() -> None:
    filter = Clock()
    backup = BackupVelocity(filter)
    _add(backup, times := [0.01 * k for k in range(BATCH)])
    backup.confirm(None, TOLERANCE)
    _add(backup, more := [0.01 * k for k in range(BATCH, 2 * BATCH)])
    assert [time for batch in filter.batches for time in batch] == times + more


def test_an_estimate_that_is_missing_or_off_is_compared_with_the_newest_state() -> None:
    for estimate in (None, np.array([0.02 - 1.1 * TOLERANCE, 0.0, 0.0]), np.full(3, np.nan)):
        backup = BackupVelocity(Clock())
        _add(backup, [0.0, 0.01, 0.02])
        assert _velocity(backup) == 0.0
        backup.confirm(estimate, TOLERANCE)
        assert _velocity(backup) == 0.02
        _add(backup, [0.03])
        assert _velocity(backup) == 0.03


def test_a_velocity_that_is_used_is_that_of_the_newest_state() -> None:
    backup = BackupVelocity(Clock())
    _add(backup, [0.0, 0.01])
    backup.confirm(np.zeros(3), TOLERANCE)
    newest = backup.newest()
    assert newest is not None
    assert newest[0] == 0.01


def test_a_filter_that_fails_has_no_velocity_until_the_next_state() -> None:
    backup = BackupVelocity(Clock())
    _add(backup, [0.0, -1.0])
    assert backup.newest() is None
    _add(backup, [0.02])
    assert _velocity(backup) == 0.02
