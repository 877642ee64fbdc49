"""The policy of SROS 2 enclaves allows what the nodes do, and nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

from quadvel_bringup.nodes import NODES

FOLDER = Path(__file__).parents[2] / "ros_ws" / "security"
KINDS = {
    ("topics", "publish"): "publisher",
    ("topics", "subscribe"): "subscription",
    ("services", "reply"): "service",
    ("services", "request"): "client",
}

# Makes every node, one after the other, and tells what each of them created.
PROGRAM = """
import quadvel_dds; quadvel_dds.install()
import inspect, json, rclpy, sys
from importlib import import_module
from rclpy.node import Node

created = {}
def told(kind, create):
    def tell(self, interface, name, *arguments, **options):
        created.setdefault(self.get_name(), {}).setdefault(kind, []).append(name)
        return create(self, interface, name, *arguments, **options)
    return tell
for kind in ("publisher", "subscription", "service", "client"):
    setattr(Node, f"create_{kind}", told(kind, getattr(Node, f"create_{kind}")))
for module in map(import_module, sys.argv[1:]):
    (make,) = [one for _, one in inspect.getmembers(module, inspect.isclass)
               if issubclass(one, Node) and one.__module__ == module.__name__]
    given = ["board:port:=0", "driver:board_address:=127.0.0.1", "sim_node:world:=corridor", "board:world:=corridor"]
    rclpy.init(args=["node", "--ros-args", *(item for parameter in given for item in ("-p", parameter))])
    make().destroy_node()
    rclpy.shutdown()
print(json.dumps(created))
"""


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
    policy = ElementTree.parse(FOLDER / "policy.xml")
    assert set(created) == set(NODES)
    for node, names in created.items():
        profile = policy.find(f"enclaves/enclave[@path='/quadvel/{node}']/profiles/profile[@node='{node}']")
        assert profile is not None, f"{node} has no enclave"
        for kind, may in allowed(profile).items():
            does = {name.removeprefix("/") for name in names.get(kind, ())} - common[kind]
            assert may - common[kind] == does, f"{node}: {kind}"
