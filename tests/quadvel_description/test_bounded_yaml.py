"""Tests that YAML whose cost exceeds its length is refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from quadvel_actuator import ActuatorParameters
from quadvel_dds.arguments import read_parameter_file
from quadvel_description.bounded_yaml import MAX_CHARACTERS, MAX_DEPTH, load_yaml
from quadvel_driver.calibration import Calibration
from quadvel_lab.plant import read_plant
from quadvel_sim.world import World
from tests.helpers.robots import ALIENGO

HOSTILE = {
    "lists in lists": ("[" * 100_000, "levels"),
    "mappings in mappings": ("{a: " * 10_000, "levels"),
    "blocks in blocks": ("\n".join(" " * k + "a:" for k in range(300)), "levels"),
    "keys of keys": ("? " * 10_000, "levels"),
    "aliases": (
        "a0: &a0 [1, 1]\n" + "\n".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 60)),
        "alias",
    ),
    "base 60": ("1:" * 50_000 + "1", "characters"),
    "many digits": ("9" * 5_000, "digits"),
    "no date": ("2001-99-99", "(month|ros__parameters)"),
    "length": ("a: 1\n" * (MAX_CHARACTERS // 4), "characters"),
    "a key twice": ("a: 1\nb: {c: 2, c: 3}", "'c' a second time.* in line 2, column 11"),
    "a section twice": ("a: {ros__parameters: {b: 1}}\na: {ros__parameters: {c: 2}}", "'a' a second time"),
    "tag of Python": ("!!python/object/apply:os.system [x]", "tag"),
}
READERS: dict[str, Callable[[Path], object]] = {
    "actuator": partial(ActuatorParameters.load, ALIENGO),
    "calibration": Calibration.load,
    "parameters": read_parameter_file,
    "plant": read_plant,
    "world": World.load,
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_refuses_hostile_yaml_and_names_the_file(tmp_path: Path, reader: str, name: str) -> None:
    text, word = HOSTILE[name]
    file = tmp_path / "hostile.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=f"hostile.yaml.*{word}") as refused:
        READERS[reader](file)
    assert "\n" not in str(refused.value)


def test_a_few_aliases_are_read() -> None:
    assert load_yaml("a: &a [1, 2]\nb: *a") == {"a": [1, 2], "b": [1, 2]}


def test_usual_depth_is_read() -> None:
    depth = MAX_DEPTH - 1
    assert load_yaml("[" * depth + "1" + "]" * depth)


def test_a_merge_key_is_no_repetition() -> None:
    text = "a: &a {x: 1}\nb: &b {y: 2}\nc: {<<: *a, <<: *b, x: 3}"
    assert load_yaml(text)["c"] == {"x": 3, "y": 2}
