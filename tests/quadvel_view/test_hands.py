"""Keys that repeat and gamepads with a dead-man's button: what is held counts, and nothing else."""

from __future__ import annotations

import pytest

from quadvel_view import gamepad
from quadvel_view.gamepad import AxisRange, Gamepad
from quadvel_view.keyboard import FIRST_REPEAT_TIMEOUT_S, REPEAT_TIMEOUT_S, Keyboard, split_keys

SPANS = {code: AxisRange(-32768, 32767) for code in gamepad.STICKS}


def test_a_key_counts_until_its_repeats_end() -> None:
    keys = Keyboard()
    assert keys.velocity(0.0) is None
    keys.press("w", 0.0)
    assert keys.velocity(0.9 * FIRST_REPEAT_TIMEOUT_S) == pytest.approx([0.5, 0.0, 0.0])
    last = 0.5
    for repeat in range(30):
        last = 0.5 + repeat / 30
        keys.press("w", last)
        assert keys.velocity(last + 0.03) is not None
    assert keys.velocity(last + 1.01 * REPEAT_TIMEOUT_S) is None


def test_a_tap_ends_by_itself() -> None:
    keys = Keyboard()
    keys.press("d", 0.0)
    assert keys.velocity(0.1)[2] < 0.0
    assert keys.velocity(1.01 * FIRST_REPEAT_TIMEOUT_S) is None


def test_any_other_key_lets_go() -> None:
    keys = Keyboard()
    keys.press("w", 0.0)
    keys.press("m", 0.1)
    assert keys.velocity(0.1) is None


def test_speed_changes_in_steps_and_has_ends() -> None:
    keys = Keyboard()
    keys.press("+", 0.0)
    assert keys.speed == 0.8
    for _ in range(20):
        keys.press("-", 0.0)
    assert keys.speed == 0.1
    keys.press("s", 0.0)
    assert keys.velocity(0.0) == pytest.approx([-0.1, 0.0, 0.0])


def test_what_a_terminal_sends_is_cut_into_keys() -> None:
    assert split_keys("w\x1b[Aa\x1b[C ") == ["w", "\x1b[A", "a", "\x1b[C", " "]


def test_sticks_count_while_the_dead_mans_button_is_held() -> None:
    pad = Gamepad(SPANS)
    pad.handle_event(gamepad.ABSOLUTE, gamepad.FORWARD, -32768)
    pad.handle_event(gamepad.ABSOLUTE, gamepad.YAW, 32767)
    assert pad.velocity() is None
    pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 1)
    assert pad.velocity() == pytest.approx([0.5, 0.0, -0.8])
    pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 0)
    assert pad.velocity() is None


def test_a_stick_that_rests_a_little_off_its_middle_is_at_rest() -> None:
    pad = Gamepad(SPANS)
    pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 1)
    pad.handle_event(gamepad.ABSOLUTE, gamepad.SIDE, 2500)
    assert pad.velocity() == pytest.approx([0.0, 0.0, 0.0])


def test_buttons_stop_and_release_when_they_go_down() -> None:
    pad = Gamepad(SPANS)
    assert pad.handle_event(gamepad.KEY, gamepad.STOP, 1) == "stop"
    assert pad.handle_event(gamepad.KEY, gamepad.STOP, 0) == ""
    assert pad.handle_event(gamepad.KEY, gamepad.RELEASE, 1) == "release"


class Clock:
    """Seconds, as a test sets them."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def held_pad(clock: Clock) -> Gamepad:
    """A gamepad whose dead-man's button is down and whose stick is ahead."""
    pad = Gamepad(SPANS, clock)
    pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 1)
    pad.handle_event(gamepad.ABSOLUTE, gamepad.FORWARD, -32768)
    assert pad.velocity() is not None
    return pad


@pytest.mark.parametrize(("keys", "held"), [((), False), ((gamepad.DEAD_MAN,), True)])
def test_after_lost_events_nothing_is_held_until_the_device_was_read_again(
    keys: tuple[int, ...], held: bool
) -> None:
    pad = held_pad(Clock())
    assert pad.handle_event(gamepad.SYNCHRONISATION, gamepad.DROPPED, 0) == ""
    assert pad.velocity() is None
    assert pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 1) == ""  # the rest of the cut report
    assert pad.velocity() is None
    assert pad.handle_event(gamepad.SYNCHRONISATION, gamepad.REPORT, 0) == "restore"
    assert pad.restore(keys, dict.fromkeys(gamepad.STICKS, 32767)) == ""
    velocity = pad.velocity()
    assert (velocity is not None) == held
    if velocity is not None:
        assert velocity == pytest.approx([-0.5, -0.3, -0.8], abs=1e-3)


def test_a_stop_among_lost_events_counts() -> None:
    pad = held_pad(Clock())
    pad.handle_event(gamepad.SYNCHRONISATION, gamepad.DROPPED, 0)
    assert pad.restore((gamepad.STOP, gamepad.DEAD_MAN), dict.fromkeys(gamepad.STICKS, 0)) == "stop"


def test_a_silent_pad_counts_as_let_go_until_its_button_is_pressed_again() -> None:
    clock = Clock()
    pad = held_pad(clock)
    clock.now = 0.9 * gamepad.SILENCE_TIMEOUT_S
    assert pad.velocity() is not None
    pad.handle_event(gamepad.ABSOLUTE, gamepad.FORWARD, -32767)  # a hand trembles
    clock.now = 1.8 * gamepad.SILENCE_TIMEOUT_S
    assert pad.velocity() is not None
    clock.now = 2.0 * gamepad.SILENCE_TIMEOUT_S
    assert pad.velocity() is None
    assert pad.timed_out
    pad.handle_event(gamepad.ABSOLUTE, gamepad.FORWARD, -32768)  # the link is back, the hand may be elsewhere
    assert pad.velocity() is None
    pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 0)
    pad.handle_event(gamepad.KEY, gamepad.DEAD_MAN, 1)
    assert pad.velocity() is not None
    assert not pad.timed_out


def test_what_has_no_two_sticks_is_refused() -> None:
    with pytest.raises(ValueError, match="no axis 0x3, expected two sticks"):
        Gamepad({code: SPANS[code] for code in (gamepad.FORWARD, gamepad.SIDE)})
