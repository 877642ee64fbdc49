"""What a dry run shows of each robot's packets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand
from quadvel_driver import wire
from quadvel_driver.dry_run import DryRun
from quadvel_driver.link import Link, LinkConfig
from quadvel_driver.unitree_dds import wire as dds_wire
from quadvel_policy.config import SupervisorConfig
from tests.helpers.robots import ALIENGO, GO2


@pytest.mark.parametrize(
    ("robot", "packets", "begin"),
    [(ALIENGO, wire, "610 bytes, ff000000"), (GO2, dds_wire, "812 bytes, 00010000feefff00")],
)
def test_the_last_packet_is_described_leg_by_leg_and_clamped(robot: Robot, packets: Any, begin: str) -> None:
    dry_run = DryRun(robot, packets)
    assert dry_run.summary() == "no packet yet"
    link = Link(robot, packets, dry_run, LinkConfig(), print)
    link.submit(JointCommand(q=np.full(12, -9.0), tau=np.full(12, 1.5), kp=np.full(12, 55.0)))
    lines = dry_run.summary().splitlines()
    assert lines[0].startswith(f"1 packet would have been sent, the last: mode servo, {begin}")
    lowest = robot.command_lower[3:6]
    assert lines[2] == "  FL: " + "; ".join(
        f"{kind} q {q:+.3f} dq +0.00 tau +1.50 kp 55 kd 0"
        for kind, q in zip(("hip", "thigh", "calf"), lowest, strict=True)
    )
    assert [line.split(":")[0].strip() for line in lines[1:]] == ["FR", "FL", "RR", "RL"]


@pytest.mark.parametrize(("robot", "packets"), [(ALIENGO, wire), (GO2, dds_wire)])
def test_a_command_without_stiffness_is_shown_as_damping(robot: Robot, packets: Any) -> None:
    dry_run = DryRun(robot, packets)
    link = Link(robot, packets, dry_run, LinkConfig(), print)
    link.submit(JointCommand(kd=np.full(12, 5.0)))
    assert "mode damping" in dry_run.summary().splitlines()[0]


@pytest.mark.parametrize(("robot", "page"), [(ALIENGO, "robot.md"), (GO2, "robot_go2.md")])
def test_the_page_gives_the_values_of_a_standing_robot(robot: Robot, page: str) -> None:
    config = SupervisorConfig()
    angles = " | ".join(f"{q:.2f}" for q in robot.nominal_q[:3].tolist())
    row = f"| servo | {angles} | 0 | {config.stand_kp:g} | {config.stand_kd:g} |"
    assert row in (Path(__file__).parents[2] / "docs" / page).read_text()
