"""What is said where no robot answers: the ROS domain, and who is on another one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import quadvel_dds

quadvel_dds.install()

from quadvel_bringup import discovery_hint, session  # noqa: E402

HERE = int(os.environ["ROS_DOMAIN_ID"])
ELSEWHERE = HERE + 1
ROBOT = """
import sys, time
import quadvel_dds
quadvel_dds.install()
import rclpy
rclpy.init()
rclpy.create_node("robot")
print("ready", flush=True)
time.sleep(60.0)
"""


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A node on another domain; its command line names it as ROS 2 names a simulator."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(ELSEWHERE)}
    (tmp_path / "sim_node").write_text(ROBOT)
    command = [sys.executable, str(tmp_path / "sim_node")]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


def test_a_robot_on_another_domain_is_named_with_its_domain(elsewhere: subprocess.Popen[str]) -> None:
    text = discovery_hint.discovery_hint()
    assert f"on ROS domain {HERE}" in text
    assert f"sim_node (pid {elsewhere.pid}) is on {ELSEWHERE}" in text


def test_participants_of_any_user_are_known_by_their_sockets(elsewhere: subprocess.Popen[str]) -> None:
    with open("/proc/net/udp") as table:
        assert ELSEWHERE in discovery_hint.domains_in_use(table.read())


@pytest.mark.parametrize(
    ("ports", "domains"),
    [
        ((7410, 7411), {0}),
        ((7400, 7412, 7413, 7660, 7661), {0, 1}),
        ((18660, 18661), {45}),
        ((8125,), set()),
        ((7411, 7412), set()),
        ((33000, 33001), set()),
    ],
)
def test_domains_are_read_from_pairs_of_ports(ports: tuple[int, ...], domains: set[int]) -> None:
    rows = "".join(f"1: 0100007F:{port:04X} 00000000:0000 07\n" for port in ports)
    assert discovery_hint.domains_in_use(f"sl local_address\n{rows}") == domains


def test_without_another_domain_the_own_and_the_ways_out_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery_hint, "running_robots", dict)
    monkeypatch.setattr(discovery_hint, "domains_in_use", lambda table: {HERE})
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    text = discovery_hint.discovery_hint()
    assert f"ROS domain {HERE}" in text
    assert "ROS_DOMAIN_ID" in text
    assert "SUBNET" in text
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    assert "SUBNET" not in discovery_hint.discovery_hint()


def test_an_order_that_nobody_answers_says_where_the_robot_is(
    elsewhere: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from std_srvs.srv import SetBool

    monkeypatch.setattr(session, "DISCOVERY_TIMEOUT_S", 0.2)
    with (
        session.Session("asking") as asking,
        pytest.raises(session.NotRunningError, match=f"is on {ELSEWHERE}"),
    ):
        asking.call(SetBool, ["nowhere"], lambda: "start it", data=True)
