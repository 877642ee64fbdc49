"""Check of this machine: what is installed and what quadvel can run on it. It changes nothing."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import metadata, util
from pathlib import Path

import attrs
import numpy as np

import quadvel_dds

from .version import version

ROBOT_PACKAGES = ("numpy", "cyclonedds", "onnxruntime", "rosbags")
"""Packages that the nodes of a robot need."""
REQUIRED_PACKAGES = {**dict.fromkeys(ROBOT_PACKAGES, "robot"), "mcap": "log", "mujoco": "sim", "scipy": "sim"}
"""Packages that the simulated robot needs, and the extra of quadvel-core that installs them."""
REPORTED_VARIABLES = (
    *("ROS_DISTRO", "RMW_IMPLEMENTATION", "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"),
    *("QUADVEL_MIDDLEWARE", "MUJOCO_GL"),
)
"""Environment variables that a bug report shows; they hold no address and no secret."""
GL_BACKENDS = ("egl", "osmesa")
GL_PACKAGES = "libegl1 libopengl0"


@attrs.frozen
class Finding:
    """One result of the check.

    Attributes:
        subject: What was checked.
        good: Whether it is as needed.
        text: What was found.
    """

    subject: str
    good: bool
    text: str


def examine() -> Iterator[Finding]:
    """Run all checks, each one when it is requested.

    Yields:
        The findings.
    """
    yield _python()
    yield _cores()
    yield _middleware()
    yield from map(_package, REQUIRED_PACKAGES)
    yield _wakeup_latency()
    yield _priority()
    yield _gl()
    yield video_encoder()
    yield _torch()
    yield _robot()


def robot_files(robot: str) -> Finding:
    """Check the description of a robot, and that a policy and an estimator are shipped for it.

    Args:
        robot: Name of the robot, or path of a robot.yaml.

    Returns:
        The finding; not good if a file is missing or wrong.
    """
    try:
        from quadvel_description.robot import load_robot
        from quadvel_estimator.learned import shipped_estimator
        from quadvel_policy.policy_file import shipped_policy

        found = load_robot(robot)
        files = [shipped(found).name for shipped in (shipped_policy, shipped_estimator)]
    except (ImportError, OSError, ValueError) as error:
        return Finding("robot files", False, str(error))
    return Finding("robot files", True, f"{found.title}: {', '.join(files)}")


def _robot() -> Finding:
    """Check for a running robot and its actuator model."""
    try:
        quadvel_dds.install()
        from .discovery_hint import discovery_hint
        from .status import FILE_KEYS, running_nodes
    except ImportError as error:
        return Finding("robot", True, f"not checked: {error}")
    nodes = running_nodes()
    if not nodes:
        return Finding(
            "robot",
            True,
            f"none runs; `quadvel up` uses the robot's own actuator model; {discovery_hint()}",
        )
    files = dict.fromkeys(  # each once, though several nodes report the robot
        f"{key} {node.values[key]}" for node in nodes.values() for key in FILE_KEYS if key in node.values
    )
    return Finding(
        "robot", True, f"running: {', '.join(nodes)}; {', '.join(files) or 'no node reports its files'}"
    )


def _python() -> Finding:
    """Check the version of Python."""
    good = (3, 11) <= sys.version_info[:2] <= (3, 13)
    text = f"{platform.python_version()}" if good else f"{platform.python_version()}, expected 3.11 to 3.13"
    return Finding("Python", good, text)


def _cores() -> Finding:
    """Check the number of cores."""
    number = len(os.sched_getaffinity(0))
    return Finding("cores", number >= 2, f"{number}" if number >= 2 else f"{number}; real time needs two")


def _middleware() -> Finding:
    """Check which middleware the nodes use."""
    distro = os.environ.get("ROS_DISTRO", "an unnamed distribution")
    if util.find_spec("rclpy") is None:
        return Finding("ROS 2", True, "not found in this shell: the nodes run on the embedded Cyclone DDS")
    if os.environ.get("QUADVEL_MIDDLEWARE") == "embedded":
        return Finding("ROS 2", True, f"{distro}, ignored because QUADVEL_MIDDLEWARE is 'embedded'")
    if fault := quadvel_dds.ros2_fault():
        return Finding("ROS 2", True, fault)
    rmw = os.environ.get("RMW_IMPLEMENTATION", "its default middleware")
    text = f"{distro} with {rmw}: the nodes run on its rclpy"
    if not _has_executor_of_events():
        text += "; real time on two cores needs the events executor of rclpy 7.1.4 or newer"
    return Finding("ROS 2", True, text)


def _has_executor_of_events() -> bool:
    """Return whether rclpy has the events executor."""
    try:
        return util.find_spec("rclpy.experimental") is not None
    except ImportError:  # the embedded middleware raises this for missing features
        return False


def _package(name: str) -> Finding:
    """Check whether a Python package is installed."""
    try:
        return Finding(name, True, metadata.version(name))
    except metadata.PackageNotFoundError:
        return Finding(name, False, f"missing: pip install 'quadvel-core[{REQUIRED_PACKAGES[name]}]'")


def _wakeup_latency(period: float = 0.005, ticks: int = 100) -> Finding:
    """Measure the lateness of sleeps at the rate of the controller."""
    late = np.empty(ticks)
    deadline = time.monotonic()
    for i in range(ticks):
        deadline += period
        time.sleep(max(deadline - time.monotonic(), 0.0))
        late[i] = time.monotonic() - deadline
    median, p99 = 1e3 * np.quantile(late, (0.5, 0.99))
    text = f"at 200 Hz, wakes {median:.2f} ms late (median), {p99:.2f} ms (99 %)"
    good = bool(p99 < 2.0)
    return Finding(
        "wake-up", good, text if good else f"{text}; the machine is busy, control loops will overrun"
    )


def gl_backend() -> str | None:
    """Find an off-screen rendering backend of MuJoCo, by trials in separate processes.

    Returns:
        The first working backend, or None.
    """
    chosen = os.environ.get("MUJOCO_GL")
    program = "import mujoco; mujoco.GLContext(64, 64).make_current()"
    for backend in (chosen,) if chosen else GL_BACKENDS:
        trial = subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "MUJOCO_GL": backend}, capture_output=True
        )
        if trial.returncode == 0:
            return backend
    return None


def _priority() -> Finding:
    """Check whether real-time priority is permitted, in a separate process."""
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    permitted = subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0
    refused = (
        "real-time priority not permitted, so all programs share the cores; see rtprio in limits.conf(5)"
    )
    return Finding("priority", True, "real-time priority is permitted" if permitted else refused)


def _gl() -> Finding:
    """Check off-screen rendering."""
    backend = gl_backend()
    if backend is None:
        return Finding("GL", False, f"no off-screen GL, so no video; sudo apt install {GL_PACKAGES}")
    return Finding("GL", True, f"{backend}: renders off screen")


def video_encoder() -> Finding:
    """Check the video encoder by running it; the package may lack its program.

    Returns:
        The finding.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        subprocess.run([get_ffmpeg_exe(), "-version"], capture_output=True, check=True)
    except ImportError:
        return Finding("ffmpeg", False, "imageio-ffmpeg is missing, so no video; pip install -e '.[eval]'")
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        reason = " ".join(str(error).split())
        return Finding("ffmpeg", False, f"imageio-ffmpeg has no working program, so no video: {reason}")
    return Finding("ffmpeg", True, f"imageio-ffmpeg {metadata.version('imageio-ffmpeg')}: encodes the video")


def _torch() -> Finding:
    """Check whether PyTorch is installed."""
    try:
        version = metadata.version("torch")
    except metadata.PackageNotFoundError:
        return Finding(
            "torch",
            True,
            "not installed; only training needs it: pip install -c requirements.lock -e '.[train]'",
        )
    return Finding("torch", True, f"{version}: training can run")


def abilities(findings: list[Finding]) -> Iterator[tuple[str, bool]]:
    """Derive what can run from the findings.

    Args:
        findings: All findings of `examine`.

    Yields:
        Name and possibility of each task, in the order of a first use.
    """
    good = {finding.subject: finding.good for finding in findings}
    runs = good["Python"] and all(good[name] for name in REQUIRED_PACKAGES)
    robot = good["Python"] and all(good[name] for name in ROBOT_PACKAGES)
    shipped = good.get("robot files", True)
    torch = any(finding.subject == "torch" and "training can run" in finding.text for finding in findings)
    yield "a robot's nodes (quadvel up --low-level driver), drive, status", robot
    if shipped:
        yield "quadvel demo, up, run, record, eval, bench", runs
    else:
        yield "quadvel up, run, record, eval, bench with --policy FILE", runs
        yield "quadvel demo: it needs a shipped policy", False
    yield "the video of the demo", runs and shipped and good["GL"] and good["ffmpeg"]
    yield "training", runs and torch


def report(findings: list[Finding]) -> str:
    """Format findings for a bug report, with the versions of all that quadvel depends on.

    It shows no name of a user, a host or an address.

    Args:
        findings: All findings of `examine`.

    Returns:
        Markdown text.
    """
    lines = [
        f"quadvel: {version()}",
        f"system: {_distribution()}, Linux {platform.release()}, {platform.machine()}, {_processor()}",
        *(f"{name}: {os.environ[name]}" for name in REPORTED_VARIABLES if name in os.environ),
        f"packages: {', '.join(_dependencies())}",
        "",
        *(f"{'ok  ' if one.good else 'note'} {one.subject:12} {one.text}" for one in findings),
    ]
    home = str(Path.home())
    text = "\n".join(line.replace(home, "~") if home != "/" else line for line in lines)
    return f"```text\n{text}\n```"


def _distribution() -> str:
    """Name of the operating system."""
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        return platform.system()


def _processor() -> str:
    """Model of the processor and memory of the machine."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(": ")[2] for line in lines if line.startswith(("model name", "Model"))]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{models[0] if models else 'unknown processor'}, {memory:.0f} GiB"


def _dependencies() -> Iterator[str]:
    """Yield name and version of each installed package that quadvel names, with all its extras."""
    try:
        named = metadata.requires("quadvel-core") or []
    except metadata.PackageNotFoundError:  # built by colcon, package by package
        named = [*REQUIRED_PACKAGES]
    names = {re.split(r"[^\w.-]", requirement, maxsplit=1)[0].lower() for requirement in named}
    for name in sorted(names - {"quadvel-core"}):
        try:
            yield f"{name} {metadata.version(name)}"
        except metadata.PackageNotFoundError:
            continue
