"""Measures the round-trip time of a message to another process over the installed middleware.

`measure_round_trips` starts the other process as `python -m quadvel_eval.round_trip`.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

import quadvel_dds
from quadvel_policy.observation import CONTROL_PERIOD_S

DISCOVERY_TIMEOUT_S = 20.0  # for the discovery of the other process
ANSWER_TIMEOUT_S = 0.1  # after which a message counts as lost


def measure_round_trips(count: int = 1000) -> dict[str, float]:
    """Measure round trips of a LowState at 200 Hz.

    Args:
        count: Number of round trips.

    Returns:
        Median and 99th percentile, us, and number of lost messages.

    Raises:
        RuntimeError: The other process does not answer.
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
        while (elapsed := time.perf_counter() - start) < ANSWER_TIMEOUT_S:
            rclpy.spin_once(node, timeout_sec=ANSWER_TIMEOUT_S - elapsed)
            if tick in answers:
                return time.perf_counter() - start
        return float("nan")

    echo = subprocess.Popen([sys.executable, "-m", "quadvel_eval.round_trip"])
    try:
        deadline = time.monotonic() + DISCOVERY_TIMEOUT_S
        while np.isnan(trip(0)):
            if time.monotonic() > deadline:
                raise RuntimeError(f"no answer from the other process within {DISCOVERY_TIMEOUT_S:g} s")
        times = np.array([_paced_trip(trip, tick) for tick in range(1, count + 1)])
    finally:
        echo.terminate()
        echo.wait()
        node.destroy_node()
        rclpy.try_shutdown()
    p50, p99 = 1e6 * np.nanquantile(times, (0.5, 0.99))
    return {"p50_us": float(p50), "p99_us": float(p99), "lost": int(np.isnan(times).sum())}


def _paced_trip(trip: Callable[[int], float], tick: int) -> float:
    """Time one round trip, then sleep until the next control period."""
    elapsed = trip(tick)
    if not np.isnan(elapsed):  # a lost message has taken longer than the period
        time.sleep(max(CONTROL_PERIOD_S - elapsed, 0.0))
    return elapsed


def _echo() -> None:
    """Send every message back until a signal ends the process."""
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
