"""The command map: what it can represent, and how it is found on robots that walk, slip and fall."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel[train]'")

from quadvel_description import symmetry
from quadvel_training.command_map import CommandMap, Tracking, fit_command_map
from quadvel_training.env import CommandRange


def test_the_command_map_finds_a_map_of_its_own_kind():
    rng = np.random.default_rng(0)
    wanted = rng.uniform(-1, 1, (2000, 3))
    x, _, r = wanted.T
    missing = np.stack([0.1 * x + 0.02, 0.2 * x * r, 0.3 * r], axis=1)
    command_map = CommandMap()
    command_map.correct(wanted, missing)
    out = command_map(np.column_stack([wanted, np.zeros(2000)]))
    assert np.abs(out[:, :3] - wanted - missing).max() < 2e-3
    still = np.array([[0.0, 0.0, 0.0, 1.0]])
    assert np.array_equal(command_map(still), still)


def test_the_command_map_of_a_teacher_treats_left_and_right_alike():
    rng = np.random.default_rng(1)
    wanted = rng.uniform(-1, 1, (500, 3))
    command_map = CommandMap(mirrored=True)
    command_map.correct(wanted, rng.normal(0, 0.1, (500, 3)))
    command = np.column_stack([wanted, np.zeros(500)])
    mirror = symmetry.PARTS["command"]
    assert np.allclose(command_map(mirror(command)), mirror(command_map(command)))


def test_the_command_map_of_a_robot_takes_out_what_it_does_to_one_side_only():
    wanted = np.random.default_rng(3).uniform(-1, 1, (2000, 3))
    x, y, _ = wanted.T
    missing = np.stack([0.03 * y, 0.02 * x, np.full(2000, 0.01)], axis=1)
    command_map = CommandMap()
    command_map.correct(wanted, missing)
    out = command_map(np.column_stack([wanted, np.zeros(2000)]))
    assert np.abs(out[:, :3] - wanted - missing).max() < 2e-3


class Slipping:
    """Robots whose velocity follows 0.7 of what they are given, beyond a dead zone; fast ones backwards fall at once."""

    def __init__(self, n: int) -> None:
        self.rng = np.random.default_rng(2)
        self.env = self
        self.config = SimpleNamespace(n=n)
        self.own, self.tracking = CommandMap(), Tracking(n, gain=0.0)
        self.command, self.velocity, self.angular_velocity = (
            np.zeros((n, 4)),
            np.zeros((n, 3)),
            np.zeros((n, 3)),
        )
        self.changed = np.zeros(n, bool)
        self.reset(np.arange(n))

    def reset(self, ids):
        self.command[ids] = CommandRange(stance=0.0).draw(self.rng, len(ids))
        self.velocity[ids] = self.angular_velocity[ids] = 0.0
        self.tracking.reset(ids)

    def targets(self):
        return self.own(self.command)

    def tick(self, given):
        walked = 0.7 * np.sign(given[:, :3]) * (np.abs(given[:, :3]) - 0.1).clip(0)
        self.velocity[:, :2] += 0.02 * (walked - self.velocity)[:, :2]
        self.angular_velocity[:, 2] += 0.02 * (walked[:, 2] - self.angular_velocity[:, 2])
        self.fallen = self.command[:, 0] < -0.7
        self.velocity[self.fallen] = 30.0

    def advance(self):
        self.tracking.advance(self, self.command[:, :3])


def test_slipping_robots_walk_as_wanted_behind_the_map_that_was_fitted_to_them():
    walker = Slipping(64)
    fit = fit_command_map(walker, seconds=12.0)
    error = walker.tracking.error[walker.command[:, 0] > -0.7]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 0.04  # 0.2 to 0.4 without
    assert fit.after < 0.2 * fit.before
    assert fit.falls > 0
