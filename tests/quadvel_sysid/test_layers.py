"""docs/sysid.md lists all modules in the order of their imports, and the tuned constants."""

import ast
import re
from importlib import import_module
from pathlib import Path

import quadvel_sysid

PACKAGE = Path(quadvel_sysid.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "sysid.md"


def _rows() -> list[list[str]]:
    modules, _, _ = PAGE.read_text().partition("## One log")
    cells = re.findall(r"^\| (`[^|]+) \|", modules, re.MULTILINE)
    return [
        [name.removesuffix(".py").strip("/") for name in re.findall(r"`([^`]+)`", cell)] for cell in cells
    ]


def _imported(path: Path) -> set[str]:
    """Modules and folders of the package that a file imports."""
    level = len(path.relative_to(PACKAGE).parts)
    nodes = [one for one in ast.walk(ast.parse(path.read_text())) if isinstance(one, ast.ImportFrom)]
    names = [(one.module or one.names[0].name).split(".")[0] for one in nodes if one.level == level]
    return set(names)


def test_imports_go_downwards_in_the_list_of_modules() -> None:
    rows = _rows()
    place = {name: k for k, names in enumerate(rows) for name in names}
    found = {p.relative_to(PACKAGE).parts[0].removesuffix(".py") for p in PACKAGE.rglob("*.py")} - {
        "__init__"
    }
    assert found == set(place)
    for path in PACKAGE.rglob("*.py"):
        mine = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        above = {name for name in _imported(path) if mine in place and place[name] < place[mine]}
        assert not above, f"{path.name} imports {above}, which stand above it in {PAGE.name}"


def test_the_tuned_constants_have_the_documented_values() -> None:
    rows = re.findall(r"^\| `(\w+)\.(\w+)` \| ([\d.]+) \|", PAGE.read_text(), re.MULTILINE)
    assert len(rows) == 29
    for module, name, value in rows:
        assert getattr(import_module(f"quadvel_sysid.{module}"), name) == float(value), f"{module}.{name}"
