"""DDS as ROS 2 uses it: names, types, QoS and user data on the wire, over Cyclone DDS.

Topics are `rt/NAME` with type `PKG::msg::dds_::NAME_`. A service is the pair `rq/NAMERequest`,
`rr/NAMEReply`; each sample starts with the request header of rmw_cyclonedds: a 64-bit client id and
a 64-bit sequence number. rmw_fastrtps matches replies by the RTPS sample identity instead. Topics
therefore work with both, service calls with rmw_cyclonedds only. Its endpoints are recognized by
their user data; calls of others are ignored.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import struct
import uuid
from typing import Any

from cyclonedds import builtin, core
from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import DDSException, InstanceState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from quadvel_dds import idl, messages

ANY = int(core.SampleState.Any | core.ViewState.Any | InstanceState.Any)
# Functions of Cyclone that its Python layer wraps.
_waitset_wait = core.WaitSet._dll_handle.dds_waitset_wait
_count_readers = DataWriter._dll_handle.dds_get_matched_subscriptions
REQUEST_HEADER = struct.Struct("<Qq")
MAX_PARTICIPANTS = 32  # on one host, as rmw_cyclonedds sets it
# Cyclone drops discovery data of other hosts on this interface; ROS 2 finds local nodes on it.
LOOPBACK = '<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>'
# Period of discovery messages: ROS 2 may start later, and its multicast is not received here.
ANNOUNCEMENT_PERIOD = "2 s"
ENDPOINTS_PER_READ = 32  # Cyclone's Python layer allocates memory for so many, whether they exist or not
DISCOVERY_RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")


def domain_configuration() -> str:
    """Create Cyclone's configuration from the ROS environment variables.

    These are ROS_AUTOMATIC_DISCOVERY_RANGE (default here: LOCALHOST), ROS_STATIC_PEERS and
    CYCLONEDDS_URI.

    Returns:
        Configuration for Cyclone DDS.

    Raises:
        ValueError: ROS_AUTOMATIC_DISCOVERY_RANGE or ROS_STATIC_PEERS has a wrong value.
    """
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "LOCALHOST"
    if reach not in DISCOVERY_RANGES:
        raise ValueError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}', expected {', '.join(DISCOVERY_RANGES)}"
        )
    discovery, general = "", LOOPBACK if reach in ("LOCALHOST", "OFF") else ""
    if reach == "OFF":
        discovery = f"<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag>"
    elif reach != "SYSTEM_DEFAULT":
        peers = ["localhost"] if reach == "LOCALHOST" else []
        peers += _static_peers()
        addresses = "".join(f'<Peer address="{peer}" pruneDelay="inf"/>' for peer in peers)
        discovery = (
            f"<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>"
            f"<SPDPInterval>{ANNOUNCEMENT_PERIOD}</SPDPInterval><Peers>{addresses}</Peers>"
        )
    own = f"<CycloneDDS><Domain>{general}<Discovery>{discovery}</Discovery></Domain></CycloneDDS>"
    return ",".join(filter(None, [own, os.environ.get("CYCLONEDDS_URI")]))


def _static_peers() -> list[str]:
    """Return the hosts of ROS_STATIC_PEERS, with ports if given; Cyclone aborts the process for an unknown one."""
    peers = [peer.strip() for peer in os.environ.get("ROS_STATIC_PEERS", "").split(";") if peer.strip()]
    for peer in peers:
        try:
            socket.getaddrinfo(peer.partition(":")[0], None, socket.AF_INET)  # Cyclone uses IPv4 here
        except (OSError, UnicodeError):
            raise ValueError(
                f"ROS_STATIC_PEERS: found {peer!r}, which this computer cannot resolve, expected names or "
                "IPv4 addresses of hosts, separated by ;"
            ) from None
    return peers


_joined: dict[int, Domain] = {}
"""Domains that this process has joined as ROS does, by number; `leave_domains` deletes them."""


def _join(domain_id: int) -> Domain:
    """Join a domain as the ROS environment variables say, or return it if it is joined.

    Without a CYCLONEDDS_URI the sockets are bound to the loopback interface.
    """
    if domain_id not in _joined:
        settings = domain_configuration()
        alone = LOOPBACK in settings and not os.environ.get("CYCLONEDDS_URI")
        _joined[domain_id] = open_domain(domain_id, settings, "lo" if alone else "")
    return _joined[domain_id]


def leave_domains() -> None:
    """Leave all domains that were joined as ROS does; to be called before the interpreter ends.

    Cyclone's garbage collector frees topics of Python, and Python ends any other thread that calls
    it once the interpreter ends. The deletion of the domain would then wait for it forever.
    """
    while _joined:
        delete(_joined.popitem()[1])


def open_domain(domain_id: int, settings: str, device: str) -> Domain:
    """Open a domain in this process.

    Args:
        domain_id: Number of the domain in this process.
        settings: Configuration for Cyclone DDS.
        device: Network interface to which to bind the sockets, which Cyclone binds to all; empty:
            none.

    Returns:
        The domain.
    """
    before = _sockets()
    domain = Domain(domain_id, settings)
    if device:
        for name in _sockets().keys() - before.keys():
            with socket.socket(fileno=os.dup(_sockets()[name])) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())
    return domain


def _sockets() -> dict[str, int]:
    """Return the descriptors of this process's sockets by unique names."""
    files = {os.path.realpath(f"/proc/self/fd/{one}"): int(one) for one in os.listdir("/proc/self/fd")}
    return {name: descriptor for name, descriptor in files.items() if "/socket:" in name}


def delete(entity: core.Entity) -> None:
    """Delete a DDS entity immediately; a second call is harmless.

    Args:
        entity: The entity. Cyclone's Python layer offers this in its finalizer only.
    """
    entity.__del__()


class Participant:
    """Membership of the process in a domain: creates readers and writers, lists endpoints.

    Attributes:
        dds: Cyclone's participant.
        gid: Its identity on the wire.
    """

    def __init__(self, domain_id: int, domain: Domain | None = None) -> None:
        """Join a domain.

        Args:
            domain_id: Number of the domain, 0 to 232.
            domain: The domain if `open_domain` has opened it; None: join it as ROS does.
        """
        self._domain = domain or _join(domain_id)
        self.dds = DomainParticipant(domain_id, qos=Qos(Policy.Userdata(b"enclave=/;")))
        self.gid = self.dds.guid.bytes
        self._topics: dict[tuple[str, str], Topic[Any]] = {}
        self._builtin = {
            "publication": builtin.BuiltinDataReader(self.dds, builtin.BuiltinTopicDcpsPublication),
            "subscription": builtin.BuiltinDataReader(self.dds, builtin.BuiltinTopicDcpsSubscription),
        }
        news = core.SampleState.NotRead | core.ViewState.Any | InstanceState.Any
        self._news = {kind: core.ReadCondition(reader, news) for kind, reader in self._builtin.items()}
        self._endpoints: dict[str, dict[Any, Any]] = {kind: {} for kind in self._builtin}  # by their keys

    def writer(self, topic: str, typename: str, profile: Any, user_data: str = "") -> Writer:
        """Create a writer.

        Args:
            topic: Name of the DDS topic.
            typename: Full name of the type.
            profile: QoS profile.
            user_data: User data of the endpoint.

        Returns:
            The writer.
        """
        return Writer(DataWriter(self.dds, *self._as_dds(topic, typename, profile, user_data)))

    def reader(self, topic: str, typename: str, profile: Any, user_data: str = "") -> Reader:
        """Create a reader.

        Args:
            topic: Name of the DDS topic.
            typename: Full name of the type.
            profile: QoS profile.
            user_data: User data of the endpoint.

        Returns:
            The reader.
        """
        return Reader(DataReader(self.dds, *self._as_dds(topic, typename, profile, user_data)))

    def _as_dds(self, topic: str, typename: str, profile: Any, user_data: str) -> tuple[Topic[Any], Qos]:
        """Return topic and QoS of an endpoint."""
        key = (topic, typename)
        if key not in self._topics:
            self._topics[key] = Topic(self.dds, topic, idl.struct(typename))
        return self._topics[key], to_dds_qos(profile, f"{user_data}typehash={messages.type_hash(typename)};")

    def endpoints(self, kind: str) -> list[Any]:
        """List all endpoints on the domain, those of this process included.

        Only those that changed since the last call are read, as each takes 0.1 ms.

        Args:
            kind: `publication` or `subscription`.

        Returns:
            Cyclone's descriptions of the endpoints.
        """
        known, news = self._endpoints[kind], self._news[kind]
        while news.triggered:
            for end in self._builtin[kind].read(N=ENDPOINTS_PER_READ, condition=news):
                if end.sample_info.instance_state == InstanceState.Alive:
                    known[end.key] = end
                else:
                    known.pop(end.key, None)
        return list(known.values())

    def count(self, kind: str, topic: str) -> int:
        """Count the endpoints of a topic.

        Args:
            kind: `publication` or `subscription`.
            topic: Name of the DDS topic.

        Returns:
            Number of endpoints.
        """
        return sum(endpoint.topic_name == topic for endpoint in self.endpoints(kind))

    def close(self) -> None:
        """Leave the domain."""
        delete(self.dds)


class Writer:
    """DDS writer of serialized messages.

    Attributes:
        dds: Cyclone's writer.
        handle: Instance handle, unsigned.
        gid: Identity on the wire.
    """

    def __init__(self, dds: DataWriter[Any]) -> None:
        """Wrap a writer.

        Args:
            dds: Cyclone's writer.
        """
        self.dds = dds
        self.handle = dds.instance_handle % 2**64  # Cyclone's Python layer gives it a sign
        self.gid = dds.guid.bytes

    def write(self, data: bytes | bytearray) -> None:
        """Send a sample.

        Args:
            data: CDR bytes.
        """
        # Cyclone's Python writer would wrap the bytes in a sample and unwrap them.
        if (code := ddspy_write(self.dds._ref, data.ljust(-(-len(data) // 4) * 4, b"\0"))) < 0:
            raise DDSException(code, f"writing to {self.dds.topic.name}")

    def matched(self) -> list[Any]:
        """List the readers that receive the samples.

        Returns:
            Cyclone's descriptions of the readers.
        """
        found = (self.dds.get_matched_subscription_data(handle) for handle in self._matched())
        return [reader for reader in found if reader is not None]

    def count(self) -> int:
        """Count the readers that receive the samples.

        Returns:
            Number of readers.
        """
        return max(int(_count_readers(self.dds._ref, None, 0)), 0)  # below 0: the participant has left

    def _matched(self) -> list[int]:
        """Return Cyclone's handles of the readers that receive the samples."""
        # Cyclone's Python layer asks for their number, then for the handles: if a reader appears in
        # between, it raises IndexError.
        while True:
            with contextlib.suppress(IndexError):
                return self.dds.get_matched_subscriptions()

    def close(self) -> None:
        """Delete the writer."""
        delete(self.dds)


class Reader:
    """DDS reader of serialized messages with a condition that wakes an executor.

    Attributes:
        dds: Cyclone's reader.
        condition: Condition that holds while samples wait.
        gid: Identity on the wire.
        is_closed: Whether the reader is deleted.
    """

    def __init__(self, dds: DataReader[Any]) -> None:
        """Wrap a reader.

        Args:
            dds: Cyclone's reader.
        """
        self.dds = dds
        self.condition = core.ReadCondition(dds, ANY)
        self.gid = dds.guid.bytes
        self.is_closed = False

    def take(self) -> tuple[bytes, Any] | None:
        """Take the oldest sample.

        Returns:
            CDR bytes and Cyclone's sample info; None if no sample waits.
        """
        while not self.is_closed:
            samples = ddspy_take(self.dds._ref, ANY, 1)
            if isinstance(samples, int):
                raise DDSException(samples, f"reading from {self.dds.topic.name}")
            if not samples:
                return None
            data, info = samples[0]
            if info.valid_data:  # else: a writer has left, which ROS 2 does not report
                return data, info
        return None

    def count(self) -> int:
        """Count the writers that are received.

        Returns:
            Number of writers.
        """
        return len(self.dds.get_matched_publications())

    def writer_of(self, info: Any) -> Any:
        """Find the writer of a sample.

        Args:
            info: Sample info of the sample.

        Returns:
            Cyclone's description of the writer; None if it has left.
        """
        return self.dds.get_matched_publication_data(info.publication_handle)

    def close(self) -> None:
        """Delete the reader."""
        self.is_closed = True
        delete(self.condition)
        delete(self.dds)


class WaitSet:
    """Waits until one of several readers has data, or until another thread calls `wake`.

    Attributes:
        dds: Cyclone's wait set.
        guard: Condition that `wake` triggers.
        readers: Readers that are waited for.
    """

    def __init__(self, participant: Participant) -> None:
        """Create a wait set without readers.

        Args:
            participant: Participant of the readers.
        """
        self.dds = core.WaitSet(participant.dds)
        self.guard = core.GuardCondition(participant.dds)
        self.dds.attach(self.guard)
        self.readers: set[Reader] = set()

    def update(self, readers: set[Reader]) -> None:
        """Replace the readers.

        Args:
            readers: New readers.
        """
        for reader in self.readers - readers:
            try:
                self.dds.detach(reader.condition)
            except DDSException:  # it is closed, and so detached, but Cyclone's Python layer still holds it
                self.dds.attached = [pair for pair in self.dds.attached if pair[0] is not reader.condition]
        for reader in readers - self.readers:
            self.dds.attach(reader.condition)
        self.readers = readers
        by_condition = {reader.condition: reader for reader in readers}
        # Cyclone names a triggered condition by the address that it was attached with.
        self._reader_at = {
            ctypes.addressof(place): by_condition.get(condition) for condition, place in self.dds.attached
        }
        self._triggered = (ctypes.c_void_p * len(self._reader_at))()

    def wait(self, timeout_ns: int) -> set[Reader | None]:
        """Wait until a reader has data, the timeout, or `wake`.

        Args:
            timeout_ns: Timeout, ns.

        Returns:
            Readers that have data; None among them if `wake` was called.
        """
        places = self._triggered
        count = _waitset_wait(self.dds._ref, places, len(places), timeout_ns)
        if count <= 0:
            return set()
        found = {self._reader_at[place] for place in places[:count] if place}
        if None in found:
            with contextlib.suppress(DDSException):  # the participant has left
                self.guard.take()
        return found

    def wake(self) -> None:
        """End the present or the next wait; may be called from any thread."""
        with contextlib.suppress(DDSException):  # the participant has left
            self.guard.set(True)

    def close(self) -> None:
        """Delete the wait set."""
        delete(self.guard)
        delete(self.dds)


class CallEndpoint:
    """Writer and reader of a client or a service; samples start with (client id, sequence number).

    Attributes:
        writer: Writer of requests (client) or replies (service).
        reader: Reader of replies (client) or requests (service).
        client_id: Id of a client in request headers.
    """

    def __init__(self, place: Participant, typename: str, name: str, profile: Any, serves: bool) -> None:
        # Identifies the writer and the reader that belong together, as in rmw_cyclonedds.
        """Create writer and reader.

        Args:
            place: Participant of this process.
            typename: Full name of the service type.
            name: Full name of the service.
            profile: QoS profile.
            serves: True for a service, False for a client.
        """
        identity = ".".join(f"{byte:02x}" for byte in uuid.uuid4().bytes)
        own, self._other = ("serviceid=", "clientid=") if serves else ("clientid=", "serviceid=")
        request = (f"rq{name}Request", f"{typename}_Request")
        reply = (f"rr{name}Reply", f"{typename}_Response")
        outgoing, incoming = (reply, request) if serves else (request, reply)
        self.writer = place.writer(*outgoing, profile, f"{own}{identity};")
        self.reader = place.reader(*incoming, profile, f"{own}{identity};")
        self.client_id = self.writer.handle

    def understands(self, endpoint: Any) -> bool:
        """Return whether an endpoint matches requests and replies as rmw_cyclonedds does.

        Args:
            endpoint: Cyclone's description of the endpoint.

        Returns:
            Whether its user data says so.
        """
        return Policy.Userdata in endpoint.qos and self._other in endpoint.qos[Policy.Userdata].data.decode()

    def is_matched(self) -> bool:
        """Return whether the other side is connected.

        Returns:
            Whether calls can be sent and received.
        """
        return self.reader.count() > 0 and any(map(self.understands, self.writer.matched()))

    def ask(self, request: Any, number: int) -> None:
        """Send a request if a service is connected.

        Args:
            request: The request.
            number: Sequence number.
        """
        if self.is_matched():
            self.writer.write(messages.serialize(request, REQUEST_HEADER.pack(self.client_id, number)))

    def answer(self, response: Any, request_id: tuple[int, int], client: Any) -> bool:
        """Send a reply if the client's reader is connected; earlier it would be lost.

        Args:
            response: The reply.
            request_id: Client id and sequence number of the request.
            client: Cyclone's description of the client's writer.

        Returns:
            Whether the reply was sent.
        """
        if all(reader.participant_key != client.participant_key for reader in self.writer.matched()):
            return False
        self.writer.write(messages.serialize(response, REQUEST_HEADER.pack(*request_id)))
        return True

    def decode(self, data: bytes, typename: str) -> tuple[tuple[int, int], Any]:
        """Deserialize a request or reply.

        Args:
            data: CDR bytes.
            typename: Full name of the request or response type.

        Returns:
            (client id, sequence number), and the message.

        Raises:
            ValueError: The data are malformed.
        """
        if len(data) < 4 + REQUEST_HEADER.size:
            raise ValueError(f"{typename}: {len(data)} bytes hold no request header")
        client_id, number = REQUEST_HEADER.unpack_from(data, 4)
        return (client_id, number), messages.deserialize(data, typename, REQUEST_HEADER.size)

    def close(self) -> None:
        """Delete writer and reader."""
        self.writer.close()
        self.reader.close()


def to_dds_qos(profile: Any, user_data: str) -> Qos:
    """Convert a QoS profile as rmw_cyclonedds does.

    Args:
        profile: A `rclpy.qos.QoSProfile`.
        user_data: User data of the endpoint.

    Returns:
        Cyclone's QoS.
    """
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
