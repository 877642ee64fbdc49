"""Definitions of all messages and services: ROS 2 Jazzy's, quadvel's and Unitree's."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from . import unitree_go

HERE = Path(__file__).parent
OWN_PACKAGE = "quadvel_msgs"

SERVICE_DEFINITIONS = {
    "std_srvs/srv/Empty": "---",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
    "rcl_interfaces/srv/DescribeParameters": "string[] names\n---\nParameterDescriptor[] descriptors",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types",
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nParameterValue[] values",
    "rcl_interfaces/srv/ListParameters": (
        "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n---\nListParametersResult result"
    ),
    "rcl_interfaces/srv/SetParameters": "Parameter[] parameters\n---\nSetParametersResult[] results",
    "rcl_interfaces/srv/SetParametersAtomically": "Parameter[] parameters\n---\nSetParametersResult result",
}
"""Definitions of the ROS 2 services in use; those of messages are in rosbags."""
TYPE_DEFAULTS = {"bool": False, "string": "", "float32": 0.0, "float64": 0.0}
"""Default values of primitive fields by type; all other types default to 0."""
FIELD_DEFAULTS = {
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("sensor_msgs/msg/NavSatStatus", "status"): -2,
}
"""Default values of single fields, which the definitions in rosbags omit."""


def _own_definitions() -> Path:
    """Return the folder of the quadvel_msgs definitions, installed or in the source tree."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    shares = [Path(prefix) / "share" / OWN_PACKAGE for prefix in prefixes]
    folders = (HERE / "interfaces", HERE.parents[1] / OWN_PACKAGE, *shares)
    return next(folder for folder in folders if (folder / "msg").is_dir())


def _load_store() -> Any:
    """Register Jazzy's and quadvel's definitions.

    The type store of rosbags has no services, so request and response are parsed as messages.
    """
    store, own_files = get_typestore(Stores.ROS2_JAZZY), _own_definitions()
    types: dict[str, Any] = {}
    for file in sorted(own_files.glob("msg/*.msg")):
        types.update(get_types_from_msg(file.read_text(), f"{OWN_PACKAGE}/msg/{file.stem}"))
    for name, text in unitree_go.DEFINITIONS.items():
        types.update(get_types_from_msg(text, f"unitree_go/msg/{name}"))
    own = {f"{OWN_PACKAGE}/srv/{file.stem}": file.read_text() for file in sorted(own_files.glob("srv/*.srv"))}
    for name, text in {**SERVICE_DEFINITIONS, **own}.items():
        package, _, short = name.split("/")
        # Add line breaks: for an empty request or response "---" is the first or last line.
        request, _, response = f"\n{text}\n".partition("\n---\n")
        for part, definition in {"Request": request, "Response": response}.items():
            (parsed,) = get_types_from_msg(definition, f"{package}/msg/{short}").values()
            types[f"{name}_{part}"] = parsed
    store.register(types)  # once: each call compiles code
    return store


STORE = _load_store()
"""All definitions by full name ("geometry_msgs/msg/Twist"), as a type store of rosbags."""
