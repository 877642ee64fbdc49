"""What a package uses is what it declares: for ROS in its package.xml, for pip in pyproject.toml, both ways."""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[2]
SRC = ROOT / "src"
PACKAGES = sorted(file.parent.name for file in SRC.glob("*/package.xml"))
MESSAGES = "quadvel_msgs"
ROSDEP = {
    "attrs": "python3-attr",
    "evdev": "python3-evdev",
    "jinja2": "python3-jinja2",
    "lz4": "python3-lz4",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "typer": "python3-typer",
    "typing_extensions": "python3-typing-extensions",
    "websockets": "python3-websockets",
    "yaml": "python3-yaml",
}
"""Names that rosdep has for modules"""
PIP = {
    **dict.fromkeys(("cattrs", "cyclonedds", "distributed", "mcap", "mujoco", "onnx", "onnxruntime"), ""),
    **dict.fromkeys(
        ("matplotlib", "numba", "numpy", "onnxscript", "rich", "rosbags", "scipy", "tensorboard"), ""
    ),
    **dict.fromkeys(("h5py", "jinja2", "lz4", "msgspec", "pyarrow"), ""),
    **dict.fromkeys(
        ("attrs", "evdev", "threadpoolctl", "torch", "trimesh", "typer", "viser", "websockets"), ""
    ),
    "backports": "backports.zstd",
    "foxglove": "foxglove-sdk",
    "imageio_ffmpeg": "imageio-ffmpeg",
    "typing_extensions": "typing-extensions",
    "yaml": "pyyaml",
}
"""Distributions that bring modules; of the module's name unless given"""
BUILD_TOOLS = {"setuptools"}
"""Of every setup.py"""
OPTIONAL = {"quadvel_eval", "quadvel_follow", "quadvel_lab", "quadvel_sim", "quadvel_sysid", "quadvel_why"}
"""What quadvel_bringup names as texts: its commands and nodes refuse to start where it is not installed"""
HEAVY = {"matplotlib", "mujoco", "numba", "onnx", "scipy", "torch"}
OF_TOOLS = ("docs", "fuzz", "test", "ros", "lint")
"""Extras whose packages no source imports"""
BY_TORCH = {"onnxscript", "tensorboard"}
"""What torch imports where a training asks it to export and to log"""
OURS = re.compile(rf"({'|'.join(PACKAGES)})\.[\w.:]+|({MESSAGES})")
TYPE_NAME = re.compile(r"/?([a-z0-9_]+)/(?:msg|srv)/\w+")


def trees(folder: Path) -> Iterator[ast.AST]:
    for file in folder.rglob("*.py"):
        yield from ast.walk(ast.parse(file.read_text()))


def imported(folder: Path) -> set[str]:
    """The first names of all modules that the sources in a folder import, by a statement or by a text.

    A text that is the name of one of our modules, or of the package of our messages, means it; and so does the type of a message
    where modules are imported by a name that is put together.
    """
    names, types, computes = set(), set(), False
    for node in trees(folder):
        match node:
            case ast.Import(names=modules):
                names |= {one.name for one in modules}
            case ast.ImportFrom(module=str(module), level=0):
                names.add(module)
            case ast.Call(func=ast.Name("import_module"), args=[ast.Constant(str(module)), *_]):
                names.add(module)
            case ast.Call(func=ast.Name("import_reader"), args=[_, ast.Constant(str(module))]):  # of an extra
                names.add(module)
            case ast.Call(func=ast.Name("import_module"), args=[ast.JoinedStr(), *_]):
                computes = True
            case ast.Constant(str(text)) if found := OURS.fullmatch(text):
                names.add(found[1] or found[2])
            case ast.Constant(str(text)) if found := TYPE_NAME.fullmatch(text):
                types.add(found[1])
    return {name.partition(".")[0] for name in names | (types if computes else set())}


def used(package: str) -> set[str]:
    """What a package needs of others: modules, or the packages of the fields of its messages."""
    if package == MESSAGES:
        definitions = [*(SRC / package).glob("msg/*.msg"), *(SRC / package).glob("srv/*.srv")]
        lines = "\n".join(file.read_text() for file in definitions)
        return set(re.findall(r"^([a-z0-9_]+)/\w+", lines, re.MULTILINE))
    found = imported(SRC / package) - set(sys.stdlib_module_names) - BUILD_TOOLS - {package}
    return found - OPTIONAL if package == "quadvel_bringup" else found


def statements(package: str) -> set[str]:
    """The first names of all modules that import statements of a package name."""
    names = set()
    for node in trees(SRC / package):
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def test_bringup_imports_no_laboratory() -> None:
    assert statements("quadvel_bringup") & (OPTIONAL | HEAVY) == set()


def test_what_the_laboratory_is_made_of_declares_itself_to_the_whole() -> None:
    """colcon build --packages-up-to quadvel_lab quadvel_why builds all; up to quadvel_bringup, what a robot needs."""
    assert needed("quadvel_lab") | needed("quadvel_why") == set(PACKAGES)
    assert needed("quadvel_bringup") & OPTIONAL == set()


def needed(package: str) -> set[str]:
    """The packages of quadvel that a package needs, with those that they need, and itself."""
    found, waiting = set(), [package]
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            waiting += declared(one) & set(PACKAGES)
    return found


def declared(package: str) -> set[str]:
    root = ElementTree.parse(SRC / package / "package.xml").getroot()
    runtime = {"rosidl_default_runtime"} if package == MESSAGES else set()
    return {one.text or "" for kind in ("depend", "exec_depend") for one in root.iter(kind)} - runtime


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_declares_what_the_sources_import_and_nothing_else(package: str) -> None:
    for_ros = {ROSDEP.get(name, name) for name in used(package) if name in ROSDEP or name not in PIP}
    assert declared(package) == for_ros


def requirements(*extras: str) -> set[str]:
    """Names of the distributions that pyproject.toml asks for, with these extras and those that they include."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    listed, waiting, seen = list(project["dependencies"]), list(extras), set()
    while waiting:
        extra = waiting.pop()
        for one in () if extra in seen else project["optional-dependencies"][extra]:
            if included := re.fullmatch(rf"{project['name']}\[(.+)\]", one):
                waiting += included[1].split(",")
            else:
                listed.append(one)
        seen.add(extra)
    return {re.split(r"[\[<>=;]", one)[0] for one in listed}


def test_pip_brings_what_the_sources_import_and_nothing_else() -> None:
    modules = set.union(
        *(used(package) for package in PACKAGES if package != MESSAGES), imported(ROOT / "training")
    )
    from_pip = {PIP[name] or name for name in modules if name in PIP}
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].keys()
    assert requirements(*(extras - set(OF_TOOLS))) - BY_TORCH == from_pip


def test_the_full_simulator_is_the_core_of_the_same_version() -> None:
    core, full = (
        tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        for folder in (ROOT, ROOT / "packaging" / "quadvel")
    )
    assert full["version"] == core["version"]
    assert full["dependencies"] == [f"{core['name']}[eval]=={core['version']}"]
    assert full["requires-python"] == core["requires-python"]
    assert {"mujoco", "onnxruntime", "matplotlib", "mcap"} <= requirements("eval")


@pytest.mark.parametrize("package", [one for one in PACKAGES if one != MESSAGES])
def test_files_that_are_no_modules_are_installed_by_pip_and_by_ament(package: str) -> None:
    """By pip with the patterns of pyproject.toml, by ament with those of the package's setup.cfg."""
    tracked = subprocess.run(
        ["git", "ls-files", f"src/{package}/{package}"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    files = [
        Path(file).relative_to(f"src/{package}/{package}") for file in tracked if not file.endswith(".py")
    ]
    pip = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["*"]
    setup = configparser.ConfigParser()
    setup.read(SRC / package / "setup.cfg")
    ament = re.split(r"[,\s]+", setup.get("options.package_data", package, fallback="").strip())
    for file in files:
        if file.suffix not in (".md", ".typed"):  # which no program of ROS reads
            assert any(file.match(pattern) for pattern in ament if pattern), f"setup.cfg: {file}"
            assert any(file.match(pattern.removeprefix("**/")) for pattern in pip), f"pyproject.toml: {file}"


def test_viser_is_held_at_the_minor_version_whose_start_is_known() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (viser,) = (one for one in project["optional-dependencies"]["view"] if one.startswith("viser"))
    assert re.fullmatch(r"viser>=(\d+)\.(\d+)(\.\d+)?,<\1\.\d+", viser)
