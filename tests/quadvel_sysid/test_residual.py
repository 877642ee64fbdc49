"""What is left in the end: white noise is white, and what is not is told with the signal that it goes with."""

import attrs
import numpy as np
from simulated_joints import NAMES, parameters, record
from test_learned import looked_at

from quadvel_sysid.engine.residual import remainder

TRUTH = attrs.evolve(parameters(), joints=NAMES[:2])


def test_noise_is_white():
    model, judge, _ = looked_at(record(TRUTH, 2, 3.0, 500, "mixed", 7))
    rest = remainder(model, None, judge)
    assert not rest.structured
    assert rest.depends_on == ()
    assert not rest.joints.any()


def test_what_is_not_white_is_told_with_its_signal_though_nothing_was_learned():
    def ripple(k, q, dq, tau):
        return tau - np.array([0.0, 1.0]) * np.sin(25.0 * q)

    model, judge, _ = looked_at(record(TRUTH, 2, 3.0, 500, "mixed", 7, distort=ripple))
    rest = remainder(model, None, judge)
    assert rest.structured
    assert rest.joints.tolist() == [False, True]
    assert rest.depends_on == ("q",)
