"""Check for another robot or simulator on the same ROS domain.

Two of them would send conflicting states and commands.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import dropwhile
from pathlib import Path
from typing import Any

from quadvel_nodes.publishers import DISCOVERY_TIME_S, has_publisher

TOPIC = "low_state"
ROBOT_PROGRAMS = ("sim_node", "board", "driver", "quadvel_lab.plant")
"""Nodes and modules of drivers and simulated robots."""
PUBLISHERS = {"sim_node", "driver"}
"""Those nodes of them that publish low_state."""
DRY_RUN = "dry_run:=true"
"""Argument of a driver that publishes nothing, and so is no robot."""
LOADED_DISCOVERY_TIME_S = 4.0
"""Time to discover other publishers if one of ROBOT_PROGRAMS runs on this machine, which may be busy and answer late."""


class RobotAlreadyRunningError(ConnectionError):
    """Another robot or simulator is on this ROS domain."""


@contextmanager
def domain_claimed(node: Any) -> Iterator[None]:
    """Claim a ROS domain of this computer for one robot, for as long as the context lasts.

    Without it, two programs that start at the same instant would both find no publisher. The claim is
    a lock on a file, which the kernel frees when the process ends, however it ends. It holds among
    the programs of one user; those of others are found by what they publish.

    Args:
        node: A node that does not publish low_state itself; used at the start only.

    Yields:
        Nothing.

    Raises:
        RobotAlreadyRunningError: Another program has claimed it, or low_state has a publisher; the
            sentence names its process.
    """
    name = f"quadvel-user-{os.getuid()}-domain-{ros_domain()}.lock"
    path = Path(tempfile.gettempdir(), name)
    with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600), "r+") as claim:
        try:
            fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _already_published(_owner(claim.read())) from None
        claim.truncate()
        claim.write(str(os.getpid()))
        claim.flush()
        if has_publisher(node, TOPIC, LOADED_DISCOVERY_TIME_S if robots_on_domain() else DISCOVERY_TIME_S):
            raise _already_published(describe_robots())
        yield


def describe_robots() -> str:
    """Name the robots of this ROS domain.

    Returns:
        Programs of this machine with their process ids, or other possible causes.
    """
    found = robots_on_domain()
    if not found:
        return "a robot, another host or user, or a process that was killed less than 10 s ago"
    return _listed(found)


def refuse_beside_a_robot() -> None:
    """Refuse to start a simulator next to a robot of this machine and domain.

    The network is not searched: the start would take seconds longer. The controller's guard finds
    robots of other hosts (docs/faults.md).

    Raises:
        RobotAlreadyRunningError: There is such a robot; the sentence names its process.
    """
    others = {pid: name for pid, name in robots_on_domain().items() if name in PUBLISHERS}
    if others:
        raise _already_published(_listed(others))


def _already_published(by: str) -> RobotAlreadyRunningError:
    return RobotAlreadyRunningError(
        f"{TOPIC}: already published on ROS domain {ros_domain()} by {by}. Stop it, or set "
        "ROS_DOMAIN_ID to another number"
    )


def _owner(pid: str) -> str:
    """Name the program that has claimed a domain by its process id, "" in the instant before it is written."""
    words = _program(Path("/proc", pid)) if pid else []
    return f"{' '.join(words[:2])} (pid {pid})" if words else "another program"


def _listed(robots: Mapping[int, str]) -> str:
    """Name programs with their process ids."""
    return ", ".join(f"{name} (pid {pid}{_started_by(pid)})" for pid, name in robots.items())


def robots_on_domain() -> dict[int, str]:
    """Find the robot programs of this machine and ROS domain.

    Returns:
        Names by process id, as far as this user may see.
    """
    return {pid: name for pid, (name, domain) in running_robots().items() if domain == ros_domain()}


def running_robots() -> dict[int, tuple[str, str]]:
    """Find the robot programs of this machine, as far as this user may see.

    Returns:
        Name and ROS domain by process id.
    """
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        name = _robot_program(_program(folder))
        environment = _environment(folder) if name and int(folder.name) != os.getpid() else None
        if name and environment is not None:
            found[int(folder.name)] = name.rpartition(".")[2], ros_domain(environment)
    return found


def _robot_program(words: list[str]) -> str | None:
    """Return the robot program that a command line runs, if any: by ROS 2, by `quadvel run` or as a module."""
    match words:
        case ["quadvel_bringup.nodes", name, *_] | ["quadvel" | "quadvel_bringup", "run", name, *_]:
            program = name
        case _:
            program = words[0] if words else ""
    return program if program in ROBOT_PROGRAMS and DRY_RUN not in words else None


def _program(folder: Path) -> list[str]:
    """Return the command line of a process without folders, and without Python and its options."""
    try:
        line = (folder / "cmdline").read_text(errors="replace").split("\0")
    except OSError:  # the process has ended
        return []
    words = [word.rpartition("/")[2] for word in line if word]
    if not words or not words[0].startswith("python"):
        return words
    return list(dropwhile(lambda word: word.startswith("-"), words[1:]))


def _environment(folder: Path) -> dict[str, str] | None:
    """Return the environment of a process; None if it has ended or belongs to another user."""
    try:
        pairs = (folder / "environ").read_text(errors="replace").split("\0")
    except OSError:
        return None
    return dict(pair.partition("=")[::2] for pair in pairs)


def ros_domain(environment: Mapping[str, str] = os.environ) -> str:
    """Return the ROS domain of a process.

    Args:
        environment: Its environment.

    Returns:
        The number of the domain.
    """
    return environment.get("ROS_DOMAIN_ID") or "0"


def _started_by(pid: int) -> str:
    """Name the `quadvel` command that started a process, if any."""
    try:
        parent = Path("/proc") / Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]
    except OSError:
        return ""
    match _program(parent):
        case ["quadvel" | "quadvel_bringup", command, *_]:
            return f", started by quadvel {command}, pid {parent.name}"
    return ""
