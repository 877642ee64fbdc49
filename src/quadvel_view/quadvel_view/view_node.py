"""The node `view`: the operator page of a running robot.

`picture` and `scene` define what it shows. Messages are queued as bytes. Only the newest message of
each topic is deserialised, once per frame.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from typing import Any

import attrs
from geometry_msgs.msg import Twist, Vector3, Wrench
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

from quadvel_description.fields import field
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_msgs.srv import Push, ResetSim, SetMode
from quadvel_nodes.node import StartError, read_parameters, run
from quadvel_recordings.definitions import STORE

from .operator import PUBLISH_PERIOD_S, STOP_RETRY_S, Operator
from .order_queue import OrderQueue
from .page_protocol import Allow, Hold, LetGo, ModeRequest, PageMessage, Record, Release, Reset, Stop
from .page_protocol import Push as PushWord
from .picture import LATCHED, TOPICS, RobotPicture
from .recording import PageRecorder
from .server import AddressError
from .viewer import DEFAULT_PORT, FRAME_PERIOD_S, MAX_PORT, Viewer

LATCHED_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATEST_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
SIMULATOR_NODES = ("sim_node", "board")
PUSH_FORCE_N, PUSH_DURATION_S = 60.0, 0.2
"""Force of the page's push, N."""


@attrs.frozen
class ViewParameters:
    """Parameters of the node.

    Attributes:
        robot: Name of the robot, or path of a robot.yaml.
        host: Address of the page's server.
        port: TCP port of the page, 0 for a free one.
        record_folder: Folder for recordings.
    """

    robot: str = field(DEFAULT_ROBOT, "the robot: its name, or the path of a robot.yaml")
    host: str = field(
        "127.0.0.1", "address on which the page is served; others than this host's need the token"
    )
    port: int = field(
        DEFAULT_PORT, "TCP port of the page; 0: any that is free", at_least=0, at_most=MAX_PORT, whole=True
    )
    record_folder: str = field("out", "folder for recordings that the page starts")


class View(Node):
    """The operator page with its subscriptions, publishers and service clients."""

    def __init__(self) -> None:
        self._ends = ExitStack()  # closes what is open when the node is destroyed, even half made
        super().__init__("view")
        settings = read_parameters(self, ViewParameters)
        robot = load_robot(settings.robot)
        self._picture, self._operator = RobotPicture(robot), Operator()
        self._orders, self._calls = OrderQueue(), dict[Any, Any]()  # the last call of each client
        self._pending: dict[str, deque[bytes]] = {}
        self._status_text, self._stop_sent_at = "", 0.0
        self._recording = PageRecorder(settings.record_folder)
        self._ends.callback(self._recording.close)
        self._velocity = self.create_publisher(Twist, "cmd_vel_teleop", 10)
        self._set_mode = self.create_client(SetMode, "controller/set_mode")
        self._enable = self.create_client(SetBool, "controller/enable_walking")
        self._reset_odometry = self.create_client(Trigger, "estimator/reset_odometry")
        self._resets = [self.create_client(ResetSim, f"{name}/reset") for name in SIMULATOR_NODES]
        self._pushes = [self.create_client(Push, f"{name}/push") for name in SIMULATOR_NODES]
        for topic, typename in TOPICS.items():
            self._subscribe(topic, typename)
        try:
            self._viewer = Viewer(robot, settings.host, settings.port, self._on_message, self._on_disconnect)
        except AddressError as error:
            raise StartError(str(error)) from None
        self._ends.callback(self._viewer.close)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(FRAME_PERIOD_S, self._draw, clock=steady)
        self.create_timer(PUBLISH_PERIOD_S, self._obey, clock=steady)
        self.get_logger().info(f"open {self._viewer.url}")

    def destroy_node(self) -> None:
        """Stop the page and the recorder, then destroy the node."""
        self._ends.close()
        super().destroy_node()

    def _subscribe(self, topic: str, typename: str) -> None:
        """Queue the messages of a topic as bytes."""
        package, kind, name = typename.split("/")
        waiting = self._pending[topic] = deque(maxlen=10 if topic in ("/diagnostics", *LATCHED) else 1)
        self.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic if topic in ("/diagnostics", "/tf_static") else topic[1:],
            lambda message: waiting.append(message),
            LATCHED_QOS if topic in LATCHED else LATEST_QOS,
            raw=True,
        )

    def _draw(self) -> None:
        """Update picture and page (30 Hz), if a page is open or a STOP is not acknowledged yet."""
        if not self._viewer.is_watched and not self._operator.stopped:
            return
        now = time.monotonic()
        for topic, waiting in self._pending.items():
            while waiting:
                self._picture.update_lazily(
                    topic, partial(STORE.deserialize_cdr, waiting.popleft(), TOPICS[topic]), now
                )
        self._viewer.show(
            self._picture,
            self._operator,
            now,
            said=self._status_text,
            recording=self._recording.file,
            playback=None,
        )

    def _obey(self) -> None:
        """Execute the orders of the pages, then publish the velocity (20 Hz)."""
        self._execute_orders()
        self._publish_velocity()

    def _publish_velocity(self) -> None:
        """Publish the held velocity, and repeat the STOP until the joints are damped."""
        now = time.monotonic()
        velocity = self._operator.velocity(now)
        if velocity is not None:
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
            self._velocity.publish(twist)
        if self._operator.should_resend_stop(self._mode(now), now - self._stop_sent_at):
            self._send_stop()

    def _mode(self, now: float) -> str:
        """Return the mode of the controller, or "" if its state is stale."""
        return self._picture.state.mode_name if self._picture.is_fresh("/controller/state", now) else ""

    def _send_stop(self) -> None:
        """Request the passive mode."""
        self._stop_sent_at = time.monotonic()
        request = SetMode.Request(
            mode="passive", requester="STOP on the page, which holds until it is released there"
        )
        self._call(self._set_mode, request, "STOP")

    # Orders arrive in the server's thread. A timer of the executor executes them, because one task
    # for each order would delay timers and subscriptions for as long as orders arrive.

    def _on_message(self, page: int, order: PageMessage) -> None:
        """Queue an order; the first STOP does not wait for the timer."""
        is_urgent = self._orders.put(page, order) and not self._operator.stopped
        if is_urgent and self.executor is not None:
            self.executor.create_task(self._execute_orders)

    def _on_disconnect(self, page: int) -> None:
        """Queue the end of the hold of a page that disconnected."""
        self._orders.put(page, LetGo())

    def _execute_orders(self) -> None:
        """Execute the waiting orders."""
        for page, order in self._orders.take_all():
            self._execute(page, order)

    def _execute(self, page: int, word: PageMessage) -> None:
        """Execute a message of the page.

        While STOP is latched, only STOP, its release, holds and recording are executed.
        """
        match word:
            case Stop():
                self._execute_stop()
            case Hold(velocity=velocity):
                self._operator.hold(page, velocity, time.monotonic())
            case LetGo():
                self._operator.end_hold(page, time.monotonic())
            case Release():
                self._operator.release()
                self.get_logger().info("the STOP was released on the page")
            case Record():
                self._status_text = self._recording.toggle()
            case _ if not self._operator.stopped:
                self._execute_unless_stopped(word)

    def _execute_stop(self) -> None:
        """Latch the STOP. A repeat is transmitted again at most every STOP_RETRY_S."""
        was_stopped = self._operator.stopped
        self._operator.stop()
        if not was_stopped:
            self.get_logger().warning("STOP was pressed on the page")
        if not was_stopped or time.monotonic() - self._stop_sent_at > STOP_RETRY_S:
            self._send_stop()

    def _execute_unless_stopped(self, word: PageMessage) -> None:
        """Execute the orders that STOP blocks."""
        match word:
            case ModeRequest():
                self._call(self._set_mode, SetMode.Request(mode=word.mode), word.mode.replace("_", " "))
            case Allow():
                self._call(self._enable, SetBool.Request(data=True), "allow walking")
            case Reset(terrain=terrain):
                self._reset(terrain)
            case PushWord(to=side):
                force = Vector3(y=-PUSH_FORCE_N if side == "right" else PUSH_FORCE_N)
                request = Push.Request(body="trunk", wrench=Wrench(force=force), duration=PUSH_DURATION_S)
                self._call(_ready_client(self._pushes), request, "push")

    def _reset(self, terrain: str) -> None:
        """Reset the simulated robot through passive mode.

        In other modes a jump in position is a fault.
        """
        request = ResetSim.Request(keyframe="lie", terrain=terrain)

        def put_back() -> None:
            self._call(_ready_client(self._resets), request, "reset", then=start_odometry)

        def start_odometry() -> None:
            if self._reset_odometry.service_is_ready():
                self._request(self._reset_odometry, Trigger.Request())

        if self._set_mode.service_is_ready():
            self._call(self._set_mode, SetMode.Request(mode="passive"), "passive", then=put_back)
        else:
            put_back()

    def _call(self, client: Any, request: Any, what: str, then: Callable[[], None] = lambda: None) -> None:
        """Call a service, show its answer, and call `then` on success."""
        if not client.service_is_ready():
            self._status_text = f"{what}: the service is not available"
            return

        def answered(future: Any) -> None:
            response = future.result()
            self._status_text = (
                response.message if response.success else f"{what} refused: {response.message}"
            )
            if response.success:
                then()

        self._request(client, request).add_done_callback(answered)

    def _request(self, client: Any, request: Any) -> Any:
        """Send a request and return its future.

        An unanswered one of the same client is given up: a service that does not answer fills no
        memory.
        """
        if client in self._calls:
            client.remove_pending_request(self._calls[client])
        self._calls[client] = client.call_async(request)
        return self._calls[client]


def _ready_client(clients: list[Any]) -> Any:
    """Return the first client whose service is available, or else the first client."""
    return next((client for client in clients if client.service_is_ready()), clients[0])


def main(args: list[str] | None = None) -> None:
    """Run the node. It has the priority of the robot's own nodes, because it transmits the STOP.

    Args:
        args: Arguments of ROS 2; those of the process if None.
    """
    run(View, args)
