"""The second generator: reproducible logs whose truth is that of the machine."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.identification.other_plant.cases import GROUP_OF, make_case
from benchmarks.identification.other_plant.machine import Machine, run

pytestmark = pytest.mark.long  # compiles the plant


def test_a_joint_without_effects_gets_the_torque_of_the_pd_law() -> None:
    two = np.ones(2)
    machine = Machine(0.05 * two, 0.5 * two, 0.05 * two, 0.0 * two, (30.0, 1.0), 1, 0.004, 3)
    sent = np.arange(0.0, 1.0, 0.02)
    targets = 0.3 * np.sin(9.0 * sent)[:, None] * two
    made = run(machine, sent, targets, 1.0)
    np.testing.assert_array_equal(made.tau, made.law)
    at = np.arange(1000, 5000)  # 0.2 ms each; the torque of three ticks before
    newest = np.searchsorted(sent + 0.004, (at - 3) * 0.0002 + 1e-9, side="right") - 1
    asked = 30.0 * (targets[newest] - made.q[at - 3]) - made.dq[at - 3]
    np.testing.assert_allclose(made.tau[at], asked, atol=1e-9)


@pytest.mark.parametrize("kind", list(GROUP_OF))
def test_logs_are_reproducible_and_their_stamps_increase(kind: str) -> None:
    one, same = make_case(kind, 0, 5), make_case(kind, 0, 5)
    assert one.truth == same.truth
    assert (one.holdout is not None) == (kind == "two_logs")
    for log in filter(None, (one.log, one.holdout)):
        assert (np.diff(log["t"]) > 0.0).all()
        assert np.isfinite(log["tau"]).all()
        assert np.abs(log["q"]).max() < 6.0
    np.testing.assert_array_equal(one.log["tau"], same.log["tau"])
