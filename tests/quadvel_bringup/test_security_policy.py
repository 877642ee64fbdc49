"""The policy of SROS 2 enclaves allows what the nodes do, and nothing else."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from quadvel_bringup.cli import drive
from quadvel_bringup.nodes import NODES
from quadvel_bringup.stack import LOW_LEVELS, Stack

FOLDER = Path(__file__).parents[2] / "ros_ws" / "security"
KINDS = {
    ("topics", "publish"): "publisher",
    ("topics", "subscribe"): "subscription",
    ("services", "reply"): "service",
    ("services", "request"): "client",
}

# Makes every node, one after the other, and reports what each of them created.
PROGRAM = """
import quadvel_dds; quadvel_dds.install()
import inspect, json, rclpy, sys
from importlib import import_module
from rclpy.node import Node

created = {}
def reporting(kind, create):
    def tell(self, interface, name, *arguments, **options):
        created.setdefault(self.get_name(), {}).setdefault(kind, []).append(name)
        return create(self, interface, name, *arguments, **options)
    return tell
for kind in ("publisher", "subscription", "service", "client"):
    setattr(Node, f"create_{kind}", reporting(kind, getattr(Node, f"create_{kind}")))
for module in map(import_module, sys.argv[1:]):
    (make,) = [one for _, one in inspect.getmembers(module, inspect.isclass)
               if issubclass(one, Node) and one.__module__ == module.__name__]
    given = ["board:port:=0", "driver:board_address:=127.0.0.1", "sim_node:world:=corridor", "board:world:=corridor"]
    given += ["view:port:=0"]
    rclpy.init(args=["node", "--ros-args", *(item for parameter in given for item in ("-p", parameter))])
    make().destroy_node()
    rclpy.shutdown()
print(json.dumps(created))
"""


def enclave(name: str) -> ElementTree.Element:
    """Fails the test if there is no such enclave."""
    found = ElementTree.parse(FOLDER / "policy.xml").find(f"enclaves/enclave[@path='{name}']")
    assert found is not None, f"there is no enclave {name}"
    return found


def allowed(profile: ElementTree.Element) -> dict[str, set[str]]:
    """Names by what a node may create of them."""
    found: dict[str, set[str]] = {kind: set() for kind in KINDS.values()}
    for (tag, verb), kind in KINDS.items():
        for group in profile.findall(f"{tag}[@{verb}='ALLOW']"):
            found[kind] |= {str(one.text) for one in group}
    return found


def test_each_node_may_do_what_it_does_and_no_more() -> None:
    modules = [entry.module for entry in NODES.values()]
    environment = os.environ | {"QUADVEL_MIDDLEWARE": "embedded"}
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, *modules],
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert run.returncode == 0, run.stderr
    created = json.loads(run.stdout)
    common = allowed(ElementTree.parse(FOLDER / "node.xml").getroot())
    assert set(created) == set(NODES)
    for node, names in created.items():
        profile = enclave(f"/quadvel/{node}").find(f"profiles/profile[@node='{node}']")
        assert profile is not None, f"{node} has no rights"
        for kind, may in allowed(profile).items():
            does = {name.removeprefix("/") for name in names.get(kind, ())} - common[kind]
            assert may - common[kind] == does, f"{node}: {kind}"


@pytest.mark.parametrize("low_level", LOW_LEVELS)
def test_each_process_of_a_robot_names_an_enclave_that_there_is(low_level: str) -> None:
    for name, arguments in Stack(low_level=low_level).arguments().items():
        assert arguments[arguments.index("--enclave") + 1] == f"/quadvel/{name}"
        enclave(f"/quadvel/{name}")


AROUND_A_RESET = {"controller/set_mode", "estimator/reset_odometry"}


@pytest.mark.parametrize("order", ["reset", "pause", "step", "push"])
def test_the_operator_may_give_an_order_to_whichever_node_simulates_the_robot(order: str) -> None:
    profile = enclave("/quadvel/operator").find(f"profiles/profile[@node='{order}']")
    assert profile is not None
    simulations = {level.simulation for level in LOW_LEVELS.values() if level.simulation}
    more = AROUND_A_RESET if order == "reset" else set()
    assert allowed(profile)["client"] == {f"{node}/{order}" for node in simulations} | more


def test_the_operator_may_drive_by_the_topic_that_drive_publishes_on() -> None:
    profile = enclave("/quadvel/operator").find("profiles/profile[@node='drive']")
    assert profile is not None
    assert allowed(profile)["publisher"] == {inspect.signature(drive).parameters["topic"].default}


def test_there_is_nothing_but_enclaves_in_the_list_of_enclaves() -> None:
    """`ros2 security generate_artifacts` takes a comment there for an enclave without a name."""
    builder = ElementTree.TreeBuilder(insert_comments=True)
    policy = ElementTree.parse(FOLDER / "policy.xml", ElementTree.XMLParser(target=builder))
    assert {one.tag for one in policy.iterfind("enclaves/")} == {"enclave"}


def test_the_documentation_names_each_enclave() -> None:
    policy = ElementTree.parse(FOLDER / "policy.xml")
    names = {one.attrib["path"].removeprefix("/quadvel/") for one in policy.iterfind("enclaves/enclave")}
    page = (FOLDER.parents[1] / "docs" / "security.md").read_text()
    _, _, after = page.partition("| enclave `/quadvel/...` | used by |")
    rows = after.partition("\n\n")[0].splitlines()[2:]
    assert {name for row in rows for name in re.findall(r"`([a-z_]+)`", row.split("|")[1])} == names
