"""Throws datagrams at the decoders: `python -m quadvel_driver.fuzz --datagrams 10000000`. For developers.

Each datagram is made of bytes that a fuzzer chooses: raw ones, whole packets with bytes changed, and packets whose CRC was
made to fit what was changed, so that the fields behind it are reached. A decoder may give a record or raise WireError, and
nothing else. What it accepts must carry the right CRC, by a computation of its own here, and hold finite numbers.

With atheris (pip install -e ".[fuzz]") the bytes are chosen by what code they reach; without, at random from a seed.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module, util
from typing import Any

import numpy as np

from quadvel_description.state import JointCommand, RobotState

RAW, CHANGED, SEALED = range(3)
HEADER = 2  # bytes that say what kind of datagram the others make, and of which packet
CHANGE = 3  # bytes a change: two for where, one for what
LONGEST = 1000  # bytes, longer than any packet


def _tables() -> list[int]:
    """What each byte does to the CRC."""
    table = []
    for byte in range(256):
        value = byte << 24
        for _ in range(8):
            value = value << 1 ^ (0x04C11DB7 if value & 0x80000000 else 0)
        table.append(value & 0xFFFFFFFF)
    return table


TABLE = _tables()


def own_crc(data: bytes) -> int:
    """The CRC of whole 4-byte words, byte by byte; computed otherwise than in `wire`."""
    value = 0xFFFFFFFF
    for start in range(0, len(data), 4):
        for byte in data[start + 3 : start - 1 if start else None : -1]:
            value = value << 8 & 0xFFFFFFFF ^ TABLE[value >> 24 ^ byte]
    return value


def _state(wire: Any) -> Any:
    """A robot that stands, as the board may report it."""
    robot = RobotState(
        *(
            0.0,
            1,
            np.tile([0.0, 0.64, -1.29], 4),
            np.zeros(12),
            np.full(12, 5.0),
            np.array([1.0, 0.0, 0.0, 0.0]),
        ),
        *(np.zeros(3), np.array([0.0, 0.0, 9.81]), np.full(4, 60.0)),
    )
    twelve = np.full(12, 10)
    return wire.BoardState(robot, twelve, 0 * twelve, 3 * twelve, 40, wire.Remote(wire.Button.L1, lx=0.5))


class Target:
    """Both decoders, and what became of the datagrams: `counts`."""

    def __init__(self, wire: Any) -> None:
        self._wire = wire
        command = JointCommand(q=np.ones(12), kp=np.full(12, 30.0), kd=np.ones(12))
        self._packets = wire.encode_command(command), wire.encode_state(_state(wire))
        self._decoders = wire.decode_command, wire.decode_state
        self.counts: Counter[str] = Counter()

    def datagram(self, chosen: bytes) -> bytes:
        """The datagram that the fuzzer's bytes stand for."""
        kind, which = (*chosen[:HEADER], 0, 0)[:2]
        rest = chosen[HEADER:]
        if kind % 3 == RAW:
            return rest
        packet = bytearray(self._packets[which % 2])
        for i in range(0, len(rest) - CHANGE + 1, CHANGE):
            place = int.from_bytes(rest[i : i + 2], "little") % len(packet)
            packet[place] = rest[i + 2]
        if kind % 3 == SEALED:
            packet[-4:] = own_crc(bytes(packet[: _covered(packet)])).to_bytes(4, "little")
        return bytes(packet)

    def __call__(self, chosen: bytes) -> None:
        """One datagram through both decoders. Raises AssertionError, or what a decoder must not raise."""
        data = self.datagram(chosen)
        for decode in self._decoders:
            try:
                record = decode(data)
            except self._wire.WireError:
                self.counts["refused"] += 1
                continue
            self.counts["accepted"] += 1
            assert int.from_bytes(data[-4:], "little") == own_crc(data[: _covered(data)]), (
                "a wrong CRC was accepted"
            )
            robot = getattr(record, "robot", record)
            assert np.isfinite((robot.q, robot.dq, robot.tau)).all(), (
                "numbers that are not finite were accepted"
            )
        self.counts["datagrams"] += 1


def _covered(packet: bytes | bytearray) -> int:
    return len(packet) // 4 * 4 - 4


def at_random(target: Target, datagrams: int, seed: int = 0) -> None:
    """Bytes without guidance: few of them mostly, as most that matters is a packet with little changed."""
    rng = random.Random(seed)
    for _ in range(datagrams):
        length = rng.randrange(LONGEST) if rng.random() < 0.05 else HEADER + CHANGE * rng.randrange(5)
        target(rng.randbytes(length))


def main() -> None:
    """Entry point. Exit code 0 where no datagram did any harm."""
    parser = argparse.ArgumentParser(prog="python -m quadvel_driver.fuzz", description=__doc__)
    parser.add_argument("--datagrams", type=int, default=1_000_000, help="how many; a million by default")
    parser.add_argument("--seed", type=int, default=1, help="of what is tried")
    arguments = parser.parse_args()
    guided = util.find_spec("atheris") is not None
    watched: AbstractContextManager[object] = nullcontext()
    if guided:
        atheris = import_module("atheris")
        watched = atheris.instrument_imports(include=["quadvel_driver.wire"])
    with watched:
        from quadvel_driver import wire
    target, start = Target(wire), time.monotonic()

    def say() -> None:
        elapsed = time.monotonic() - start
        print(
            f"{dict(target.counts)} in {elapsed:.0f} s, {'guided by coverage' if guided else 'at random'}",
            flush=True,
        )

    if not guided:
        at_random(target, arguments.datagrams, arguments.seed)
        say()
        return

    def one(chosen: bytes) -> None:
        target(chosen)
        if target.counts["datagrams"] in (arguments.datagrams, *range(0, arguments.datagrams, 1_000_000)):
            say()

    options = [
        f"-runs={arguments.datagrams}",
        f"-seed={arguments.seed}",
        f"-max_len={LONGEST}",
        "-verbosity=0",
    ]
    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()  # ends the process


if __name__ == "__main__":
    main()
