"""Planner node with a fake controller in this process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from quadvel_lab.scripted_planner import RETRY_INTERVAL_S, ScriptedPlanner  # noqa: E402
from quadvel_msgs.msg import ControllerState  # noqa: E402
from quadvel_msgs.srv import SetMode  # noqa: E402


class Controller:
    """Fake controller with a given mode and loop rate that records mode requests."""

    def __init__(self, *parameters: str) -> None:
        rclpy.init(args=["test", "--ros-args", *(word for name in parameters for word in ("-p", name))])
        self.node, self._planner = rclpy.create_node("controller"), ScriptedPlanner()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._planner)
        self._own_executor = SingleThreadedExecutor()
        self._own_executor.add_node(self.node)
        self.asked: list[str] = []
        self._state = self.node.create_publisher(ControllerState, "controller/state", 10)
        self.node.create_service(SetMode, "controller/set_mode", self._on_set_mode)

    def _on_set_mode(self, request: Any, response: Any) -> Any:
        self.asked.append(request.mode)
        return response

    def publish_until(
        self, rate: float, is_so: Callable[[], Any], *, mode: str = "passive", answers: bool = True
    ) -> None:
        """Publish states (rate: Hz of the loop) until the predicate holds; answer requests, or let them wait."""
        until = time.monotonic() + 20.0
        while not is_so():
            assert time.monotonic() < until, f"asked for {self.asked}"
            self._state.publish(ControllerState(mode_name=mode, rate_hz=rate))
            self._executor.spin_once(timeout_sec=0.01)
            if answers:
                self._own_executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        self._executor.shutdown()
        self._own_executor.shutdown()
        for node in (self.node, self._planner):
            node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def controller() -> Iterator[Controller]:
    controller = Controller()
    yield controller
    controller.close()


def test_a_waiting_script_starts_with_its_service() -> None:
    controller = Controller("wait:=true")
    try:
        until = time.monotonic() + 3.0 * RETRY_INTERVAL_S
        controller.publish_until(200.0, lambda: time.monotonic() > until)
        assert controller.asked == []
        start = controller.node.create_client(Trigger, "planner/start")
        controller.publish_until(200.0, start.service_is_ready)
        answer = start.call_async(Trigger.Request())
        controller.publish_until(200.0, lambda: answer.done() and controller.asked)
        assert answer.result().success
        assert controller.asked[0] == "stand_up"
    finally:
        controller.close()


def test_no_mode_is_requested_before_the_controller_receives_states(controller: Controller) -> None:
    until = time.monotonic() + 3.0 * RETRY_INTERVAL_S
    controller.publish_until(0.0, lambda: time.monotonic() > until)
    assert controller.asked == []
    controller.publish_until(200.0, lambda: controller.asked)
    assert controller.asked[0] == "stand_up"


def test_a_request_that_waits_for_its_answer_is_not_repeated(controller: Controller) -> None:
    until = time.monotonic() + 4.0 * RETRY_INTERVAL_S
    controller.publish_until(200.0, lambda: time.monotonic() > until, answers=False)
    until = time.monotonic() + 2.0 * RETRY_INTERVAL_S
    controller.publish_until(200.0, lambda: time.monotonic() > until, mode="stand_up")
    assert controller.asked == ["stand_up"]
