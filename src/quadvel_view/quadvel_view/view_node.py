"""The node `view`: the operator's page on the robot that runs. What it shows is `picture`'s and `scene`'s matter.

Messages come as bytes and wait: only the newest of each topic is read, as often as a picture is drawn.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import attrs
from geometry_msgs.msg import Twist, Vector3, Wrench
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

from quadvel_msgs.srv import Push, ResetSim, SetMode
from quadvel_nodes.node import StartError, read_parameters, run
from quadvel_recordings.definitions import STORE

from .operator import PERIOD, Operator
from .picture import LATCHED, TOPICS, RobotPicture
from .recording import Recording
from .server import AddressError
from .viewer import FRAME, LARGEST_PORT, PORT, Viewer
from .words import Allow, Hold, LetGo, ModeRequest, Record, Release, Reset, Stop, Word
from .words import Push as PushWord

KEPT = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
NEWEST = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
SIMULATIONS = ("sim_node", "board")
PUSH, PUSH_TIME = 60.0, 0.2  # N, s
SLOPE = 0.175  # rad, of the page's slope


def _parameter(default: Any, description: str) -> Any:
    return attrs.field(default=default, metadata={"description": description})


@attrs.frozen
class ViewParameters:
    """The node's parameters."""

    host: str = _parameter(
        "127.0.0.1", "address on which the page is served; others than this host's need the token"
    )
    port: int = _parameter(PORT, "TCP port of the page; 0: any that is free")
    record_folder: str = _parameter("out", "folder for recordings that the page starts")

    def __attrs_post_init__(self) -> None:
        if not 0 <= self.port <= LARGEST_PORT:
            raise ValueError(f"port is {self.port}, expected 0 to {LARGEST_PORT}")


class View(Node):
    """The page, what it shows, and what it asks for."""

    def __init__(self) -> None:
        super().__init__("view")
        settings = read_parameters(self, ViewParameters)
        self._picture, self._operator = RobotPicture(), Operator()
        self._waiting: dict[str, deque[bytes]] = {}
        self._said, self._stop_asked = "", 0.0
        self._recording = Recording(settings.record_folder)
        self._velocity = self.create_publisher(Twist, "cmd_vel_teleop", 10)
        self._set_mode = self.create_client(SetMode, "controller/set_mode")
        self._enable = self.create_client(SetBool, "controller/enable_walking")
        self._reset_odometry = self.create_client(Trigger, "estimator/reset_odometry")
        self._resets = [self.create_client(ResetSim, f"{name}/reset") for name in SIMULATIONS]
        self._pushes = [self.create_client(Push, f"{name}/push") for name in SIMULATIONS]
        for topic, typename in TOPICS.items():
            self._subscribe(topic, typename)
        try:
            self._viewer = Viewer(settings.host, settings.port, self._on_word, self._on_leave)
        except AddressError as error:
            raise StartError(str(error)) from None
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(FRAME, self._show, clock=steady)
        self.create_timer(PERIOD, self._drive, clock=steady)
        self.get_logger().info(f"open {self._viewer.url}")

    def destroy_node(self) -> None:
        """End the page, then the node."""
        self._viewer.close()
        self._recording.close()
        super().destroy_node()

    def _subscribe(self, topic: str, typename: str) -> None:
        package, kind, name = typename.split("/")
        waiting = self._waiting[topic] = deque(maxlen=10 if topic in ("/diagnostics", *LATCHED) else 1)
        self.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic if topic in ("/diagnostics", "/tf_static") else topic[1:],
            lambda message: waiting.append(message),
            KEPT if topic in LATCHED else NEWEST,
            raw=True,
        )

    def _show(self) -> None:
        """Thirty times a second: read what came, draw it, where somebody looks or a STOP waits to be seen through."""
        if not self._viewer.is_watched and not self._operator.stopped:
            return
        now = time.monotonic()
        for topic, waiting in self._waiting.items():
            while waiting:
                self._picture.read(
                    topic, partial(STORE.deserialize_cdr, waiting.popleft(), TOPICS[topic]), now
                )
        self._viewer.show(
            self._picture, self._operator, now, said=self._said, recording=self._recording.file, playback=None
        )

    def _drive(self) -> None:
        """Twenty times a second: the velocity that is held; and STOP again until the joints brake."""
        now = time.monotonic()
        velocity = self._operator.velocity(now)
        if velocity is not None:
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
            self._velocity.publish(twist)
        if self._operator.is_unheeded(self._mode(now), now - self._stop_asked):
            self._ask_to_stop()

    def _mode(self, now: float) -> str:
        return self._picture.state.mode_name if self._picture.is_fresh("/controller/state", now) else ""

    def _ask_to_stop(self) -> None:
        self._stop_asked = time.monotonic()
        self._call(self._set_mode, SetMode.Request(mode="passive"), "STOP")

    # What a page says; it comes in the server's thread, and is heeded in the executor's.

    def _on_word(self, page: int, word: Word) -> None:
        self._soon(partial(self._heed, page, word))

    def _on_leave(self, page: int) -> None:
        self._soon(lambda: self._operator.let_go(page, time.monotonic()))

    def _soon(self, task: Any) -> None:
        if self.executor is not None:
            self.executor.create_task(task)

    def _heed(self, page: int, word: Word) -> None:
        match word:
            case Stop():
                self._operator.stop()
                self.get_logger().warning("STOP was pressed on the page")
                self._ask_to_stop()
            case Hold(velocity=velocity):
                self._operator.hold(page, velocity, time.monotonic())
            case LetGo():
                self._operator.let_go(page, time.monotonic())
            case Release():
                self._operator.release()
                self.get_logger().info("the STOP was released on the page")
            case Record():
                self._said = self._recording.toggle()
            case _ if not self._operator.stopped:
                self._order(word)

    def _order(self, word: Word) -> None:
        """What may not be asked for while STOP is pressed."""
        match word:
            case ModeRequest():
                self._call(self._set_mode, SetMode.Request(mode=word.mode), word.mode.replace("_", " "))
            case Allow():
                self._call(self._enable, SetBool.Request(data=True), "allow walking")
            case Reset(terrain=terrain):
                self._reset(terrain)
            case PushWord(to=side):
                force = Vector3(y=-PUSH if side == "right" else PUSH)
                request = Push.Request(body="trunk", wrench=Wrench(force=force), duration=PUSH_TIME)
                self._call(_ready(self._pushes), request, "push")

    def _reset(self, terrain: str) -> None:
        """Put the simulated robot back: a jump to another place is a fault of a robot that is not passive."""
        slope = SLOPE if terrain == "slope" else 0.0
        request = ResetSim.Request(keyframe="lie", terrain=terrain, slope=slope)

        def put_back() -> None:
            self._call(_ready(self._resets), request, "reset", then=start_odometry)

        def start_odometry() -> None:
            if self._reset_odometry.service_is_ready():
                self._reset_odometry.call_async(Trigger.Request())

        if self._set_mode.service_is_ready():
            self._call(self._set_mode, SetMode.Request(mode="passive"), "passive", then=put_back)
        else:
            put_back()

    def _call(self, client: Any, request: Any, what: str, then: Callable[[], None] = lambda: None) -> None:
        """Call a service, show its answer, and where it was a success do what comes `then`."""
        if not client.service_is_ready():
            self._said = f"{what}: nobody is there who could"
            return

        def answered(future: Any) -> None:
            response = future.result()
            self._said = response.message if response.success else f"{what} refused: {response.message}"
            if response.success:
                then()

        client.call_async(request).add_done_callback(answered)


def _ready(clients: list[Any]) -> Any:
    """The first whose service is there, or the first."""
    return next((client for client in clients if client.service_is_ready()), clients[0])


def main(args: list[str] | None = None) -> None:
    """Entry point of the node. It has the priority of the robot's own nodes, as STOP comes through it."""
    run(View, args)
