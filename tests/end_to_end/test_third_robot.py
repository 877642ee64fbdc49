"""From the file of a new robot to a robot that stands, by the steps of the page "Bring your own robot"."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest

from quadvel_actuator import ActuatorParameters
from quadvel_bringup import cli
from quadvel_bringup.processes import ProcessGroup
from quadvel_description.found_robot import find_robot
from quadvel_description.kinematics import foot_positions
from quadvel_description.mjcf import Plant, load_model
from quadvel_description.quadruped import LEGS
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_folder import robot_files
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_eval import robot_check
from quadvel_eval.robot_loop import RobotLoop
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import GO2
from tests.helpers.third_robot import (
    BASH,
    check_third_robot,
    complete_third_robot,
    page_cells,
    write_third_robot,
)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which the steps of the page were taken, up to the complete robot."""
    folder = tmp_path_factory.mktemp("page")
    check_third_robot(folder)
    with pytest.raises(ValueError, match="kp, kd, velocity_limit, armature: found 'to_decide'"):
        load_robot(str(folder / "out/third"))
    complete_third_robot(folder)
    return folder


@pytest.fixture(scope="module")
def third(page: Path) -> Robot:
    return load_robot(str(page / "out/third"))


def test_the_folder_describes_the_robot_of_the_file(page: Path, third: Robot) -> None:
    """Equal inertia matrices and feet at random angles: names, order, signs, places and inertias are right."""
    found = find_robot(page / "third.xml")
    original, ours = (
        mujoco.MjModel.from_xml_path(str(page / "third.xml")),
        load_model(third, Plant(armature=np.zeros(12))),
    )
    q = np.random.default_rng(1).uniform(third.lower, third.upper)
    own = np.zeros(12)
    for joint, angle in zip(found.joints, q, strict=True):
        own[joint.number] = joint.sign * angle
    order = [joint.number for joint in found.joints]
    signs = np.concatenate([np.ones(6), [joint.sign for joint in found.joints]])
    expected = _mass_matrix(original, own)[np.ix_(*2 * [[*range(6), *(6 + n for n in order)]])]
    np.testing.assert_allclose(_mass_matrix(ours, q), expected * np.outer(signs, signs), atol=1e-9)
    data = mujoco.MjData(ours)
    data.qpos[7:] = q
    mujoco.mj_forward(ours, data)
    feet = [data.geom(f"{leg}_foot").xpos - data.body("trunk").xpos for leg in LEGS]
    np.testing.assert_allclose(feet, foot_positions(third, q), atol=1e-9)


def _mass_matrix(model: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    data, full = mujoco.MjData(model), np.zeros((18, 18))
    data.qpos[:7], data.qpos[7:] = [0, 0, 1, 1, 0, 0, 0], q
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    return full


def test_its_rear_knees_bend_forward_in_the_proposed_postures(third: Robot) -> None:
    np.testing.assert_array_equal(third.legs.knees, [-1, -1, 1, 1])
    feet = foot_positions(third, np.array([third.nominal_q, third.lie_q]))
    np.testing.assert_allclose(feet[..., 0], np.tile([0.28, 0.28, -0.28, -0.28], (2, 1)), atol=1e-4)
    assert third.nominal_height == pytest.approx(0.75 * 0.5 + 0.025, abs=1e-3)
    assert third.lie_height < 0.2


def test_without_an_actuator_file_it_has_a_plain_pd_law(third: Robot) -> None:
    parameters = ActuatorParameters.of(third)
    assert (parameters.robot, parameters.kp_ref, parameters.delta_kp, parameters.effects) == (
        "third",
        22.0,
        0.0,
        (),
    )
    np.testing.assert_array_equal(parameters.torque_limit, third.torque_limit)


def test_it_stands_up_withstands_a_push_and_lies_down(third: Robot) -> None:
    simulator = Simulator(SimulatorConfig(robot=third))
    loop = RobotLoop(simulator, Supervisor(third, None), KalmanEstimator(third))
    loop.tick()
    assert loop.supervisor.request("stand_up")[0]
    assert _run(loop, 2.5) == "stance"
    assert loop.tick().truth.position[2] == pytest.approx(third.nominal_height, abs=0.02)
    assert loop.supervisor.request("walk") == (False, "there is no policy to walk with")
    simulator.push("trunk", (0.0, 60.0, 0.0))
    loop.tick((0.5, 0.0, 0.0))
    assert loop.supervisor.walk_refusal == "there is no policy to walk with"
    assert _run(loop, 1.0) == "stance"
    assert not simulator.fallen
    assert loop.supervisor.request("lie_down")[0]
    assert _run(loop, 1.5) == "passive"
    assert loop.tick().truth.position[2] == pytest.approx(third.lie_height, abs=0.04)


def _run(loop: RobotLoop, seconds: float) -> str:
    for _ in range(round(seconds / 0.005)):
        mode = loop.tick().mode
    return mode


def test_the_folder_of_a_shipped_robots_urdf_is_that_robot(tmp_path: Path) -> None:
    for name, text in robot_files(find_robot(GO2.urdf_file)).items():
        (tmp_path / name).write_text(re.sub("^(kp|kd|armature): to_decide", r"\1: 1.0", text, flags=re.M))
    again = load_robot(str(tmp_path))
    for field in ("torque_limit", "velocity_limit", "lower", "upper", "command_lower", "foot_radius"):
        np.testing.assert_allclose(getattr(again, field), getattr(GO2, field), err_msg=field)
    assert again.mass == pytest.approx(GO2.mass)
    q = np.random.default_rng(1).uniform(GO2.lower, GO2.upper)
    np.testing.assert_allclose(foot_positions(again, q), foot_positions(GO2, q), atol=1e-9)


def test_a_folder_with_a_robot_is_kept_unless_forced(tmp_path: Path) -> None:
    file = write_third_robot(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / "robot.yaml").write_text("mine")
    line = [str(file), "--out", str(out)]
    with pytest.raises(FileExistsError, match=r"robot\.yaml: exists, expected none; --force replaces it"):
        cli.command("robot check").main(line, standalone_mode=False)
    assert [*out.iterdir()] == [out / "robot.yaml"]
    assert (out / "robot.yaml").read_text() == "mine"
    cli.command("robot check").main([*line, "--force"], standalone_mode=False)
    assert (out / "robot.yaml").read_text().startswith("# third")


def test_all_files_are_written_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = find_robot(write_third_robot(tmp_path))

    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(robot_check, "write_figure", full)
    with pytest.raises(OSError, match="no space left"):
        robot_check.write_robot_folder(found, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_commands_of_the_page_stand_it_up(page: Path) -> None:
    said: list[str] = []
    with ProcessGroup(lambda process, line: said.append(line)) as group:
        for cell in page_cells("Let it stand", "Check your model against your robot's motion"):
            if terminal := re.search(r'Terminal\(\s*"quadvel (.*?)",\s*ready="(.*?)"', cell):
                words, ready = terminal.groups()
                group.start(
                    words, ["env", "-C", str(page), sys.executable, "-m", "quadvel_bringup", *words.split()]
                )
                until = time.monotonic() + 120.0
                while not any(ready in line for line in said):
                    assert not group.ended(), said
                    assert time.monotonic() < until, said
                    time.sleep(0.1)
            else:
                line = cell.removeprefix(BASH).replace("quadvel", f"{sys.executable} -m quadvel_bringup")
                ended = subprocess.run(
                    line, shell=True, cwd=page, capture_output=True, text=True, timeout=120, check=False
                )
                assert ended.returncode == 0, f"{cell}\n{ended.stdout}{ended.stderr}"
        codes = group.stop()
    assert not any(codes.values()), f"{codes}: {said[-5:]}"
