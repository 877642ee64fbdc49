"""How long a message takes to another process and back, over whatever middleware is there.

`measure` starts the other side as `python -m quadvel_eval.round_trip`.
"""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

import numpy as np

import quadvel_dds

from .robot_loop import PERIOD

PATIENCE = 20.0  # s, until the two have found each other
LOST = 0.1  # s, after which an answer is not waited for


def measure(count: int = 1000) -> dict[str, float]:
    """Median and 99th percentile (us) of `count` round trips of a LowState at 200 Hz, and how many got lost.

    RuntimeError where the other process does not answer.
    """
    quadvel_dds.install()
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.signals import SignalHandlerOptions

    from quadvel_msgs.msg import LowState

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("round_trip")
    answers: list[int] = []
    publisher = node.create_publisher(LowState, "round_trip/there", qos_profile_sensor_data)
    node.create_subscription(
        LowState, "round_trip/back", lambda message: answers.append(message.tick), qos_profile_sensor_data
    )

    def trip(tick: int) -> float:
        """Seconds until the answer to `tick`, nan if it got lost."""
        answers.clear()
        start = time.perf_counter()
        publisher.publish(LowState(tick=tick))
        while (elapsed := time.perf_counter() - start) < LOST:
            rclpy.spin_once(node, timeout_sec=LOST - elapsed)
            if tick in answers:
                return time.perf_counter() - start
        return float("nan")

    echo = subprocess.Popen([sys.executable, "-m", "quadvel_eval.round_trip"])
    try:
        until = time.monotonic() + PATIENCE
        while np.isnan(trip(0)):
            if time.monotonic() > until:
                raise RuntimeError(f"no answer from the other process within {PATIENCE:g} s")
        times = np.array([_at_rate(trip, tick) for tick in range(1, count + 1)])
    finally:
        echo.terminate()
        echo.wait()
        node.destroy_node()
        rclpy.try_shutdown()
    p50, p99 = 1e6 * np.nanquantile(times, (0.5, 0.99))
    return {"p50_us": float(p50), "p99_us": float(p99), "lost": int(np.isnan(times).sum())}


def _at_rate(trip: Any, tick: int) -> float:
    """One round trip, and a rest so that they come at the controller's rate."""
    elapsed: float = trip(tick)
    time.sleep(max(PERIOD - elapsed, 0.0) if elapsed == elapsed else 0.0)
    return elapsed


def _echo() -> None:
    """The other side: sends back what comes, until it is told to end."""
    quadvel_dds.install()
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import qos_profile_sensor_data

    from quadvel_msgs.msg import LowState

    rclpy.init(args=[])
    node = rclpy.create_node("round_trip_echo")
    publisher = node.create_publisher(LowState, "round_trip/back", qos_profile_sensor_data)
    node.create_subscription(LowState, "round_trip/there", publisher.publish, qos_profile_sensor_data)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    _echo()
