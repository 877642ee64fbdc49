"""Random commands in raw steps: their distribution, and what is counted."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.paper.steps import HOLD_S, SEMI_AXES, Steps, draw_commands


def test_commands_fill_the_papers_ellipsoid_uniformly_and_one_in_five_stands() -> None:
    commands = [command for seed in range(400) for command, _ in draw_commands(seed, 40.0)]
    radius = np.linalg.norm(np.array(commands) / SEMI_AXES, axis=1)
    assert radius.max() <= 1.0
    assert np.mean(radius == 0.0) == pytest.approx(0.2, abs=0.03)
    moving = radius[radius > 0.0]
    # in a ball of radius 1 the share within r is r^3
    assert [np.mean(moving < r) for r in (0.5, 0.8)] == pytest.approx([0.125, 0.512], abs=0.03)


def test_commands_last_for_2_to_10_s_and_fill_the_episode() -> None:
    held = [seconds for _, seconds in draw_commands(3, 200.0)]
    assert sum(held) == pytest.approx(200.0)
    assert min(held[:-1]) >= HOLD_S[0]
    assert max(held) <= HOLD_S[1]
    assert draw_commands(3, 20.0) == draw_commands(3, 20.0) != draw_commands(4, 20.0)


def test_the_share_of_falls_counts_the_episodes_that_ended_early() -> None:
    section = Steps()
    ends = (None, 3.5, None, None)
    records = section.to_records([({"policy": "mine", "seed": i}, end) for i, end in enumerate(ends)])
    ours = {row.what: row.ours["mine"] for row in section.rows(records)}
    assert ours == {"episodes that end in a fall": 25.0, "episodes": 4}
    section.figure(records)
