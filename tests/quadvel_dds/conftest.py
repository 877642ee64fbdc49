"""Fixtures of the embedded middleware."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import quadvel_dds

if not quadvel_dds.install():
    # ROS 2 is here: what the two middlewares do together is tested in tests/ros.
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture
def ros() -> Iterator[Callable[..., None]]:
    """Starts rclpy with the arguments given; after the test it is stopped and its nodes are destroyed."""
    import rclpy

    contexts = []

    def start(*args: str) -> None:
        rclpy.init(args=["test", *args])
        contexts.append(rclpy.get_default_context())

    yield start
    for node in [node for context in contexts for node in list(context._nodes)]:
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def spin_until() -> Callable[..., bool]:
    """Spin a node until a condition holds or a timeout; return whether it holds."""
    import rclpy

    def spin(node: Any, condition: Callable[[], Any], timeout: float = 20.0) -> bool:
        deadline = time.monotonic() + timeout
        while not condition() and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.1)
        return bool(condition())

    return spin


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts another process with the embedded middleware; it is killed after the test at the latest."""
    processes: list[subprocess.Popen[str]] = []

    def start(source: str, *args: str) -> subprocess.Popen[str]:
        file = tmp_path / f"program_{len(processes)}.py"
        file.write_text(f"import quadvel_dds\nquadvel_dds.install()\n{source}")
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen([sys.executable, str(file), *args], **pipes))
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()
