"""Unreliable network: seeded loss, delay, duplication, reordering and corruption of packets.

No sockets and no clock: the caller passes the time.
"""

from __future__ import annotations

import heapq
import itertools

import attrs
import numpy as np

from quadvel_description.fields import field

REORDERING_DELAY_S = 0.005
"""Additional delay of a reordered packet, s: later packets overtake it."""


@attrs.frozen(kw_only=True, slots=False)  # no slots: a subclass may have a second base class
class NetworkConfig:
    """Faults of the network, the same in both directions.

    Raises:
        ValueError: A number is out of its range.

    Attributes:
        network_delay: Constant delay of every packet, s.
        network_jitter: Upper bound of the additional, uniformly distributed delay, s.
        network_loss: Share of lost packets, 0 to 1.
        network_duplicates: Share of duplicated packets, 0 to 1.
        network_reordering: Share of packets that arrive `REORDERING_DELAY_S` late, 0 to 1.
        network_corruption: Share of packets with one to eight flipped bits, 0 to 1.
        network_seed: Seed of all random draws.
    """

    network_delay: float = field(0.0, "constant delay of every packet, s", at_least=0.0, at_most=1.0)
    network_jitter: float = field(
        0.0, "largest additional delay of a packet, s, uniformly distributed", at_least=0.0, at_most=1.0
    )
    network_loss: float = field(0.0, "share of lost packets, 0 to 1", at_least=0.0, at_most=1.0)
    network_duplicates: float = field(0.0, "share of duplicated packets, 0 to 1", at_least=0.0, at_most=1.0)
    network_reordering: float = field(
        0.0,
        f"share of packets that arrive {1e3 * REORDERING_DELAY_S:g} ms late, after later ones",
        at_least=0.0,
        at_most=1.0,
    )
    network_corruption: float = field(
        0.0, "share of packets with one to eight flipped bits", at_least=0.0, at_most=1.0
    )
    network_seed: int = field(0, "seed of the network's faults")


class BadNetwork:
    """One direction of an unreliable network. Times are in s on any clock."""

    def __init__(self, config: NetworkConfig, direction: int) -> None:
        """Create an empty network.

        Args:
            config: Faults and their seed.
            direction: 0 or 1; the two directions draw independent faults.
        """
        self._config = config
        self._rng = np.random.default_rng([config.network_seed, direction])
        self._in_flight: list[tuple[float, int, bytes]] = []
        self._numbers = itertools.count()

    @property
    def next_arrival(self) -> float:
        """Arrival time of the next packet, s; inf if no packet is in flight."""
        return self._in_flight[0][0] if self._in_flight else float("inf")

    def send(self, packet: bytes, now: float) -> None:
        """Send a packet; it may get lost, corrupted, delayed or duplicated.

        Args:
            packet: Bytes of the packet.
            now: Present time, s.
        """
        config = self._config
        # Always six uniform draws a packet, so that loss, duplicates, reordering and jitter do not
        # change each other; bits are flipped by further draws:
        # arrival = now + delay + reordering + jitter * U(0, 1), with one jitter for each copy.
        loss, duplicate, reorder, corrupt, *jitters = self._rng.random(6)
        if loss < config.network_loss:
            return
        if corrupt < config.network_corruption:
            packet = self._with_flipped_bits(packet)
        delay = config.network_delay + (REORDERING_DELAY_S if reorder < config.network_reordering else 0.0)
        for jitter in jitters[: 2 if duplicate < config.network_duplicates else 1]:
            arrival = now + delay + config.network_jitter * jitter
            heapq.heappush(self._in_flight, (arrival, next(self._numbers), packet))

    def pop_arrived(self, now: float) -> list[bytes]:
        """Remove and return the packets that have arrived.

        Args:
            now: Present time, s.

        Returns:
            Packets in order of arrival.
        """
        packets = []
        while self.next_arrival <= now:
            packets.append(heapq.heappop(self._in_flight)[2])
        return packets

    def _with_flipped_bits(self, packet: bytes) -> bytes:
        """Return the packet with one to eight random bits flipped."""
        changed = bytearray(packet)
        for bit in self._rng.choice(8 * len(packet), size=self._rng.integers(1, 9), replace=False).tolist():
            changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)
