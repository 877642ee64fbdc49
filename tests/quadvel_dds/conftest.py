"""The embedded middleware for the tests of this folder."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

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
