"""YAML of files that somebody else may have written: no tags of Python, and bounds on size, depth and aliases."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import yaml

LARGEST = 200_000
"""Characters of a file; PyYAML reads some 50,000 a second"""
LONGEST_SCALAR = 10_000
"""Characters of one value; numbers to the base of 60 take time that grows with its square"""
MOST_NODES = 100_000
"""Values, lists and mappings of a file, with those that aliases repeat: about what a text of LARGEST may have"""
DEEPEST = 20
"""Lists and mappings in each other"""


class BoundedLoader(yaml.SafeLoader):
    """Refuses what may cost much more time or memory than its text is long."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = self._count = 0
        self._sizes: dict[str | None, int] = {}  # nodes under each anchor

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """A node. Raises YAMLError for one that is too deep or too long, and for too many, those under an alias counted again."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        before = self._count
        self._count += self._sizes.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
        self._depth += 1
        if self._depth > DEEPEST:
            self._refuse(f"more than {DEEPEST} levels, expected fewer", event)
        if self._count > MOST_NODES:
            self._refuse(f"more than {MOST_NODES} values, those of aliases included, expected fewer", event)
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_SCALAR:
            self._refuse(
                f"a value of {len(event.value)} characters, expected {LONGEST_SCALAR} at most", event
            )
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor is not None and not isinstance(event, yaml.AliasEvent):
            self._sizes[event.anchor] = self._count - before
        return node

    @staticmethod
    def _refuse(found: str, event: Any) -> NoReturn:
        mark = event.start_mark
        raise yaml.YAMLError(f"found {found}, in line {mark.line + 1}, column {mark.column + 1}")


def load_yaml(text: str, loader: type[BoundedLoader] = BoundedLoader) -> Any:
    """The document in a text. Raises ValueError that says what is wrong with it, on one line."""
    if len(text) > LARGEST:
        raise ValueError(f"found more than {LARGEST} characters, expected fewer")
    try:
        return loader(text).get_single_data()
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def bounded_text(path: Path) -> str:
    """What `load_yaml` may read of a file, and of a longer one so much that it refuses it. Raises OSError, UnicodeDecodeError."""
    with path.open(encoding="utf-8") as file:
        return file.read(LARGEST + 1)


def read_yaml(path: Path, what: str) -> Any:
    """The document in a file. Raises ValueError that names the file, and OSError. what: it should be, `a YAML file of a world`."""
    try:
        return load_yaml(bounded_text(path))
    except UnicodeDecodeError:
        raise ValueError(f"{path}: no text, expected {what}") from None
    except ValueError as error:
        raise ValueError(f"{path}: no valid YAML: {error}") from None
