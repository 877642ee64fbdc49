"""Lost and late commands, estimated from the torque and reported as a share of samples."""

import attrs
import numpy as np
import pytest

from quadvel_actuator import Effect
from quadvel_sysid.identify import identify
from quadvel_sysid.search import context, lost_commands
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = NAMES[:2]


def test_lost_commands_are_found_alike_in_one_piece_and_in_several(monkeypatch):
    """Of 3000 rows with a command every fifth, three are lost, at the edges of pieces."""
    behind = np.zeros(3000, dtype=int)
    for first in (595, 1400, 2400):
        behind[first : first + 5] = 1
    rng = np.random.default_rng(0)
    costs = 5.0 * (behind[:, None, None] != np.arange(3)) + rng.exponential(0.3, (3000, 1, 3))
    new = (np.arange(3000) % 5 == 0).astype(int)
    several, moves = lost_commands._forward_backward(costs, new, lost_commands.LossProbabilities())
    np.testing.assert_array_equal(several[:, 0].argmax(axis=1), behind)
    assert lost_commands.LossProbabilities.estimate(moves).lost == pytest.approx(3 / 600, rel=0.05)
    monkeypatch.setattr(lost_commands, "_PIECE_ROWS", 3000)
    np.testing.assert_allclose(
        several, lost_commands._forward_backward(costs, new, lost_commands.LossProbabilities())[0], atol=1e-9
    )


def _losing(share, joints=JOINTS):
    """A log that loses that share of its commands, which come at 200 Hz."""
    truth = parameters([Effect("command_hold", joints, {"share": share})], noise=0.01)
    log = record(attrs.evolve(truth, joints=joints), len(joints), 3.0, 500, seed=2)
    sent = slice(None, None, 5)  # what changes at 200 Hz
    return attrs.evolve(log, **{name: getattr(log, name)[sent] for name in ("t_cmd", "q_des", "kp", "kd")})


def test_lost_commands_are_reported_with_their_share_of_samples():
    report = identify([_losing(0.1)]).report
    (effect,) = report["effects"]
    assert effect["name"] == "command_hold"
    assert effect["samples_hit"] == pytest.approx(0.1, abs=0.03)


def test_a_drive_that_lags_after_each_command_alike_loses_none(monkeypatch):
    """Its backlog follows from the age of the command, so no random loss is reported."""
    found = []
    looked_for = lost_commands.lost_commands

    def remembered(*given):
        found.append(looked_for(*given))
        return found[-1]

    monkeypatch.setattr(context, "lost_commands", remembered)
    truth = parameters([Effect("first_order_lag", NAMES[:4], {"T": 0.012})], noise=0.01)
    log = record(attrs.evolve(truth, joints=NAMES[:4]), 4, 3.0, 500, motion="chirp", seed=1)
    assert [one["name"] for one in identify([log]).report["effects"]] == ["first_order_lag"]
    assert found
    assert not any(found)
