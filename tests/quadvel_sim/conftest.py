"""Fixtures: the node in a separate process, and a peer that receives and commands it."""

import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import PoseArray  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu, JointState, LaserScan  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from quadvel_description.state import JointCommand  # noqa: E402
from quadvel_msgs.msg import LowCmd, LowState  # noqa: E402
from quadvel_msgs.srv import Push, ResetSim, StepSim  # noqa: E402
from quadvel_nodes.messages import write_low_cmd  # noqa: E402

PROGRAM = "import quadvel_dds; quadvel_dds.install(); from quadvel_sim.sim_node import main; main()"
STATIC = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # of several publishers
TOPICS = {
    "low_state": LowState,
    "imu": Imu,
    "joint_states": JointState,
    "ground_truth/odom": Odometry,
    "scan": LaserScan,
    "ground_truth/persons": PoseArray,
    "/tf": TFMessage,
    "/tf_static": TFMessage,
    "/clock": Clock,
    "/diagnostics": DiagnosticArray,
}
SERVICES = {"reset": ResetSim, "pause": SetBool, "step": StepSim, "push": Push}


class SimProcess:
    """The node as `ros2 run` starts it."""

    def __init__(self, program: str = PROGRAM, **parameters: object) -> None:
        arguments = [item for name, value in parameters.items() for item in ("-p", f"{name}:={value}")]
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, "--ros-args", *arguments], stderr=subprocess.PIPE, text=True
        )

    def interrupt(self) -> None:
        """What Ctrl-C sends."""
        self.process.send_signal(signal.SIGINT)

    def end(self) -> tuple[int, str]:
        """Return exit status and stderr."""
        _, text = self.process.communicate(timeout=40.0)
        return self.process.returncode, text


class Peer:
    """Hears all topics of the node; `answer`, where set, makes the command for each state."""

    def __init__(self) -> None:
        self.node = Node("peer")
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.answer: Callable[[Any], JointCommand | None] = lambda state: None
        self._commands = self.node.create_publisher(LowCmd, "low_cmd", 10)
        for topic, kind in TOPICS.items():
            qos = STATIC if topic == "/tf_static" else 100
            self.node.create_subscription(kind, topic, lambda message, t=topic: self._hear(t, message), qos)
        self._clients = {
            name: self.node.create_client(kind, f"sim_node/{name}") for name, kind in SERVICES.items()
        }

    def _hear(self, topic: str, message: Any) -> None:
        self.heard[topic].append(message)
        if topic == "low_state" and (command := self.answer(message)) is not None:
            self.send(command)

    def send(self, command: JointCommand, **changes: object) -> None:
        """Publish the command; `changes` are written over its fields."""
        message = LowCmd()
        write_low_cmd(command, message)
        for field, value in changes.items():
            setattr(message, field, value)
        self._commands.publish(message)

    def spin_until(self, condition: Callable[[], object], seconds: float = 40.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            heard = {topic: len(messages) for topic, messages in self.heard.items()}
            assert time.monotonic() < deadline, f"time is up; heard {heard}"
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def spin(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            rclpy.spin_once(self.node, timeout_sec=0.01)

    def call(self, service: str, **fields: object) -> Any:
        client = self._clients[service]
        assert client.wait_for_service(timeout_sec=40.0)
        future = client.call_async(SERVICES[service].Request(**fields))
        self.spin_until(future.done)
        return future.result()

    def diagnosed(self) -> tuple[str, dict[str, str]]:
        """Summary and values of the last report of the node."""
        statuses = [status for message in self.heard["/diagnostics"] for status in message.status]
        for status in reversed(statuses):
            if status.name == "sim_node":
                return status.message, {pair.key: pair.value for pair in status.values}
        return "", {}


@pytest.fixture
def peer() -> Iterator[Peer]:
    """A peer in this process."""
    rclpy.init(args=["test"])
    peer = Peer()
    yield peer
    peer.node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def start() -> Iterator[Callable[..., SimProcess]]:
    """Starts the node with parameters; it is killed after the test if it still runs."""
    started: list[SimProcess] = []

    def begin(**arguments: Any) -> SimProcess:
        started.append(SimProcess(**arguments))
        return started[-1]

    yield begin
    for simulation in started:
        if simulation.process.poll() is None:
            simulation.process.kill()
        simulation.process.communicate()
