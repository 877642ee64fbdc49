"""No source unpickles a file, or reads YAML that makes objects: whoever can change a file must not be able to run a program."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PICKLES = {"pickle", "_pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
READERS = {"load", "loads", "Unpickler", "open"}
SAFE_LOADERS = {"SafeLoader", "CSafeLoader"}
# What is unpickled there was pickled by a process that this one forked, and came through a pipe.
OWN_FORKS = Path("src/quadvel_sysid/quadvel_sysid/parallel.py")


def faults(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of all that reads objects out of files."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    modules = {
        alias.asname or alias.name: alias.name
        for node in nodes
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    own_loaders = {
        node.name
        for node in nodes
        if isinstance(node, ast.ClassDef) and any(_last(base) in SAFE_LOADERS for base in node.bases)
    }
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module in PICKLES:
            names = READERS.intersection(alias.name for alias in node.names)
            if names:
                yield node.lineno, f"from {node.module} import {', '.join(sorted(names))}"
        elif isinstance(node, ast.ImportFrom) and node.module in ("torch", "numpy", "yaml"):
            if any(alias.name in ("load", "unsafe_load", "full_load", "load_all") for alias in node.names):
                yield node.lineno, f"load by its bare name, expected {node.module}.load"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            if module in PICKLES and node.attr in READERS:
                yield node.lineno, f"{module}.{node.attr}"
            elif module == "yaml" and node.attr in ("unsafe_load", "full_load", "UnsafeLoader", "FullLoader"):
                yield node.lineno, f"yaml.{node.attr}"
            elif node.attr == "read_pickle":
                yield node.lineno, f"{module}.read_pickle"
        if isinstance(node, ast.Call):
            yield from _call_faults(node, modules, own_loaders)


def _call_faults(call: ast.Call, modules: dict[str, str], own_loaders: set[str]) -> Iterator[tuple[int, str]]:
    options = {option.arg: option.value for option in call.keywords}
    name = _last(call.func)
    module = (
        modules.get(_last(call.func.value))
        if isinstance(call.func, ast.Attribute) and isinstance(call.func.value, ast.Name)
        else None
    )
    if "allow_pickle" in options and not _is(options["allow_pickle"], False):
        yield call.lineno, f"{name} with allow_pickle"
    if module == "torch" and name == "load" and not _is(options.get("weights_only"), True):
        yield call.lineno, "torch.load without weights_only=True"
    if module == "yaml" and name in ("load", "load_all"):
        loader = _last(options.get("Loader", call.args[1] if len(call.args) > 1 else None))
        if loader not in SAFE_LOADERS | own_loaders:
            yield call.lineno, f"yaml.{name} without a SafeLoader"


def _last(node: ast.AST | None) -> str:
    """The last part of a dotted name."""
    return getattr(node, "attr", getattr(node, "id", ""))


def _is(node: ast.AST | None, value: bool) -> bool:
    return isinstance(node, ast.Constant) and node.value is value


def sources() -> list[Path]:
    folders = (ROOT / name for name in ("src", "training", "tests", "ros_ws"))
    return [file for folder in folders for file in folder.rglob("*.py") if ".egg-info" not in str(file)]


def test_no_source_reads_objects_out_of_files() -> None:
    found = [
        f"{file.relative_to(ROOT)}:{line}: {what}"
        for file in sources()
        if file.relative_to(ROOT) != OWN_FORKS
        for line, what in faults(file.read_text())
    ]
    assert not found, "\n".join(found)
    assert len(sources()) > 300


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("import pickle\npickle.load(file)", "pickle.load"),
        ("import pickle as p\nx = 1; p.loads(data)", "pickle.loads"),
        ("x = 1\nfrom pickle import Unpickler", "from pickle import Unpickler"),
        ("import pickle\nclass A(pickle.Unpickler): pass", "pickle.Unpickler"),
        ("import joblib\njoblib.load(path)", "joblib.load"),
        ("import shelve\nshelve.open(path)", "shelve.open"),
        ("import torch\ntorch.load(path)", "torch.load without weights_only=True"),
        ("import torch\ntorch.load(path, weights_only=False)", "torch.load without weights_only=True"),
        ("x = 1\nfrom torch import load", "load by its bare name"),
        ("import numpy as np\nnp.load(path, allow_pickle=True)", "load with allow_pickle"),
        ("import numpy as np\nnp.load(path, allow_pickle=trusted)", "load with allow_pickle"),
        ("import yaml\nyaml.load(text)", "yaml.load without a SafeLoader"),
        ("import yaml\nyaml.load(text, Loader=yaml.Loader)", "yaml.load without a SafeLoader"),
        ("import yaml\nyaml.unsafe_load(text)", "yaml.unsafe_load"),
        ("import pandas\npandas.read_pickle(path)", "pandas.read_pickle"),
    ],
)
def test_what_does_is_found_with_its_line(source: str, text: str) -> None:
    ((line, what),) = faults(source)
    assert line == 2
    assert what.startswith(text)


def test_what_reads_plain_data_is_no_fault() -> None:
    source = """
import json, pickle, numpy as np, torch, yaml
class Mine(yaml.SafeLoader): pass
yaml.safe_load(text), yaml.load(text, Loader=yaml.CSafeLoader), yaml.load(text, Mine)
np.load(path), np.load(path, allow_pickle=False), torch.load(path, weights_only=True), json.load(file)
pickle.dumps([1])
"""
    assert list(faults(source)) == []
