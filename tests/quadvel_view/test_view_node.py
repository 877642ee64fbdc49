"""The node of the page under more orders than it can execute: STOP at once, everything else goes on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor

from quadvel_view.page_protocol import Hold, Passive, Release, StandUp, Stop
from quadvel_view.view_node import View

MANY = 20_000


class Answer:
    """Future of a call that is never answered."""

    def add_done_callback(self, callback: Any) -> None:
        pass


class Service:
    """Client of a service that receives every request and answers none."""

    def __init__(self) -> None:
        self.modes: list[str] = []
        self.requesters: list[str] = []
        self.waiting: set[Answer] = set()

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: Any) -> Answer:
        self.modes.append(request.mode)
        self.requesters.append(request.requester)
        answer = Answer()
        self.waiting.add(answer)
        return answer

    def remove_pending_request(self, answer: Answer) -> None:
        self.waiting.discard(answer)


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch) -> Iterator[View]:
    rclpy.init(args=["test", "--ros-args", "-p", "port:=0"])
    node = View()
    monkeypatch.setattr(node, "_set_mode", Service())
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    yield node
    executor.remove_node(node)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


def spin_until_stopped(view: View, limit_s: float = 10.0) -> float:
    """Spin until STOP is latched; return the time that it took, s."""
    start = time.monotonic()
    while not view._operator.stopped and time.monotonic() - start < limit_s:
        view.executor.spin_once(timeout_sec=0.1)
    return time.monotonic() - start


def test_stop_passes_orders_that_came_before_it(view: View) -> None:
    for _ in range(MANY):
        view._on_message(1, StandUp())
        view._on_message(1, Hold((0.5, 0.0, 0.0)))
    view._on_message(2, Stop())
    assert spin_until_stopped(view) < 0.5
    assert view._set_mode.modes == ["passive"]
    assert view._set_mode.requesters[0].startswith("STOP on the page")
    assert view._operator.velocity(time.monotonic()) is None


@pytest.mark.parametrize("order", [Passive(), Stop()])
def test_repeated_orders_delay_no_timer_and_call_a_service_a_few_times(view: View, order: Any) -> None:
    frames: list[float] = []
    view.create_timer(0.01, lambda: frames.append(time.monotonic()))
    for _ in range(MANY):
        view._on_message(1, order)
    start = time.monotonic()
    while not frames and time.monotonic() - start < 10.0:
        view.executor.spin_once(timeout_sec=0.1)
        view._on_message(1, order)
    assert frames[0] - start < 0.5
    assert len(view._set_mode.modes) <= 2


def test_a_repeated_stop_is_transmitted_again_until_the_joints_are_damped(view: View) -> None:
    start = time.monotonic()
    while time.monotonic() - start < 1.0:
        view._on_message(1, Stop())
        view.executor.spin_once(timeout_sec=0.01)
    assert 2 <= len(view._set_mode.modes) <= 6


def test_a_stop_after_its_release_is_transmitted_at_once(view: View) -> None:
    for order in (Stop(), Release(), Stop()):
        view._on_message(1, order)
        view._execute_orders()
    assert view._set_mode.modes == ["passive", "passive"]


def test_a_service_that_does_not_answer_fills_no_memory(view: View) -> None:
    for _ in range(100):
        view._on_message(1, Passive())
        view._execute_orders()
    assert len(view._set_mode.modes) == 100
    assert len(view._set_mode.waiting) == 1
