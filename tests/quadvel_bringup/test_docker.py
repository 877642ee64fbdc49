"""The images by their description: who runs in them, what they contain, and whom they let in. No engine is needed."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from pathlib import Path

import attrs
import pytest

from .test_packages import HEAVY, OPTIONAL, PACKAGES, declared, needed, requirements

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
IN_ROS_CORE = {
    *("builtin_interfaces", "rcl_interfaces", "rmw_dds_common", "rosgraph_msgs"),
    *(
        "diagnostic_msgs",
        "geometry_msgs",
        "nav_msgs",
        "sensor_msgs",
        "std_msgs",
        "std_srvs",
        "visualization_msgs",
    ),
    *("launch", "launch_ros", "rclpy"),
}
"""Of what we declare, what the variant ros_core of REP 2001 has; every ROS 2 image stands on it"""


@attrs.frozen
class Stage:
    """A stage of the Dockerfile, with the instructions of those that it stands on: first the image that it comes from."""

    image: str
    instructions: tuple[tuple[str, str], ...]

    def all(self, kind: str) -> list[str]:
        return [rest for name, rest in self.instructions if name == kind]


def stages() -> dict[str, Stage]:
    lines = [line for line in (DOCKER / "Dockerfile").read_text().splitlines() if not line.startswith("#")]
    found: dict[str, Stage] = {}
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "FROM":
            image, _, name = rest.split()
            found[name] = found.get(image, Stage(image, ()))
        elif kind:
            found[name] = attrs.evolve(found[name], instructions=(*found[name].instructions, (kind, rest)))
    return found


def apt_packages(script: str) -> set[str]:
    text = (DOCKER / script).read_text().replace("\\\n", " ")
    lines = [shlex.split(line) for line in text.splitlines() if line.startswith("apt-get install")]
    return {word for line in lines for word in line[2:] if not word.startswith("-")}


@pytest.mark.parametrize("name", ["sim", "robot"])
def test_nodes_do_not_run_as_root_and_can_write_where_they_run(name: str) -> None:
    stage = stages()[name]
    user = stage.all("USER")[-1]
    assert user not in ("root", "0")
    assert f"useradd --create-home {user}" in stage.all("RUN")
    assert stage.all("WORKDIR")[-1] == f"/home/{user}"
    kinds = [kind for kind, _ in stage.instructions]
    assert "RUN" not in kinds[kinds.index("USER") :]


@pytest.mark.parametrize("name", ["sim", "robot"])
def test_nodes_hear_this_host_alone_unless_told_otherwise(name: str) -> None:
    variables = dict(pair.split("=") for line in stages()[name].all("ENV") for pair in line.split())
    assert variables["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert stages()[name].all("EXPOSE") == []


def test_what_is_run_stands_on_the_image_that_it_was_built_on() -> None:
    assert len({stage.image for stage in stages().values()}) == 1
    assert (stages()["base"].all("RUN"), stages()["run"].all("RUN")[0]) == (
        ["/install-runtime"],
        "/install-runtime",
    )


def test_packages_of_ros_that_ours_declare_are_in_the_image() -> None:
    names = set.union(*map(declared, PACKAGES)) - set(PACKAGES) - IN_ROS_CORE
    of_ros = {f"ros-jazzy-{name.replace('_', '-')}" for name in names if not name.startswith("python3-")}
    assert of_ros <= apt_packages("install-runtime")


def build(name: str) -> tuple[set[str], set[str]]:
    """Distributions that pip installs into an image, and packages of quadvel that colcon builds."""
    lines = stages()[f"build-{name}"].all("RUN")
    extras = [words[1:] for words in map(str.split, lines) if words[0] == "docker/install-deps"][-1]
    default = re.search(r'--editable "\.\[\$\{1:-(.+?)\}\]"', (DOCKER / "install-deps").read_text())
    assert default is not None
    up_to = re.search(r"--packages-up-to (.+)", lines[-1])
    packages = set.union(*map(needed, up_to[1].split())) if up_to else set(PACKAGES)
    return requirements(*(extras[0] if extras else default[1]).split(",")), packages


def test_the_image_of_the_simulator_has_everything() -> None:
    distributions, packages = build("sim")
    assert {"evdev", "foxglove-sdk", "imageio-ffmpeg", "mujoco", "viser", "websockets"} <= distributions
    assert packages == set(PACKAGES)
    assert "docker/install-runtime" in (DOCKER / "install-deps").read_text().splitlines()


def test_the_image_of_the_robot_has_no_laboratory() -> None:
    distributions, packages = build("robot")
    assert packages & OPTIONAL == {"quadvel_follow"}
    assert distributions & HEAVY == {"scipy"}  # of quadvel_follow
    assert {"evdev", "mcap", "onnxruntime", "viser", "websockets"} <= distributions


@pytest.mark.parametrize("name", ["sim", "robot"])
def test_an_image_takes_what_was_built_for_it(name: str) -> None:
    from_stages = re.findall(r"--from=(\S+)", " ".join(stages()[name].all("COPY")))
    assert set(from_stages) == {f"build-{name}"}


def test_files_that_the_images_take_are_there_and_scripts_can_be_read() -> None:
    for line in stages()["base"].all("COPY"):
        assert all((ROOT / file).is_file() for file in line.split()[:-1])
    for script in ("entrypoint", "install-deps", "install-runtime"):
        assert os.access(DOCKER / script, os.X_OK)
        subprocess.run(["bash", "-n", DOCKER / script], check=True)
