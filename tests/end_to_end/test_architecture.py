"""The source keeps to docs/architecture.md: imports as in the diagram, no use of others' private names."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = (*sorted((ROOT / "src").glob("quadvel_*/quadvel_*")), ROOT / "training" / "quadvel_training")
EVERYWHERE = "quadvel_msgs"  # imported by all packages with nodes, as the text says
PUBLIC_IN_PYTHON = {"_exit", "_getframe", "_replace"}  # documented, in spite of their names
NO_PUBLIC_WAY = {"_parameter_overrides", "_messages", "_websock_server"}  # of rclpy and viser
ONLY_BENCH = ("quadvel_eval", "quadvel_training")  # dotted in the diagram


def imports(folder: Path) -> set[str]:
    """The other packages of quadvel that modules in `folder` import, at their top or inside functions."""
    names = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module)
    packages = {name.partition(".")[0] for name in names}
    return {name for name in packages if name.startswith("quadvel_")} - {folder.name, EVERYWHERE}


def arrows() -> set[tuple[str, str]]:
    """Importing and imported package of each solid arrow."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    first = text.partition("```mermaid")[2].partition("```")[0]
    return {
        (f"quadvel_{a}", f"quadvel_{b}") for a, b in re.findall(r"^ *(\w+) --> (\w+)$", first, re.MULTILINE)
    }


def test_the_diagram_of_packages_shows_the_imports() -> None:
    found = {(folder.name, other) for folder in FOLDERS for other in imports(folder)} - {ONLY_BENCH}
    drawn = arrows()
    assert drawn - found == set()
    reachable = set(drawn)
    while more := {(a, c) for a, b in reachable for b_, c in drawn if b == b_} - reachable:
        reachable |= more
    assert found - reachable == set()


def private_names(path: Path) -> set[str]:
    """Private attributes of other modules' objects that a module uses or imports."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    own = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    used = {alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.Attribute):
            of_itself = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            (own if of_itself else used).add(node.attr)
    return {name for name in used - own if name.startswith("_") and not name.startswith("__")}


def test_no_module_uses_private_names_of_others() -> None:
    paths = [path for folder in FOLDERS for path in folder.rglob("*.py")]
    # The classes of the embedded rclpy are friends: their public names are those of rclpy.
    found = {path.name: private_names(path) for path in paths if "rclpy" not in path.parts}
    allowed = PUBLIC_IN_PYTHON | NO_PUBLIC_WAY
    assert {name: names - allowed for name, names in found.items() if names - allowed} == {}
