"""Injects faults into a `Stack`: each component with each kind of fault that makes sense for it.

`stack` simulates the robot and its processes; `cases` states what must happen after each fault;
`campaign` runs all cases and compares. Times are ms of the simulation unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.state import RobotState
from quadvel_sim.simulator import DT

from .stack import STATE_PERIOD_MS, Link, Message, Stack, corrupt

KINDS = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent", "duplicated")
"""Kinds of faults.

`off` sends nothing or zeros, `stuck` repeats an old value or stops a process, `garbage` is random
numbers, and `wrong` is a value with an offset or a factor.
"""
Rng = np.random.Generator
Deliveries = list[tuple[int, Message]]
"""Delay in ms and content of each message that a link delivers for one that was sent."""

DELAY_MS = 80  # of delayed messages and sensors
SLOW_LINK_DIVISOR = 16  # a slow link passes one message in so many
MAX_DROPOUT_MS = 15  # of an intermittent link
PAUSE_MS = 100  # of an intermittent process
SLOW_SENSOR_PERIOD_MS = 200  # between two new values of a slow sensor


@attrs.frozen
class Injection:
    """One fault; `begin(stack, rng)` injects it.

    Attributes:
        component: Key of COMPONENTS.
        kind: One of KINDS.
        begin: Function that injects the fault into a stack.
    """

    component: str
    kind: str
    begin: Callable[[Stack, Rng], None]


def make_injection(component: str, kind: str) -> Injection:
    """Return the injection of a fault.

    Args:
        component: Key of COMPONENTS.
        kind: One of KINDS.

    Returns:
        The injection.

    Raises:
        ValueError: Component or kind is unknown, or the combination makes no sense.
    """
    if component not in COMPONENTS:
        raise ValueError(f"component is '{component}', expected one of {', '.join(COMPONENTS)}")
    if kind not in KINDS:
        raise ValueError(f"kind is '{kind}', expected one of {', '.join(KINDS)}")
    known = COMPONENTS[component]
    if kind not in known:
        raise ValueError(
            f"{component} can't be {kind}: expected one of {', '.join(known)}; {REASONS_UNSUPPORTED[component]}"
        )
    return Injection(component, kind, known[kind])


# Faults of links: each function returns, for a link, what the link does with each message.


def _link(
    name: str, make_fault: Callable[[Link, Rng], Callable[[int, Message], Deliveries]]
) -> Callable[[Stack, Rng], None]:
    """Install a fault on a link."""

    def begin(stack: Stack, rng: Rng) -> None:
        stack.links[name].fault = make_fault(stack.links[name], rng)

    return begin


def _off(link: Link, rng: Rng) -> Callable[[int, Message], Deliveries]:
    """Lose every message."""
    return lambda now, message: []


def _repeated(link: Link, rng: Rng) -> Callable[[int, Message], Deliveries]:
    """Repeat the first message forever; a repeated state gets the stamp of the one it replaces."""
    first: list[Message] = []

    def deliver(now: int, message: Message) -> Deliveries:
        first.append(message)
        return [(0, _replaced(first[0], stamp=message.stamp) if hasattr(message, "q") else first[0])]

    return deliver


def _garbage(link: Link, rng: Rng) -> Callable[[int, Message], Deliveries]:
    """Corrupt every message."""
    return lambda now, message: [(0, corrupt(message, rng))]


def _slow(link: Link, rng: Rng) -> Callable[[int, Message], Deliveries]:
    """Pass one message in SLOW_LINK_DIVISOR."""
    count = iter(range(1, 10**9))
    return lambda now, message: [(0, message)] if next(count) % SLOW_LINK_DIVISOR == 0 else []


def _delayed(delay_ms: int) -> Callable[[Link, Rng], Callable[[int, Message], Deliveries]]:
    """Delay every message by `delay_ms` ms."""
    return lambda link, rng: lambda now, message: [(delay_ms, message)]


def _intermittent(link: Link, rng: Rng) -> Callable[[int, Message], Deliveries]:
    """Lose all messages in random bursts of up to MAX_DROPOUT_MS."""
    silent_until = [0, 0]  # end of this dropout, and earliest start of the next, ms

    def deliver(now: int, message: Message) -> Deliveries:
        if now >= silent_until[1]:
            silent_until[:] = (
                now + int(rng.integers(1, MAX_DROPOUT_MS + 1)),
                now + int(rng.integers(2 * MAX_DROPOUT_MS, 8 * MAX_DROPOUT_MS)),
            )
        return [] if now < silent_until[0] else [(0, message)]

    return deliver


def _duplicated(link: Link, rng: Rng) -> Callable[[int, Message], Deliveries]:
    """Deliver every message twice, 1 ms apart."""
    return lambda now, message: [(0, message), (1, message)]


def _changed(
    change: Callable[[Message, Rng], Message],
) -> Callable[[Link, Rng], Callable[[int, Message], Deliveries]]:
    """Change every message by a function."""
    return lambda link, rng: lambda now, message: [(0, change(message, rng))]


def _replaced(message: Message, **fields: Any) -> Message:
    """Copy a message with other fields."""
    return SimpleNamespace(**{**vars(message), **fields})


def _combined(*begins: Callable[[Stack, Rng], None]) -> Callable[[Stack, Rng], None]:
    """Inject several faults together."""

    def begin(stack: Stack, rng: Rng) -> None:
        for one in begins:
            one(stack, rng)

    return begin


# Faults of sensors: functions from a measured state to a faulty one.


def _sensor(fields: tuple[str, ...], kind: str, one_joint: bool = False) -> Callable[[Stack, Rng], None]:
    """Install a sensor fault on fields of the state, at one random joint or at all values."""

    def begin(stack: Stack, rng: Rng) -> None:
        joint = int(rng.integers(12))
        sizes = {"quaternion": 4, "foot_force": 4, "angular_velocity": 3, "linear_acceleration": 3}
        places = {
            field: np.arange(12) == joint if one_joint else np.ones(sizes.get(field, 12), bool)
            for field in fields
        }
        stack.sensor_fault = _Sensor(kind, places, rng)

    return begin


class _Sensor:
    """Sensor fault: replaces some values of each state."""

    def __init__(self, kind: str, places: dict[str, Bools], rng: Rng) -> None:
        self._kind, self._places, self._rng = kind, places, rng
        self._past: list[tuple[int, RobotState]] = []  # time in ms and state, every STATE_PERIOD_MS

    def __call__(self, now: int, state: RobotState) -> RobotState:
        self._past.append((now, state))
        values = {
            field: np.where(place, self._value(field, now, getattr(state, field)), getattr(state, field))
            for field, place in self._places.items()
        }
        return attrs.evolve(state, **values)

    def _value(self, field: str, now: int, true: Array) -> Any:
        """Return the faulty value of a field, in the unit of the field."""
        kind, begun = self._kind, self._past[0]
        if kind == "off" or (kind == "intermittent" and self._rng.random() < 0.3):
            return 0.0
        if kind == "stuck":
            return getattr(begun[1], field)
        if kind == "slow":
            period = SLOW_SENSOR_PERIOD_MS
            return getattr(self._past[(now - begun[0]) // period * period // STATE_PERIOD_MS][1], field)
        if kind == "delayed":
            return getattr(self._past[max(len(self._past) - 1 - DELAY_MS // STATE_PERIOD_MS, 0)][1], field)
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
"""Standard deviation of garbage, in the unit of the field."""
MOUNTING_TILT = np.array([np.cos(0.25), np.sin(0.25), 0.0, 0.0])
"""Quaternion (w, x, y, z) of a rotation by 0.5 rad about x."""


def _wrong(field: str, true: Array) -> Array:
    """Add an offset to a field, in its unit; an orientation gets the tilt of a wrong mounting."""
    if field == "quaternion":
        # Hamilton product q * (a, b, 0, 0): rotation by 2 acos(a) about the body's x axis.
        w, x, y, z = true
        a, b = MOUNTING_TILT[0], MOUNTING_TILT[1]
        return np.array([w * a - x * b, x * a + w * b, y * a + z * b, z * a - y * b])
    return (
        true + {"q": 0.5, "dq": 0.0, "tau": 25.0, "angular_velocity": 1.5, "linear_acceleration": 15.0}[field]
    )


# Faults of drives, processes, clock and processor.


def _dead_drive(stack: Stack, rng: Rng) -> None:
    """Switch off one random drive."""
    stack.simulator.fail_joint(JOINT_NAMES[int(rng.integers(12))])


def _jammed(stack: Stack, rng: Rng) -> None:
    """Block one random thigh or calf joint."""
    stack.simulator.jam_joint(JOINT_NAMES[int(rng.choice((1, 2, 4, 5, 7, 8, 10, 11)))])


def _killed(name: str) -> Callable[[Stack, Rng], None]:
    """Kill a process."""

    def begin(stack: Stack, rng: Rng) -> None:
        stack.processes[name].killed = True

    return begin


def _stopped(name: str) -> Callable[[Stack, Rng], None]:
    """Stop a process without resuming it; its input waits in a queue."""

    def begin(stack: Stack, rng: Rng) -> None:
        stack.processes[name].stopped = True

    return begin


def _pausing(name: str) -> Callable[[Stack, Rng], None]:
    """Stop a process for PAUSE_MS in every three periods of PAUSE_MS."""

    def begin(stack: Stack, rng: Rng) -> None:
        process, earlier_fault = stack.processes[name], stack.sensor_fault

        def pause(now: int, state: RobotState) -> RobotState:
            if now // PAUSE_MS % 3 == 0:
                process.stopped = True
            elif process.stopped:
                process.resume()
            return state if earlier_fault is None else earlier_fault(now, state)

        stack.sensor_fault = pause

    return begin


def _set_clock(by: float) -> Callable[[Stack, Rng], None]:
    """Set the machine's clock forward or back by `by` seconds."""

    def begin(stack: Stack, rng: Rng) -> None:
        stack.clock_offset += by * float(rng.choice((-1.0, 1.0)))

    return begin


def _slow_processor(stack: Stack, rng: Rng) -> None:
    """Lengthen each tick of the controller by 8 ms."""
    stack.extra_tick_time = 8 * DT


_LINK_KINDS = {
    "off": _off,
    "stuck": _repeated,
    "garbage": _garbage,
    "slow": _slow,
    "delayed": _delayed(DELAY_MS),
    "intermittent": _intermittent,
    "duplicated": _duplicated,
}


def _of_link(
    name: str, wrong: Callable[[Message, Rng], Message] | None = None, without: tuple[str, ...] = ()
) -> dict[str, Any]:
    """All link faults of a link, and an optional wrong value."""
    kinds = {kind: _link(name, make_fault) for kind, make_fault in _LINK_KINDS.items() if kind not in without}
    return kinds | ({} if wrong is None else {"wrong": _link(name, _changed(wrong))})


def _of_sensor(fields: tuple[str, ...], *kinds: str, one_joint: bool = False) -> dict[str, Any]:
    """Sensor faults of some kinds."""
    return {kind: _sensor(fields, kind, one_joint) for kind in kinds}


COMPONENTS: dict[str, dict[str, Callable[[Stack, Rng], None]]] = {
    "low_state": _of_link("low_state", lambda m, rng: _replaced(m, q=m.q + np.float32(0.5))),
    "low_cmd": _of_link("low_cmd", without=("garbage",)) | {"delayed": _link("low_cmd", _delayed(30))},
    "estimate": _of_link("estimate", lambda m, rng: _replaced(m, velocity=m.velocity + np.float32(1.5))),
    "command": _of_link("command", lambda m, rng: _replaced(m, velocity=m.velocity * np.float32(100.0))),
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
        kind: _combined(_link("low_state", make_fault), _link("low_cmd", make_fault))
        for kind, make_fault in _LINK_KINDS.items()
        if kind in ("off", "slow", "intermittent", "duplicated")
    }
    | {"delayed": _combined(_link("low_state", _delayed(5)), _link("low_cmd", _delayed(5)))},
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
"""Injection of each kind of fault of each component."""

_A_SENSOR = "a sensor sends no separate messages"
_A_PROCESS = "faults of its messages belong to the link"
REASONS_UNSUPPORTED = {
    "low_state": "all make sense",
    "low_cmd": "packets to the board have a checksum, so that corrupt ones are lost: see intermittent",
    "estimate": "all make sense",
    "command": "all make sense",
    **dict.fromkeys(
        ("encoder", "imu", "orientation", "gyroscope", "accelerometer", "torque", "foot"), _A_SENSOR
    ),
    "drive": "low_cmd drives it, and the torque sensor reports it",
    "network": "datagrams have a checksum, so that corrupt ones are lost: see intermittent",
    **dict.fromkeys(("controller", "estimator", "mux", "planner"), _A_PROCESS),
    "clock": "a stopped or slowly drifting clock is not detectable within seconds",
    "processor": "a fully loaded processor is equivalent to a stuck process",
}
"""Reason why the other kinds of fault make no sense."""
