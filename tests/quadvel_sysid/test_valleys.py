"""A fit that has settled in one of many small valleys of the error finds a deeper one beside it."""

import attrs
import numpy as np
import pytest
from simulated_joints import NAMES, parameters, record
from test_learned import looked_at

from quadvel_actuator import Effect
from quadvel_actuator.effects import registry
from quadvel_sysid.engine.delays import fit_with_delays
from quadvel_sysid.engine.intervals import intervals
from quadvel_sysid.engine.model import Applied
from quadvel_sysid.engine.valleys import as_deep, deepest

WIDTH = 0.05  # rad


@pytest.fixture(scope="module")
def stuck():
    """A hard deadband, fitted from a width that is three hundredths too large, and the rows that it is fitted to."""
    hard = Effect("deadband", NAMES[:3], {"width": WIDTH, "edge": "hard"})
    truth = attrs.evolve(parameters([hard]), joints=NAMES[:3])
    log = record(truth, joints=3, seconds=4.0, motion="mixed", seed=5)
    plain, judge, _ = looked_at(log)
    law = registry()["deadband"].configured({"edge": "hard"}, log.joints)
    one = np.zeros(3, dtype=np.intp)
    begun = plain.plus(Applied(law, np.ones(3, dtype=bool), np.full((1, 3), 1.03 * WIDTH), one))
    late = begun.with_delays(np.full(3, 0.0075), np.full(3, 0.0012))  # 7 and 1 ms are right
    return fit_with_delays(late, judge.fit, 5), judge


def test_a_deeper_valley_is_found_and_its_bottom_is_the_truth(stuck):
    model, judge = stuck
    found = deepest(model, judge.fit, 4)
    assert found.error(judge.fit) < model.error(judge.fit) - 10 * model.mse(judge.fit)
    assert found.applied[0].values == pytest.approx(np.full((1, 3), WIDTH), rel=0.005)


def test_intervals_hold_what_is_as_deep(stuck):
    model, judge = stuck
    found = deepest(model, judge.fit, 4)
    others = as_deep(found, judge.fit)
    half = intervals(found, judge).effects[0]
    assert others
    for other in others:
        assert (np.abs(other.applied[0].values - found.applied[0].values) <= half + 1e-12).all()


def test_what_the_clearest_joint_shows_is_tried_on_all():
    """Three equal drives cog; fits of two of them have settled a lobe of the spectrum away."""
    truth = attrs.evolve(
        parameters([Effect("cogging", NAMES[:3], {"a": 0.8, "n": 60.0, "phi": 0.5})]), joints=NAMES[:3]
    )
    log = record(truth, joints=3, seconds=4.0, motion="mixed", seed=6)
    plain, judge, _ = looked_at(log)
    values = np.array([[0.8, 0.3, 0.3], [60.0, 75.0, 45.0], [0.5, 1.0, -1.0]])
    cogs = Applied(registry()["cogging"](), np.ones(3, dtype=bool), values, np.arange(3))
    settled = fit_with_delays(plain.plus(cogs), judge.fit, 10)
    assert np.abs(settled.applied[0].values[1] - 60.0).max() > 5.0
    found = deepest(settled, judge.fit, 4).applied[0].values
    assert found[1] == pytest.approx(np.full(3, 60.0), abs=0.5)
