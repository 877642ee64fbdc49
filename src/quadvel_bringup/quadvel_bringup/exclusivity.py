"""Whether another robot or simulator is there already: two on one domain would wreck each other."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import quadvel_dds

TOPIC = "low_state"
SERVERS = ("sim_node", "board", "driver", "quadvel_bringup.plant")
"""Words of a command line whose process serves TOPIC"""
LOOK = 0.5  # s; who is there answers a newcomer at once
LONG_LOOK = 4.0  # s, where a process of this machine looks like it: a busy one answers late


class NotAlone(ConnectionError):
    """Somebody else serves the robot's topics."""


def ensure_alone(node: Any) -> None:
    """Raises NotAlone where somebody publishes low_state beside what this command is about to start."""
    until = time.monotonic() + (LONG_LOOK if servers() else LOOK)
    while time.monotonic() < until:
        if node.count_publishers(TOPIC):
            raise NotAlone(
                f"{TOPIC}: somebody publishes it already on ROS domain {ros_domain()}: {_who()}. Stop it, or set "
                "ROS_DOMAIN_ID to another number"
            )
        time.sleep(0.02)


def _who() -> str:
    """The processes of this machine that serve TOPIC on our domain, or what else it may be."""
    found = servers()
    if not found:
        return "no process of yours on this machine, so a robot, another host or user, or one that was killed less than 10 s ago"
    return ", ".join(f"{name} (pid {pid}{_starter(pid)})" for pid, name in found.items())


def servers() -> dict[int, str]:
    """Names, by process id, of what serves TOPIC on our ROS domain, as far as this user may look."""
    return {pid: name for pid, (name, domain) in robots().items() if domain == ros_domain()}


def robots() -> dict[int, tuple[str, str]]:
    """Name and ROS domain, by process id, of what serves TOPIC on this machine, as far as this user may look."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        name = next((word for word in SERVERS if word in _words(folder)), None)
        environment = _environment(folder) if name and int(folder.name) != os.getpid() else None
        if name and environment is not None:
            found[int(folder.name)] = name.rpartition(".")[2], ros_domain(environment)
    return found


def _words(folder: Path) -> list[str]:
    """The command line of a process, without the folders of its words."""
    try:
        return [
            word.rpartition("/")[2] for word in (folder / "cmdline").read_text(errors="replace").split("\0")
        ]
    except OSError:  # it has ended meanwhile
        return []


def _environment(folder: Path) -> dict[str, str] | None:
    try:
        pairs = (folder / "environ").read_text(errors="replace").split("\0")
    except OSError:  # another user's
        return None
    return dict(pair.partition("=")[::2] for pair in pairs)


def ros_domain(environment: Mapping[str, str] = os.environ) -> str:
    """The number of the ROS domain that a process with this environment is on."""
    return environment.get("ROS_DOMAIN_ID") or "0"


def _starter(pid: int) -> str:
    """The `quadvel` command that started a process, if one did."""
    try:
        parent = Path("/proc") / Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]
    except OSError:
        return ""
    words = [word for word in _words(parent) if word]
    for program in ("quadvel", "quadvel_bringup"):
        if program in words[:-1]:
            return f", started by quadvel {words[words.index(program) + 1]}, pid {parent.name}"
    return ""


def look_for_others() -> None:
    """The same for a command that has no node of its own."""
    quadvel_dds.install()
    from .session import Session

    with Session("look_for_others") as session:
        ensure_alone(session.node)
