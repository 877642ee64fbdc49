"""The contest of identifications: logs tell nothing of their truth, and the judge counts what is right."""

from __future__ import annotations

import json
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import provenance
from benchmarks.identification import __main__ as program
from benchmarks.identification import contest, entrants, judge
from quadvel_actuator import ActuatorParameters, DelayPair
from quadvel_sysid.data.plain_model import fit_eam
from quadvel_sysid.data.signals import Samples
from tests.helpers.robots import ALIENGO


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A contest of two logs: one without an effect, one with Coulomb friction."""
    made = tmp_path_factory.mktemp("contest")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(contest.KINDS, "tiny", {"first": ("none", "coulomb_friction")})
        contest.publish("tiny", 3, made)
    return made


def test_the_logs_tell_neither_their_kind_nor_their_last_torques(folder: Path) -> None:
    truths = contest.read_truth(folder / "truth")
    assert sorted(truth["kind"] for truth in truths.values()) == ["coulomb_friction", "none"]
    files = sorted((folder / "logs").iterdir())
    assert [file.name for file in files] == ["log_000.npz", "log_001.npz"]
    for file in files:
        with np.load(file, allow_pickle=False) as arrays:
            assert set(arrays.files) <= {
                *("t", "q", "dq", "tau", "t_cmd", "q_des_cmd", "kp", "kd", "joint_names"),
                *("temperature", "voltage"),
            }
            missing = np.isnan(arrays["tau"]).all(axis=1)
        assert missing.mean() == pytest.approx(contest.PREDICTED_SHARE, abs=0.001)
        assert missing[-1]
        assert np.shape(truths[file.stem]["torque"])[0] == missing.sum()


def test_entrants_predict_what_they_model(folder: Path) -> None:
    truths = contest.read_truth(folder / "truth")
    for shared in contest.shared_logs(folder / "logs"):
        truth = truths[shared.name]
        plain, pd, friction = (
            judge.judge_log(entrant(shared).to_json(), truth)
            for entrant in (entrants.plain_eam, entrants.joint_pd, entrants.friction_pd)
        )
        if truth["kind"] == "none":
            assert plain["error"] < 1.1
            assert friction["right"]
        else:
            assert friction["error"] < 0.9 * pd["error"]
            assert friction["right"]
            assert friction["joints"]
            assert max(friction["params"]) < 0.3


def test_an_actuator_model_run_on_a_log_gives_the_torque_of_the_plain_model(folder: Path) -> None:
    (shared,) = (
        one
        for one in contest.shared_logs(folder / "logs")
        if contest.read_truth(folder / "truth")[one.name]["kind"] == "none"
    )
    samples = Samples.of([shared.log])
    eam = fit_eam(samples, np.repeat(shared.known[:, None], len(shared.log.joints), axis=1), windows=(0.0,))
    kp, kd = (float(np.median(gains)) for gains in (shared.log.kp, shared.log.kd))
    parameters = attrs.evolve(
        ActuatorParameters.of(ALIENGO),
        kp_ref=kp,
        kd_ref=kd,
        delta_kp=kp * (float(eam.gains[0, 0]) - 1.0),
        delta_kd=kd * (float(eam.gains[1, 0]) - 1.0),
        pairs=(DelayPair(float(eam.input_delay[0]), float(eam.output_delay[0]), 0.0),),
    )
    difference = entrants.modelled_torque(parameters, shared.log) - eam.predict(samples)
    assert np.sqrt(np.mean(difference[100:] ** 2)) < 0.2 * eam.mse**0.5


TRUTH: dict[str, Any] = {
    "group": "alone",
    "floor": 0.5,
    "torque": [[1.0], [2.0]],
    "joints": ["A_hip_joint"],
    "effects": [{"name": "cogging", "joints": ["A_hip_joint"], "params": {"a": 0.4}, "signals": {}}],
}


def test_the_judge_counts_name_joints_parameter_and_prediction() -> None:
    effect = {"name": "cogging", "joints": ["A_hip_joint"], "params": {"a": {"value": 0.42}}}
    found = judge.judge_log({"effects": [effect], "torque": [[1.0], [3.0]]}, TRUTH)
    assert (found["right"], found["joints"]) == (True, True)
    assert found["params"] == [pytest.approx(0.05)]
    assert found["error"] == pytest.approx(1.0)


def test_an_answer_without_names_counts_by_its_prediction_alone() -> None:
    found = judge.judge_log({"torque": [[1.0], [2.0]]}, TRUTH)
    assert (found["right"], found["joints"], found["params"], found["error"]) == (False, False, [], 0.0)
    row = judge.judgement_table([{"entrant": "mine", "logs": {"log_000": found}}]).splitlines()[-1]
    assert row == "| mine | 0 of 1 | 0 of 1 | – | 0.00, 0.00 | – |"


def test_a_missing_or_short_prediction_is_refused_by_the_name_of_its_log(tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    for logs, found in (({}, r"\(0,\)"), ({"log_000": {"torque": [[1.0]]}}, r"\(1, 1\)")):
        file.write_text(json.dumps({"schema": 1, "entrant": "mine", "logs": logs}))
        with pytest.raises(ValueError, match=rf"logs/log_000/torque: found shape {found}, expected \(2, 1\)"):
            judge.read_answers(file, {"log_000": TRUTH})


def test_without_torch_the_entrant_that_needs_it_is_left_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def version_here(name: str) -> str:
        if name == "torch":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr(provenance, "version", version_here)
    monkeypatch.setattr(program, "ENTRANTS", dict.fromkeys(("joint_pd", "network"), entrants.joint_pd))
    done = CliRunner().invoke(program.app, ["enter", "--folder", str(folder)])
    assert done.exit_code == 0, done.output
    assert "left out: network" in done.output
    content = json.loads((folder / "answers" / "joint_pd.json").read_text())
    assert "numpy" in content["versions"]
    assert "torch" not in content["versions"]
    assert CliRunner().invoke(program.app, ["enter", "network", "--folder", str(folder)]).exit_code == 2
