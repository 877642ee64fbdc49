"""Tests of the unreliable network: faults of packets, and reproducibility from a seed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from quadvel_sim.bad_network import REORDERING_DELAY_S, BadNetwork, NetworkConfig


def packet(i: int) -> bytes:
    return i.to_bytes(4, "little") + bytes(60)


def passed(packets: int = 2000, way: int = 0, **config: float) -> list[tuple[int, float, bytes]]:
    """Number, time under way (s) and bytes of packets in the order of their arrival; one is sent each ms."""

    def arrivals() -> Iterator[tuple[int, float, bytes]]:
        network = BadNetwork(NetworkConfig(**config), way)
        for step in range(10 * packets + 1000):
            if step % 10 == 0 and step < 10 * packets:
                network.send(packet(step // 10), 1e-4 * step)
            for data in network.pop_arrived(1e-4 * step):
                number = int.from_bytes(data[:4], "little")
                yield number, 1e-4 * step - 1e-3 * number, data

    return list(arrivals())


def test_a_good_network_passes_all_at_once_and_in_order() -> None:
    found = passed()
    assert [number for number, _, _ in found] == list(range(2000))
    assert max(delay for _, delay, _ in found) < 1e-9
    assert all(data == packet(number) for number, _, data in found)


def test_a_share_is_lost() -> None:
    assert len(passed(network_loss=0.1)) == pytest.approx(1800, abs=60)
    assert passed(network_loss=1.0) == []


def test_delay_and_jitter_add_up() -> None:
    delays = np.array([delay for _, delay, _ in passed(network_delay=0.003, network_jitter=0.002)])
    assert delays.min() == pytest.approx(0.003, abs=2e-4)
    assert delays.max() == pytest.approx(0.005, abs=2e-4)
    assert delays.mean() == pytest.approx(0.004, abs=2e-4)


def test_jitter_beyond_the_period_changes_the_order() -> None:
    numbers = [number for number, _, _ in passed(network_jitter=0.002)]
    assert numbers != sorted(numbers)
    assert sorted(numbers) == list(range(2000))


def test_a_share_comes_twice() -> None:
    assert len(passed(network_duplicates=0.1)) == pytest.approx(2200, abs=60)


def test_a_share_is_held_back_behind_others() -> None:
    found = passed(network_reordering=0.1)
    assert sum(delay > 0.9 * REORDERING_DELAY_S for _, delay, _ in found) == pytest.approx(200, abs=60)


def test_a_share_comes_with_bits_flipped() -> None:
    found = [data for _, _, data in passed(network_corruption=0.1)]
    changed = [data for i, data in enumerate(found) if data != packet(i)]
    assert len(changed) == pytest.approx(200, abs=60)
    assert all(len(data) == 64 for data in found)


def test_the_same_seed_brings_the_same_accidents_and_each_way_has_its_own() -> None:
    config = {"network_loss": 0.3, "network_jitter": 0.002, "network_corruption": 0.1}
    assert passed(**config) == passed(**config)
    assert passed(**config) != passed(**config, network_seed=1)
    assert passed(**config) != passed(**config, way=1)


def test_a_share_beyond_one_is_refused() -> None:
    with pytest.raises(ValueError, match="network_loss"):
        NetworkConfig(network_loss=1.5)
