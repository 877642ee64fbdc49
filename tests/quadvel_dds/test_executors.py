"""Tests of executors: concurrency, errors in callbacks, end of a spin."""

import threading
from collections.abc import Callable

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

Start = Callable[..., None]


def test_error_in_a_callback_ends_the_spin(ros: Start) -> None:
    ros()
    node = Node("faulty")
    node.create_timer(0.001, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        rclpy.spin(node)


def test_executor_is_shut_down_by_another_thread(ros: Start) -> None:
    ros()
    node, failures = Node("idle"), []

    def spin() -> None:
        try:
            executor.spin()
        except BaseException as error:
            failures.append(error)

    for _ in range(5):
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=spin)
        thread.start()
        executor.shutdown()
        thread.join(timeout=20.0)
        assert not thread.is_alive()
    assert not failures
