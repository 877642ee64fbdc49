"""Operator commands without ROS 2: modes of the controller and services of the simulator.

Each function prints the response and returns the exit code, 1 if the command was refused or failed.
Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import Vector3, Wrench
from std_srvs.srv import SetBool, Trigger

from quadvel_msgs.msg import ControllerState
from quadvel_msgs.srv import Push, ResetSim, SetMode, StepSim

from .session import DISCOVERY_TIMEOUT_S, NotRunningError, Session
from .stack import LOW_LEVELS

START_HINT = "start the robot first: quadvel up"
"""Advice if no controller runs."""
SIMULATOR_NODES = tuple(dict.fromkeys(level.simulation for level in LOW_LEVELS.values() if level.simulation))
"""Nodes that can simulate the robot; they offer the same services."""
RECOVERY_HINT = "quadvel mode passive, then quadvel mode stand_up"
"""Advice after a fault."""
NO_STATES = "the controller receives no states: is the simulator paused? Does the driver reach its robot?"
"""Likely causes if a robot does not follow."""
TRANSIENT_MODES = {"stand_up": "stance", "lie_down": "passive"}
"""Modes that end by themselves, and their successors."""
MODE_TIMEOUT_S = 10.0
"""Longest duration of standing up or lying down."""


def mode(wanted: str) -> int:
    """Request a mode of the controller and wait until a transient mode is over.

    Args:
        wanted: The mode.

    Returns:
        The exit code.

    Raises:
        NotRunningError: The controller stopped reporting.
    """
    with Session("mode") as session:
        states = session.listen(ControllerState, "controller/state")
        response = session.call(SetMode, ["controller/set_mode"], lambda: START_HINT, mode=wanted)
        print(response.message)
        if not response.success:
            if session.spin_until(lambda: states, 1.0) and states[-1].mode_name == "fault":
                print(f"once its cause is gone: {RECOVERY_HINT}")
            return 1
        if wanted not in TRANSIENT_MODES:
            return 0
        asked = time.monotonic()
        began = session.spin_until(lambda: states and states[-1].mode_name == wanted, 1.0)
        if not began and states and states[-1].mode_name == TRANSIENT_MODES[wanted]:
            return 0
        session.spin_until(lambda: states and states[-1].mode_name != wanted, MODE_TIMEOUT_S)
        if not states:
            raise NotRunningError(f"controller/state: no message for {MODE_TIMEOUT_S:g} s")
        state = states[-1]
        print(f"{state.mode_name}: {state.reason} ({time.monotonic() - asked:.1f} s)")
        if state.mode_name == wanted and not state.rate_hz:
            print(NO_STATES)
        return 0 if state.mode_name == TRANSIENT_MODES[wanted] else 1


def enable(enabled: bool) -> int:
    """Permit or forbid walking.

    Args:
        enabled: Whether walking is permitted.

    Returns:
        The exit code.
    """
    with Session("enable") as session:
        return _print_response(
            session.call(SetBool, ["controller/enable_walking"], lambda: START_HINT, data=enabled)
        )


def reset(keyframe: str, terrain: str = "", slope: float = 0.0) -> int:
    """Reset the simulated robot and its odometry.

    It requests passive mode first: in other modes a jump in position is a fault.

    Args:
        keyframe: Initial posture, "lie" or "stand".
        terrain: New terrain, or "" for the present one.
        slope: Inclination of the terrain, rad.

    Returns:
        The exit code.
    """
    with Session("reset") as session:
        passive = session.node.create_client(SetMode, "controller/set_mode")
        odometry = session.node.create_client(Trigger, "estimator/reset_odometry")
        # A simulator may lack controller and estimator.
        session.spin_until(
            lambda: passive.service_is_ready() and odometry.service_is_ready(), DISCOVERY_TIMEOUT_S
        )
        if passive.service_is_ready():
            session.call(SetMode, [passive.service_name], lambda: START_HINT, mode="passive")
        put_back = _call_simulator(
            session, "reset", ResetSim, keyframe=keyframe, terrain=terrain, slope=slope
        )
        code = _print_response(put_back)
        if code == 0 and odometry.service_is_ready():
            session.call(Trigger, [odometry.service_name], lambda: START_HINT)
        return code


def pause(paused: bool) -> int:
    """Pause or resume the simulation.

    Args:
        paused: Whether to pause.

    Returns:
        The exit code.
    """
    return _order_simulator("pause", SetBool, data=paused)


def step(milliseconds: int) -> int:
    """Advance a paused simulation.

    Args:
        milliseconds: Simulated time, ms.

    Returns:
        The exit code.
    """
    return _order_simulator("step", StepSim, may_retry=False, steps=milliseconds)  # of 1 ms


def push(force: tuple[float, float, float], seconds: float, body: str) -> int:
    """Apply a force to the simulated robot.

    Args:
        force: x, y, z, N, world frame.
        seconds: Duration, s.
        body: Name of the body.

    Returns:
        The exit code.

    Raises:
        ValueError: The force is zero.
    """
    if not any(force):
        raise ValueError("the force is 0 N, expected --fx, --fy or --fz")
    x, y, z = force
    wrench = Wrench(force=Vector3(x=x, y=y, z=z))
    return _order_simulator("push", Push, may_retry=False, body=body, wrench=wrench, duration=seconds)


def _order_simulator(order: str, kind: Any, may_retry: bool = True, **fields: Any) -> int:
    """Call a service of the simulator. `may_retry`: see `Session.call`."""
    with Session(order) as session:
        return _print_response(_call_simulator(session, order, kind, may_retry, **fields))


def _call_simulator(session: Session, order: str, kind: Any, may_retry: bool = True, **fields: Any) -> Any:
    """Call a service of the node that simulates the robot; returns the response."""
    services = [f"{node}/{order}" for node in SIMULATOR_NODES]
    return session.call(kind, services, lambda: _missing_simulator(session), may_retry, **fields)


def _missing_simulator(session: Session) -> str:
    """Explain why no simulator answers."""
    if session.node.count_publishers("low_state"):
        return "the running robot is not simulated by quadvel, and a real one does not support this command"
    return "there is no simulator; start one: quadvel up"


def _print_response(response: Any) -> int:
    """Print the message of a response and return the exit code."""
    print(response.message)
    return 0 if response.success else 1
