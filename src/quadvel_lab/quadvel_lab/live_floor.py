"""Two lower bounds of what the control loop costs; `live_bench` runs both together with the stack.

`python -m quadvel_lab.live_floor` is the node `floor`: it takes each `low_state`, runs the policy's
network once, and writes `floor/low_cmd`. Nothing else. `... live_floor SECONDS` sleeps for one
control period at a time, and prints its lateness and its processor time.
"""

from __future__ import annotations

import gc
import json
import sys
import time
from typing import Any

import numpy as np

import quadvel_dds

quadvel_dds.install()  # before anything imports rclpy

# ruff: noqa: E402
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_msgs.msg import LowCmd, LowState
from quadvel_nodes.node import run
from quadvel_nodes.scheduling import Scheduling
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_policy.policy_file import PolicyFile


class Floor(Node):
    """Answers each state with an output of the network for an observation of zeros.

    The stamp of an answer is the time at which the node received the state.
    """

    def __init__(self) -> None:
        super().__init__("floor")
        self._policy = PolicyFile(load_robot(DEFAULT_ROBOT))
        self._observation = np.zeros(self._policy.metadata.observation.size, np.float32)
        self._answers = self.create_publisher(LowCmd, "floor/low_cmd", 1)
        self.create_subscription(LowState, "low_state", self._on_state, qos_profile_sensor_data)
        Scheduling().apply(self.get_logger().warning)
        gc.freeze()

    def _on_state(self, message: Any) -> None:
        stamp = self.get_clock().now().to_msg()
        action = self._policy.step(self._observation)
        self._answers.publish(LowCmd(stamp=stamp, tick=message.tick, q=action))


def measure_sleep(seconds: float) -> dict[str, float]:
    """Sleep until each deadline of a grid of CONTROL_PERIOD_S.

    Args:
        seconds: Duration, s.

    Returns:
        Median and high percentiles of the lateness, us, and processor time of a period, us.
    """
    Scheduling().apply(print)
    count, start, used = round(seconds / CONTROL_PERIOD_S), time.perf_counter(), time.process_time()
    late = []
    for k in range(1, count + 1):
        deadline = start + k * CONTROL_PERIOD_S
        time.sleep(max(deadline - time.perf_counter(), 0.0))
        late.append(time.perf_counter() - deadline)
    used = time.process_time() - used
    p50, p99, p999 = 1e6 * np.quantile(late, (0.5, 0.99, 0.999))
    return {"p50_us": p50, "p99_us": p99, "p999_us": p999, "cpu_us": 1e6 * used / count}


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] != "--ros-args":
        print(json.dumps(measure_sleep(float(sys.argv[1]))))
    else:
        run(Floor)
