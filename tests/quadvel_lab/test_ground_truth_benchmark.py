"""The plants of the twin: physics against closed form, hidden from all but their own process; and the page."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rich.console import Console

from quadvel_actuator import ActuatorParameters
from quadvel_description.state import JointCommand, RobotState
from quadvel_lab import plant as plant_module
from quadvel_lab.ground_truth_benchmark import PLANTS, SHIPPED, WALKS, _identify, plant_nodes
from quadvel_lab.ground_truth_page import summary_sentence, twin_page
from quadvel_lab.plant import ChafingCable, DryGear, HiddenDrives, Plant, SlowCurrent, read_plant
from quadvel_sim import SimulatorConfig
from tests.helpers.robots import ALIENGO

DT = 0.001
ZERO = np.zeros(12)


def full(value: float) -> np.ndarray:
    return np.full(12, value)


@pytest.mark.parametrize("speed", [-3.0, 0.1, 0.4, 12.0])
def test_a_dry_gear_turned_at_constant_speed_resists_with_its_stribeck_level(speed: float) -> None:
    gear = DryGear(slip=full(0.7), stick=full(1.1))
    for _ in range(400):
        torque = gear.torque(ZERO, ZERO, full(speed), DT)
    level = 0.7 + (1.1 - 0.7) * np.exp(-((speed / 0.25) ** 2))
    np.testing.assert_allclose(torque, -np.sign(speed) * level, rtol=1e-3)


def test_a_dry_gear_gives_way_like_a_spring_before_it_slips() -> None:
    gear = DryGear(slip=full(0.7), stick=full(1.1), stiffness=250.0)
    torque = [gear.torque(ZERO, ZERO, full(0.01), DT)[0] for _ in range(20)]
    np.testing.assert_allclose(torque, [-250.0 * 0.01 * DT * (i + 1) for i in range(20)], rtol=0.05)


def test_a_slow_current_answers_a_step_as_its_winding_lets_it() -> None:
    drive = SlowCurrent(constant=full(0.005), droop=full(0.1))
    drive.torque(ZERO, ZERO, ZERO, DT)
    torque = np.array([drive.torque(full(4.0), ZERO, ZERO, DT)[0] for _ in range(30)])
    edges = 4.0 * 0.005 * np.exp(-np.arange(31) * DT / 0.005)
    np.testing.assert_allclose(torque, 4.0 + np.diff(edges) / DT, rtol=1e-9)  # the mean over each ms
    held = [drive.torque(full(4.0), ZERO, full(2.0), DT)[0] for _ in range(100)]
    assert held[-1] == pytest.approx(4.0 - 0.1 * 2.0)  # what the back-EMF takes off


def test_a_cable_rubs_in_its_part_of_the_range_alone() -> None:
    cable = ChafingCable(rub=full(2.0), begin=full(-1.35))
    np.testing.assert_allclose(cable.torque(ZERO, full(-1.8), full(5.0), DT), 0.0, atol=1e-3)
    np.testing.assert_allclose(cable.torque(ZERO, full(-0.9), full(5.0), DT), -2.0 * 1.4, atol=1e-3)
    np.testing.assert_allclose(cable.torque(ZERO, full(-0.9), full(-5.0), DT), 2.0 * 0.6, atol=1e-3)


@pytest.mark.parametrize("name", SHIPPED)
def test_reading_a_plants_state_does_not_alter_its_run(name: str) -> None:
    physics = read_plant(PLANTS / f"{name}.yaml")
    ends = []
    for looks in (False, True):
        plant = Plant(SimulatorConfig(robot=ALIENGO, seed=1), physics)
        plant.reset("stand")
        for step in range(120):
            target = ALIENGO.nominal_q + 0.2 * np.sin(0.05 * step)
            plant.command(JointCommand(q=target, kp=full(30.0), kd=full(0.5)))
            if looks:
                plant.state()
            plant.step()
        ends.append(plant.data.qpos.copy())
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-12)


def test_a_plant_logs_its_state_every_ms_however_seldom_it_is_read() -> None:
    logged: list[RobotState] = []
    plant = Plant(
        SimulatorConfig(robot=ALIENGO, seed=1), read_plant(PLANTS / "slow_current.yaml"), logged.append
    )
    plant.reset("stand")
    for _ in range(3):
        state = plant.state()
        assert logged[-1] is state
        plant.step(5)
    assert [one.tick for one in logged] == [*range(15)]


def test_what_a_plant_reports_is_the_torque_that_its_joints_get() -> None:
    plant = Plant(SimulatorConfig(robot=ALIENGO, seed=1), read_plant(PLANTS / "slow_current.yaml"))
    plant.reset("stand")
    plant.command(JointCommand(q=np.array(ALIENGO.nominal_q), kp=full(30.0), kd=full(0.5)))
    plant.step(5)
    reported = plant.state().tau
    plant.step()
    np.testing.assert_array_equal(reported, plant.data.ctrl)


def test_the_noise_of_hidden_drives_is_that_of_the_stacks_model() -> None:
    parameters = ActuatorParameters.of(ALIENGO)
    still = DryGear(slip=ZERO, stick=ZERO)
    drives = HiddenDrives(parameters, still, ALIENGO.torque_limit, DT, seed=0)
    torque = [drives.step(ZERO, ZERO, ZERO, 30.0, 0.5) for _ in range(2000)]
    assert np.var(torque) == pytest.approx(parameters.torque_noise, rel=0.05)


def test_only_the_plants_process_is_told_of_its_file() -> None:
    nodes = plant_nodes(PLANTS / "dry_gears.yaml", seed=4)
    named = [name for name, line in nodes.items() if any("dry_gears" in word for word in line)]
    assert named == ["sim_node"]
    assert set(nodes) == {"sim_node", "estimator", "controller", "command_mux"}
    assert "seed:=4" in nodes["sim_node"]


def test_the_nodes_follow_the_board_and_the_recording_holds_the_plants_log() -> None:
    nodes = plant_nodes(PLANTS / "dry_gears.yaml", seed=0)
    followers = {name for name, line in nodes.items() if "low_state:=board/low_state" in line}
    assert followers == {"sim_node", "estimator", "controller"}
    assert "joint_log:=low_state" in nodes["sim_node"]


def test_the_plants_physics_knows_nothing_of_what_identification_fits() -> None:
    tree = ast.parse(Path(plant_module.__file__).read_text())
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not any("effects" in str(name) or "sysid" in str(name) for name in imported)
    for plant in PLANTS.glob("*.yaml"):
        assert "_friction" not in plant.read_text()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("kind: rust", "kind: found 'rust', expected one of dry_gear, slow_current, chafing_cable"),
        ("kind: [", "no valid YAML"),
        ("kind: dry_gear\nslip: {FR_knee: 1.0}\nstick: {}", "slip: joint names: found 'FR_knee'"),
        (
            "kind: dry_gear\nslip: much\nstick: {}",
            "slip: found 'much', expected one number or a list of 12",
        ),
        ("kind: dry_gear\nslip: {}", "stick: found nothing, expected a value"),
        (
            "kind: dry_gear\nslip: {}\nstick: {}\nwear: 1.0",
            "found the field 'wear', expected one of slip, stick",
        ),
    ],
)
def test_a_file_that_describes_no_plant_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=f"^{re.escape(str(file))}: .*{re.escape(sentence)}"):
        read_plant(file)


def entry(name: str, after: float) -> dict[str, Any]:
    def model(scale: float) -> dict[str, Any]:
        tracking = {"xy": 0.05 * scale, "wz": 0.04 * scale}
        errors = {"torque_mse": 0.8 * scale, "tau": 1.0 * scale, "q": 0.02 * scale, "dq": 0.9 * scale}
        growth = [0.002 * scale * step for step in range(20)]
        return {**errors, "stretches": 70, "growth": growth, "tracking": tracking}

    return {
        "name": name,
        "decision": f"Add friction to {name} <now>.",
        "effects": ["stribeck_friction"],
        "fit": {"eam": 0.7, "corrected": 0.07},
        "noise_floor": 0.066,
        "segments": [
            {"command": [0.5, 0.0, 0.0], "plant": [0.44, 0, 0], "before": [0.5, 0, 0], "after": [0.45, 0, 0]}
        ],
        "repeat": {"xy": 0.004, "wz": 0.01},
        "before": model(1.0),
        "after": model(after),
    }


def test_the_page_says_by_how_much_the_corrected_models_are_nearer() -> None:
    results = [entry("dry_gears", 0.1), entry("slow_current", 0.3)]
    assert summary_sentence(results) == (
        "With what was identified on 2 plants, the model's torque error falls by 80 %, its open-loop error of q "
        "falls by 80 % and of dq falls by 80 %, the gap of its velocity tracking falls by 80 %."
    )
    page = twin_page(results)
    assert page.index("80 %") < page.index("dry_gears") < page.index("slow_current")
    for text in (
        "Add friction to dry_gears &lt;now&gt;.",
        "dry_gears/identify/report.html",
        "+0.440, +0.000",
        "90 %",
        "0.8 → <b>0.24</b>",
    ):
        assert text in page
    ids = re.findall(r' id="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_the_page_owns_up_to_a_model_that_got_worse() -> None:
    assert "torque error grows by 25 %" in summary_sentence([entry("dry_gears", 1.25)])
    assert "-25 %" in twin_page([entry("dry_gears", 1.25)])


def test_a_file_that_is_no_plant_ends_its_process_in_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text("kind: rust")
    line = [sys.executable, "-m", "quadvel_lab.plant", str(file)]
    ended = subprocess.run(line, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"plant: {file}: kind: found 'rust'")
    assert ended.stderr.count("\n") == 1


def test_a_plant_that_cannot_be_identified_is_named_with_the_reason(tmp_path: Path) -> None:
    for walk in WALKS:
        (tmp_path / f"{walk}.mcap").write_text("no recording")
    said = Console(record=True, soft_wrap=True)
    with pytest.raises(typer.Exit) as ended:
        _identify({"rusty": tmp_path}, said)
    assert ended.value.exit_code == 2
    assert re.search(r"rusty was not identified: quadvel: .*walk_1\.mcap", said.export_text())
    assert {path.name for path in tmp_path.iterdir()} == {f"{walk}.mcap" for walk in WALKS}
