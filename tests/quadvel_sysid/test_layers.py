"""docs/sysid.md lists all modules in the order of their imports, and the tuned constants."""

import ast
import re
from importlib import import_module
from pathlib import Path

import quadvel_sysid
from quadvel_sysid.options import SEARCH_DEFAULTS

PACKAGE = Path(quadvel_sysid.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "sysid.md"


def _rows() -> list[list[str]]:
    modules, _, _ = PAGE.read_text().partition("## Records")
    cells = re.findall(r"^\| (`[^|]+) \|", modules, re.MULTILINE)
    return [[name.removesuffix(".py") for name in re.findall(r"`([^`]+)`", cell)] for cell in cells]


def _name(path: Path) -> str:
    """A module as the page writes it, or a room in `logs/` for all of that folder."""
    inside = path.relative_to(PACKAGE).with_suffix("").as_posix()
    room = re.match(r"logs/\w+/", inside)
    return room[0] if room else inside


def _imported(path: Path) -> set[str]:
    """Modules of the package that a file imports."""
    here = path.relative_to(PACKAGE).parts[:-1]
    found = set()
    for one in ast.walk(ast.parse(path.read_text())):
        if isinstance(one, ast.ImportFrom) and 0 < one.level <= len(here) + 1:
            folder = PACKAGE.joinpath(*here[: len(here) + 1 - one.level], *(one.module or "").split("."))
            paths = [folder.with_suffix(".py")] if one.module else []
            paths += [folder / f"{name.name}.py" for name in one.names]
            found |= {_name(found) for found in paths if found.exists()}
    return found


def test_imports_go_downwards_in_the_list_of_modules() -> None:
    place = {name: k for k, names in enumerate(_rows()) for name in names}
    paths = [path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"]
    assert {_name(path) for path in paths} == set(place)
    for path in paths:
        above = {name for name in _imported(path) if place[name] < place[_name(path)]}
        assert not above, f"{path.name} imports {above}, which stand above it in {PAGE.name}"


def test_parameters_that_hold_a_log_have_the_name_of_its_record() -> None:
    table = re.findall(r"^\| `(\w+)` \| (.+?) \| `", PAGE.read_text(), re.MULTILINE)
    names = {record: set(re.findall(r"`(\w+)`", cell)) for record, cell in table}
    assert len(names) == 6
    for path in PACKAGE.rglob("*.py"):
        for one in ast.walk(ast.parse(path.read_text())):
            if isinstance(one, ast.arg) and one.annotation is not None:
                of = re.fullmatch(r"(?:Sequence\[)?(\w+)\]?(?: \| None)?", ast.unparse(one.annotation))
                if of and of[1] in names:
                    assert one.arg in names[of[1]], f"{path.name}:{one.lineno}: {one.arg}: {of[1]}"


def test_the_tuned_constants_have_the_documented_values() -> None:
    rows = re.findall(r"^\| `([\w.]+)\.(\w+)` \| ([\d.]+) \|", PAGE.read_text(), re.MULTILINE)
    assert len(rows) == 37
    for module, name, value in rows:
        owner = (
            SEARCH_DEFAULTS if module == "options.SearchOptions" else import_module(f"quadvel_sysid.{module}")
        )
        assert getattr(owner, name) == float(value), f"{module}.{name}"
