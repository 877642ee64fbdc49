"""A following run that cannot begin ends with a sentence."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

import quadvel_dds
from quadvel_bringup.stack import Stack
from quadvel_lab import follow_demo
from quadvel_lab.follow_demo import FollowedWalk

quadvel_dds.install()


class Node:
    """A node of the recorder whose clock is set by the test, s."""

    def __init__(self) -> None:
        self.time = 100.0
        self.hear: Callable[[Any], None]

    def create_subscription(self, kind: type, topic: str, hear: Callable[[Any], None], depth: int) -> None:
        self.hear = hear

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=int(1e9 * self.time)))


@pytest.fixture
def node() -> Node:
    return Node()


@pytest.fixture
def walk(node: Node, monkeypatch: pytest.MonkeyPatch) -> FollowedWalk:
    monkeypatch.setattr(follow_demo, "MAX_WAIT_S", 0.0)
    walk = FollowedWalk(Path("unused.mcap"), Stack(), (0.25, 0.0), 30.0, False, Console(quiet=True))
    walk.listen(node, {})
    return walk


def test_a_robot_that_sees_nobody_ends_the_run_with_its_last_state(walk: FollowedWalk, node: Node) -> None:
    node.hear(SimpleNamespace(data="waiting: sees no person"))
    assert "waiting: sees no person" in walk.failure()


def test_a_robot_that_follows_goes_on_for_its_time_on_the_clock_of_the_nodes(
    walk: FollowedWalk, node: Node
) -> None:
    node.hear(SimpleNamespace(data="following: follows"))
    assert walk.failure() == ""
    node.time += 29.0
    assert not walk.is_over({})
    node.time += 2.0
    assert walk.is_over({})
