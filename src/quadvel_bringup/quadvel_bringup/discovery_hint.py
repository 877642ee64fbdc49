"""Advice for an undiscovered robot: another ROS domain, or a host outside the discovery range."""

from __future__ import annotations

import os
from pathlib import Path

import quadvel_dds

from .exclusivity import ros_domain, running_robots

PORTS_PER_DOMAIN = 250
"""Ports of one domain, by the RTPS standard."""
DDS_PORTS = range(7400, 32768)
"""UDP ports of ROS domains 0 to 101. The system hands out the ports from 32768 on to anyone."""
PARTICIPANT_PORT_OFFSETS = range(10, PORTS_PER_DOMAIN, 2)
"""Offsets of a participant's discovery ports within its domain; its data port is the odd one after."""


def discovery_hint() -> str:
    """Explain in one sentence why no robot was discovered.

    Returns:
        This domain, robots or programs on other domains, and what to set.
    """
    here = ros_domain()
    sentence = f"this command is on ROS domain {here}"
    elsewhere = [
        f"{name} (pid {pid}) is on {domain}"
        for pid, (name, domain) in running_robots().items()
        if domain != here
    ]
    others = sorted(
        domain for domain in domains_in_use(Path("/proc/net/udp").read_text()) if str(domain) != here
    )
    if elsewhere:
        sentence += f", {', '.join(elsewhere)}: set ROS_DOMAIN_ID to that number"
    elif others:
        sentence += f", programs of this machine are on {', '.join(map(str, others))}: set ROS_DOMAIN_ID to the robot's"
    else:
        sentence += "; the robot must have the same ROS_DOMAIN_ID"
    if _is_limited_to_this_host():
        sentence += "; to discover other hosts, set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
    return sentence


def domains_in_use(table: str) -> set[int]:
    """Find the ROS domains up to 101 with participants on this machine.

    Args:
        table: Content of /proc/net/udp.

    Returns:
        Numbers of the domains.
    """
    local = (line.split()[1] for line in table.splitlines()[1:])
    bound = {int(address.rpartition(":")[2], 16) for address in local}
    return {
        (port - DDS_PORTS.start) // PORTS_PER_DOMAIN
        for port in bound
        if port in DDS_PORTS
        and (port - DDS_PORTS.start) % PORTS_PER_DOMAIN in PARTICIPANT_PORT_OFFSETS
        and port + 1 in bound
    }


def _is_limited_to_this_host() -> bool:
    """Return whether the discovery range excludes other hosts."""
    # The embedded middleware stays on this host unless asked otherwise (docs/security.md).
    default_range = "LOCALHOST" if quadvel_dds.is_installed() else "SUBNET"
    return (os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or default_range) in ("LOCALHOST", "OFF")
