"""The source keeps to docs/architecture.md: imports as in the diagram, no use of others' private names."""

from __future__ import annotations

import ast
import graphlib
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = (*sorted((ROOT / "src").glob("quadvel_*/quadvel_*")), ROOT / "training" / "quadvel_training")
PUBLIC_IN_PYTHON = {"_exit", "_getframe", "_replace"}  # documented, in spite of their names
NO_PUBLIC_WAY = {"_parameter_overrides", "_messages", "_websock_server"}  # of rclpy and viser


def modules() -> dict[str, Path]:
    """File of each module by dotted name; a package has the name of its folder."""
    paths = {
        ".".join(path.relative_to(folder.parent).with_suffix("").parts): path
        for folder in FOLDERS
        for path in folder.rglob("*.py")
    }
    return {name.removesuffix(".__init__"): path for name, path in paths.items()}


def imported(name: str, path: Path) -> set[str]:
    """Dotted names that a module imports, at its top or inside functions; `from a import b` gives a and a.b."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) + 1 - node.level] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def import_graph() -> dict[str, set[str]]:
    """Our modules that each of our modules imports.

    A submodule that is imported from its package does not count as an import of the package.
    """
    known = modules()
    graph = {}
    for name, path in known.items():
        found = imported(name, path) & known.keys() - {name}
        graph[name] = {one for one in found if not any(other.startswith(f"{one}.") for other in found)}
    return graph


def arrows() -> set[tuple[str, str]]:
    """Importing and imported package of each solid arrow."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    first = text.partition("```mermaid")[2].partition("```")[0]
    return {
        (f"quadvel_{a}", f"quadvel_{b}") for a, b in re.findall(r"^ *(\w+) --> (\w+)$", first, re.MULTILINE)
    }


def test_the_diagram_of_packages_shows_the_imports() -> None:
    found = {
        (name.partition(".")[0], other.partition(".")[0])
        for name, others in import_graph().items()
        for other in others
    }
    found = {(package, other) for package, other in found if package != other}
    drawn = arrows()
    assert drawn - found == set()
    reachable = set(drawn)
    while more := {(a, c) for a, b in reachable for b_, c in drawn if b == b_} - reachable:
        reachable |= more
    assert found - reachable == set()
    assert not {(a, b) for a, b in reachable if (b, a) in reachable}  # imports go one way only


def test_no_modules_import_each_other_in_a_circle() -> None:
    graphlib.TopologicalSorter(import_graph()).prepare()  # raises CycleError with the circle


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


def test_no_console_reads_markup_in_paths_and_messages():
    """`[x]` in a path is text: a console of rich would drop it, or fail at `[/x]`."""
    calls = [
        (name, node)
        for name, path in modules().items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Console"
    ]
    assert calls
    with_markup = [
        f"{name}:{node.lineno}"
        for name, node in calls
        if not any(word.arg == "markup" and ast.unparse(word.value) == "False" for word in node.keywords)
    ]
    assert with_markup == []
