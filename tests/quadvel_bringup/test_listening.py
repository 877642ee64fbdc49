"""What the nodes listen to: this host alone, unless somebody asked for more."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.helpers.sockets import Bound, family_of, sockets_of

PROGRAM = [sys.executable, "-m", "quadvel_bringup"]
SOCKETS_OF_DDS = 3  # discovery, data, and the one that sends


def wait_for(condition, seconds: float = 60.0):
    """What `condition` gives once it is true."""
    until = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < until, "time is up"
        time.sleep(0.2)
    return found


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The embedded middleware as it is without anything set."""
    unset = ("CYCLONEDDS_URI", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS")
    return {k: v for k, v in os.environ.items() if k not in unset} | {"QUADVEL_MIDDLEWARE": "embedded"}


def test_nothing_of_a_running_robot_can_be_reached_from_another_host(environment: dict[str, str]) -> None:
    up = subprocess.Popen(
        [*PROGRAM, "up", "--low-level", "board"], env=environment, stdout=subprocess.DEVNULL
    )

    def everything() -> dict[int, list[Bound]]:
        """The sockets of all six processes, once there are all of them: board and driver have one more."""
        found = {pid: sockets_of(pid) for pid in family_of(up.pid)}
        counts = sorted(len(sockets) for sockets in found.values())
        return found if counts == [SOCKETS_OF_DDS] * 4 + [SOCKETS_OF_DDS + 1] * 2 else {}

    try:
        found = wait_for(everything)
    finally:
        up.send_signal(signal.SIGINT)
        up.wait(30.0)
    open_to_others = [one for sockets in found.values() for one in sockets if not one.of_this_host]
    assert not open_to_others


NODE = """
import quadvel_dds
quadvel_dds.install()
import rclpy
rclpy.init()
node = rclpy.create_node("alone")
node.create_client(__import__("std_srvs.srv", fromlist=["Trigger"]).Trigger, "anything")
print("ready", flush=True)
input()
"""


@pytest.mark.parametrize(
    ("reach", "alone"), [(None, True), ("LOCALHOST", True), ("OFF", True), ("SUBNET", False)]
)
def test_other_hosts_are_heard_where_that_is_asked_for(
    environment: dict[str, str], reach: str | None, alone: bool
) -> None:
    if reach is not None:
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = reach
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", NODE], env=environment, **pipes) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == "ready\n"
        found = sockets_of(node.pid)
        node.communicate("\n")
    assert len(found) > 1
    assert all(one.of_this_host for one in found) == alone
