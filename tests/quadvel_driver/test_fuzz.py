"""A short run of the fuzzer, and that its oracle sees what it is there for."""

from __future__ import annotations

import types
from typing import Any

import pytest

from quadvel_driver import packets, wire
from quadvel_driver.unitree_dds import wire as dds_wire
from tests.quadvel_driver import fuzz

BOTH = (wire, fuzz.aliengo_covered), (dds_wire, fuzz.go2_covered)


def test_some_thousand_datagrams_do_no_harm() -> None:
    target = fuzz.FuzzTarget(*BOTH)
    fuzz.fuzz_at_random(target, 2000)
    assert target.counts["datagrams"] == 2000
    assert target.counts["accepted"] > 200
    assert target.counts["refused"] > 6000


def weaker(**changes: Any) -> types.SimpleNamespace:
    """The decoders as they would be without one of their checks."""
    return types.SimpleNamespace(**{**vars(wire), **changes})


def test_a_decoder_that_lets_a_wrong_crc_pass_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (packets, wire, dds_wire):
        monkeypatch.setattr(module, "crc", lambda data: 0)
    target = fuzz.FuzzTarget(*BOTH)
    for packet in range(4):
        with pytest.raises(AssertionError, match="a wrong CRC was accepted"):
            target(bytes([fuzz.CHANGED, packet]))


def test_a_decoder_that_raises_anything_but_its_own_error_is_caught() -> None:
    def careless(data: bytes) -> object:
        return wire.decode_state(data) if len(data) == wire.STATE_BYTES else data[1000]

    target = fuzz.FuzzTarget((weaker(decode_state=careless), fuzz.aliengo_covered))
    with pytest.raises(IndexError):
        fuzz.fuzz_at_random(target, 100)
