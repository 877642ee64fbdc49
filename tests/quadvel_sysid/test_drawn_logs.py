"""Randomly drawn drives: a healthy log yields no findings, a faulty one the finding of its cause."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from quadvel_sysid.logs.check_log import CheckedLog, check_log
from quadvel_sysid.logs.findings import Finding
from tests.quadvel_sysid.drawn_logs import as_log, drawn, of_torque_commands, with_spikes

SEEDS = (1, 3)


def found(checked: CheckedLog) -> list[Finding]:
    """Refusals and warnings, except those about inseparable parameters."""
    return [one for one in checked.findings if one.kind != "note" and "hardly separates" not in one.text]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("stiff", [False, True])
def test_healthy_log_is_used_whole_without_findings(seed: int, stiff: bool) -> None:
    checked = check_log(as_log(drawn(seed, stiff)))
    assert found(checked) == []
    assert checked.log.valid.all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_offset_torque_is_not_unsigned(sign: float) -> None:
    log = as_log(drawn(1))
    assert log.tau is not None
    lifted = log.tau - sign * (sign * log.tau).min(axis=0)
    assert found(check_log(attrs.evolve(log, tau=lifted))) == []


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("lead", [0.07, 1.4, 4.0, -0.3, -2.0])
def test_commands_of_another_time_are_refused_as_another_clock(seed: int, lead: float) -> None:
    (one,) = found(check_log(as_log(drawn(seed, lead=lead))))
    assert (one.kind, one.field) == ("refusal", "t_cmd")


def test_commands_of_another_time_show_in_the_motion_alone() -> None:
    log = attrs.evolve(as_log(drawn(3, lead=1.4)), tau=None)
    refused = [one.field for one in found(check_log(log)) if one.kind == "refusal"]
    assert "t_cmd" in refused


@pytest.mark.parametrize(("share", "size"), [(0.002, 100.0), (0.02, 10.0), (0.1, 5.0)])
def test_spikes_in_the_torque_are_left_out_and_named(share: float, size: float) -> None:
    log = as_log(drawn(1))
    spiky, rows = with_spikes(log, share, size, seed=0)
    checked = check_log(spiky)
    (one,) = found(checked)
    assert (one.kind, one.field) == ("warning", "tau")
    out = ~checked.log.valid
    assert out[rows].mean() > 0.8
    assert out[~rows].mean() < 0.005


@pytest.mark.parametrize("command", [0.0, 0.3])
@pytest.mark.parametrize("torque", [True, False])
def test_a_log_whose_commands_rest_while_all_joints_move_is_refused(command: float, torque: bool) -> None:
    log = of_torque_commands(as_log(drawn(1)), np.array([True, True, True]), command, seed=0)
    (one,) = [
        one
        for one in found(check_log(log if torque else attrs.evolve(log, tau=None)))
        if one.kind == "refusal"
    ]
    assert one.field == "q_des"


@pytest.mark.parametrize(("dither", "rows"), [(1e-3, 0), (0.0, 5), (1e-3, 5)])
def test_commands_that_rest_but_for_noise_and_a_few_rows_are_refused_as_resting(
    dither: float, rows: int
) -> None:
    log = of_torque_commands(as_log(drawn(1)), np.array([True, True, True]), 0.02, seed=0)
    q_des = log.q_des + dither * np.random.default_rng(0).normal(size=log.q_des.shape)
    q_des[:rows] += 0.4
    (one,) = [one for one in found(check_log(attrs.evolve(log, q_des=q_des))) if one.kind == "refusal"]
    assert one.field == "q_des"
    assert one.joints == log.joints


def test_joints_whose_commands_rest_while_they_move_are_left_out() -> None:
    rests = np.array([False, True, False])
    checked = check_log(of_torque_commands(as_log(drawn(1)), rests, 0.0, seed=0))
    (one,) = found(checked)
    assert (one.kind, one.field, one.joints) == ("warning", "q_des", ("1_joint",))
    np.testing.assert_array_equal(checked.log.valid.all(axis=0), ~rests)
    np.testing.assert_array_equal(checked.log.valid.any(axis=0), ~rests)
