"""Nodes, and the entities that they create."""

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
    """Node with a subset of the members of rclpy's Node.

    Attributes:
        context: Context of the process.
        executor: Executor that runs the callbacks, or None.
    """

    def __init__(
        self, node_name: str, *, context: Any = None, cli_args: list[str] | None = None,
        namespace: str | None = None, use_global_arguments: bool = True, enable_rosout: bool = True,
        start_parameter_services: bool = True, parameter_overrides: list[Parameter] | None = None,
        allow_undeclared_parameters: bool = False, automatically_declare_parameters_from_overrides: bool = False,
        enable_logger_service: bool = False,
    ) -> None:  # fmt: skip
        """Create a node. Options that are not listed raise UnsupportedError if they are set.

        Args:
            node_name: Name before remapping.
            context: Not supported.
            cli_args: Additional ROS arguments of this node.
            namespace: Namespace before remapping.
            use_global_arguments: Whether the arguments of `rclpy.init` apply.
            enable_rosout: Whether log messages are published on /rosout.
            start_parameter_services: Whether the parameter services are created.
            parameter_overrides: Parameter values that replace defaults.
            allow_undeclared_parameters: Not supported.
            automatically_declare_parameters_from_overrides: Not supported.
            enable_logger_service: Not supported.

        Raises:
            NotInitializedException: rclpy.init() was not called.
        """
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
        """Return valid name and namespace after remapping."""
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

    # Names.
    def get_name(self) -> str:
        """Return the name.

        Returns:
            Name without namespace.
        """
        return self._name

    def get_namespace(self) -> str:
        """Return the namespace.

        Returns:
            Namespace with a leading slash.
        """
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """Return the full name.

        Returns:
            Namespace and name.
        """
        return names.expand(self._name, self._name, self._namespace)

    def get_logger(self) -> Any:
        """Return the logger.

        Returns:
            Logger with the name of the node.
        """
        return self._logger

    def get_clock(self) -> Clock:
        """Return the clock.

        Returns:
            Clock with ROS time.
        """
        return self._clock

    def _entities(self) -> Iterator[Any]:
        """Yield all entities that an executor serves, timers first."""
        yield from self._timers
        yield from (service._retry_timer for service in self._services)
        yield from (*self._subscriptions, *self._clients, *self._services)

    def _changed(self) -> None:
        """Announce a change of the entities and wake the executor."""
        self.context._announce_nodes()
        self._wake_executor()

    def _wake_executor(self) -> None:
        if self.executor is not None:
            self.executor.wake()

    def _added(self, entity: Any, entities: list[Any]) -> Any:
        """Add an entity to a list and return it."""
        entities.append(entity)
        self._changed()
        return entity

    def _removed(self, entity: Any, entities: list[Any]) -> bool:
        """Destroy an entity of a list; return whether it was in the list."""
        if entity not in entities:
            return False
        entities.remove(entity)
        entity.destroy()
        self._changed()
        return True

    # Topics.
    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """Return the full name of a topic.

        Args:
            topic: Name of the topic.
            only_expand: Not supported.

        Returns:
            Its name after expansion and remapping.
        """
        refuse_options("resolve_topic_name", only_expand=only_expand)
        return self._resolve(topic)

    def _resolve(self, name: str, kind: str = "topic") -> str:
        """Return the full name of a topic or service after remapping."""
        if fault := names.fault(names.TOPIC, name):
            raise exceptions.NameValidationException(f"{kind} name", name, *fault)
        full = names.expand(name, self._name, self._namespace)
        return names.remap(full, self._name, self._namespace, self._rules)

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, *, callback_group: Any = None,
        event_callbacks: Any = None, qos_overriding_options: Any = None, publisher_class: type[Publisher] = Publisher,
    ) -> Publisher:  # fmt: skip
        """Create a publisher.

        Args:
            msg_type: Class of the messages.
            topic: Name of the topic.
            qos_profile: QoS profile or queue depth.
            callback_group: Not supported.
            event_callbacks: Not supported.
            qos_overriding_options: Not supported.
            publisher_class: Class of the publisher.

        Returns:
            The publisher.
        """
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
        """Create a subscription.

        Args:
            msg_type: Class of the messages.
            topic: Name of the topic.
            callback: Called with each message, and its information if it takes two arguments.
            qos_profile: QoS profile or queue depth.
            callback_group: Not supported.
            event_callbacks: Not supported.
            qos_overriding_options: Not supported.
            raw: Whether the callback gets CDR bytes.

        Returns:
            The subscription.
        """
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
        """Create a service.

        Args:
            srv_type: Class of the service.
            srv_name: Name of the service.
            callback: Called with request and response; returns the response.
            qos_profile: QoS profile.
            callback_group: Not supported.

        Returns:
            The service.
        """
        refuse_options("create_service", callback_group=callback_group)
        name = self._resolve(srv_name, "service")
        typename = _typename(srv_type)
        endpoint = wire.CallEndpoint(self.context.participant, typename, name, qos_profile, serves=True)
        service = Service(endpoint, srv_type, name, callback, None, qos_profile)
        service._retry_timer._on_change = self._wake_executor
        return self._added(service, self._services)

    def create_client(
        self, srv_type: Any, srv_name: str, *, qos_profile: QoSProfile = qos.qos_profile_services_default,
        callback_group: Any = None,
    ) -> Client:  # fmt: skip
        """Create a client of a service.

        Args:
            srv_type: Class of the service.
            srv_name: Name of the service.
            qos_profile: QoS profile.
            callback_group: Not supported.

        Returns:
            The client.
        """
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
        """Create a timer.

        Args:
            timer_period_sec: Period, s.
            callback: Called once per period.
            callback_group: Not supported.
            clock: Clock of the timer; None: the clock of the node.
            autostart: Whether the timer starts now.

        Returns:
            The timer.
        """
        refuse_options("create_timer", callback_group=callback_group)
        period = int(float(timer_period_sec) * 10**9)
        timer = Timer(callback, None, period, clock or self._clock, autostart=autostart)
        timer._on_change = self._wake_executor
        return self._added(timer, self._timers)

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher.

        Args:
            publisher: The publisher.

        Returns:
            Whether it belonged to this node.
        """
        return self._removed(publisher, self._publishers)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription.

        Args:
            subscription: The subscription.

        Returns:
            Whether it belonged to this node.
        """
        return self._removed(subscription, self._subscriptions)

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service.

        Args:
            service: The service.

        Returns:
            Whether it belonged to this node.
        """
        return self._removed(service, self._services)

    def destroy_client(self, client: Client) -> bool:
        """Destroy a client.

        Args:
            client: The client.

        Returns:
            Whether it belonged to this node.
        """
        return self._removed(client, self._clients)

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer.

        Args:
            timer: The timer.

        Returns:
            Whether it belonged to this node.
        """
        return self._removed(timer, self._timers)

    def destroy_node(self) -> None:
        """Destroy the node and all its entities; a second call does nothing."""
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

    # Discovery.
    def count_publishers(self, topic_name: str) -> int:
        """Count the publishers of a topic.

        Args:
            topic_name: Name of the topic.

        Returns:
            Number of publishers on the domain.
        """
        return self.context.participant.count("publication", f"rt{self._resolve(topic_name)}")

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Subscriptions of this node."""
        yield from self._subscriptions

    def get_publishers_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """List the publishers of a topic.

        Args:
            topic_name: Name of the topic.
            no_mangle: Not supported.

        Returns:
            Their types.
        """
        refuse_options("get_publishers_info_by_topic", no_mangle=no_mangle)
        return self._endpoints_of("publication", topic_name)

    def get_subscriptions_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """List the subscriptions of a topic.

        Args:
            topic_name: Name of the topic.
            no_mangle: Not supported.

        Returns:
            Their types.
        """
        refuse_options("get_subscriptions_info_by_topic", no_mangle=no_mangle)
        return self._endpoints_of("subscription", topic_name)

    def _endpoints_of(self, kind: str, topic_name: str) -> list[TopicEndpointInfo]:
        """Return the endpoints of a topic."""
        topic = f"rt{self._resolve(topic_name)}"
        ends = self.context.participant.endpoints(kind)
        return [TopicEndpointInfo(names.ros_type(end.type_name)) for end in ends if end.topic_name == topic]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        """List the topics on the domain.

        Args:
            no_demangle: Not supported.

        Returns:
            Sorted pairs of name and types.
        """
        refuse_options("get_topic_names_and_types", no_demangle=no_demangle)
        found: dict[str, set[str]] = {}
        for kind in ("publication", "subscription"):
            for endpoint in self.context.participant.endpoints(kind):
                if endpoint.topic_name.startswith("rt/"):
                    found.setdefault(endpoint.topic_name[2:], set()).add(names.ros_type(endpoint.type_name))
        return [(topic, sorted(types)) for topic, types in sorted(found.items())]


def _profile(qos_profile: QoSProfile | int) -> QoSProfile:
    """Return a QoS profile; a number is a queue depth."""
    return qos_profile if isinstance(qos_profile, QoSProfile) else QoSProfile(depth=qos_profile)


def _typename(interface: Any) -> str:
    """Return the full type name of a message or service class."""
    if not hasattr(interface, "TYPENAME"):
        raise TypeError(f"expected a message or service class of quadvel_dds, found {interface!r}")
    return str(interface.TYPENAME)
