"""Each block of YAML in the documents is valid, and means what its reader wants, when it is used as he would use it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import quadvel_dds
from quadvel_bringup.nodes import NODES
from quadvel_bringup.preflight import check_stack
from quadvel_bringup.stack import PARAMETERS, Stack
from quadvel_sysid.logs.readers.columns import ColumnMap

quadvel_dds.install()

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("*.md", "docs/**/*.md", "src/*/README.md", "training/README.md", "ros_ws/README.md")
FENCED = re.compile(r"^```\w*\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)(?: {4}.*\n|\n(?= {4}))+")
KEY = re.compile(r"^\s*[\w/*]+:(?=\s)", re.MULTILINE)


def _blocks() -> Iterator[tuple[str, str]]:
    """Document and text of each block most of whose lines begin with a key."""
    for path in sorted({path for pattern in DOCUMENTS for path in ROOT.glob(pattern)}):
        text = path.read_text(encoding="utf-8")
        for block in [*FENCED.findall(text), *INDENTED.findall(text)]:
            lines = [line for line in block.splitlines() if line.strip()]
            if 2 * len(KEY.findall(block)) > len(lines) > 1:
                yield str(path.relative_to(ROOT)), block


def _as_parameters(block: str, folder: Path) -> None:
    """The reader of a parameter file: alone, and pasted over the shipped one's values in a copy."""
    given = yaml.safe_load(block)
    whole = yaml.safe_load(PARAMETERS.read_text())
    for node, section in given.items():
        assert section["ros__parameters"].keys() <= whole[node]["ros__parameters"].keys()
        whole[node]["ros__parameters"] |= section["ros__parameters"]
    for name, values in (("alone", given), ("copy", whole)):
        file = folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump(values))
        for low_level in ("sim", "driver"):
            check_stack(Stack(low_level=low_level, parameters=file))


def _as_columns(block: str, folder: Path) -> None:
    file = folder / "columns.yaml"
    file.write_text(block)
    ColumnMap.load(file)


def _reader(block: str) -> Callable[[str, Path], None]:
    keys: Any = yaml.safe_load(block)
    assert isinstance(keys, dict), f"found {type(keys).__name__}, expected a mapping"
    return _as_parameters if keys.keys() <= NODES.keys() else _as_columns


BLOCKS = list(_blocks())


def test_the_documents_have_such_blocks() -> None:
    assert {where for where, _ in BLOCKS} >= {"docs/robot.md", "docs/identification.md"}


@pytest.mark.parametrize(("where", "block"), BLOCKS, ids=lambda text: text[:40].strip())
def test_a_block_of_yaml_is_taken_as_its_reader_would_use_it(where: str, block: str, tmp_path: Path) -> None:
    _reader(block)(block, tmp_path)
