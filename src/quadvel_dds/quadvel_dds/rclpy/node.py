"""Nodes: a name, and everything that is created under it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from typing import Any

from rcl_interfaces.msg import Log, ParameterEvent
from rosgraph_msgs.msg import Clock as ClockMessage

from quadvel_dds import arguments, names, wire
from quadvel_dds.errors import refuse_options, unsupported

from ._parameter_services import ParameterServices
from ._parameters import ParameterMixin
from .callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from .client import Client
from .clock import Clock, ROSClock
from .exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidServiceNameException,
    InvalidTopicNameException,
    NotInitializedException,
)
from .impl import rcutils_logger
from .logging import get_logger
from .parameter import Parameter
from .publisher import Publisher
from .qos import (
    QoSProfile,
    qos_profile_parameter_events,
    qos_profile_rosout_default,
    qos_profile_sensor_data,
    qos_profile_services_default,
)
from .service import Service
from .subscription import Subscription
from .time import Time
from .timer import Rate, Timer
from .utilities import get_default_context


class Node(ParameterMixin):
    def __init__(
        self,
        node_name: str,
        *,
        context: Any = None,
        cli_args: list[str] | None = None,
        namespace: str | None = None,
        use_global_arguments: bool = True,
        enable_rosout: bool = True,
        start_parameter_services: bool = True,
        parameter_overrides: list[Parameter] | None = None,
        allow_undeclared_parameters: bool = False,
        automatically_declare_parameters_from_overrides: bool = False,
        enable_logger_service: bool = False,
    ) -> None:
        refuse_options("Node", enable_logger_service=enable_logger_service)
        self._context = context or get_default_context()
        if not self._context.ok():
            raise NotInitializedException("cannot create node")
        local = arguments.parse(["--ros-args", *(cli_args or [])])
        sources = [local, self._context.arguments] if use_global_arguments else [local]
        self._rules = [rule for source in sources for rule in source.remappings]
        self._name, self._namespace = self._resolve_own_name(node_name, namespace or "")
        self._logger = get_logger(self.get_fully_qualified_name()[1:].replace("/", "."))
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._services: list[Service] = []
        self._clients: list[Client] = []
        self._timers: list[Timer] = []
        self._executor: Callable[[], Any] = lambda: None
        self._default_callback_group = MutuallyExclusiveCallbackGroup()
        self._clock = ROSClock()
        self._context._nodes.append(self)

        overrides: dict[str, Any] = {}
        for source in reversed(sources):
            overrides.update(source.parameters_for(self.get_fully_qualified_name()))
        given = {name: Parameter(name, value=value) for name, value in overrides.items()}
        given.update({parameter.name: parameter for parameter in parameter_overrides or []})
        self._init_parameters(given, allow_undeclared_parameters)
        if enable_rosout:
            self._rosout = self.create_publisher(Log, "/rosout", qos_profile_rosout_default)
            rcutils_logger.sinks[self._logger.name] = self._publish_log
        self._parameter_events = self.create_publisher(
            ParameterEvent, "/parameter_events", qos_profile_parameter_events
        )
        if automatically_declare_parameters_from_overrides:
            for parameter in given.values():
                self.declare_parameter(parameter.name, parameter.value)
        self._start_time_source()
        if start_parameter_services:
            ParameterServices(self)

    def _resolve_own_name(self, name: str, namespace: str) -> tuple[str, str]:
        name, namespace = names.remap_node(name, namespace, self._rules)
        namespace = namespace if namespace.startswith("/") else f"/{namespace}"
        if fault := names.fault(names.NODE, name):
            raise InvalidNodeNameException(name, *fault)
        if fault := names.fault(names.ABSOLUTE, namespace):
            raise InvalidNamespaceException(namespace, *fault)
        return name, namespace

    # Simulated time.
    def _start_time_source(self) -> None:
        if not self.has_parameter("use_sim_time"):
            self.declare_parameter("use_sim_time", False)
        self._clock_subscription: Subscription | None = None
        self.add_post_set_parameters_callback(self._follow_use_sim_time)
        self._follow_use_sim_time([self.get_parameter("use_sim_time")])

    def _follow_use_sim_time(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name != "use_sim_time":
                continue
            if parameter.value and self._clock_subscription is None:
                self._clock._simulated_ns = 0
                self._clock_subscription = self.create_subscription(
                    ClockMessage,
                    "/clock",
                    self._on_clock,
                    QoSProfile(depth=1, reliability=qos_profile_sensor_data.reliability),
                    callback_group=ReentrantCallbackGroup(),
                )
            elif not parameter.value and self._clock_subscription is not None:
                self.destroy_subscription(self._clock_subscription)
                self._clock_subscription = None
                self._clock._simulated_ns = None

    def _on_clock(self, message: Any) -> None:
        self._clock._simulated_ns = message.clock.sec * 10**9 + message.clock.nanosec

    def _publish_parameter_event(self, event: Any) -> None:
        event.stamp = self._clock.now().to_msg()
        if self._context.ok():
            self._parameter_events.publish(event)

    def _publish_log(self, level: int, name: str, message: str, stamp_ns: int, frame: Any) -> None:
        if self._context.ok():
            stamp = Time(nanoseconds=stamp_ns).to_msg()
            code = frame.f_code
            log = Log(stamp=stamp, level=level, name=name, msg=message, file=code.co_filename)
            log.function, log.line = code.co_name, frame.f_lineno
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

    @property
    def context(self) -> Any:
        return self._context

    @property
    def executor(self) -> Any:
        return self._executor()

    @executor.setter
    def executor(self, new_executor: Any) -> None:
        current = self.executor
        if current is new_executor:
            return
        if current is not None:
            current.remove_node(self)
        self._executor = weakref.ref(new_executor) if new_executor is not None else lambda: None
        if new_executor is not None:
            new_executor.add_node(self)

    @property
    def default_callback_group(self) -> CallbackGroup:
        return self._default_callback_group

    # What the node has.
    @property
    def publishers(self) -> Iterator[Publisher]:
        yield from self._publishers

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        yield from self._subscriptions

    @property
    def clients(self) -> Iterator[Client]:
        yield from self._clients

    @property
    def services(self) -> Iterator[Service]:
        yield from self._services

    @property
    def timers(self) -> Iterator[Timer]:
        yield from self._timers

    def _entities(self) -> list[Any]:
        """What an executor waits for, in the order in which it is served."""
        return [*self._timers, *self._subscriptions, *self._clients, *self._services]

    def _added(self, entity: Any) -> None:
        entity.callback_group.add_entity(entity)
        self._changed()

    def _changed(self) -> None:
        self._context._announce_nodes()
        self._wake_executor()

    def _wake_executor(self) -> None:
        if (executor := self.executor) is not None:
            executor.wake()

    def _removed(self, entity: Any, entities: list[Any]) -> bool:
        if entity not in entities:
            return False
        entities.remove(entity)
        entity.destroy()
        self._changed()
        return True

    # Topics.
    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        if fault := names.fault(names.TOPIC, topic):
            raise InvalidTopicNameException(topic, *fault)
        return self._resolve(topic, only_expand)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        if fault := names.fault(names.TOPIC, service):
            raise InvalidServiceNameException(service, *fault)
        return self._resolve(service, only_expand)

    def _resolve(self, name: str, only_expand: bool) -> str:
        full = names.expand(name, self._name, self._namespace)
        return full if only_expand else names.remap(full, self._name, self._namespace, self._rules)

    def create_publisher(
        self,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        publisher_class: type[Publisher] = Publisher,
    ) -> Publisher:
        refuse_options(
            "create_publisher", event_callbacks=event_callbacks, qos_overriding_options=qos_overriding_options
        )
        profile = _profile(qos_profile)
        name = self.resolve_topic_name(topic)
        writer = self._context.participant.writer(f"rt{name}", _typename(msg_type), profile)
        group = callback_group or self._default_callback_group
        publisher = publisher_class(writer, msg_type, name, profile, None, group)
        publisher._is_valid = self._context.ok
        self._publishers.append(publisher)
        self._changed()
        return publisher

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        raw: bool = False,
    ) -> Subscription:
        refuse_options(
            "create_subscription",
            event_callbacks=event_callbacks,
            qos_overriding_options=qos_overriding_options,
        )
        profile = _profile(qos_profile)
        name = self.resolve_topic_name(topic)
        reader = self._context.participant.reader(f"rt{name}", _typename(msg_type), profile)
        group = callback_group or self._default_callback_group
        subscription = Subscription(reader, msg_type, name, callback, group, profile, raw, None)
        self._subscriptions.append(subscription)
        self._added(subscription)
        return subscription

    # Services.
    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Service:
        name = self.resolve_service_name(srv_name)
        endpoint = wire.CallEndpoint(
            self._context.participant, _typename(srv_type), name, qos_profile, serves=True
        )
        group = callback_group or self._default_callback_group
        service = Service(endpoint, srv_type, name, callback, group, qos_profile)
        self._services.append(service)
        self._added(service)
        return service

    def create_client(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Client:
        name = self.resolve_service_name(srv_name)
        endpoint = wire.CallEndpoint(
            self._context.participant, _typename(srv_type), name, qos_profile, serves=False
        )
        group = callback_group or self._default_callback_group
        client = Client(self._context, endpoint, srv_type, name, qos_profile, group)
        self._clients.append(client)
        self._added(client)
        return client

    # Timers.
    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], Any],
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        group = callback_group or self._default_callback_group
        period = int(float(timer_period_sec) * 10**9)
        timer = Timer(
            callback, group, period, clock or self._clock, context=self._context, autostart=autostart
        )
        timer._on_change = self._wake_executor
        self._timers.append(timer)
        self._added(timer)
        return timer

    def create_rate(self, frequency: float, clock: Clock | None = None) -> Rate:
        if frequency <= 0:
            raise ValueError("frequency must be > 0")
        timer = self.create_timer(1.0 / frequency, lambda: None, ReentrantCallbackGroup(), clock)
        return Rate(timer, context=self._context)

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

    def destroy_rate(self, rate: Rate) -> bool:
        rate.destroy()
        return self.destroy_timer(rate._timer)

    def destroy_node(self) -> None:
        """Destroy the node and all that was created under it. A second call does nothing."""
        # Looked up once: the executor is held by a weak reference, and may go at any time.
        if (executor := self.executor) is not None:
            executor.remove_node(self)
        rcutils_logger.sinks.pop(self._logger.name, None)
        for entities in (self._timers, self._subscriptions, self._services, self._clients, self._publishers):
            for entity in entities:
                entity.destroy()
            entities.clear()
        if self in self._context._nodes:
            self._context._nodes.remove(self)
            self._context._announce_nodes()
        self._context._leave_if_unused()

    # Who else is there.
    def count_publishers(self, topic_name: str) -> int:
        return int(self._context.participant.count("publication", f"rt{self.resolve_topic_name(topic_name)}"))

    def count_subscribers(self, topic_name: str) -> int:
        return int(
            self._context.participant.count("subscription", f"rt{self.resolve_topic_name(topic_name)}")
        )

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        refuse_options("get_topic_names_and_types", no_demangle=no_demangle)
        found: dict[str, set[str]] = {}
        for kind in ("publication", "subscription"):
            for endpoint in self._context.participant.endpoints(kind):
                if endpoint.topic_name.startswith("rt/"):
                    typename = endpoint.type_name.replace("::dds_::", "/").replace("::", "/").rstrip("_")
                    found.setdefault(endpoint.topic_name[2:], set()).add(typename)
        return [(topic, sorted(types)) for topic, types in sorted(found.items())]


for _name in (
    "add_waitable",
    "count_clients",
    "count_services",
    "create_guard_condition",
    "destroy_guard_condition",
    "get_client_names_and_types_by_node",
    "get_fully_qualified_node_names",
    "get_node_names",
    "get_node_names_and_namespaces",
    "get_node_names_and_namespaces_with_enclaves",
    "get_publisher_names_and_types_by_node",
    "get_publishers_info_by_topic",
    "get_service_names_and_types",
    "get_service_names_and_types_by_node",
    "get_subscriber_names_and_types_by_node",
    "get_subscriptions_info_by_topic",
    "remove_waitable",
    "wait_for_node",
):
    setattr(Node, _name, unsupported(f"Node.{_name}"))
for _name in ("guards", "handle", "waitables"):
    setattr(Node, _name, property(unsupported(f"Node.{_name}")))


def _profile(qos_profile: QoSProfile | int) -> QoSProfile:
    return qos_profile if isinstance(qos_profile, QoSProfile) else QoSProfile(depth=qos_profile)


def _typename(interface: Any) -> str:
    typename = getattr(interface, "TYPENAME", None)
    if not isinstance(typename, str):
        raise TypeError(
            f"expected a message or service class of the embedded middleware, found {interface!r}"
        )
    return typename
