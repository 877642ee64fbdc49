"""What the remote's sticks and buttons mean."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_driver.board_state import Button, Remote
from quadvel_driver.remote import BUTTONS, ZERO_VELOCITY_S, OperatorCommand, RemoteConfig, RemotePilot

CONFIG = RemoteConfig(stick_dead_zone=0.1, stick_velocity=(1.0, 0.5, 2.0))


@pytest.fixture
def pilot() -> RemotePilot:
    return RemotePilot(CONFIG)


def press(pilot: RemotePilot, buttons: Button) -> OperatorCommand | None:
    """What pressing buttons and letting them go orders."""
    order = pilot.update(Remote(buttons), 0.0)
    assert pilot.update(Remote(buttons), 0.0) is None
    assert pilot.update(Remote(), 0.0) is None
    return order


@pytest.mark.parametrize(
    "order", [order for order in OperatorCommand if order is not OperatorCommand.RELEASE]
)
def test_an_order_is_given_once_when_its_buttons_go_down(pilot: RemotePilot, order: OperatorCommand) -> None:
    assert press(pilot, BUTTONS[order]) is order


def test_arrows_alone_order_nothing(pilot: RemotePilot) -> None:
    for button in (Button.UP, Button.DOWN, Button.LEFT, Button.RIGHT, Button.L1, Button.START):
        assert press(pilot, button) is None


def test_a_stop_stays_until_it_is_released_and_nothing_else_counts_meanwhile(pilot: RemotePilot) -> None:
    assert press(pilot, Button.B) is OperatorCommand.STOP
    for order in (
        OperatorCommand.STAND_UP,
        OperatorCommand.LIE_DOWN,
        OperatorCommand.ALLOW_WALKING,
        OperatorCommand.FORBID_WALKING,
    ):
        assert press(pilot, BUTTONS[order]) is None
    assert pilot.stopped
    assert press(pilot, BUTTONS[OperatorCommand.RELEASE]) is OperatorCommand.RELEASE
    assert pilot.stopped  # the caller resets it
    pilot.stopped = False
    assert press(pilot, BUTTONS[OperatorCommand.STAND_UP]) is OperatorCommand.STAND_UP


def test_a_stop_counts_whatever_else_is_held(pilot: RemotePilot) -> None:
    assert press(pilot, BUTTONS[OperatorCommand.STAND_UP] | Button.B) is OperatorCommand.STOP
    assert press(pilot, BUTTONS[OperatorCommand.RELEASE] | Button.B) is OperatorCommand.STOP


def test_there_is_nothing_to_release_where_nothing_was_stopped(pilot: RemotePilot) -> None:
    assert press(pilot, BUTTONS[OperatorCommand.RELEASE]) is None


@pytest.mark.parametrize(
    ("sticks", "velocity"),
    [
        ({"ly": 1.0}, (1.0, 0.0, 0.0)),
        ({"ly": -1.0}, (-1.0, 0.0, 0.0)),
        ({"lx": 1.0}, (0.0, -0.5, 0.0)),
        ({"rx": 1.0}, (0.0, 0.0, -2.0)),
        ({"ly": 0.55}, (0.5, 0.0, 0.0)),
        ({"ly": 1e9, "rx": -5.0}, (1.0, 0.0, 2.0)),
    ],
)
def test_sticks_are_velocities_in_the_robots_axes(
    pilot: RemotePilot, sticks: dict[str, float], velocity: tuple[float, ...]
) -> None:
    pilot.update(Remote(**sticks), 0.0)
    np.testing.assert_allclose(pilot.velocity(0.0), velocity, atol=1e-12)


def test_sticks_in_the_dead_zone_command_nothing(pilot: RemotePilot) -> None:
    pilot.update(Remote(lx=0.09, ly=-0.1, rx=0.05), 0.0)
    assert pilot.velocity(0.0) is None


def test_sticks_let_go_command_zero_for_a_while_and_then_leave_the_robot_to_others(
    pilot: RemotePilot,
) -> None:
    pilot.update(Remote(ly=1.0), 10.0)
    pilot.update(Remote(), 10.1)
    np.testing.assert_array_equal(pilot.velocity(10.1), np.zeros(3))
    assert pilot.velocity(10.0 + ZERO_VELOCITY_S + 0.01) is None


def test_a_stopped_robot_follows_no_stick(pilot: RemotePilot) -> None:
    pilot.update(Remote(Button.B, ly=1.0), 0.0)
    assert pilot.velocity(0.0) is None


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"stick_dead_zone": 1.0}, "stick_dead_zone is 1.0, expected 0 to below 1"),
        ({"stick_velocity": (1.0, 1.0)}, r"stick_velocity is \[1.0, 1.0\], expected three speeds"),
        ({"stick_velocity": (1.0, np.nan, 1.0)}, "expected three speeds"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(changes: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        RemoteConfig(**changes)
