"""YAML loader for untrusted files: no Python tags, and bounds on size, depth and aliases."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import yaml

MAX_CHARACTERS = 200_000
"""Largest number of characters of a file; PyYAML reads some 50,000 per second."""
MAX_SCALAR_CHARACTERS = 10_000
"""Largest number of characters of a value; base-60 numbers take quadratic time."""
MAX_NODES = 100_000
"""Largest number of values, lists and mappings; those under an alias count each time."""
MAX_DEPTH = 20
"""Largest number of nested lists and mappings."""
MERGE_TAG = "tag:yaml.org,2002:merge"
"""Tag of the key `<<`, which takes over the values of other mappings."""


class BoundedLoader(yaml.SafeLoader):
    """Safe YAML loader that refuses documents whose cost exceeds their length.

    Aliases may make a short text expand to many values ("billion laughs"): values under an alias
    count each time they are used.
    """

    def __init__(self, stream: str) -> None:
        """Start to load a text.

        Args:
            stream: The text.
        """
        super().__init__(stream)
        self._depth = self._count = 0
        self._sizes: dict[str | None, int] = {}  # nodes under each anchor

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose a node and count it.

        Args:
            parent: Node that contains it.
            index: Place in its parent.

        Returns:
            The node.

        Raises:
            yaml.YAMLError: The document is too deep, has too many values, or a value is too long.
        """
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        before = self._count
        self._count += self._sizes.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
        self._depth += 1
        if self._depth > MAX_DEPTH:
            self._raise_yaml_error(f"more than {MAX_DEPTH} levels, expected fewer", event)
        if self._count > MAX_NODES:
            self._raise_yaml_error(
                f"more than {MAX_NODES} values, those of aliases included, expected fewer", event
            )
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_SCALAR_CHARACTERS:
            self._raise_yaml_error(
                f"a value of {len(event.value)} characters, expected {MAX_SCALAR_CHARACTERS} at most", event
            )
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor is not None and not isinstance(event, yaml.AliasEvent):
            self._sizes[event.anchor] = self._count - before
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping that has each key once; YAML loaders drop all but the last.

        Args:
            node: The mapping.
            deep: Whether to construct what it contains at once.

        Returns:
            The mapping.

        Raises:
            yaml.YAMLError: A key is repeated.
        """
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != MERGE_TAG:
                if key.value in seen:
                    self._raise_yaml_error(f"the key {key.value!r} a second time, expected it once", key)
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    @staticmethod
    def _raise_yaml_error(found: str, place: Any) -> NoReturn:
        """Raise a YAMLError with line and column of an event or a node."""
        mark = place.start_mark
        raise yaml.YAMLError(f"found {found}, in line {mark.line + 1}, column {mark.column + 1}")


def load_yaml(text: str, loader: type[BoundedLoader] = BoundedLoader) -> Any:
    """Parse a YAML text.

    Args:
        text: The text.
        loader: Class of the loader.

    Returns:
        The document.

    Raises:
        ValueError: The text is no valid YAML or exceeds a bound; the message is one line.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"found more than {MAX_CHARACTERS} characters, expected fewer")
    try:
        return loader(text).get_single_data()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f" in line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ValueError(f"{error.problem or error.context}{place}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def read_bounded_text(path: Path) -> str:
    """Read a file, at most one character more than `load_yaml` accepts.

    Args:
        path: Path of the file.

    Returns:
        Its text. OSError and UnicodeDecodeError propagate.
    """
    with path.open(encoding="utf-8") as file:
        return file.read(MAX_CHARACTERS + 1)


def read_yaml(path: Path, expected: str) -> Any:
    """Parse a YAML file. OSError propagates.

    Args:
        path: Path of the file.
        expected: Description of the expected content for the error message, such as `a YAML file of
            a world`.

    Returns:
        The document.

    Raises:
        ValueError: The file is no text, no valid YAML, or exceeds a bound; the message names the
            file.
    """
    try:
        return load_yaml(read_bounded_text(path))
    except UnicodeDecodeError:
        raise ValueError(f"{path}: no text, expected {expected}") from None
    except ValueError as error:
        raise ValueError(f"{path}: no valid YAML: {error}") from None
