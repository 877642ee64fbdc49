"""Fuzzer of the packet decoders: `python -m tests.quadvel_driver.fuzz --datagrams 10000000`. For developers.

Both formats are tried: UDP packets of the AlienGo (`wire`) and DDS samples of the Go2
(`unitree_dds.wire`). A fuzzer chooses bytes, from which three kinds of datagrams are made: raw bytes, packets with
changed bytes, and packets with changed bytes and a valid CRC, which reach the checks of the fields.
A decoder must return a record or raise WireError. A packet that it accepts must have the right CRC,
by an independent computation, and finite numbers.

With atheris (pip install -e ".[fuzz]"), code coverage guides the bytes; without it, they are
random.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module, util
from typing import Any

import numpy as np

from quadvel_description.state import JointCommand, RobotState
from quadvel_driver.board_state import BoardState, Button, Remote
from quadvel_driver.packets import WireError

RAW, CHANGED, VALID_CRC = range(3)
HEADER_BYTES = 2  # bytes that select the kind of datagram and the packet
CHANGE_BYTES = 3  # bytes per change: two for the position, one for the value
MAX_BYTES = 1400  # bytes, longer than any packet


def _crc_table() -> list[int]:
    """Return the CRC update of each byte value, (256,)."""
    table = []
    for byte in range(256):
        value = byte << 24
        for _ in range(8):
            value = value << 1 ^ (0x04C11DB7 if value & 0x80000000 else 0)
        table.append(value & 0xFFFFFFFF)
    return table


CRC_TABLE = _crc_table()


def reference_crc(data: bytes) -> int:
    """Compute the CRC of whole 4-byte words byte by byte, independently of `wire.crc`.

    Args:
        data: The bytes.

    Returns:
        The CRC.
    """
    value = 0xFFFFFFFF
    for start in range(0, len(data), 4):
        for byte in data[start + 3 : start - 1 if start else None : -1]:
            value = value << 8 & 0xFFFFFFFF ^ CRC_TABLE[value >> 24 ^ byte]
    return value


def _state() -> BoardState:
    """Return the board state of a standing robot."""
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
    return BoardState(robot, twelve, 0 * twelve, 3 * twelve, 40, Remote(Button.L1, lx=0.5))


def aliengo_covered(packet: bytes) -> bytes:
    """Return the bytes of an AlienGo's packet that its CRC covers: whole words without the CRC."""
    return packet[: len(packet) // 4 * 4 - 4]


def go2_covered(sample: bytes) -> bytes:
    """Return the bytes that the CRC of a Go2's sample covers: the C structure without the CRC.

    The structure is the body of the sample with the padding that aligns the first motor.
    """
    covered = bytearray(sample[4:-4])
    for place, padding in ((22, 2), (26, 2)) if len(sample) < 1000 else ((77, 3), (83, 1)):
        covered[place:place] = bytes(padding)
    return bytes(covered[: len(covered) // 4 * 4])


class FuzzTarget:
    """All decoders under test.

    Attributes:
        counts: Number of datagrams, and of decodings that were accepted and refused.
    """

    def __init__(self, *formats: tuple[Any, Callable[[bytes], bytes]]) -> None:
        """Create a target.

        Args:
            formats: Each a module with decoders and encoders, and a function that returns the bytes
                of a packet that its CRC covers.
        """
        command = JointCommand(q=np.ones(12), kp=np.full(12, 30.0), kd=np.ones(12))
        self._packets = [
            (packet, covered)
            for wire, covered in formats
            for packet in (wire.encode_command(command), wire.encode_state(_state()))
        ]
        self._decoders = [
            (decode, covered)
            for wire, covered in formats
            for decode in (wire.decode_command, wire.decode_state)
        ]
        self.counts: Counter[str] = Counter()

    def make_datagram(self, chosen: bytes) -> bytes:
        """Build a datagram from the bytes of the fuzzer.

        Args:
            chosen: Bytes that the fuzzer chose.

        Returns:
            The datagram.
        """
        kind, which = (*chosen[:HEADER_BYTES], 0, 0)[:2]
        rest = chosen[HEADER_BYTES:]
        if kind % 3 == RAW:
            return rest
        original, covered = self._packets[which % len(self._packets)]
        packet = bytearray(original)
        for i in range(0, len(rest) - CHANGE_BYTES + 1, CHANGE_BYTES):
            place = int.from_bytes(rest[i : i + 2], "little") % len(packet)
            packet[place] = rest[i + 2]
        if kind % 3 == VALID_CRC:
            packet[-4:] = reference_crc(covered(bytes(packet))).to_bytes(4, "little")
        return bytes(packet)

    def __call__(self, chosen: bytes) -> None:
        """Decode one datagram with all decoders.

        Args:
            chosen: Bytes that the fuzzer chose.

        Raises:
            AssertionError: A decoder accepted a wrong CRC or a number that is not finite.
        """
        data = self.make_datagram(chosen)
        for decode, covered in self._decoders:
            try:
                record = decode(data)
            except WireError:
                self.counts["refused"] += 1
                continue
            self.counts["accepted"] += 1
            assert int.from_bytes(data[-4:], "little") == reference_crc(covered(data)), (
                "a wrong CRC was accepted"
            )
            robot = getattr(record, "robot", record)
            assert np.isfinite((robot.q, robot.dq, robot.tau)).all(), (
                "numbers that are not finite were accepted"
            )
        self.counts["datagrams"] += 1


def fuzz_at_random(target: FuzzTarget, datagrams: int, seed: int = 0) -> None:
    """Run random datagrams; most are packets with few changes, which reach most of the code.

    Args:
        target: The decoders.
        datagrams: Number of datagrams.
        seed: Seed of the random numbers.
    """
    rng = random.Random(seed)
    for _ in range(datagrams):
        length = (
            rng.randrange(MAX_BYTES)
            if rng.random() < 0.05
            else HEADER_BYTES + CHANGE_BYTES * rng.randrange(5)
        )
        target(rng.randbytes(length))


def main() -> None:
    """Run the fuzzer; exit code 0 means that no decoder failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.quadvel_driver.fuzz", description=__doc__)
    parser.add_argument("--datagrams", type=int, default=1_000_000, help="how many; a million by default")
    parser.add_argument("--seed", type=int, default=1, help="of what is tried")
    arguments = parser.parse_args()
    guided = util.find_spec("atheris") is not None
    watched: AbstractContextManager[object] = nullcontext()
    if guided:
        atheris = import_module("atheris")
        watched = atheris.instrument_imports(
            include=["quadvel_driver.wire", "quadvel_driver.unitree_dds.wire"]
        )
    with watched:
        from quadvel_driver import wire
        from quadvel_driver.unitree_dds import wire as dds_wire
    target, start = FuzzTarget((wire, aliengo_covered), (dds_wire, go2_covered)), time.monotonic()

    def say() -> None:
        elapsed = time.monotonic() - start
        print(
            f"{dict(target.counts)} in {elapsed:.0f} s, {'guided by coverage' if guided else 'at random'}",
            flush=True,
        )

    if not guided:
        fuzz_at_random(target, arguments.datagrams, arguments.seed)
        say()
        return

    def one(chosen: bytes) -> None:
        target(chosen)
        if target.counts["datagrams"] in (arguments.datagrams, *range(0, arguments.datagrams, 1_000_000)):
            say()

    options = [
        f"-runs={arguments.datagrams}",
        f"-seed={arguments.seed}",
        f"-max_len={MAX_BYTES}",
        "-verbosity=0",
    ]
    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()  # ends the process


if __name__ == "__main__":
    main()
