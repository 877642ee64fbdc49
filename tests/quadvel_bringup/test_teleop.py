"""What teleop shows of the robot."""

from __future__ import annotations

import pytest

import quadvel_dds

quadvel_dds.install()

from quadvel_bringup.teleop import BUTTONS, KEYS, RecoveryKeys, state_line  # noqa: E402
from quadvel_msgs.msg import ControllerState  # noqa: E402
from quadvel_view import gamepad, keyboard  # noqa: E402


@pytest.mark.parametrize("way_out", [KEYS, BUTTONS])
def test_in_fault_the_cause_and_the_way_out_are_shown(way_out: RecoveryKeys) -> None:
    state = ControllerState(mode_name="fault", reason="the trunk tilts by 1.2 rad")
    line = state_line(state, False, 0.5, way_out)
    assert state.reason in line
    assert way_out.recover in line


def test_no_way_out_is_shown_of_a_healthy_robot() -> None:
    line = state_line(ControllerState(mode_name="walk", reason="asked"), False, 0.5, KEYS)
    assert line.startswith("walk ")
    assert KEYS.recover not in line


@pytest.mark.parametrize(("way_out", "hand"), [(KEYS, keyboard), (BUTTONS, gamepad)])
def test_a_pressed_stop_names_what_releases_it_on_this_hand(way_out: RecoveryKeys, hand: object) -> None:
    line = state_line(ControllerState(mode_name="passive"), True, 0.5, way_out)
    assert line.startswith(f"STOPPED, {way_out.release} ")
    assert way_out.release in str(hand.__doc__)
