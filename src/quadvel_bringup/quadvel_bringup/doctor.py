"""What this machine has, and what of quadvel it can run. Looks, and changes nothing."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import metadata, util

import attrs
import numpy as np

import quadvel_dds

NEEDED = ("mujoco", "onnx", "onnxruntime", "cyclonedds", "rosbags", "mcap", "numpy", "scipy")
FILES = ("actuator", "policy")
"""Values of /diagnostics that say with which files a node runs"""
GL_BACKENDS = ("egl", "osmesa")
GL_PACKAGES = "libegl1 libopengl0"


@attrs.frozen
class Finding:
    """One line: what was looked at, whether it is as it should be, and what was found."""

    subject: str
    good: bool
    text: str


def examine() -> Iterator[Finding]:
    """All findings, one after the other, as they are made."""
    yield _python()
    yield _cores()
    yield _middleware()
    yield from map(_package, NEEDED)
    yield _clock()
    yield _priority()
    yield _gl()
    yield video_encoder()
    yield _torch()
    yield _robot()


def _robot() -> Finding:
    """Which robot runs, and on which actuator model."""
    try:
        quadvel_dds.install()
        from .status import look
        from .whereabouts import whereabouts
    except ImportError as error:
        return Finding("robot", True, f"not looked for: {error}")
    nodes = look()
    if not nodes:
        return Finding(
            "robot",
            True,
            f"none runs; `quadvel up` takes the shipped actuator model (Table 4); {whereabouts()}",
        )
    told = [f"{key} {node.values[key]}" for node in nodes.values() for key in FILES if key in node.values]
    return Finding(
        "robot", True, f"{', '.join(nodes)} run; {', '.join(told) or 'with files that none tells'}"
    )


def _python() -> Finding:
    good = (3, 11) <= sys.version_info[:2] <= (3, 13)
    text = f"{platform.python_version()}" if good else f"{platform.python_version()}, expected 3.11 to 3.13"
    return Finding("Python", good, text)


def _cores() -> Finding:
    number = len(os.sched_getaffinity(0))
    return Finding("cores", number >= 2, f"{number}" if number >= 2 else f"{number}; real time wants two")


def _middleware() -> Finding:
    distro = os.environ.get("ROS_DISTRO", "an unnamed distribution")
    if util.find_spec("rclpy") is None:
        return Finding("ROS 2", True, "not found in this shell: the nodes run on the embedded Cyclone DDS")
    if os.environ.get("QUADVEL_MIDDLEWARE") == "embedded":
        return Finding("ROS 2", True, f"{distro}, left aside: QUADVEL_MIDDLEWARE is 'embedded'")
    if fault := quadvel_dds.ros2_fault():
        return Finding("ROS 2", True, fault)
    rmw = os.environ.get("RMW_IMPLEMENTATION", "its default middleware")
    text = f"{distro} with {rmw}: the nodes run on its rclpy"
    if not _has_executor_of_events():
        text += "; real time on two cores wants its executor of events, of rclpy 7.1.4 or newer"
    return Finding("ROS 2", True, text)


def _has_executor_of_events() -> bool:
    try:
        return util.find_spec("rclpy.experimental") is not None
    except ImportError:  # the embedded middleware's answer for what it does not offer
        return False


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, metadata.version(name))
    except metadata.PackageNotFoundError:
        return Finding(name, False, "missing: make setup")


def _clock(period: float = 0.005, ticks: int = 100) -> Finding:
    """How late a sleep to a deadline ends, at the controller's rate."""
    late = np.empty(ticks)
    deadline = time.monotonic()
    for i in range(ticks):
        deadline += period
        time.sleep(max(deadline - time.monotonic(), 0.0))
        late[i] = time.monotonic() - deadline
    median, p99 = 1e3 * np.quantile(late, (0.5, 0.99))
    text = f"at 200 Hz, wakes {median:.2f} ms late (median), {p99:.2f} ms (99 %)"
    good = bool(p99 < 2.0)
    return Finding("clock", good, text if good else f"{text}; the machine is busy, loops will overrun")


def gl_backend() -> str | None:
    """The first of MuJoCo's off-screen backends that draws here, or None. Tried in processes of their own."""
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
    """Real-time priority, tried in a process of its own, which ends at once."""
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    permitted = subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0
    refused = "real time not permitted, so all programs share the cores alike; see rtprio in limits.conf(5)"
    return Finding("priority", True, "real time is permitted" if permitted else refused)


def _gl() -> Finding:
    backend = gl_backend()
    if backend is None:
        return Finding("GL", False, f"no off-screen GL, so no video; sudo apt install {GL_PACKAGES}")
    return Finding("GL", True, f"{backend}: draws off screen")


def video_encoder() -> Finding:
    """The program that makes a video of pictures, tried: the package may be there without it."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        subprocess.run([get_ffmpeg_exe(), "-version"], capture_output=True, check=True)
    except ImportError:
        return Finding("ffmpeg", False, "imageio-ffmpeg is missing, so no video; pip install -e '.[video]'")
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        reason = " ".join(str(error).split())
        return Finding("ffmpeg", False, f"imageio-ffmpeg has no program that runs, so no video: {reason}")
    return Finding("ffmpeg", True, f"imageio-ffmpeg {metadata.version('imageio-ffmpeg')}: encodes the video")


def _torch() -> Finding:
    try:
        version = metadata.version("torch")
    except metadata.PackageNotFoundError:
        return Finding("torch", True, "not installed; only training needs it: pip install -e '.[train]'")
    return Finding("torch", True, f"{version}: training can run")


def abilities(findings: list[Finding]) -> Iterator[tuple[str, bool]]:
    """What can be run with that, in the order in which one would try it."""
    good = {finding.subject: finding.good for finding in findings}
    runs = good["Python"] and all(good[name] for name in NEEDED)
    torch = any(finding.subject == "torch" and "training can run" in finding.text for finding in findings)
    yield "quadvel demo, up, run, record", runs
    yield "quadvel eval, bench", runs
    yield "the video of the demo", runs and good["GL"] and good["ffmpeg"]
    yield "training", runs and torch
