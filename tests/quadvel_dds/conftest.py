"""The embedded middleware, installed for the tests of this folder; each worker of pytest-xdist has its own DDS domain."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import quadvel_dds

worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
os.environ["ROS_DOMAIN_ID"] = str(31 + int(worker) % 9)
os.environ["QUADVEL_MIDDLEWARE"] = "embedded"
quadvel_dds.install()

import rclpy  # noqa: E402

HERE = Path(__file__).parent


@pytest.fixture
def ros() -> Iterator[Callable[..., None]]:
    """Starts rclpy with the arguments given; it is stopped after the test, and its nodes are destroyed."""
    nodes: list[rclpy.node.Node] = []

    def start(*args: str) -> None:
        rclpy.init(args=["test", *args])
        nodes.append(rclpy.get_default_context())

    yield start
    for context in nodes:
        for node in list(context._nodes):
            node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts another Python process with the embedded middleware; it is killed after the test if it still runs."""
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
