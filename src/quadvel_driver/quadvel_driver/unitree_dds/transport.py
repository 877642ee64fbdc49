"""Connection to the joints: `rt/lowcmd` and `rt/lowstate` on the robot's bus. No ROS.

`wire` encodes the samples, and `bus` handles DDS; `link` decides what to send and when.
"""

from __future__ import annotations

from collections import Counter

import attrs
from cyclonedds.core import DDSException
from typing_extensions import override

from quadvel_dds.wire import Writer
from quadvel_description.fields import field
from quadvel_driver.link import LinkConfig, Transport

from .bus import MAX_DOMAIN, Bus
from .types import LOW_CMD, LOW_STATE

COMMAND_TOPIC, STATE_TOPIC = "rt/lowcmd", "rt/lowstate"


@attrs.frozen(kw_only=True, slots=False)  # for multiple inheritance
class DdsConfig(LinkConfig):
    """The robot's bus, and when its joints may be taken over.

    Attributes:
        dds_domain: Number of the robot's DDS domain.
        min_battery: State of charge below which the joints are not taken over, %.

    Raises:
        ValueError: A number is out of range; raised by the constructor.
    """

    dds_domain: int = field(
        0,
        "DDS domain of a Go2: 0 on the robot, 1 for simulators",
        at_least=0,
        at_most=MAX_DOMAIN,
        whole=True,
    )
    min_battery: int = field(
        20, "% of charge below which a Go2 is not taken over", at_least=0, at_most=100, whole=True
    )


class DdsTransport(Transport):
    """Reads states and writes commands; watches for other writers of commands.

    The writer is created by `claim` only, because other programs assume that any writer of
    `rt/lowcmd` commands the joints.
    """

    def __init__(self, bus: Bus) -> None:
        """Read the robot's states.

        Args:
            bus: The robot's bus; `close` closes it.
        """
        self.board, self.counts = bus.name, Counter()
        self._bus = bus
        self._states = bus.reader(STATE_TOPIC, LOW_STATE)
        self._others = bus.reader(COMMAND_TOPIC, LOW_CMD)
        self._commands: Writer | None = None

    def claim(self) -> None:
        """Create the writer of commands."""
        self._commands = self._bus.writer(COMMAND_TOPIC, LOW_CMD)

    def foreign_commands(self) -> int:
        """Count the commands of other programs.

        Returns:
            Number of samples since the last call.
        """
        count = 0
        while self._others.take() is not None:
            count += 1
        self.counts["from_others"] += count
        return count

    def foreign_writers(self) -> int:
        """Count other programs' writers of commands, also those that have not written yet.

        Returns:
            Number of writers that DDS has discovered.
        """
        return self._others.count()

    @override
    def wait(self, timeout: float) -> None:
        self._bus.wait(timeout)

    @override
    def receive(self) -> bytes | None:
        try:
            sample = self._states.take()
        except DDSException as error:
            raise OSError(str(error)) from error
        return None if sample is None else sample[0]

    @override
    def send(self, packet: bytes) -> None:
        if self._commands is None:
            raise OSError("the joints are not taken over")
        try:
            self._commands.write(packet)
        except DDSException as error:
            raise OSError(f"{COMMAND_TOPIC}: {error}") from error

    @override
    def close(self) -> None:
        self._bus.close()
