"""What a dry run shows of each robot's packets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand
from quadvel_driver import wire
from quadvel_driver.dry_run import DryRun
from quadvel_driver.link import Link, LinkConfig
from quadvel_driver.unitree_dds import wire as dds_wire
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
    assert lines[0].startswith(f"1 packets would have been sent, the last: {begin}")
    lowest = robot.command_lower[3:6]
    assert lines[2] == "  FL: " + "; ".join(
        f"{kind} q {q:+.3f} dq +0.00 tau +1.50 kp 55 kd 0"
        for kind, q in zip(("hip", "thigh", "calf"), lowest, strict=True)
    )
    assert [line.split(":")[0].strip() for line in lines[1:]] == ["FR", "FL", "RR", "RL"]
