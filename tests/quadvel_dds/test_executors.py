"""Executors: what runs side by side, what an error in a callback does, how a spin ends."""

import threading
import time
from collections.abc import Callable

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool

Start = Callable[..., None]


def test_error_in_a_callback_ends_the_spin(ros: Start) -> None:
    ros()
    node = Node("faulty")
    node.create_timer(0.001, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        rclpy.spin(node)


def test_reentrant_callbacks_run_side_by_side_and_exclusive_ones_do_not(ros: Start) -> None:
    ros()
    node, meeting = Node("workers"), threading.Barrier(2)
    running, overlaps, met = [], [], threading.Event()

    def meet() -> None:
        meeting.wait(timeout=20.0)
        met.set()

    def alone() -> None:
        overlaps.append(len(running))
        running.append(1)
        time.sleep(0.005)
        running.pop()

    group = ReentrantCallbackGroup()
    node.create_timer(0.001, meet, callback_group=group)
    node.create_timer(0.001, meet, callback_group=group)
    node.create_timer(0.001, alone)
    node.create_timer(0.001, alone)
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline and not (met.is_set() and len(overlaps) > 5):
        executor.spin_once(timeout_sec=0.1)
    meeting.abort()
    executor._running.clear()
    executor.shutdown()
    assert met.is_set()
    assert set(overlaps) == {0}


def test_multi_threaded_executor_raises_what_a_callback_raised(ros: Start) -> None:
    ros()
    node = Node("faulty")
    node.create_timer(0.001, lambda: 1 / 0)
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    with pytest.raises(ZeroDivisionError):
        executor.spin()
    executor.shutdown()


def test_blocking_call_with_a_spinning_thread(ros: Start) -> None:
    ros()
    node = Node("server")
    node.create_service(SetBool, "allow", lambda request, response: response)
    client = node.create_client(SetBool, "allow")
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    assert client.wait_for_service(timeout_sec=10.0)
    answer = client.call(SetBool.Request(data=True), timeout_sec=10.0)
    rclpy.shutdown()
    thread.join()
    executor.shutdown()
    assert answer == SetBool.Response()


@pytest.mark.parametrize("executor_class", [SingleThreadedExecutor, MultiThreadedExecutor])
def test_executor_is_shut_down_by_another_thread(ros: Start, executor_class: type[Executor]) -> None:
    ros()
    node, failures = Node("idle"), []

    def spin() -> None:
        try:
            executor.spin()
        except BaseException as error:
            failures.append(error)

    for _ in range(5):
        executor = executor_class()
        executor.add_node(node)
        thread = threading.Thread(target=spin)
        thread.start()
        executor.shutdown()
        thread.join(timeout=20.0)
        assert not thread.is_alive()
    assert not failures
