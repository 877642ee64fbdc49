"""Actuators of groups of robots: each group moves as robots with its drives alone do."""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_training.actuator_groups import ActuatorGroups
from quadvel_training.randomisation import Randomisation
from tests.helpers.robots import ALIENGO

DT = 0.0025
PLAIN = attrs.evolve(ActuatorParameters.of(ALIENGO), torque_noise=0.0)
STIFF = attrs.evolve(PLAIN, delta_kp=9.0)
STILL = Randomisation(transmission_delay=(0.0, 0.0))


def steps(actuators: ActuatorGroups | ActuatorModel, kp: float | np.ndarray, robots: slice, count: int = 30):
    rng = np.random.default_rng(3)
    for _ in range(count):
        q, dq, target, push = rng.normal(0.0, 0.3, (4, 5, 12))[:, robots]
        gain = kp[robots] if np.ndim(kp) else kp
        yield actuators.step(q, dq, target, gain, 0.5, 0.0, push).copy()


def test_each_group_has_its_own_drives() -> None:
    groups = ActuatorGroups((PLAIN, STIFF), 5, DT, seed=1)
    kp = np.full((5, 12), 30.0)
    both = np.array(list(steps(groups, kp, slice(None))))
    for rows, kind in ((slice(0, 2), PLAIN), (slice(2, 5), STIFF)):
        alone = ActuatorModel(kind, (len(kp[rows]), 12), DT, seed=1)
        np.testing.assert_array_equal(both[:, rows], list(steps(alone, kp, rows)))


def test_one_kind_is_one_model_even_with_draws() -> None:
    groups, alone = ActuatorGroups((PLAIN,), 5, DT, seed=1), ActuatorModel(PLAIN, (5, 12), DT, seed=1)
    groups.sample(np.array([1, 4]), STILL, np.random.default_rng(2))
    alone.sample(np.array([1, 4]), np.random.default_rng(2))
    alone.reset(np.array([1, 4]))
    np.testing.assert_array_equal(
        list(steps(groups, 30.0, slice(None))), list(steps(alone, 30.0, slice(None)))
    )


def test_a_reset_concerns_the_robots_that_are_named() -> None:
    groups, fresh = (ActuatorGroups((PLAIN, STIFF), 5, DT, seed=1) for _ in range(2))
    list(steps(groups, 30.0, slice(None)))
    groups.reset(np.array([0, 3]))
    now, new = (next(steps(one, 30.0, slice(None))) for one in (groups, fresh))
    np.testing.assert_array_equal(now[[0, 3]], new[[0, 3]])
    assert (now[[1, 2, 4]] != new[[1, 2, 4]]).any(axis=1).all()
