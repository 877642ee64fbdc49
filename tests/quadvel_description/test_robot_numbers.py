"""Numbers of a robot stand in its folder and nowhere else."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from quadvel_description.robot import load_robot
from quadvel_description.robot_name import shipped_robots

ROOT = Path(__file__).parents[2]
MODULES = [path for folder in ("src", "training") for path in (ROOT / folder).rglob("*.py")]
ANY_ROBOT = {1.5708}  # a right angle, rad


def peculiar_numbers(name: str) -> set[float]:
    """Numbers of robot.yaml, ranges and heights with four digits and more: no two sources agree on them by chance."""

    def numbers(value: object) -> Iterator[float]:
        if isinstance(value, dict | list):
            for one in value.values() if isinstance(value, dict) else value:
                yield from numbers(one)
        elif isinstance(value, float):
            yield abs(value)

    robot = load_robot(name)
    content = yaml.safe_load((robot.folder / "robot.yaml").read_text())
    derived = [*robot.lower.tolist(), *robot.upper.tolist(), robot.nominal_height, robot.lie_height]
    return {
        one
        for one in numbers(content | {"derived": derived})
        if len(f"{one:.12g}".replace(".", "").lstrip("0")) >= 4
    } - ANY_ROBOT


def module_level(tree: ast.Module) -> Iterator[ast.AST]:
    """All nodes of a module that run when it is imported."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            waiting += ast.iter_child_nodes(node)


@pytest.mark.parametrize("robot", shipped_robots())
def test_no_module_holds_a_number_of_a_robot(robot: str) -> None:
    known = peculiar_numbers(robot)
    assert len(known) >= 5
    found = {
        f"{path.relative_to(ROOT)}:{node.lineno} {node.value}"
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, float) and abs(node.value) in known
    }
    assert not found


def test_no_module_loads_a_robot_when_it_is_imported() -> None:
    found = {
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in MODULES
        for node in module_level(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "load_robot"
    }
    assert not found
