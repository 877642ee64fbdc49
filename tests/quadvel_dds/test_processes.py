"""Tests with several processes: discovery, signals, and the choice of the middleware."""

import signal
import subprocess
import time
from collections.abc import Callable

import pytest
import rclpy
from rclpy.node import Node
from std_srvs.srv import SetBool

from quadvel_dds import wire
from quadvel_msgs.msg import LowCmd, LowState

Start = Callable[..., None]
Program = Callable[..., "subprocess.Popen[str]"]

ECHO = """
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from quadvel_msgs.msg import LowCmd, LowState
from std_srvs.srv import SetBool

def main():
    rclpy.init()
    node = Node("echo")
    publisher = node.create_publisher(LowCmd, "low_cmd", 1)
    def answer(state):
        publisher.publish(LowCmd(tick=state.tick, q=state.q))
    node.create_subscription(LowState, "low_state", answer, 1)
    def allow(request, response):
        response.success = request.data
        return response
    node.create_service(SetBool, "allow", allow)
    try:
        print("ready", flush=True)
        rclpy.spin(node)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    except ExternalShutdownException:
        print("shut down", flush=True)
    else:
        print("shut down", flush=True)  # between two callbacks the spin just ends
    finally:
        node.destroy_node()
        rclpy.try_shutdown()

main()
"""

EXIT = """
import atexit
from pathlib import Path

def print_threads():
    print(*(path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")))

atexit.register(print_threads)  # registered first, so it runs last
import rclpy
rclpy.init()
node = rclpy.create_node("ends")
"""


def wait_until(node: Node, condition: Callable[[], object], timeout: float = 40.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "time is up"
        rclpy.spin_once(node, timeout_sec=0.1)


def test_messages_and_calls_cross_processes(ros: Start, program: Program) -> None:
    ros()
    program(ECHO)
    node, commands = Node("robot"), []
    publisher = node.create_publisher(LowState, "low_state", 1)
    node.create_subscription(LowCmd, "low_cmd", commands.append, 1)
    wait_until(node, lambda: publisher.get_subscription_count() and node.count_publishers("low_cmd"))
    wait_until(node, lambda: publisher.publish(LowState(tick=2**32 - 1, q=[0.5] * 12)) or commands)
    assert commands[0].tick == 2**32 - 1
    assert (commands[0].q == 0.5).all()

    client = node.create_client(SetBool, "allow")
    assert client.wait_for_service(timeout_sec=20.0)
    future = client.call_async(SetBool.Request(data=True))
    rclpy.spin_until_future_complete(node, future, timeout_sec=20.0)
    assert future.result().success


def test_ctrl_c_interrupts_a_spin_that_waits(program: Program) -> None:
    process = program(ECHO)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=40)
    assert (process.returncode, output, errors) == (0, "interrupted\n", "")


def test_threads_of_the_middleware_end_before_the_interpreter(program: Program) -> None:
    """Python ends a thread that calls it later, and a deletion of the domain waits for it."""
    process = program(EXIT)
    output, _ = process.communicate(timeout=60.0)
    assert process.returncode == 0
    assert not {"recv", "tev", "gc", "dq.builtins"} & set(output.split()), output


def test_discovery_stays_on_this_host_unless_asked_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    assert "<AllowMulticast>false</AllowMulticast>" in wire.domain_configuration()
    assert '<NetworkInterface name="lo"/>' in wire.domain_configuration()
    assert '<Peer address="localhost" pruneDelay="inf"/>' in wire.domain_configuration()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("ROS_STATIC_PEERS", "192.168.123.10")
    assert "AllowMulticast" not in wire.domain_configuration()
    assert "localhost" not in wire.domain_configuration()
    assert "NetworkInterface" not in wire.domain_configuration()
    assert '<Peer address="192.168.123.10" pruneDelay="inf"/>' in wire.domain_configuration()
    monkeypatch.setenv("ROS_STATIC_PEERS", "127.0.0.1:7410; localhost;")
    assert '<Peer address="127.0.0.1:7410" pruneDelay="inf"/>' in wire.domain_configuration()
    for unknown in ("no.such.host.invalid", 'a"/><Evil', "127.0.0.1;no.such.host.invalid", "::1", ":7410"):
        monkeypatch.setenv("ROS_STATIC_PEERS", unknown)
        with pytest.raises(ValueError, match="ROS_STATIC_PEERS: found "):
            wire.domain_configuration()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "PLANET")
    with pytest.raises(ValueError, match="ROS_AUTOMATIC_DISCOVERY_RANGE is 'PLANET', expected LOCALHOST"):
        wire.domain_configuration()
