"""Nodes: a name, and everything that is created under it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rcl_interfaces.msg import Log
from rosgraph_msgs.msg import Clock as ClockMessage

from quadvel_dds import arguments, names, wire
from quadvel_dds.errors import refuse_options

from . import exceptions, qos
from ._parameters import ParameterMixin
from .client import Client
from .clock import Clock, ClockType
from .context import get_default_context
from .logging import get_logger, sinks
from .parameter import Parameter
from .publisher import Publisher
from .qos import QoSProfile
from .service import Service
from .subscription import Subscription
from .time import Time
from .timer import Timer
from .topic_endpoint_info import TopicEndpointInfo

CLOCK_QOS = QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)


class Node(ParameterMixin):
    def __init__(
        self, node_name: str, *, context: Any = None, cli_args: list[str] | None = None,
        namespace: str | None = None, use_global_arguments: bool = True, enable_rosout: bool = True,
        start_parameter_services: bool = True, parameter_overrides: list[Parameter] | None = None,
        allow_undeclared_parameters: bool = False, automatically_declare_parameters_from_overrides: bool = False,
        enable_logger_service: bool = False,
    ) -> None:  # fmt: skip
        refuse_options(
            "Node",
            context=context,
            allow_undeclared_parameters=allow_undeclared_parameters,
            automatically_declare_parameters_from_overrides=automatically_declare_parameters_from_overrides,
            enable_logger_service=enable_logger_service,
        )
        self.context = get_default_context()
        if not self.context.ok():
            raise exceptions.NotInitializedException("cannot create node: rclpy.init() has not been called")
        local = arguments.parse(["--ros-args", *(cli_args or [])])
        sources = [local, self.context.arguments] if use_global_arguments else [local]
        self._rules = [rule for source in sources for rule in source.remappings]
        self._name, self._namespace = self._resolve_own_name(node_name, namespace or "")
        self._logger = get_logger(self.get_fully_qualified_name()[1:].replace("/", "."))
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._services: list[Service] = []
        self._clients: list[Client] = []
        self._timers: list[Timer] = []
        self.executor: Any = None
        self._clock = Clock(clock_type=ClockType.ROS_TIME)
        self.context._nodes.append(self)

        overrides: dict[str, Any] = {}
        for source in reversed(sources):
            overrides.update(source.parameters_for(self.get_fully_qualified_name()))
        given = {name: Parameter(name, value=value) for name, value in overrides.items()}
        self._init_parameters(given | {parameter.name: parameter for parameter in parameter_overrides or []})
        if enable_rosout:
            self._rosout = self.create_publisher(Log, "/rosout", qos.qos_profile_rosout_default)
            sinks[self._logger.name] = self._publish_log
        if self.declare_parameter("use_sim_time", False).value:
            self._clock._simulated_ns = 0
            self.create_subscription(ClockMessage, "/clock", self._on_clock, CLOCK_QOS)
        if start_parameter_services:
            self._start_parameter_services()

    def _resolve_own_name(self, name: str, namespace: str) -> tuple[str, str]:
        name, namespace = names.remap_node(name, namespace, self._rules)
        namespace = namespace if namespace.startswith("/") else f"/{namespace}"
        if fault := names.fault(names.NODE, name):
            raise exceptions.NameValidationException("node name", name, *fault)
        if fault := names.fault(names.ABSOLUTE, namespace):
            raise exceptions.NameValidationException("namespace", namespace, *fault)
        return name, namespace

    def _on_clock(self, message: Any) -> None:
        self._clock._simulated_ns = message.clock.sec * 10**9 + message.clock.nanosec

    def _publish_log(self, level: int, name: str, message: str, stamp_ns: int, frame: Any) -> None:
        if self.context.ok():
            stamp = Time(nanoseconds=stamp_ns).to_msg()
            log = Log(stamp=stamp, level=level, name=name, msg=message, file=frame.f_code.co_filename)
            log.function, log.line = frame.f_code.co_name, frame.f_lineno
            self._rosout.publish(log)

    # Who the node is.
    def get_name(self) -> str:
        return self._name

    def get_namespace(self) -> str:
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        return names.expand(self._name, self._name, self._namespace)

    def get_logger(self) -> Any:
        return self._logger

    def get_clock(self) -> Clock:
        return self._clock

    def _entities(self) -> Iterator[Any]:
        """All that an executor serves; timers come first."""
        yield from self._timers
        yield from (service._look for service in self._services)
        yield from (*self._subscriptions, *self._clients, *self._services)

    def _changed(self) -> None:
        self.context._announce_nodes()
        self._wake_executor()

    def _wake_executor(self) -> None:
        if self.executor is not None:
            self.executor.wake()

    def _added(self, entity: Any, entities: list[Any]) -> Any:
        entities.append(entity)
        self._changed()
        return entity

    def _removed(self, entity: Any, entities: list[Any]) -> bool:
        if entity not in entities:
            return False
        entities.remove(entity)
        entity.destroy()
        self._changed()
        return True

    # Topics.
    def _resolve(self, name: str, kind: str = "topic") -> str:
        """Full name of a topic or service, after remapping."""
        if fault := names.fault(names.TOPIC, name):
            raise exceptions.NameValidationException(f"{kind} name", name, *fault)
        full = names.expand(name, self._name, self._namespace)
        return names.remap(full, self._name, self._namespace, self._rules)

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, *, callback_group: Any = None,
        event_callbacks: Any = None, qos_overriding_options: Any = None, publisher_class: type[Publisher] = Publisher,
    ) -> Publisher:  # fmt: skip
        options = {"event_callbacks": event_callbacks, "qos_overriding_options": qos_overriding_options}
        refuse_options("create_publisher", callback_group=callback_group, **options)
        profile, name = _profile(qos_profile), self._resolve(topic)
        writer = self.context.participant.writer(f"rt{name}", _typename(msg_type), profile)
        publisher = publisher_class(writer, msg_type, name, profile, None, None)
        publisher._is_valid = self.context.ok
        return self._added(publisher, self._publishers)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], qos_profile: QoSProfile | int, *,
        callback_group: Any = None, event_callbacks: Any = None, qos_overriding_options: Any = None, raw: bool = False,
    ) -> Subscription:  # fmt: skip
        options = {"event_callbacks": event_callbacks, "qos_overriding_options": qos_overriding_options}
        refuse_options("create_subscription", callback_group=callback_group, **options)
        profile, name = _profile(qos_profile), self._resolve(topic)
        reader = self.context.participant.reader(f"rt{name}", _typename(msg_type), profile)
        subscription = Subscription(reader, msg_type, name, callback, None, profile, raw, None)
        return self._added(subscription, self._subscriptions)

    # Services.
    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], *,
        qos_profile: QoSProfile = qos.qos_profile_services_default, callback_group: Any = None,
    ) -> Service:  # fmt: skip
        refuse_options("create_service", callback_group=callback_group)
        name = self._resolve(srv_name, "service")
        typename = _typename(srv_type)
        endpoint = wire.CallEndpoint(self.context.participant, typename, name, qos_profile, serves=True)
        service = Service(endpoint, srv_type, name, callback, None, qos_profile)
        service._look._on_change = self._wake_executor
        return self._added(service, self._services)

    def create_client(
        self, srv_type: Any, srv_name: str, *, qos_profile: QoSProfile = qos.qos_profile_services_default,
        callback_group: Any = None,
    ) -> Client:  # fmt: skip
        refuse_options("create_client", callback_group=callback_group)
        name = self._resolve(srv_name, "service")
        typename = _typename(srv_type)
        endpoint = wire.CallEndpoint(self.context.participant, typename, name, qos_profile, serves=False)
        client = Client(self.context, endpoint, srv_type, name, qos_profile, None)
        return self._added(client, self._clients)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], Any], callback_group: Any = None,
        clock: Clock | None = None, autostart: bool = True,
    ) -> Timer:  # fmt: skip
        refuse_options("create_timer", callback_group=callback_group)
        period = int(float(timer_period_sec) * 10**9)
        timer = Timer(callback, None, period, clock or self._clock, autostart=autostart)
        timer._on_change = self._wake_executor
        return self._added(timer, self._timers)

    def destroy_publisher(self, publisher: Publisher) -> bool:
        return self._removed(publisher, self._publishers)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        return self._removed(subscription, self._subscriptions)

    def destroy_service(self, service: Service) -> bool:
        return self._removed(service, self._services)

    def destroy_client(self, client: Client) -> bool:
        return self._removed(client, self._clients)

    def destroy_timer(self, timer: Timer) -> bool:
        return self._removed(timer, self._timers)

    def destroy_node(self) -> None:
        """Destroy the node and all that was created under it. A second call does nothing."""
        if self.executor is not None:
            self.executor.remove_node(self)
        sinks.pop(self._logger.name, None)
        for entities in (self._timers, self._subscriptions, self._services, self._clients, self._publishers):
            for entity in entities:
                entity.destroy()
            entities.clear()
        if self in self.context._nodes:
            self.context._nodes.remove(self)
            self.context._announce_nodes()
        self.context._leave()

    # Who else is there.
    def count_publishers(self, topic_name: str) -> int:
        return self.context.participant.count("publication", f"rt{self._resolve(topic_name)}")

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        yield from self._subscriptions

    def get_publishers_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        refuse_options("get_publishers_info_by_topic", no_mangle=no_mangle)
        return self._endpoints_of("publication", topic_name)

    def get_subscriptions_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        refuse_options("get_subscriptions_info_by_topic", no_mangle=no_mangle)
        return self._endpoints_of("subscription", topic_name)

    def _endpoints_of(self, kind: str, topic_name: str) -> list[TopicEndpointInfo]:
        topic = f"rt{self._resolve(topic_name)}"
        ends = self.context.participant.endpoints(kind)
        return [TopicEndpointInfo(names.ros_type(end.type_name)) for end in ends if end.topic_name == topic]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        refuse_options("get_topic_names_and_types", no_demangle=no_demangle)
        found: dict[str, set[str]] = {}
        for kind in ("publication", "subscription"):
            for endpoint in self.context.participant.endpoints(kind):
                if endpoint.topic_name.startswith("rt/"):
                    found.setdefault(endpoint.topic_name[2:], set()).add(names.ros_type(endpoint.type_name))
        return [(topic, sorted(types)) for topic, types in sorted(found.items())]


def _profile(qos_profile: QoSProfile | int) -> QoSProfile:
    return qos_profile if isinstance(qos_profile, QoSProfile) else QoSProfile(depth=qos_profile)


def _typename(interface: Any) -> str:
    if not hasattr(interface, "TYPENAME"):
        raise TypeError(f"expected a message or service class of quadvel_dds, found {interface!r}")
    return str(interface.TYPENAME)
