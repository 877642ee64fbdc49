"""DDS bus of one robot: readers and writers of its topics. No ROS.

The robot's domain is one of its own in this process, so a node may at the same time be in the ROS
domain of the same number, on another interface.
"""

from __future__ import annotations

import itertools
import socket
from typing import Any

from cyclonedds.core import DDSException
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from quadvel_dds.wire import Participant, Reader, WaitSet, Writer, delete, open_domain
from quadvel_driver.link import LinkError

BLOCKING_LIMIT_MS = 1  # longest time that a write may wait for a slow reader
DEPTH = 16  # samples that wait in a reader, about 30 ms of 500 Hz
MAX_DOMAIN = 232
# Numbers of domains in this process; on the network, `ExternalDomainId` counts.
_LOCAL_DOMAINS = itertools.count(1000)


class Bus:
    """Membership in the robot's DDS domain."""

    def __init__(self, domain: int, interface: str) -> None:
        """Join the domain.

        Args:
            domain: Number of the domain on the network, 0 to MAX_DOMAIN.
            interface: Network interface to use alone; empty for any.

        Raises:
            LinkError: The interface does not exist, or the domain cannot be joined.
        """
        self.name = f"DDS domain {domain} on {interface or 'any interface'}"
        local = next(_LOCAL_DOMAINS)
        try:
            if interface:
                socket.if_nametoindex(interface)
            self._domain = open_domain(local, _settings(domain, interface), interface)
            self._participant = Participant(local, self._domain)
        except (OSError, DDSException) as error:
            raise LinkError(f"no link to {self.name}: {error}") from error
        self._topics: dict[str, Topic[Any]] = {}
        self._waiting = WaitSet(self._participant)

    def writer(self, topic: str, kind: Any) -> Writer:
        """Create a reliable writer that keeps the last sample, as the vendor's library does.

        Args:
            topic: Name of the topic.
            kind: Type of the samples.

        Returns:
            The writer.
        """
        reliability = Policy.Reliability.Reliable(duration(milliseconds=BLOCKING_LIMIT_MS))
        qos = Qos(reliability, Policy.History.KeepLast(1), Policy.IgnoreLocal.Participant)
        return Writer(DataWriter(self._participant.dds, self._topic(topic, kind), qos))

    def reader(self, topic: str, kind: Any) -> Reader:
        """Create a best-effort reader of what other programs write; it ends `wait`.

        Args:
            topic: Name of the topic.
            kind: Type of the samples.

        Returns:
            The reader.
        """
        qos = Qos(
            Policy.Reliability.BestEffort,
            Policy.History.KeepLast(DEPTH),
            Policy.IgnoreLocal.Participant,
        )
        reader = Reader(DataReader(self._participant.dds, self._topic(topic, kind), qos))
        self._waiting.update({*self._waiting.readers, reader})
        return reader

    def wait(self, timeout: float) -> None:
        """Wait until a reader has a sample.

        Args:
            timeout: Longest time, s.
        """
        self._waiting.wait(max(round(1e9 * timeout), 1))

    def close(self) -> None:
        """Leave the domain."""
        for reader in self._waiting.readers:
            reader.is_closed = True
        self._waiting.close()
        self._participant.close()
        delete(self._domain)

    def _topic(self, name: str, kind: Any) -> Topic[Any]:
        if name not in self._topics:
            self._topics[name] = Topic(self._participant.dds, name, kind)
        return self._topics[name]


def _settings(domain: int, interface: str) -> str:
    """Return the configuration of Cyclone DDS for the robot's domain on one interface."""
    choice = f'name="{interface}"' if interface else 'autodetermine="true"'
    return (
        f"<CycloneDDS><Domain><General><Interfaces><NetworkInterface {choice}/></Interfaces></General>"
        f"<Discovery><ExternalDomainId>{domain}</ExternalDomainId></Discovery></Domain></CycloneDDS>"
    )
