"""Nodes on both middlewares at once: those of rclpy, embedded ones, and a watcher on rclpy in this process."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy

from quadvel_bringup import nodes

EMBEDDED = {"QUADVEL_MIDDLEWARE": "embedded"}


class Graph:
    """Processes on one domain, each on one of the middlewares, and a node that watches them."""

    def __init__(self) -> None:
        rclpy.init(args=[])
        self.node = rclpy.create_node("watcher")
        self._processes: list[subprocess.Popen[str]] = []

    def start(self, name: str, *arguments: str, embedded: bool) -> None:
        """Start one of our nodes; `arguments` are those after --ros-args."""
        self._begin(nodes.process_command(name, ["--ros-args", *arguments] if arguments else []), embedded)

    def program(self, source: str) -> subprocess.Popen[str]:
        """Start a Python program on the embedded middleware."""
        head = "import quadvel_dds\nquadvel_dds.install()\n"
        return self._begin([sys.executable, "-c", f"{head}{source}"], embedded=True)

    def _begin(self, command: list[str], embedded: bool) -> subprocess.Popen[str]:
        environment = {**os.environ, **(EMBEDDED if embedded else {})}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self._processes.append(subprocess.Popen(command, env=environment, **pipes))
        return self._processes[-1]

    def listen(self, kind: Any, topic: str) -> list[Any]:
        """The messages of a topic, as they come."""
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, 50)
        return heard

    def wait(self, holds: Callable[[], Any], found: Callable[[], Any], seconds: float = 60.0) -> None:
        """Serve the watcher until a predicate holds; fail with what was found instead when the time is up."""
        until = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < until, f"after {seconds} s: {found()}"
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def close(self) -> None:
        """End all processes, each of which must end with 0."""
        self.node.destroy_node()
        rclpy.shutdown()
        for process in self._processes:
            process.terminate()
        outputs = [process.communicate(timeout=30.0)[0] for process in self._processes]
        ended = [(process.returncode, text) for process, text in zip(self._processes, outputs, strict=True)]
        assert all(code == 0 for code, _ in ended), ended


@pytest.fixture
def graph() -> Iterator[Graph]:
    graph = Graph()
    yield graph
    graph.close()
