"""Health of robot and link."""

from __future__ import annotations

import attrs
import pytest

from quadvel_driver.board_state import Battery, BoardState
from quadvel_driver.health import Health, Level, diagnostic_values
from quadvel_driver.link import COUNTER_NAMES, LinkReport
from tests.helpers.robots import ALIENGO

from .conftest import standing

COUNTS = dict.fromkeys(COUNTER_NAMES, 0)
WELL = LinkReport(
    state_rate=500.0,
    send_rate=600.0,
    silence=0.002,
    commanded=True,
    tick_unit="ms",
    counter_rate=None,
    counts={**COUNTS, "states": 100, "sent": 100},
    last_refusal="",
    last_error="",
)


def judged(
    stopped: bool = False, newest: BoardState | None = None, counts: dict | None = None, **changes: object
):
    changed = attrs.evolve(WELL, counts={**WELL.counts, **(counts or {})}, **changes)
    return Health("192.168.123.10:8007", ALIENGO).assess(changed, newest or standing(1), stopped)


def test_all_is_well_where_commands_are_followed_and_where_none_come() -> None:
    assert judged() == (Level.OK, "commands are followed")
    assert judged(commanded=False) == (Level.OK, "no low_cmd: the joints are damped")


@pytest.mark.parametrize(
    ("changes", "level", "sentence"),
    [
        (
            {"silence": float("inf")},
            Level.ERROR,
            "no state from 192.168.123.10:8007 yet: is the robot on and in low",
        ),
        ({"silence": 2.0}, Level.ERROR, "no state from 192.168.123.10:8007 for 2.0 s: is the robot on"),
        (
            {"silence": 2.0, "counts": {"network_errors": 3}, "last_error": "Network is unreachable"},
            Level.ERROR,
            "no state from 192.168.123.10:8007 for 2.0 s: Network is unreachable",
        ),
        (
            {"silence": 2.0, "counts": {"repeated": 500}},
            Level.ERROR,
            "no state from 192.168.123.10:8007 for 2.0 s: its tick stands still",
        ),
        (
            {"silence": 2.0, "counts": {"wrong_length": 500}, "last_refusal": "state: 684 bytes, the old"},
            Level.ERROR,
            "no state from 192.168.123.10:8007 for 2.0 s: state: 684 bytes, the old",
        ),
        (
            {"counter_rate": 32000.0, "silence": float("inf")},
            Level.ERROR,
            "the counter of 192.168.123.10:8007 runs at 32000 a second, expected some 1000 or 1000000",
        ),
        (
            {"counts": {"wrong_crc": 2, "wrong_length": 1}, "last_refusal": "state: CRC is"},
            Level.WARN,
            "3 datagrams dropped in the last second, the last: state: CRC is",
        ),
        ({"counts": {"command_timeouts": 1}}, Level.WARN, "low_cmd stopped: the joints were damped"),
        ({"takeover": "another program"}, Level.ERROR, "another program"),
        ({"stopped": True}, Level.WARN, "stopped by the remote; R1 + L1 + START release it"),
    ],
)
def test_what_is_wrong_with_the_link_is_said(changes: dict, level: Level, sentence: str) -> None:
    found = judged(**changes)
    assert found[0] == level
    assert found[1].startswith(sentence)


def test_a_motor_that_dropped_out_is_named_before_anything_less() -> None:
    newest = standing(1)
    newest.temperature[2] = 75
    assert judged(newest=newest) == (Level.WARN, "FR_calf_joint is at 75 deg C: let it rest")
    newest.motor_mode[7], newest.motor_error[7] = 8, 4
    level, sentence = judged(newest=newest, stopped=True)
    assert level == Level.ERROR
    assert sentence.startswith("RR_thigh_joint has dropped out (mode 8, error 4): stop the robot")


def test_a_battery_that_is_low_is_named_and_each_is_reported() -> None:
    assert judged(newest=attrs.evolve(standing(1), battery=Battery(15, 26.0, -3.0)))[0] == Level.OK
    low = attrs.evolve(standing(1), battery=Battery(14, 26.0, -3.0))
    assert judged(newest=low) == (Level.WARN, "the battery is at 14 %: lie down and charge it")
    assert diagnostic_values(WELL, low, ALIENGO)["battery"] == "14 %, 26.0 V, -3.0 A"


def test_only_what_is_new_since_the_last_report_counts() -> None:
    health, report = (
        Health("board", ALIENGO),
        attrs.evolve(WELL, counts={**WELL.counts, "wrong_crc": 2}, last_refusal="CRC"),
    )
    assert health.assess(report, standing(1), False)[0] == Level.WARN
    assert health.assess(report, standing(1), False)[0] == Level.OK


def test_the_figures_hold_counts_temperatures_and_modes() -> None:
    values = diagnostic_values(WELL, standing(1), ALIENGO)
    assert values["states"] == 100
    assert values["FL_hip_joint temperature"] == 35
    assert values["FL_hip_joint mode"] == 10
    assert values["imu temperature"] == 40
    assert "FL_hip_joint mode" not in diagnostic_values(WELL, None, ALIENGO)
