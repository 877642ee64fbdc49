"""A network that loses, delays, doubles, reorders and corrupts packets, by chance and from a seed. No sockets, no clock."""

from __future__ import annotations

import heapq
import itertools
from typing import Any

import attrs
import numpy as np
from attrs.validators import ge, le

HELD_BACK = 0.005  # s that a reordered packet waits while others pass it


def _setting(description: str, most: float = 1.0) -> Any:
    return attrs.field(default=0.0, validator=[ge(0.0), le(most)], metadata={"description": description})


@attrs.frozen(kw_only=True, slots=False)  # to stand beside another base
class NetworkConfig:
    """What happens to packets, each way. Raises ValueError where a number can't be."""

    network_delay: float = _setting("s that every packet takes")
    network_jitter: float = _setting("s that a packet takes longer at most, evenly spread")
    network_loss: float = _setting("share of packets, 0 to 1, that are lost")
    network_duplicates: float = _setting("share of packets that come twice")
    network_reordering: float = _setting(
        f"share of packets that come {1e3 * HELD_BACK:g} ms late, behind others"
    )
    network_corruption: float = _setting("share of packets of which one to eight bits come flipped")
    network_seed: int = attrs.field(default=0, metadata={"description": "seed of all that"})


class BadNetwork:
    """One way of it. Times are s on any clock."""

    def __init__(self, config: NetworkConfig, way: int) -> None:
        """way: 0 or 1, so that there and back are different accidents."""
        self._config = config
        self._rng = np.random.default_rng([config.network_seed, way])
        self._under_way: list[tuple[float, int, bytes]] = []
        self._numbers = itertools.count()

    @property
    def next(self) -> float:
        """When the next packet arrives; inf where none is under way."""
        return self._under_way[0][0] if self._under_way else float("inf")

    def send(self, packet: bytes, now: float) -> None:
        """Put a packet on its way."""
        config = self._config
        lost, twice, held, flipped, *late = self._rng.random(6)
        if lost < config.network_loss:
            return
        if flipped < config.network_corruption:
            packet = self._corrupted(packet)
        delay = config.network_delay + (HELD_BACK if held < config.network_reordering else 0.0)
        for chance in late[: 2 if twice < config.network_duplicates else 1]:
            arrival = now + delay + config.network_jitter * chance
            heapq.heappush(self._under_way, (arrival, next(self._numbers), packet))

    def arrived(self, now: float) -> list[bytes]:
        """The packets that have arrived by now, in their order."""
        packets = []
        while self.next <= now:
            packets.append(heapq.heappop(self._under_way)[2])
        return packets

    def _corrupted(self, packet: bytes) -> bytes:
        changed = bytearray(packet)
        for bit in self._rng.choice(8 * len(packet), size=self._rng.integers(1, 9), replace=False).tolist():
            changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)
