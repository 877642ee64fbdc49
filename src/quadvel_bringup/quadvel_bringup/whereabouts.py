"""Where a robot may be that does not answer: on another ROS domain of this machine, or on a host that is not heard."""

from __future__ import annotations

import os
from pathlib import Path

import quadvel_dds

from .exclusivity import robots, ros_domain

PORTS = range(7400, 32651)
"""UDP ports of the ROS domains 0 to 101, by the RTPS standard; above them the system hands out ports of its own"""
PORTS_OF_A_DOMAIN = 250
OWN_PORTS = range(10, PORTS_OF_A_DOMAIN, 2)
"""Ports in a domain's range at which a participant hears others find it; at the next one it hears their data"""


def whereabouts() -> str:
    """One sentence for somebody whom no robot answers: the domain, what is on others, and what to set."""
    here = ros_domain()
    sentence = f"this command is on ROS domain {here}"
    elsewhere = [
        f"{name} (pid {pid}) is on {domain}" for pid, (name, domain) in robots().items() if domain != here
    ]
    others = sorted(
        domain for domain in domains_in_use(Path("/proc/net/udp").read_text()) if str(domain) != here
    )
    if elsewhere:
        sentence += f", {', '.join(elsewhere)}: set ROS_DOMAIN_ID to that number"
    elif others:
        sentence += f", programs of this machine are on {', '.join(map(str, others))}: set ROS_DOMAIN_ID to the robot's"
    else:
        sentence += "; the robot's ROS_DOMAIN_ID has to be the same"
    if _hears_this_host_alone():
        sentence += "; other hosts are heard with ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
    return sentence


def domains_in_use(table: str) -> set[int]:
    """The ROS domains, up to 101, of which this machine has participants, out of the kernel's table of UDP sockets."""
    local = (line.split()[1] for line in table.splitlines()[1:])
    bound = {int(address.rpartition(":")[2], 16) for address in local}
    return {
        (port - PORTS.start) // PORTS_OF_A_DOMAIN
        for port in bound
        if port in PORTS and (port - PORTS.start) % PORTS_OF_A_DOMAIN in OWN_PORTS and port + 1 in bound
    }


def _hears_this_host_alone() -> bool:
    usual = "LOCALHOST" if quadvel_dds.is_installed() else "SUBNET"
    return (os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or usual) in ("LOCALHOST", "OFF")
