"""A velocity only while somebody holds it, zero once it is let go, and a STOP that stays."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_view.operator import HOLD_TIMEOUT_S, MAX_VELOCITY, ZERO_DURATION_S, Operator


def test_nothing_is_published_before_anything_is_held() -> None:
    assert Operator().velocity(0.0) is None


def test_what_is_held_is_published_and_then_zero_and_then_nothing() -> None:
    operator = Operator()
    operator.hold("page", (0.5, 0.0, -0.2), 10.0)
    assert operator.velocity(10.1) == pytest.approx([0.5, 0.0, -0.2])
    operator.end_hold("page", 10.2)
    assert operator.velocity(10.2) == pytest.approx([0.0, 0.0, 0.0])
    assert operator.velocity(10.2 + 0.9 * ZERO_DURATION_S) is not None
    assert operator.velocity(10.2 + 1.1 * ZERO_DURATION_S) is None


def test_who_falls_silent_has_let_go() -> None:
    operator = Operator()
    operator.hold("page", (0.5, 0.0, 0.0), 10.0)
    assert operator.velocity(10.0 + 1.01 * HOLD_TIMEOUT_S) == pytest.approx([0.0, 0.0, 0.0])
    assert operator.velocity(10.0 + HOLD_TIMEOUT_S + 1.1 * ZERO_DURATION_S) is None


def test_a_second_hand_is_not_listened_to_while_the_first_holds() -> None:
    operator = Operator()
    operator.hold(1, (0.5, 0.0, 0.0), 10.0)
    operator.hold(2, (-1.0, 0.0, 0.0), 10.1)
    operator.end_hold(2, 10.1)
    assert operator.velocity(10.1) == pytest.approx([0.5, 0.0, 0.0])
    operator.end_hold(1, 10.2)
    operator.hold(2, (-1.0, 0.0, 0.0), 10.3)
    assert operator.velocity(10.3) == pytest.approx([-1.0, 0.0, 0.0])


def test_after_stop_nothing_is_published_until_it_is_released() -> None:
    operator = Operator()
    operator.hold("page", (0.5, 0.0, 0.0), 10.0)
    operator.stop()
    operator.hold("page", (0.5, 0.0, 0.0), 10.1)
    assert operator.velocity(10.1) is None
    operator.release()
    assert operator.velocity(10.1) is None
    operator.hold("page", (0.5, 0.0, 0.0), 10.2)
    assert operator.velocity(10.2) is not None


def test_no_hand_asks_for_more_than_the_robot_can() -> None:
    operator = Operator()
    operator.hold("page", (99.0, -99.0, 99.0), 10.0)
    assert operator.velocity(10.0) == pytest.approx(MAX_VELOCITY * [1, -1, 1])


@pytest.mark.parametrize("wrong", [(np.nan, 0.0, 0.0), (0.0, 0.0), (0.0, np.inf, 0.0)])
def test_what_is_no_velocity_is_refused(wrong: tuple[float, ...]) -> None:
    operator = Operator()
    with pytest.raises(ValueError, match="expected three finite numbers"):
        operator.hold("page", wrong, 10.0)
    assert operator.velocity(10.0) is None
