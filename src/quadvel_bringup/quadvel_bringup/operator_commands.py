"""Orders of the operator that need no ROS 2: modes of the controller, and what can be done to a simulated robot.

Each prints what came of it and returns the exit code: 1 where it was refused or failed. Needs `rclpy`: ROS 2's own, or
the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import Vector3, Wrench
from std_srvs.srv import SetBool, Trigger

from quadvel_msgs.msg import ControllerState
from quadvel_msgs.srv import Push, ResetSim, SetMode, StepSim

from .session import NobodyThere, Session
from .stack import LOW_LEVELS

CONTROLLER = "start the robot first: quadvel up"
SIMULATIONS = tuple(dict.fromkeys(level.simulation for level in LOW_LEVELS.values() if level.simulation))
"""The nodes of which one simulates the robot; they offer the same services"""
WAY_OUT = "quadvel mode passive, then quadvel mode stand_up"
PASSING = {"stand_up": "stance", "lie_down": "passive"}
"""Modes that end by themselves, and the one that follows"""
LOOK = 2.0
"""s to find the controller and the estimator next to a simulator; it may run without them"""
LONGEST = 10.0
"""s that standing up or lying down may take"""


def mode(wanted: str) -> int:
    """Ask the controller for a mode; where that takes a while, wait until it is done."""
    with Session("mode") as session:
        states = session.listen(ControllerState, "controller/state")
        response = session.call(SetMode, ["controller/set_mode"], lambda: CONTROLLER, mode=wanted)
        print(response.message)
        if not response.success:
            if session.spin_until(lambda: states, 1.0) and states[-1].mode_name == "fault":
                print(f"once its cause is gone: {WAY_OUT}")
            return 1
        if wanted not in PASSING:
            return 0
        asked = time.monotonic()
        session.spin_until(lambda: states and states[-1].mode_name == wanted, 1.0)
        session.spin_until(lambda: states and states[-1].mode_name != wanted, LONGEST)
        if not states:
            raise NobodyThere(f"controller/state: nothing came for {LONGEST:g} s")
        state = states[-1]
        print(f"{state.mode_name}: {state.reason} ({time.monotonic() - asked:.1f} s)")
        return 0 if state.mode_name == PASSING[wanted] else 1


def enable(enabled: bool) -> int:
    """Allow walking, as a robot wants it from its operator, or forbid it."""
    with Session("enable") as session:
        return _told(session.call(SetBool, ["controller/enable_walking"], lambda: CONTROLLER, data=enabled))


def reset(keyframe: str, terrain: str = "", slope: float = 0.0) -> int:
    """Put the simulated robot back, on other ground where `terrain` names one.

    It goes through passive, as a jump to another place is a fault of a robot that is not; odometry starts again there.
    """
    with Session("reset") as session:
        passive = session.node.create_client(SetMode, "controller/set_mode")
        odometry = session.node.create_client(Trigger, "estimator/reset_odometry")
        session.spin_until(lambda: passive.service_is_ready() and odometry.service_is_ready(), LOOK)
        if passive.service_is_ready():
            session.call(SetMode, [passive.service_name], lambda: CONTROLLER, mode="passive")
        put_back = _call_simulation(
            session, "reset", ResetSim, keyframe=keyframe, terrain=terrain, slope=slope
        )
        code = _told(put_back)
        if code == 0 and odometry.service_is_ready():
            session.call(Trigger, [odometry.service_name], lambda: CONTROLLER)
        return code


def pause(paused: bool) -> int:
    """Let simulated time stand still, or go on."""
    return _to_simulation("pause", SetBool, data=paused)


def step(milliseconds: int) -> int:
    """Let a paused simulation run on for a while."""
    return _to_simulation("step", StepSim, repeats=False, steps=milliseconds)


def push(force: tuple[float, float, float], seconds: float, body: str) -> int:
    """Push the simulated robot with a force (N, world frame)."""
    x, y, z = force
    wrench = Wrench(force=Vector3(x=x, y=y, z=z))
    return _to_simulation("push", Push, repeats=False, body=body, wrench=wrench, duration=seconds)


def _to_simulation(order: str, kind: Any, repeats: bool = True, **fields: Any) -> int:
    """Whichever node simulates the robot carries it out. repeats: whether twice is as good as once."""
    with Session(order) as session:
        return _told(_call_simulation(session, order, kind, repeats, **fields))


def _call_simulation(session: Session, order: str, kind: Any, repeats: bool = True, **fields: Any) -> Any:
    services = [f"{node}/{order}" for node in SIMULATIONS]
    return session.call(kind, services, lambda: _no_simulation(session), repeats, **fields)


def _no_simulation(session: Session) -> str:
    if session.node.count_publishers("low_state"):
        return (
            "the robot that is there is not simulated by quadvel, and a real one can not be given this order"
        )
    return "there is no simulator; start one: quadvel up"


def _told(response: Any) -> int:
    """Print what came of an order; the exit code."""
    print(response.message)
    return 0 if response.success else 1
