"""What these tests need of ROS 2: its environment, our workspace, and processes that end with the test.

ROS 2 is taken from the environment where it is sourced, or from the setup file that QUADVEL_ROS_SETUP names;
where neither is there the tests skip. colcon is looked for next to the interpreter that runs
them, then on PATH.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from quadvel_bringup import nodes

ROOT = Path(__file__).parents[2]
DOMAINS = itertools.cycle(range(int(os.environ["ROS_DOMAIN_ID"]) % 4 + 4, 101, 4))
"""The next for each test, so that none hears what another left; another worker's are not among them."""
RMW_IMPLEMENTATIONS = ("rmw_cyclonedds_cpp", "rmw_fastrtps_cpp")
RMW_INDEX = Path("share/ament_index/resource_index/rmw_typesupport")


class Process:
    """A process in a group of its own, and what it wrote so far."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self.name = " ".join(command)
        self.lines: list[str] = []
        self._popen = subprocess.Popen(
            command,
            env={**environment, "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        with self._popen.stdout as stream:
            for line in stream:
                self.lines.append(line.rstrip())

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def wait(self, seconds: float) -> int:
        """The exit code. Fails the test if the process does not end in time."""
        try:
            code = self._popen.wait(seconds)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.name} still runs after {seconds} s; it wrote:\n{self.text}")
        self._reader.join(5.0)
        return code

    def interrupt(self, times: int = 1, patience: float = 60.0) -> int:
        """Ctrl-C, as a terminal sends it to the whole group; returns the exit code."""
        for _ in range(times):
            os.killpg(self._popen.pid, signal.SIGINT)
            time.sleep(0.05)
        return self.wait(patience)

    def kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._popen.pid, signal.SIGKILL)
        self._popen.wait()
        self._reader.join(5.0)


class Ros:
    """Nodes and commands on one domain: those of ROS 2 with one middleware, and embedded nodes."""

    def __init__(self, environment: Mapping[str, str], rmw: str) -> None:
        own = {
            "ROS_DOMAIN_ID": str(next(DOMAINS)),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_PYTHON_CHECK_FIELDS": "1",
            "OMP_NUM_THREADS": "1",
        }
        self.rmw = rmw
        self.processes: list[Process] = []
        self._ros = {**environment, **own, "RMW_IMPLEMENTATION": rmw}
        self._embedded = {**os.environ, **own, "QUADVEL_MIDDLEWARE": "embedded"}

    def secure(self, keystore: Path) -> None:
        """Have what is started from now on keep to the rights of its SROS 2 enclave."""
        self._ros |= {
            "ROS_SECURITY_KEYSTORE": str(keystore),
            "ROS_SECURITY_ENABLE": "true",
            "ROS_SECURITY_STRATEGY": "Enforce",
        }

    def start(self, *command: str) -> Process:
        """Start a command of ROS 2; it ends with the test."""
        self.processes.append(Process(command, self._ros))
        return self.processes[-1]

    def call(self, *command: str, seconds: float = 60.0) -> str:
        """What a command of ROS 2 wrote. Fails the test if its exit code is not 0."""
        process = self.start(*command)
        code = process.wait(seconds)
        assert code == 0, f"{process.name} ended with {code}:\n{process.text}"
        return process.text

    def node(self, name: str, *arguments: str, embedded: bool = False) -> Process:
        """Start one of our nodes; `arguments` are those after --ros-args."""
        ros_arguments = ["--ros-args", *arguments] if arguments else []
        if not embedded:
            return self.start("ros2", "run", nodes.node_entry(name).package, name, *ros_arguments)
        self.processes.append(Process(nodes.process_command(name, ros_arguments), self._embedded))
        return self.processes[-1]

    def program(self, package: str, name: str, *arguments: str) -> Process:
        """Start an installed program itself, as `ros2 launch` does; `ros2 run` would die of a second Ctrl-C."""
        places = [Path(prefix, "lib", package, name) for prefix in self._ros["AMENT_PREFIX_PATH"].split(":")]
        return self.start(str(next(place for place in places if place.exists())), *arguments)

    def python(self, program: str) -> Process:
        """Start a Python program on the embedded middleware."""
        self.processes.append(Process([sys.executable, "-c", program], self._embedded))
        return self.processes[-1]

    def echo(self, topic: str, kind: str, field: str) -> Callable[[], list[str]]:
        """Listen to one field of a topic; returns a function that gives the values that came so far."""
        process = self.start("ros2", "topic", "echo", "--csv", "--field", field, topic, kind)
        return lambda: [line for line in process.lines if line != "---" and " " not in line]  # no warnings

    def wait_for_nodes(self, *names: str, seconds: float = 90.0) -> None:
        found: list[str] = []

        def all_there() -> bool:
            found[:] = self.call("ros2", "node", "list", "--no-daemon", "--spin-time", "1").split()
            return set(names) <= set(found)

        self.wait_until(all_there, seconds, lambda: f"expected the nodes {names}, found {found}")

    def wait_until(self, predicate: Callable[[], bool], seconds: float, fault: Callable[[], str]) -> None:
        """Wait for a predicate, or fail the test with `fault` and what the processes wrote last."""
        deadline = time.monotonic() + seconds
        while not predicate():
            if time.monotonic() > deadline:
                last = "\n".join("\n".join([f"--- {p.name}", *p.lines[-8:]]) for p in self.processes)
                pytest.fail(f"after {seconds} s: {fault()}\n{last}")
            time.sleep(0.05)

    def close(self) -> None:
        for process in self.processes:
            process.kill()


def sourced(setup: Path, environment: Mapping[str, str]) -> dict[str, str]:
    """The environment after a setup file was sourced in it. Raises RuntimeError."""
    script = f". '{setup}' >&2 && env -0"
    shell = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True)
    if shell.returncode:
        raise RuntimeError(f"{setup} cannot be sourced: {shell.stderr}")
    return dict(variable.split("=", 1) for variable in shell.stdout.split("\0") if variable)


@pytest.fixture(scope="session")
def ros_environment() -> dict[str, str]:
    """Environment of ROS 2, with this interpreter's programs first on PATH."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    if setup := os.environ.get("QUADVEL_ROS_SETUP"):
        environment = sourced(Path(setup), environment)
    if "AMENT_PREFIX_PATH" not in environment:
        pytest.skip("ROS 2 is not here: source its setup file, or name it in QUADVEL_ROS_SETUP")
    if shutil.which("colcon", path=environment["PATH"]) is None:
        pytest.skip("ROS 2 is here but colcon is not: pip install colcon-common-extensions")
    return environment


@pytest.fixture(scope="session")
def workspace(ros_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment of ROS 2 and of ros_ws, which is built from clean, outside the source tree."""
    target = tmp_path_factory.mktemp("ros_ws")
    command = ["colcon", "--log-base", str(target / "log"), "build"]
    command += ["--build-base", str(target / "build"), "--install-base", str(target / "install")]
    build = subprocess.run(
        command,
        cwd=ROOT / "ros_ws",
        env=ros_environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert build.returncode == 0, f"{' '.join(command)} failed:\n{build.stdout[-10_000:]}"
    return sourced(target / "install" / "setup.bash", ros_environment)


@pytest.fixture(params=RMW_IMPLEMENTATIONS)
def ros(request: pytest.FixtureRequest, workspace: dict[str, str]) -> Iterator[Ros]:
    """ROS 2 on a domain of the test's own, once with each middleware that is installed."""
    prefixes = [Path(prefix) for prefix in workspace["AMENT_PREFIX_PATH"].split(":")]
    if not any((prefix / RMW_INDEX / request.param).exists() for prefix in prefixes):
        pytest.skip(f"{request.param} is not installed")
    ros = Ros(workspace, request.param)
    yield ros
    ros.close()
