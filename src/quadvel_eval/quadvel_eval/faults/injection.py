"""What can be done to a `Stack`: each component with each kind of fault that makes sense for it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_description.robot import JOINT_NAMES
from quadvel_description.state import RobotState
from quadvel_sim.simulator import DT

from .stack import Link, Message, Stack, spoil

KINDS = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent", "duplicated")
Rng = np.random.Generator
Way = list[tuple[int, Message]]

LATE = 80  # ms, of what is delayed
ONE_OF = 16  # messages get through a slow link
BURST = 15  # ms that an intermittent link is silent at most
PAUSE = 100  # ms that a process does nothing, now and then


@attrs.frozen
class Injection:
    """One fault: `begin(stack, rng)` brings it about."""

    component: str
    kind: str
    begin: Callable[[Stack, Rng], None]


def injection(component: str, kind: str) -> Injection:
    """The fault. Raises ValueError, one sentence, where there is no such component or kind, or they make no sense together."""
    if component not in COMPONENTS:
        raise ValueError(f"component is '{component}', expected one of {', '.join(COMPONENTS)}")
    if kind not in KINDS:
        raise ValueError(f"kind is '{kind}', expected one of {', '.join(KINDS)}")
    known = COMPONENTS[component]
    if kind not in known:
        raise ValueError(
            f"{component} can't be {kind}: expected one of {', '.join(known)}; {WHY_NOT[component]}"
        )
    return Injection(component, kind, known[kind])


# Links.


def _link(
    name: str, way: Callable[[Link, Rng], Callable[[int, Message], Way]]
) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        stack.links[name].way = way(stack.links[name], rng)

    return begin


def _off(link: Link, rng: Rng) -> Callable[[int, Message], Way]:
    return lambda now, message: []


def _repeated(link: Link, rng: Rng) -> Callable[[int, Message], Way]:
    """The first message again and again; a state under the stamp of each that it takes the place of."""
    first: list[Message] = []

    def way(now: int, message: Message) -> Way:
        first.append(message)
        return [(0, _with(first[0], stamp=message.stamp) if hasattr(message, "q") else first[0])]

    return way


def _garbage(link: Link, rng: Rng) -> Callable[[int, Message], Way]:
    return lambda now, message: [(0, spoil(message, rng))]


def _slow(link: Link, rng: Rng) -> Callable[[int, Message], Way]:
    count = iter(range(1, 10**9))
    return lambda now, message: [(0, message)] if next(count) % ONE_OF == 0 else []


def _delayed(late: int) -> Callable[[Link, Rng], Callable[[int, Message], Way]]:
    return lambda link, rng: lambda now, message: [(late, message)]


def _intermittent(link: Link, rng: Rng) -> Callable[[int, Message], Way]:
    silent_until = [0, 0]  # and the next time from which it may be silent

    def way(now: int, message: Message) -> Way:
        if now >= silent_until[1]:
            silent_until[:] = (
                now + int(rng.integers(1, BURST + 1)),
                now + int(rng.integers(2 * BURST, 8 * BURST)),
            )
        return [] if now < silent_until[0] else [(0, message)]

    return way


def _duplicated(link: Link, rng: Rng) -> Callable[[int, Message], Way]:
    return lambda now, message: [(0, message), (1, message)]


def _changed(
    change: Callable[[Message, Rng], Message],
) -> Callable[[Link, Rng], Callable[[int, Message], Way]]:
    return lambda link, rng: lambda now, message: [(0, change(message, rng))]


def _with(message: Message, **fields: Any) -> Message:
    return SimpleNamespace(**{**vars(message), **fields})


def _both(*begins: Callable[[Stack, Rng], None]) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        for one in begins:
            one(stack, rng)

    return begin


# Sensors.


def _sensor(fields: tuple[str, ...], kind: str, one_joint: bool = False) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        joint = int(rng.integers(12))
        sizes = {"quaternion": 4, "foot_force": 4, "angular_velocity": 3, "linear_acceleration": 3}
        places = {
            field: np.arange(12) == joint if one_joint else np.ones(sizes.get(field, 12), bool)
            for field in fields
        }
        stack.sensors = _Sensor(kind, places, rng)

    return begin


class _Sensor:
    """Spoils some numbers of the states."""

    def __init__(self, kind: str, places: dict[str, NDArray[np.bool_]], rng: Rng) -> None:
        self._kind, self._places, self._rng = kind, places, rng
        self._past: list[tuple[int, RobotState]] = []

    def __call__(self, now: int, state: RobotState) -> RobotState:
        self._past.append((now, state))
        values = {
            field: np.where(place, self._value(field, now, getattr(state, field)), getattr(state, field))
            for field, place in self._places.items()
        }
        return attrs.evolve(state, **values)

    def _value(self, field: str, now: int, true: NDArray[np.float64]) -> Any:
        kind, begun = self._kind, self._past[0]
        if kind == "off" or (kind == "intermittent" and self._rng.random() < 0.3):
            return 0.0
        if kind == "stuck":
            return getattr(begun[1], field)
        if kind == "slow":  # a new value every 200 ms
            return getattr(self._past[(now - begun[0]) // 200 * 200 // 5][1], field)
        if kind == "delayed":
            return getattr(self._past[max(len(self._past) - 1 - LATE // 5, 0)][1], field)
        if kind == "garbage":
            return self._rng.normal(0.0, GARBAGE[field], np.shape(true))
        return _wrong(field, true) if kind == "wrong" else true


GARBAGE = {
    "q": 3.0,
    "dq": 20.0,
    "tau": 30.0,
    "quaternion": 1.0,
    "angular_velocity": 5.0,
    "linear_acceleration": 50.0,
    "foot_force": 500.0,
}
"""Standard deviation of nonsense, in the field's unit"""
TILT = np.array([np.cos(0.25), np.sin(0.25), 0.0, 0.0])


def _wrong(field: str, true: NDArray[np.float64]) -> NDArray[np.float64]:
    """A zero that is off, or for the orientation a mounting."""
    if field == "quaternion":
        w, x, y, z = true
        a, b = TILT[0], TILT[1]
        return np.array([w * a - x * b, x * a + w * b, y * a + z * b, z * a - y * b])
    return (
        true + {"q": 0.5, "dq": 0.0, "tau": 25.0, "angular_velocity": 1.5, "linear_acceleration": 15.0}[field]
    )


# Drives, processes, clock, processor.


def _dead_drive(stack: Stack, rng: Rng) -> None:
    """One that gives no torque and says so."""
    joint = int(rng.integers(12))
    step = stack.simulator.actuator.step

    def without(*law: Any) -> Any:
        torque = np.array(step(*law))
        torque[joint] = 0.0
        return torque

    stack.simulator.actuator.step = without  # type: ignore[method-assign, assignment]


def _jammed(stack: Stack, rng: Rng) -> None:
    """Something holds one joint where it is."""
    joint = mujoco.mj_name2id(
        stack.simulator.model,
        mujoco.mjtObj.mjOBJ_JOINT,
        JOINT_NAMES[int(rng.choice((1, 2, 4, 5, 7, 8, 10, 11)))],
    )
    stack.simulator.model.dof_frictionloss[stack.simulator.model.jnt_dofadr[joint]] = 500.0


def _killed(name: str) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        stack.processes[name].killed = True

    return begin


def _stopped(name: str) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        stack.processes[name].stopped = True

    return begin


def _pausing(name: str) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        process, report = stack.processes[name], stack.sensors

        def pause(now: int, state: RobotState) -> RobotState:
            if now // PAUSE % 3 == 0:
                process.stopped = True
            elif process.stopped:
                process.resume()
            return state if report is None else report(now, state)

        stack.sensors = pause

    return begin


def _set_clock(by: float) -> Callable[[Stack, Rng], None]:
    def begin(stack: Stack, rng: Rng) -> None:
        stack.clock_offset += by * float(rng.choice((-1.0, 1.0)))

    return begin


def _slow_processor(stack: Stack, rng: Rng) -> None:
    """Each tick of the controller takes 8 ms more."""
    stack.late = 8 * DT


_LINK_KINDS = {
    "off": _off,
    "stuck": _repeated,
    "garbage": _garbage,
    "slow": _slow,
    "delayed": _delayed(LATE),
    "intermittent": _intermittent,
    "duplicated": _duplicated,
}


def _of_link(
    name: str, wrong: Callable[[Message, Rng], Message] | None = None, without: tuple[str, ...] = ()
) -> dict[str, Any]:
    kinds = {kind: _link(name, way) for kind, way in _LINK_KINDS.items() if kind not in without}
    return kinds | ({} if wrong is None else {"wrong": _link(name, _changed(wrong))})


def _of_sensor(fields: tuple[str, ...], *kinds: str, one_joint: bool = False) -> dict[str, Any]:
    return {kind: _sensor(fields, kind, one_joint) for kind in kinds}


COMPONENTS: dict[str, dict[str, Callable[[Stack, Rng], None]]] = {
    "low_state": _of_link("low_state", lambda m, rng: _with(m, q=m.q + np.float32(0.5))),
    "low_cmd": _of_link("low_cmd", without=("garbage",)) | {"delayed": _link("low_cmd", _delayed(30))},
    "estimate": _of_link("estimate", lambda m, rng: _with(m, velocity=m.velocity + np.float32(1.5))),
    "command": _of_link("command", lambda m, rng: _with(m, velocity=m.velocity * np.float32(100.0))),
    "encoder": _of_sensor(
        ("q", "dq"), "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent", one_joint=True
    ),
    "imu": _of_sensor(
        ("quaternion", "angular_velocity"), "off", "stuck", "garbage", "slow", "delayed", "intermittent"
    ),
    "orientation": _of_sensor(("quaternion",), "wrong", "stuck"),
    "gyroscope": _of_sensor(("angular_velocity",), "off", "wrong", "garbage", "stuck"),
    "accelerometer": _of_sensor(("linear_acceleration",), "stuck", "wrong", "garbage", "off"),
    "torque": _of_sensor(("tau",), "wrong", "garbage", one_joint=True),
    "foot": _of_sensor(("foot_force",), "off", "stuck", "garbage"),
    "drive": {"off": _dead_drive, "stuck": _jammed},
    "network": {
        kind: _both(_link("low_state", way), _link("low_cmd", way))
        for kind, way in _LINK_KINDS.items()
        if kind in ("off", "slow", "intermittent", "duplicated")
    }
    | {"delayed": _both(_link("low_state", _delayed(5)), _link("low_cmd", _delayed(5)))},
    "controller": {
        "off": _killed("controller"),
        "stuck": _stopped("controller"),
        "intermittent": _pausing("controller"),
    },
    "estimator": {
        "off": _killed("estimator"),
        "stuck": _stopped("estimator"),
        "intermittent": _pausing("estimator"),
    },
    "mux": {"off": _killed("mux"), "stuck": _stopped("mux")},
    "planner": {"off": _killed("planner"), "stuck": _stopped("planner")},
    "clock": {"wrong": _set_clock(1.0)},
    "processor": {"slow": _slow_processor},
}
"""What each component can suffer, and how that is brought about"""

_A_SENSOR = "a sensor sends no messages of its own"
_A_PROCESS = "what a process sends is the link's matter"
WHY_NOT = {
    "low_state": "all make sense",
    "low_cmd": "packets to the board carry a check sum, and what is spoilt is lost: see intermittent",
    "estimate": "all make sense",
    "command": "all make sense",
    **dict.fromkeys(
        ("encoder", "imu", "orientation", "gyroscope", "accelerometer", "torque", "foot"), _A_SENSOR
    ),
    "drive": "it is driven by low_cmd and reports through the torque sensor",
    "network": "datagrams carry a check sum, and what is spoilt is lost: see intermittent",
    **dict.fromkeys(("controller", "estimator", "mux", "planner"), _A_PROCESS),
    "clock": "a clock that stands or drifts slowly is not noticed within seconds",
    "processor": "a processor without time for anybody is a process that is stuck",
}
"""Why a kind that is not there makes no sense"""
