"""DDS as ROS 2 uses it: names, types, QoS and user data on the wire, over Cyclone DDS.

Topics are `rt/NAME` with type `PKG::msg::dds_::NAME_`; services are the pair `rq/NAMERequest`,
`rr/NAMEReply`, each sample led by the request header of rmw_cyclonedds (a 64-bit client id and a 64-bit
sequence number). rmw_fastrtps matches replies by the RTPS sample identity instead, so topics work with both,
service calls with rmw_cyclonedds alone: it is known by its user data, and calls of others are left alone.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import uuid
from functools import cache
from typing import Any

from cyclonedds import builtin, core
from cyclonedds.core import DDSException, InstanceState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from quadvel_dds import idl, messages

ANY = core.SampleState.Any | core.ViewState.Any | InstanceState.Any
REQUEST_HEADER = struct.Struct("<Qq")
MAX_PARTICIPANTS = 32  # on one host, as rmw_cyclonedds sets it
# Cyclone drops what nodes elsewhere say of themselves, and ROS 2 looks for nodes of its host on this one.
LOOPBACK = '<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>'
# How often participants introduce themselves: ROS 2 may start later, and it calls over multicast, which is not heard here.
ANNOUNCEMENT = "2 s"
REACHES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")


def domain_configuration() -> str:
    """Cyclone's settings for ROS_AUTOMATIC_DISCOVERY_RANGE (default here: LOCALHOST) and ROS_STATIC_PEERS."""
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "LOCALHOST"
    if reach not in REACHES:
        raise ValueError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}', expected {', '.join(REACHES)}")
    discovery, general = "", LOOPBACK if reach in ("LOCALHOST", "OFF") else ""
    if reach == "OFF":
        discovery = f"<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag>"
    elif reach != "SYSTEM_DEFAULT":
        peers = ["localhost"] if reach == "LOCALHOST" else []
        peers += [peer for peer in os.environ.get("ROS_STATIC_PEERS", "").split(";") if peer]
        addresses = "".join(f'<Peer address="{peer}" pruneDelay="inf"/>' for peer in peers)
        discovery = (
            f"<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>"
            f"<SPDPInterval>{ANNOUNCEMENT}</SPDPInterval><Peers>{addresses}</Peers>"
        )
    own = f"<CycloneDDS><Domain>{general}<Discovery>{discovery}</Discovery></Domain></CycloneDDS>"
    return ",".join(filter(None, [own, os.environ.get("CYCLONEDDS_URI")]))


@cache
def _join(domain_id: int) -> Domain:
    """The domain. Without settings of the user's own its sockets, open to all in Cyclone, hear the loopback interface alone."""
    settings, before = domain_configuration(), _sockets()
    domain = Domain(domain_id, settings)
    if LOOPBACK in settings and not os.environ.get("CYCLONEDDS_URI"):
        for name in _sockets().keys() - before.keys():
            with socket.socket(fileno=os.dup(_sockets()[name])) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
    return domain


def _sockets() -> dict[str, int]:
    """The descriptors of this process's sockets, by names that no two have."""
    files = {os.path.realpath(f"/proc/self/fd/{one}"): int(one) for one in os.listdir("/proc/self/fd")}
    return {name: descriptor for name, descriptor in files.items() if "/socket:" in name}


def delete(entity: core.Entity) -> None:
    """Delete a DDS entity now. Cyclone offers this in its finaliser alone; a second call is harmless."""
    entity.__del__()


class Participant:
    """One process on the domain: makes readers and writers and tells who else is there."""

    def __init__(self, domain_id: int) -> None:
        _join(domain_id)
        self.dds = DomainParticipant(domain_id, qos=Qos(Policy.Userdata(b"enclave=/;")))
        self.gid = self.dds.guid.bytes
        self._topics: dict[tuple[str, str], Topic[Any]] = {}
        self._builtin = {
            "publication": builtin.BuiltinDataReader(self.dds, builtin.BuiltinTopicDcpsPublication),
            "subscription": builtin.BuiltinDataReader(self.dds, builtin.BuiltinTopicDcpsSubscription),
        }
        news = core.SampleState.NotRead | core.ViewState.Any | InstanceState.Any
        self._news = {kind: core.ReadCondition(reader, news) for kind, reader in self._builtin.items()}
        self._endpoints: dict[str, list[Any]] = {}

    def writer(self, topic: str, typename: str, profile: Any, user_data: str = "") -> Writer:
        return Writer(DataWriter(self.dds, *self._as_dds(topic, typename, profile, user_data)))

    def reader(self, topic: str, typename: str, profile: Any, user_data: str = "") -> Reader:
        return Reader(DataReader(self.dds, *self._as_dds(topic, typename, profile, user_data)))

    def _as_dds(self, topic: str, typename: str, profile: Any, user_data: str) -> tuple[Topic[Any], Qos]:
        key = (topic, typename)
        if key not in self._topics:
            self._topics[key] = Topic(self.dds, topic, idl.struct(typename))
        return self._topics[key], to_dds_qos(profile, f"{user_data}typehash={messages.type_hash(typename)};")

    def endpoints(self, kind: str) -> list[Any]:
        """All writers ("publication") or readers ("subscription") on the domain, our own included."""
        if kind not in self._endpoints or self._news[kind].triggered:
            found = self._builtin[kind].read(N=100_000)
            alive = [end for end in found if end.sample_info.instance_state == InstanceState.Alive]
            self._endpoints[kind] = alive
        return self._endpoints[kind]

    def count(self, kind: str, topic: str) -> int:
        return sum(endpoint.topic_name == topic for endpoint in self.endpoints(kind))

    def close(self) -> None:
        delete(self.dds)


class Writer:
    """A DDS writer of ready CDR bytes."""

    def __init__(self, dds: DataWriter[Any]) -> None:
        self.dds = dds
        self.handle = dds.instance_handle % 2**64  # Cyclone's Python layer gives it a sign
        self.gid = dds.guid.bytes
        self._sample: Any = dds.topic.data_type

    def write(self, data: bytes | bytearray) -> None:
        self.dds.write(self._sample(data))

    def matched(self) -> list[Any]:
        """The readers that get what is written."""
        found = (self.dds.get_matched_subscription_data(h) for h in self.dds.get_matched_subscriptions())
        return [reader for reader in found if reader is not None]

    def count(self) -> int:
        return len(self.dds.get_matched_subscriptions())

    def close(self) -> None:
        delete(self.dds)


class Reader:
    """A DDS reader of CDR bytes, with the condition that wakes an executor."""

    def __init__(self, dds: DataReader[Any]) -> None:
        self.dds = dds
        self.condition = core.ReadCondition(dds, ANY)
        self.gid = dds.guid.bytes
        self.is_closed = False

    def has_data(self) -> bool:
        return not self.is_closed and self.condition.triggered

    def take(self) -> tuple[bytes, Any] | None:
        """The oldest sample that waits and its DDS sample info, or None."""
        while not self.is_closed:
            samples = self.dds.take(1)
            if not samples:
                return None
            info = samples[0].sample_info
            if info.valid_data:  # else: news of a writer that left, which ROS 2 does not tell
                return samples[0].data, info
        return None

    def count(self) -> int:
        return len(self.dds.get_matched_publications())

    def writer_of(self, info: Any) -> Any:
        """The endpoint that wrote a sample, or None if it left."""
        return self.dds.get_matched_publication_data(info.publication_handle)

    def close(self) -> None:
        self.is_closed = True
        delete(self.condition)
        delete(self.dds)


class WaitSet:
    """Waits until one of a changing set of readers has data, or until another thread wakes it."""

    def __init__(self, participant: Participant) -> None:
        self.dds = core.WaitSet(participant.dds)
        self.guard = core.GuardCondition(participant.dds)
        self.dds.attach(self.guard)
        self.readers: set[Reader] = set()

    def update(self, readers: set[Reader]) -> None:
        """Wait for these readers from now on."""
        for reader in self.readers - readers:
            try:
                self.dds.detach(reader.condition)
            except DDSException:  # it is closed, and so detached, but Cyclone's Python layer still holds it
                self.dds.attached = [pair for pair in self.dds.attached if pair[0] is not reader.condition]
        for reader in readers - self.readers:
            self.dds.attach(reader.condition)
        self.readers = readers

    def wait(self, timeout_ns: int) -> None:
        """Until a reader has data, the time-out, or a wake-up; returns at once if the participant has left."""
        with contextlib.suppress(DDSException):
            self.dds.wait(timeout_ns)
            self.guard.take()

    def wake(self) -> None:
        with contextlib.suppress(DDSException):  # the participant has left
            self.guard.set(True)

    def close(self) -> None:
        delete(self.guard)
        delete(self.dds)


class CallEndpoint:
    """A client's or a service's writer and reader; every sample starts with (client id, sequence number)."""

    def __init__(self, place: Participant, typename: str, name: str, profile: Any, serves: bool) -> None:
        # Tells which writer and reader belong together, as in rmw_cyclonedds.
        identity = ".".join(f"{byte:02x}" for byte in uuid.uuid4().bytes)
        own, self._other = ("serviceid=", "clientid=") if serves else ("clientid=", "serviceid=")
        request = (f"rq{name}Request", f"{typename}_Request")
        reply = (f"rr{name}Reply", f"{typename}_Response")
        outgoing, incoming = (reply, request) if serves else (request, reply)
        self.writer = place.writer(*outgoing, profile, f"{own}{identity};")
        self.reader = place.reader(*incoming, profile, f"{own}{identity};")
        self.client_id = self.writer.handle

    def understands(self, endpoint: Any) -> bool:
        """Whether an endpoint of the other side matches requests and replies as we do."""
        return Policy.Userdata in endpoint.qos and self._other in endpoint.qos[Policy.Userdata].data.decode()

    def is_matched(self) -> bool:
        return self.reader.count() > 0 and any(map(self.understands, self.writer.matched()))

    def ask(self, request: Any, number: int) -> None:
        """Send a request, if somebody is there who understands it."""
        if self.is_matched():
            self.writer.write(messages.serialize(request, REQUEST_HEADER.pack(self.client_id, number)))

    def answer(self, response: Any, request_id: tuple[int, int], client: Any) -> bool:
        """Answer if the client's reader is matched, and say whether it is: before, the answer would be lost."""
        if all(reader.participant_key != client.participant_key for reader in self.writer.matched()):
            return False
        self.writer.write(messages.serialize(response, REQUEST_HEADER.pack(*request_id)))
        return True

    def decode(self, data: bytes, typename: str) -> tuple[tuple[int, int], Any]:
        """((client id, sequence number), message). Raises ValueError on malformed data."""
        if len(data) < 4 + REQUEST_HEADER.size:
            raise ValueError(f"{typename}: {len(data)} bytes hold no request header")
        client_id, number = REQUEST_HEADER.unpack_from(data, 4)
        return (client_id, number), messages.deserialize(data, typename, REQUEST_HEADER.size)

    def close(self) -> None:
        self.writer.close()
        self.reader.close()


def to_dds_qos(profile: Any, user_data: str) -> Qos:
    """DDS QoS of a `rclpy.qos.QoSProfile`, as rmw_cyclonedds maps it."""
    keep_all = profile.history.name == "KEEP_ALL"
    history = Policy.History.KeepAll if keep_all else Policy.History.KeepLast(max(profile.depth, 1))
    reliable = Policy.Reliability.Reliable(duration(infinite=True))
    policies = [
        history,
        Policy.Reliability.BestEffort if profile.reliability.name == "BEST_EFFORT" else reliable,
        Policy.Userdata(user_data.encode()),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    ]
    if profile.durability.name == "TRANSIENT_LOCAL":
        policies += [Policy.Durability.TransientLocal, Policy.DurabilityService(0, history, -1, -1, -1)]
    if profile.lifespan.nanoseconds:
        policies.append(Policy.Lifespan(profile.lifespan.nanoseconds))
    return Qos(*policies)
