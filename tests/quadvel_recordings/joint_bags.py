"""Recordings of joints as others make them: JointState pairs, a Go2's low level, and this stack's with stamps of 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from quadvel_recordings.definitions import STORE
from quadvel_recordings.joint_log import LEG_JOINTS

JOINT_STATE = "sensor_msgs/msg/JointState"
T0 = 1_760_000_000_000_000_000
"""ns, when the recordings begin"""
PERIOD = 5_000_000
ROWS = 400


def motion(joints: int = 12, seed: int = 0) -> dict[str, np.ndarray]:
    """q, dq, tau, q_des (ROWS, joints) of a PD drive (kp 30, kd 0.5) that lags by one row."""
    rng = np.random.default_rng(seed)
    t = np.arange(ROWS)[:, None] * 1e-9 * PERIOD
    q_des = 0.3 * np.sin(2 * np.pi * rng.uniform(0.6, 2.2, joints) * t + rng.uniform(0, 6, joints))
    q = 0.9 * np.vstack([q_des[:1], q_des[:-1]])
    dq = np.gradient(q, 1e-9 * PERIOD, axis=0)
    return {"q": q, "dq": dq, "tau": 30.0 * (q_des - q) - 0.5 * dq, "q_des": q_des}


def time(store: Any, nanoseconds: int) -> Any:
    return store.types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def joint_state(
    store: Any, stamp: int, names: Sequence[str], position: Any, velocity: Any = (), effort: Any = ()
) -> Any:
    header: dict[str, Any] = {"stamp": time(store, stamp), "frame_id": ""}
    if "seq" in dict(store.fielddefs["std_msgs/msg/Header"][1]):
        header["seq"] = 0
    arrays = (np.asarray(values, float) for values in (position, velocity, effort))
    return store.types[JOINT_STATE](store.types["std_msgs/msg/Header"](**header), list(names), *arrays)


Message = tuple[str, str, int, Any]
"""Topic, type, time of receipt (ns), message."""


def joint_states(
    names: Sequence[str] = LEG_JOINTS,
    topics: tuple[str, str] = ("/joint_states", "/joint_commands"),
    store: Any = STORE,
    stamped: bool = True,
    commanded: Sequence[str] | None = None,
) -> list[Message]:
    """A pair of topics; commands name the joints `commanded`, in that order."""
    moved, messages = motion(len(names)), []
    order = [names.index(name) for name in commanded or names]
    for k in range(ROWS):
        now = T0 + k * PERIOD
        stamp = now if stamped else 0
        state = joint_state(store, stamp, names, *(moved[name][k] for name in ("q", "dq", "tau")))
        command = joint_state(store, stamp, commanded or names, moved["q_des"][k, order])
        messages += [(topics[0], JOINT_STATE, now, state), (topics[1], JOINT_STATE, now + 1000, command)]
    return messages


def go2(topics: tuple[str, str] = ("/lowstate", "/lowcmd"), off: Sequence[int] = ()) -> list[Message]:
    """A Go2's low level; in the rows `off` its motors have no target."""
    moved, messages, types = motion(), [], STORE.types
    for k in range(ROWS):
        state, command = empty("LowState"), empty("LowCmd")
        for j in range(12):
            state.motor_state[j].q, state.motor_state[j].dq = moved["q"][k, j], moved["dq"][k, j]
            state.motor_state[j].tau_est = moved["tau"][k, j]
            motor = command.motor_cmd[j]
            motor.mode, motor.q, motor.kp, motor.kd = 1, moved["q_des"][k, j], 30.0, 0.5
            if k in off:
                motor.q, motor.dq = 2.146e9, 16000.0
        now = T0 + k * PERIOD
        for topic, name, message in ((topics[0], "LowState", state), (topics[1], "LowCmd", command)):
            assert isinstance(message, types[f"unitree_go/msg/{name}"])
            messages.append((topic, f"unitree_go/msg/{name}", now, message))
    return messages


def empty(name: str) -> Any:
    """A message of unitree_go, all zero."""
    sizes = {"LowState": 1176, "LowCmd": 808}
    return STORE.deserialize_cdr(b"\0\1\0\0" + bytes(sizes[name]), f"unitree_go/msg/{name}")


def own(zeros: Sequence[int]) -> list[Message]:
    """low_state and low_cmd of this stack, with the stamp 0 in the rows `zeros`."""
    moved, messages = motion(), []

    def single(values: Any, size: int = 12) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, np.float32), (size,)).copy()

    for k in range(ROWS):
        now = T0 + k * PERIOD
        both = {"stamp": time(STORE, 0 if k in zeros else now), "tick": 5 * k}
        state: dict[str, Any] = {name: single(moved[name][k]) for name in ("q", "dq", "tau")}
        state |= {"orientation_wxyz": single([1, 0, 0, 0], 4), "foot_force": single(30, 4)}
        state |= {"angular_velocity": single(0, 3), "linear_acceleration": single([0, 0, 9.81], 3)}
        command = {"mode": 10, "q": single(moved["q_des"][k]), "dq": single(0), "tau": single(0)}
        command |= {"kp": single(30), "kd": single(0.5)}
        for topic, name, values in (("/low_state", "LowState", state), ("/low_cmd", "LowCmd", command)):
            kind = f"quadvel_msgs/msg/{name}"
            messages.append((topic, kind, now, STORE.types[kind](**both, **values)))
    return messages


def rosbag2(
    path: Path,
    messages: Sequence[Message],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        channels: dict[str, Any] = {}
        for topic, kind, now, message in messages:
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(channels[topic], now, STORE.serialize_cdr(message, kind))
    return path


def ros1(path: Path, packing: Any = None) -> Path:
    """A pair of JointState topics as ROS 1 records them."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    if packing:
        writer.set_compression(packing)
    with writer:
        channels: Mapping[str, Any] = {
            topic: writer.add_connection(topic, JOINT_STATE, typestore=store)
            for topic in ("/joint_states", "/joint_commands")
        }
        for topic, kind, now, message in joint_states(store=store):
            writer.write(channels[topic], now, store.serialize_ros1(message, kind))
    return path
