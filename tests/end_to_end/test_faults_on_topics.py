"""Rows of docs/faults.md on the topics of a running robot: the processes of `quadvel up` with its own parameters, and a relay.

The default run has those whose cause was hidden from the operator once; `pytest -m long` has them all.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from quadvel_bringup.stack import Stack
from quadvel_lab.topic_faults import BOARD_FAULTS, FAULTS, TopicFault, TopicRobot
from quadvel_policy.faults import table

ONCE_HIDDEN = ("state_not_finite", "attitude_not_unit", "state_stale", "controller_stopped")
NOT_ON_TOPICS = {
    "policy_not_finite": "comes from the policy's file: tests/quadvel_policy/test_faults.py",
    "no_velocity": "needs a Kalman filter that fails, which no message that is taken brings about",
}


@pytest.fixture(scope="module")
def robot() -> Iterator[TopicRobot]:
    with TopicRobot(Stack()) as robot:
        yield robot


@pytest.fixture(scope="module")
def board() -> Iterator[TopicRobot]:
    with TopicRobot(Stack(low_level="board")) as robot:
        yield robot


def _faults() -> list[object]:
    marks = {True: (), False: (pytest.mark.long,)}
    return [pytest.param(one, marks=marks[one.name in ONCE_HIDDEN], id=one.name) for one in FAULTS]


@pytest.mark.parametrize("fault", _faults())
def test_it_is_named(robot: TopicRobot, fault: TopicFault) -> None:
    robot.provoke(fault)


@pytest.mark.realtime
@pytest.mark.parametrize("fault", BOARD_FAULTS, ids=lambda fault: fault.name)
def test_what_a_board_alone_reports_is_named(board: TopicRobot, fault: TopicFault) -> None:
    board.provoke(fault)


def test_each_row_comes_about_on_topics() -> None:
    provoked = {fault.name for fault in (*FAULTS, *BOARD_FAULTS)}
    assert provoked | NOT_ON_TOPICS.keys() == {row.name for row in table()}


def test_at_last_a_simulator_that_is_killed_is_a_fault(robot: TopicRobot) -> None:
    robot.bring_to("stance")
    os.kill(robot.process_id("sim_node"), signal.SIGKILL)
    robot.wait_for(lambda state: state.fault == "state_stale", "a dead simulator is not noticed")
