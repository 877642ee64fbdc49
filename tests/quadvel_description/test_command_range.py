"""Tests of joint targets beyond the command range."""

import numpy as np
import pytest

from quadvel_description.command_range import split_target
from quadvel_description.state import JointCommand
from tests.helpers.robots import ALIENGO

KNEE = 2


def test_a_target_within_the_range_goes_as_it_is():
    target, torque = split_target(ALIENGO, ALIENGO.nominal_q + 0.2, ALIENGO.kp, ALIENGO.nominal_q)
    np.testing.assert_array_equal(target, ALIENGO.nominal_q + 0.2)
    np.testing.assert_array_equal(torque, np.zeros(12))


def test_what_lies_beyond_the_range_pushes_as_the_whole_target_would():
    wanted = ALIENGO.nominal_q + np.tile([1.2, 0.1, 1.0], 4)
    target, torque = split_target(ALIENGO, wanted, ALIENGO.kp, ALIENGO.nominal_q)
    assert (target <= ALIENGO.command_upper).all()
    np.testing.assert_allclose(ALIENGO.kp * target + torque, ALIENGO.kp * wanted)
    assert torque[KNEE] == pytest.approx(30.0 * (-1.287 + 1.0 + 0.646))
    sent = JointCommand(q=target, tau=torque, kp=np.full(12, ALIENGO.kp))
    np.testing.assert_allclose(sent.target, wanted)


@pytest.mark.parametrize(("wanted", "stop"), [(9.0, ALIENGO.upper), (-9.0, ALIENGO.lower)])
def test_no_torque_into_a_mechanical_stop_beyond_what_is_left_of_the_way(wanted, stop):
    away = -np.sign(wanted)
    pushes = [
        np.sign(wanted) * split_target(ALIENGO, np.full(12, wanted), ALIENGO.kp, stop + away * way)[1]
        for way in (-0.1, 0.0, 0.05, 0.1, 5.0)
    ]
    np.testing.assert_array_equal(pushes[:2], np.zeros((2, 12)))
    np.testing.assert_allclose(pushes[2:4], np.tile([[5.0], [10.0]], 12))
    np.testing.assert_allclose(pushes[4], ALIENGO.torque_limit)


def test_a_robot_that_brakes_is_not_pushed():
    assert not split_target(ALIENGO, np.full(12, 9.0), np.zeros(12), ALIENGO.nominal_q)[1].any()


def test_batches_are_as_their_robots():
    rng = np.random.default_rng(0)
    wanted, q = rng.normal(0, 2, (2, 5, 12))
    together = split_target(ALIENGO, wanted, ALIENGO.kp, q)
    alone = [split_target(ALIENGO, w, ALIENGO.kp, p) for w, p in zip(wanted, q, strict=True)]
    np.testing.assert_array_equal(together, np.swapaxes(alone, 0, 1))
