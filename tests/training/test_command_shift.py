"""Commands for the teacher that remove the steady errors of its student."""

import numpy as np
import pytest

from quadvel_training.command_shift import MAX_SHIFT, CommandShift


def commands(n: int, seed: int = 0) -> np.ndarray:
    """Random commands of walking robots, (n, 4)."""
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 3)) * [2.0, 1.0, 3.0]
    return np.concatenate([drawn, np.zeros((n, 1))], axis=1)


def slow(asked: np.ndarray) -> np.ndarray:
    """Velocity (n, 3) of a student whose teacher is asked for (n, 4): too slow, and it drifts in curves."""
    drift = np.zeros((len(asked), 3))
    drift[:, 1] = 0.03 * asked[:, 0] * asked[:, 2]
    return 0.9 * asked[:, :3] + drift


def test_a_student_whose_teacher_follows_shifted_commands_has_no_steady_error() -> None:
    shift, found = CommandShift(every=2), []
    for k in range(40):
        command = commands(800, seed=k)
        error = command[:, :3] - slow(command + shift.of(command))
        found.append(np.abs(error).mean())
        shift.add(command, error)
    assert found[0] > 0.1
    assert found[-1] < 0.02 * found[0]


def test_the_shift_changes_after_some_sequences_and_is_bounded() -> None:
    shift, command = CommandShift(every=3), commands(500)
    for _ in range(2):
        shift.add(command, 50.0 * command[:, :3])
    assert not shift.of(command).any()
    shift.add(command, 50.0 * command[:, :3])
    once = np.abs(shift.of(command)).max(axis=0)
    for _ in range(60):
        shift.add(command, 50.0 * command[:, :3])
    largest = np.abs(shift.of(command)).max(axis=0)
    assert (once[:3] > 0.0).all()
    assert (once[:3] < MAX_SHIFT).all()
    assert largest[:3] == pytest.approx(MAX_SHIFT)
    assert largest[3] == 0.0


def test_a_shift_at_its_bound_returns_as_soon_as_the_error_changes_its_sign() -> None:
    shift, command = CommandShift(every=1), commands(500)
    pushed = 0.1 * np.sign(command[:, :3])
    for _ in range(60):
        shift.add(command, pushed)
    at_bound = np.median(np.abs(shift.of(command)[:, 0]))
    for _ in range(3):
        shift.add(command, -pushed)
    assert np.median(np.abs(shift.of(command)[:, 0])) < 0.8 * at_bound


def test_the_shift_is_symmetric_and_zero_in_stance() -> None:
    shift, command = CommandShift(every=1), commands(500)
    shift.add(command, np.abs(command[:, :3]) ** 1.5)
    mirror = np.array([1.0, -1.0, -1.0, 1.0])
    np.testing.assert_allclose(shift.of(command * mirror), shift.of(command) * mirror, atol=1e-12)
    command[:, 3] = 1.0
    assert not shift.of(command).any()


def test_a_resumed_run_goes_on_with_its_shift() -> None:
    first, second, command = CommandShift(every=1), CommandShift(every=1), commands(300)
    first.add(command, 0.1 * command[:, :3])
    second.restore(first.state())
    np.testing.assert_array_equal(second.of(command), first.of(command))


def test_an_error_at_one_speed_is_removed_there_and_not_at_twice_the_speed() -> None:
    shift = CommandShift(every=1)
    command = np.zeros((900, 4))
    command[:, 0] = np.repeat([0.5, 1.0, 1.5], 300)
    for _ in range(30):
        error = np.zeros((900, 3))
        error[:300, 0] = 0.05 - shift.of(command)[:300, 0]
        error[300:, 0] = -shift.of(command)[300:, 0]
        shift.add(command, error)
    assert shift.of(command)[::300, 0] == pytest.approx([0.05, 0.0, 0.0], abs=2e-3)
