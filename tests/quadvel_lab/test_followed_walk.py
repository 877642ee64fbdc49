"""A following run that cannot begin ends with a sentence."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from quadvel_bringup.stack import Stack
from quadvel_lab import follow_demo
from quadvel_lab.follow_demo import FollowedWalk


@pytest.fixture
def walk(monkeypatch: pytest.MonkeyPatch) -> FollowedWalk:
    monkeypatch.setattr(follow_demo, "MAX_WAIT_S", 0.0)
    return FollowedWalk(Path("unused.mcap"), Stack(), (0.25, 0.0), 30.0, False, Console(quiet=True))


def test_a_robot_that_sees_nobody_ends_the_run_with_its_last_state(walk: FollowedWalk) -> None:
    walk._on_state(SimpleNamespace(data="waiting: sees no person"))
    assert "waiting: sees no person" in walk.failure()


def test_a_robot_that_follows_goes_on(walk: FollowedWalk) -> None:
    walk._on_state(SimpleNamespace(data="following: follows"))
    assert walk.failure() == ""
