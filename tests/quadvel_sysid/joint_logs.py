"""Logs of joints under a PD law with delays, as arrays and files, computed without the model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_recordings.definitions import STORE
from tests.helpers.robots import ALIENGO

KP, KD = 30.0, 0.5


def fields(seconds: float = 4.0, rate: float = 500.0, seed: int = 0) -> dict[str, Any]:
    """The named arrays of a clean log of 12 joints in motion, all on one time base."""
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate

    def waves(amplitude: float) -> tuple[np.ndarray, np.ndarray]:
        """Sums of two sines (N, 12), and their slopes."""
        pulse, phase = 2.0 * np.pi * random.uniform(0.5, 3.0, (2, 12)), random.uniform(0.0, 6.0, (2, 12))
        angle = pulse * t[:, None, None] + phase
        return amplitude * np.sin(angle).sum(axis=1), amplitude * (pulse * np.cos(angle)).sum(axis=1)

    motion, dq = waves(0.1)
    load, _ = waves(0.04)
    q = ALIENGO.nominal_q + motion
    q_des = q + 0.02 * dq + load
    tau = KP * (q_des - q) - KD * dq + random.normal(0.0, 0.1, q.shape)
    return {
        "t": t,
        "q": q,
        "dq": dq,
        "q_des": q_des,
        "tau": tau,
        "kp": KP,
        "kd": KD,
        "joint_names": JOINT_NAMES,
    }


def npz(path: Path, **changes: Any) -> Path:
    """`fields` with some of them changed, or left out where None, as an archive."""
    np.savez(path, **{name: value for name, value in (fields() | changes).items() if value is not None})
    return path


def csv(path: Path, log: dict[str, Any]) -> Path:
    """Arrays (n, 12) and (n,) as columns; cells behind the end of a shorter one are empty."""
    columns: dict[str, np.ndarray] = {}
    for name, values in log.items():
        if np.ndim(values) == 2:
            columns |= {f"{name}/{joint}": values[:, j] for j, joint in enumerate(JOINT_NAMES)}
        elif np.ndim(values) == 1 and name != "joint_names":
            columns[name] = values
    rows = max(len(values) for values in columns.values())
    lines = [",".join(columns)]
    for row in range(rows):
        cells = (str(values[row]) if row < len(values) else "" for values in columns.values())
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def mcap(
    path: Path, log: dict[str, Any], mode: int = 10, chunk_size: int = 2**20, description: str = ""
) -> Path:
    """low_state and low_cmd as the stack sends them, each command 2 ms after its state."""
    time_type = STORE.types["builtin_interfaces/msg/Time"]
    state_type, command_type = (STORE.types[f"quadvel_msgs/msg/{name}"] for name in ("LowState", "LowCmd"))

    def stamp(nanoseconds: int) -> Any:
        return time_type(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

    def single(values: Any, size: int = 12) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, np.float32), (size,)).copy()

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, name in (("/low_state", "LowState"), ("/low_cmd", "LowCmd")):
            text, _ = STORE.generate_msgdef(f"quadvel_msgs/msg/{name}", ros_version=2)
            schema = writer.register_schema(f"quadvel_msgs/msg/{name}", "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        if description:
            message = STORE.types["std_msgs/msg/String"](data=description)
            text, _ = STORE.generate_msgdef(message.__msgtype__, ros_version=2)
            schema = writer.register_schema(message.__msgtype__, "ros2msg", text.encode())
            channel = writer.register_channel("/robot_description", "cdr", schema)
            writer.add_message(channel, 0, bytes(STORE.serialize_cdr(message, message.__msgtype__)), 0)
        for k, t in enumerate(log["t"]):
            now = 1_700_000_000 * 10**9 + round(1e9 * t)
            state = state_type(
                stamp=stamp(now),
                tick=k,
                q=single(log["q"][k]),
                dq=single(log["dq"][k]),
                tau=single(log["tau"][k]),
                orientation_wxyz=single([1.0, 0.0, 0.0, 0.0], 4),
                angular_velocity=single(0.0, 3),
                linear_acceleration=single(0.0, 3),
                foot_force=single(0.0, 4),
            )
            command = command_type(
                stamp=stamp(now + 2_000_000),
                tick=k,
                mode=mode,
                q=single(log["q_des"][k]),
                dq=single(0.0),
                tau=single(0.0),
                kp=single(log["kp"]),
                kd=single(log["kd"]),
            )
            for topic, message in (("/low_state", state), ("/low_cmd", command)):
                data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
                writer.add_message(channels[topic], now, data, now)
        writer.finish()
    return path
