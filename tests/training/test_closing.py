"""The closed loop as one command: each step once, with the files of the step before, in any folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_eval.paper.files import write_records
from quadvel_eval.paper.gap import TRAINED
from quadvel_training import closing


def given(out: Path) -> tuple[str, Path, Path, Path, float, Path]:
    return "drives of the go2", Path("policy.onnx"), Path("dagger.pt"), Path("privileged.pt"), 2.0, out


def records(ratios: dict[str, float], falls_after: int = 0) -> list[dict]:
    """Records of ten walks a plant: the tuned policy's errors are `ratios` of those before, and vary by 10 %."""
    return [
        {
            "policy": policy,
            "level": plant,
            **{"vx": walk, "vy": 0, "wz": 0, "seed": 0},
            "error_xy": 0.02 * (1.0 if policy == "before" else ratio * (0.9 + 0.2 * (walk % 2))),
            "fell": int(policy == "after" and walk < falls_after),
        }
        for plant, ratio in ratios.items()
        for policy in ("before", "after")
        for walk in range(10)
    ]


@pytest.mark.parametrize(
    ("on_plant", "as_trained", "falls", "accepted"),
    [
        (0.7, 1.0, 0, True),
        (0.7, 1.03, 0, True),  # within the scatter of the walks
        (0.97, 1.0, 0, False),
        (1.3, 1.0, 0, False),
        (0.7, 1.3, 0, False),
        (0.7, 1.0, 1, False),
        (0.7, 1.0, 10, False),
    ],
)
def test_a_tuned_policy_is_refused_unless_it_is_better(on_plant, as_trained, falls, accepted):
    walks = records({"friction": on_plant, TRAINED: as_trained}, falls)
    reason = closing.refusal(*(closing.Comparison.of(walks, plant) for plant in ("friction", TRAINED)))
    assert bool(reason) is not accepted


def test_steps_whose_files_are_there_are_not_run_again(tmp_path, monkeypatch, capsys):
    out, ran = tmp_path / "a loop", []

    def run(command, check):
        assert check
        ran.append(command)
        file = next(file for file, arguments in closing.fill_steps(*given(out)) if arguments == command[1:])
        file.parent.mkdir(exist_ok=True)
        file.touch()
        write_records(file.with_name("gap.csv"), records({"drives of the go2": 0.5, TRAINED: 1.0}))

    monkeypatch.setattr(subprocess, "run", run)
    assert not closing.close_the_loop(*given(out))
    assert [command[0] for command in ran] == [sys.executable] * 4
    assert "drives of the go2" in ran[0]
    assert str(out / "walk.npz") in ran[0]
    assert str(out / "walk.npz") in ran[1]
    (out / "tuned" / "policy.onnx").unlink()
    closing.close_the_loop(*given(out))
    assert ran[4:] == ran[2:4]  # the comparison is that of the new policy
    assert capsys.readouterr().out.count("kept: ") == 2


def test_a_step_that_fails_ends_it(tmp_path, monkeypatch):
    monkeypatch.setattr(closing, "STEPS", (("{out}/never", "-c raise(SystemExit(3))"), ("{out}/x", "-c 0")))
    with pytest.raises(subprocess.CalledProcessError) as failed:
        closing.close_the_loop(*given(tmp_path))
    assert failed.value.returncode == 3
