"""Content of the run directory of stage 3."""

from __future__ import annotations

import json

import attrs
import pytest
from typer.testing import CliRunner

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_actuator import ActuatorParameters, Effect  # noqa: E402
from quadvel_description.quadruped import JOINT_NAMES  # noqa: E402
from quadvel_policy.policy_file import PolicyFile  # noqa: E402
from quadvel_training import loop, run_folder, stages  # noqa: E402
from quadvel_training.__main__ import app  # noqa: E402
from quadvel_training.constrained import ConstrainedConfig  # noqa: E402
from quadvel_training.loop import Budget  # noqa: E402
from quadvel_training.networks import Recurrent  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402


@pytest.fixture
def drives(tmp_path):
    """An actuator file with an effect that is known within an interval."""
    effect = Effect("coulomb_friction", JOINT_NAMES, {"c": 0.5, "v_0": 0.05}, {}, {"c": [0.3, 0.7]})
    path = tmp_path / "actuator.yaml"
    attrs.evolve(ActuatorParameters.of(ALIENGO), effects=(effect,)).save(path)
    return path


def test_a_run_keeps_what_it_is_and_how_it_fared(tmp_path, monkeypatch, drives):
    torch.manual_seed(0)
    figures = {"falls": 1, "mean_error_xy": 0.1, "max_error_xy": 0.2}
    setups = []
    monkeypatch.setattr(run_folder, "_evaluate", lambda setup: setups.append(setup) or figures)
    start, folder = tmp_path / "start.pt", tmp_path / "run"
    loop.save({"average": Recurrent(48, 12).state_dict(), "samples": 7}, start)
    config = ConstrainedConfig(
        n=2, length=3, threads=1, keep=10, actuator=str(drives), budget=Budget(15, 1.0)
    )
    assert stages.train_policy(config, tmp_path / "mine.yaml", start, None, folder, "cpu")

    about = json.loads((folder / "run.json").read_text())
    assert (about["stage"], about["recipe"], about["configuration"]["n"]) == ("constrained", "mine", 2)
    assert about["commit"]
    kept = sorted(path.name for path in (folder / "kept").iterdir())
    assert kept == [f"000000k.{suffix}" for suffix in ("json", "onnx", "pt")]
    assert json.loads((folder / "kept" / kept[0]).read_text()) == figures
    assert [one.plant["actuator"] for one in setups] == [ActuatorParameters.load(ALIENGO, drives)]
    assert (
        PolicyFile(ALIENGO, folder / "kept" / kept[1]).metadata.actuator["effects"][0]["name"]
        == "coulomb_friction"
    )
    assert loop.load(folder / "kept" / kept[2])["samples"] == 12

    training_record = run_folder.training_record("constrained", None, config, folder / stages.POLICY)
    assert training_record["samples"] == 18
    assert training_record["hours"] >= 0.0
    assert training_record["configuration"]["actuator"] == drives.name  # in a file that goes elsewhere


def test_actuators_of_some_joints_are_refused_before_training(tmp_path, drives):
    some = ("FR_hip_joint", "FR_thigh_joint", "FR_calf_joint")
    attrs.evolve(ActuatorParameters.load(ALIENGO, drives), joints=some, effects=()).save(drives)
    start = tmp_path / "start.pt"
    start.touch()
    arguments = ["tune", "--actuator", str(drives), "--policy", str(start), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "joints: found 3" in result.output
    assert not (tmp_path / "out").exists()
