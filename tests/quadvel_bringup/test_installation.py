"""What is not installed is refused by one sentence that says what to install, before anything starts."""

from __future__ import annotations

import subprocess
import sys

import pytest

from quadvel_bringup import cli, installation, nodes
from quadvel_bringup.installation import PROBES
from quadvel_bringup.nodes import NODES
from quadvel_bringup.preflight import check_node
from quadvel_bringup.stack import Stack

from .test_packages import HEAVY, PIP, requirements

ROBOT = ("driver", "estimator", "controller", "command_mux")


@pytest.fixture
def missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)


@pytest.mark.parametrize("extra", PROBES)
def test_modules_that_show_an_extra_come_with_it(extra: str) -> None:
    assert {PIP.get(module) or module for module in PROBES[extra]} <= requirements(extra)


@pytest.mark.usefixtures("missing")
def test_nodes_that_are_not_installed_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    sentence = r"sim_node needs mujoco, not installed here: pip install 'quadvel-core\[sim\]'"
    monkeypatch.setattr(nodes, "import_module", pytest.fail)
    with pytest.raises(ValueError, match=sentence):
        nodes.run("sim_node", [])
    with pytest.raises(ValueError, match=sentence):
        Stack().commands()
    with pytest.raises(ValueError, match=sentence):
        check_node("sim_node", [])
    assert list(Stack(low_level="driver").commands()) == [*ROBOT]


@pytest.mark.usefixtures("missing")
def test_commands_that_are_not_installed_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^demo needs mujoco, .* 'quadvel-core\[eval\]'"):
        cli.command("demo")


@pytest.mark.parametrize("name", cli.DELEGATED_COMMANDS)
def test_a_package_that_is_not_built_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    package = cli.DELEGATED_COMMANDS[name].target.partition(".")[0]
    monkeypatch.setattr(installation, "find_spec", lambda module: None if module == package else object())
    with pytest.raises(ValueError, match=f"^{name} needs the package {package}, .* with colcon"):
        cli.command(name)


@pytest.mark.parametrize("name", ROBOT)
def test_a_node_of_a_robot_imports_no_heavy_library(name: str) -> None:
    program = (
        f"import sys, quadvel_dds; quadvel_dds.install(); import {NODES[name].module}; print(*sys.modules)"
    )
    modules = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert {one.partition(".")[0] for one in modules.split()} & HEAVY == set()
