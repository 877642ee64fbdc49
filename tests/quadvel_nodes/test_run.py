"""How a node's process waits and ends."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = """
import sys, threading
import quadvel_dds
quadvel_dds.install()
from rclpy.node import Node
from quadvel_nodes.node import request_exit, run

class Ending(Node):
    def __init__(self):
        super().__init__("ending")
        how, self.sentence = sys.argv[1], sys.argv[2]
        if how == "callback":
            self.create_timer(0.1, self.finish)
        elif how == "thread":
            threading.Timer(0.5, self.finish).start()
        else:
            print("ready", flush=True)

    def finish(self):
        request_exit(self, self.sentence)
        request_exit(self, "what comes later")

run(Ending, [])
"""


def start(how: str, sentence: str = "") -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROGRAM, how, sentence]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("how", ["callback", "thread"])
def test_a_node_that_ends_itself_ends_its_process_with_0(how: str) -> None:
    process = start(how)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")


@pytest.mark.parametrize("how", ["callback", "thread"])
def test_a_node_that_ends_with_an_error_says_it_and_exits_with_1(how: str) -> None:
    process = start(how, "the robot is gone")
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (1, "the robot is gone\n")


def test_a_node_that_has_nothing_to_do_leaves_the_processor_to_others() -> None:
    process = start("idle")
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.5)
    before = cpu_seconds(process.pid)
    time.sleep(2.0)
    used = cpu_seconds(process.pid) - before
    process.terminate()
    assert process.wait(60) == 0
    process.communicate()
    assert used < 0.3


def cpu_seconds(pid: int) -> float:
    """What a process has computed so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
