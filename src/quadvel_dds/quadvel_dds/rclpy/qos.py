"""Quality of service: policies, and the profiles of ROS 2."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from quadvel_dds.errors import module_getattr, unsupported

from .duration import Duration

__getattr__ = module_getattr(__name__)


class HistoryPolicy(IntEnum):
    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class ReliabilityPolicy(IntEnum):
    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class DurabilityPolicy(IntEnum):
    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class LivelinessPolicy(IntEnum):
    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3
    UNKNOWN = 4
    BEST_AVAILABLE = 5


# Name, type and default of each policy; a duration of zero means "not set".
_POLICIES: dict[str, tuple[type, Any]] = {
    "history": (HistoryPolicy, HistoryPolicy.SYSTEM_DEFAULT),
    "depth": (int, 0),
    "reliability": (ReliabilityPolicy, ReliabilityPolicy.RELIABLE),
    "durability": (DurabilityPolicy, DurabilityPolicy.VOLATILE),
    "lifespan": (Duration, Duration()),
    "deadline": (Duration, Duration()),
    "liveliness": (LivelinessPolicy, LivelinessPolicy.SYSTEM_DEFAULT),
    "liveliness_lease_duration": (Duration, Duration()),
    "avoid_ros_namespace_conventions": (bool, False),
}


class InvalidQoSProfileException(Exception):
    def __init__(self, *args: Any) -> None:
        super().__init__("Invalid QoSProfile", *args)


class QoSProfile:
    """What a publisher offers and a subscription asks for. `history` or `depth` must be given."""

    history: HistoryPolicy
    depth: int
    reliability: ReliabilityPolicy
    durability: DurabilityPolicy
    lifespan: Duration
    deadline: Duration
    liveliness: LivelinessPolicy
    liveliness_lease_duration: Duration
    avoid_ros_namespace_conventions: bool

    __slots__ = tuple(f"_{name}" for name in _POLICIES)

    def __init__(self, **kwargs: Any) -> None:
        unknown = {f"_{name}" for name in kwargs} - set(self.__slots__)
        if unknown:
            raise TypeError(f"QoSProfile has no policy {', '.join(sorted(name[1:] for name in unknown))}")
        if "history" not in kwargs:
            if "depth" not in kwargs:
                raise InvalidQoSProfileException("History and/or depth settings are required.")
            kwargs["history"] = HistoryPolicy.KEEP_LAST
        if kwargs["history"] == HistoryPolicy.KEEP_LAST and "depth" not in kwargs:
            raise InvalidQoSProfileException("History set to KEEP_LAST without a depth setting.")
        for name, (_, default) in _POLICIES.items():
            setattr(self, name, kwargs.get(name, default))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, QoSProfile):
            return NotImplemented
        return all(getattr(self, slot) == getattr(other, slot) for slot in self.__slots__)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"QoSProfile({', '.join(f'{slot[1:]}={getattr(self, slot)}' for slot in self.__slots__)})"

    get_c_qos_profile = unsupported("QoSProfile.get_c_qos_profile")


def _policy_property(name: str, type_: type) -> property:
    def assign(profile: QoSProfile, value: Any) -> None:
        value = type_(value) if issubclass(type_, IntEnum) else value
        if not isinstance(value, type_) or (isinstance(value, int) and value < 0):
            raise ValueError(f"QoS policy '{name}' must be of type {type_.__name__}, found {value!r}")
        setattr(profile, f"_{name}", value)

    return property(lambda profile: getattr(profile, f"_{name}"), assign)


for _name, (_type, _) in _POLICIES.items():
    setattr(QoSProfile, _name, _policy_property(_name, _type))

qos_profile_system_default = QoSProfile(
    history=HistoryPolicy.SYSTEM_DEFAULT,
    reliability=ReliabilityPolicy.SYSTEM_DEFAULT,
    durability=DurabilityPolicy.SYSTEM_DEFAULT,
)
qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
qos_profile_services_default = QoSProfile(depth=10)
qos_profile_parameters = QoSProfile(depth=1000)
qos_profile_parameter_events = QoSProfile(depth=1000)
qos_profile_rosout_default = QoSProfile(
    depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10)
)
