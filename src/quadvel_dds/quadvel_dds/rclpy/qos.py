"""Quality of service: policies, and the profiles of ROS 2."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from quadvel_dds.errors import Partial, UnsupportedError, module_getattr

from .duration import Duration

__getattr__ = module_getattr(__name__)


class HistoryPolicy(IntEnum):
    """History policies, as in rclpy."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class ReliabilityPolicy(IntEnum):
    """Reliability policies, as in rclpy."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class DurabilityPolicy(IntEnum):
    """Durability policies, as in rclpy."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


# Name, type and default of each policy that is offered; a duration of zero means "not set".
_POLICIES: dict[str, tuple[type, Any]] = {
    "history": (HistoryPolicy, HistoryPolicy.SYSTEM_DEFAULT),
    "depth": (int, 0),
    "reliability": (ReliabilityPolicy, ReliabilityPolicy.RELIABLE),
    "durability": (DurabilityPolicy, DurabilityPolicy.VOLATILE),
    "lifespan": (Duration, Duration()),
}
_UNSUPPORTED = ("deadline", "liveliness", "liveliness_lease_duration", "avoid_ros_namespace_conventions")


class InvalidQoSProfileException(Exception):
    """A profile lacks a required policy."""


class QoSProfile(Partial):
    """Quality of service of an endpoint, see rclpy's QoSProfile; `history` or `depth` is required.

    Attributes:
        history: Which samples are kept.
        depth: Number of kept samples.
        reliability: Whether samples are sent again.
        durability: Whether late subscriptions receive earlier samples.
        lifespan: Age beyond which samples are dropped; zero: unlimited.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create a profile.

        Args:
            **kwargs: Policies by name.

        Raises:
            InvalidQoSProfileException: A depth is required.
        """
        history = kwargs.setdefault("history", HistoryPolicy.KEEP_LAST)
        if history == HistoryPolicy.KEEP_LAST and "depth" not in kwargs:
            raise InvalidQoSProfileException("Invalid QoSProfile: a depth is required")
        for name, value in ({name: default for name, (_, default) in _POLICIES.items()} | kwargs).items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _UNSUPPORTED:
            raise UnsupportedError(f"QoS policy '{name}'")
        if name not in _POLICIES:
            raise TypeError(f"QoSProfile has no policy {name}")
        kind = _POLICIES[name][0]
        value = kind(value) if issubclass(kind, IntEnum) else value
        if not isinstance(value, kind) or (isinstance(value, int) and value < 0):
            raise ValueError(f"QoS policy '{name}' must be of type {kind.__name__}, found {value!r}")
        super().__setattr__(name, value)


qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
qos_profile_services_default = QoSProfile(depth=10)
qos_profile_parameters = QoSProfile(depth=1000)
qos_profile_rosout_default = QoSProfile(
    depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10)
)
