"""Recipe files, and the three of the ablation."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import attrs
import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_actuator import ActuatorModel
from quadvel_estimator.learned import LearnedEstimator
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile
from quadvel_training import loop, recipe, stages
from quadvel_training.__main__ import main
from quadvel_training.constrained import ConstrainedConfig
from quadvel_training.dagger import DaggerConfig
from quadvel_training.estimator import EstimatorConfig
from quadvel_training.loop import Budget
from quadvel_training.privileged import PrivilegedConfig
from quadvel_training.randomisation import load_actuator, sample_actuators
from tests.helpers.robots import ALIENGO


@pytest.fixture
def ablation():
    return {
        name: recipe.read_recipe(ConstrainedConfig, stages.RECIPES / f"{name}.yaml")
        for name in stages.ABLATION
    }


def test_the_recipes_of_the_ablation_differ_in_what_is_compared_alone(ablation):
    shipped = ablation["crl_eam"]
    free = attrs.evolve(
        shipped,
        ppo=attrs.evolve(shipped.ppo, symmetry=0.0, smoothness=0.0),
        rewards=attrs.evolve(shipped.rewards, action_smoothness=0.01),
    )
    assert ablation["rl_eam"] == free
    pd = ablation["rl_pd"]
    assert pd == attrs.evolve(free, actuator="ideal", randomisation=pd.randomisation)
    assert (
        attrs.evolve(
            pd.randomisation,
            gain_scale=(1.0, 1.0),
            transmission_delay=free.randomisation.transmission_delay,
        )
        == free.randomisation
    )


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("privileged", PrivilegedConfig),
        ("privileged_rough", PrivilegedConfig),
        ("dagger", DaggerConfig),
        ("crl_eam", ConstrainedConfig),
    ],
)
def test_the_stages_share_robots_and_commands(name, kind):
    config = recipe.read_recipe(kind, stages.RECIPES / f"{name}.yaml")
    assert config.randomisation.payload == (-2.0, 5.0)
    teacher = recipe.read_recipe(PrivilegedConfig, stages.RECIPES / "privileged.yaml")
    assert config.grid.limits() == teacher.grid.limits()


def test_plain_pd_joints_have_gains_and_delays_of_their_own(ablation):
    config, ids = ablation["rl_pd"], np.arange(400)
    joints = ActuatorModel(load_actuator(ALIENGO, config.actuator), (400, 12))
    for _ in range(2):  # drawing again starts from the nominal joints, not from those drawn before
        sample_actuators(joints, ids, config.randomisation, np.random.default_rng(0))
    for drawn, (low, high) in (
        (joints.input_delay, config.randomisation.transmission_delay),
        (joints.kp_scale, config.randomisation.gain_scale),
        (joints.kd_scale, config.randomisation.gain_scale),
    ):
        assert low <= drawn.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < drawn.max() <= high
    assert np.ptp(joints.kp_scale, axis=1).max() == 0.0
    assert abs(np.corrcoef(joints.kp_scale[:, 0], joints.kd_scale[:, 0])[0, 1]) < 0.2


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("ppo: {symetry: 1.0}", "symetry"),
        ("n: many", "n: found 'many', expected a whole number"),
        ("- 1", r"found \[1\]"),
        ("n: 3\nfoo: 1", "foo"),
    ],
)
def test_a_recipe_with_a_mistake_is_refused_by_file_and_field(tmp_path, text, complaint):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(recipe.RecipeError, match=rf"mine[.]yaml: .*{complaint}"):
        recipe.read_recipe(ConstrainedConfig, path)


def small(monkeypatch):
    """Run every stage with few robots and samples, in place of its recipe's."""
    read, few = recipe.read_recipe, {"n": 4, "length": 4, "budget": Budget(40, 5.0)}

    def read_small(kind, source):
        config = read(kind, source)
        fields = few | ({"keep": 1e9} if hasattr(config, "keep") else {})
        fields |= {"mini_batches": 2} if kind is EstimatorConfig else {}
        return attrs.evolve(config, **fields)

    monkeypatch.setattr(recipe, "read_recipe", read_small)


def test_all_stages_follow_each_other_and_what_is_done_is_not_done_again(tmp_path, monkeypatch):
    small(monkeypatch)
    assert stages.train_all(tmp_path)
    assert PolicyFile(ALIENGO, tmp_path / "dagger" / stages.POLICY_FILE).metadata.recipe["samples"] >= 40
    LearnedEstimator(ALIENGO, tmp_path / "estimator" / stages.ESTIMATOR_FILE)
    kept = {path: loop.load(path)["samples"] for path in tmp_path.glob("*/*.pt")}
    assert len(kept) == 3
    assert stages.train_all(tmp_path)
    assert {path: loop.load(path)["samples"] for path in kept} == kept


def test_the_ablation_gives_every_recipe_the_same_budget_and_resumes(tmp_path, monkeypatch):
    runs, stop_after = [], 2

    def train(config, source, start, teacher, folder, device):
        shares = (
            config.pull_samples / config.budget.samples,
            config.constraint_samples / config.budget.samples,
        )
        same = (config.budget.samples, config.n, config.seed, *np.round(shares, 9))
        runs.append((source.stem, start.name, teacher.name, same, folder.name))
        return len(runs) != stop_after

    monkeypatch.setattr(stages, "train_policy", train)
    start, teacher = tmp_path / "start.pt", tmp_path / "teacher.pt"
    assert not stages.train_ablation(start, teacher, 100.0, 64, 7, tmp_path, "cpu")
    assert stages.train_ablation(start, teacher, 100.0, 64, 7, tmp_path, "cpu")
    order = ["rl_pd", "rl_eam", "rl_pd", "rl_eam", "crl_eam"]
    own = recipe.read_recipe(ConstrainedConfig, stages.RECIPES / "crl_eam.yaml")
    shares = own.pull_samples / own.budget.samples, own.constraint_samples / own.budget.samples
    same = (100.0, 64, 7, *np.round(shares, 9))
    assert runs == [(name, "start.pt", "teacher.pt", same, name) for name in order]


def test_a_recipe_that_does_not_exist_is_named_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe_file = tmp_path / "nofile.yaml"
    monkeypatch.setattr(sys, "argv", ["quadvel_training", "privileged", "--recipe", str(recipe_file)])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.set_num_threads", lambda count: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert str(recipe_file) in said
    assert "Errno" not in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["walks", "--teacher", "{policy}"], "no checkpoint"),
        (["limit", "{policy}", "--forward", "99"], "command_limits"),
        (["limit", "{text}", "--forward", "1"], "text.onnx"),
        (["privileged", "--recipe", "{recipe}"], "n: found 0"),
        (["privileged", "--recipe", "{budget}"], "minutes: found -1"),
        (["record", "--plant", "friction", "--out", "{log}"], "expected .npz"),
    ],
)
def test_a_wrong_argument_or_file_is_named_in_one_sentence(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copy(SHIPPED_POLICY, tmp_path / "policy.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    (tmp_path / "recipe.yaml").write_text("n: 0\n")
    (tmp_path / "budget.yaml").write_text("budget: {minutes: -1}\n")
    files = {
        "policy": "policy.onnx",
        "text": "text.onnx",
        "recipe": "recipe.yaml",
        "budget": "budget.yaml",
        "log": "log.csv",
    }
    words = [word.format(**{name: tmp_path / file for name, file in files.items()}) for word in arguments]
    before = sorted(path.name for path in tmp_path.iterdir())
    monkeypatch.setattr(sys, "argv", ["quadvel_training", *words])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.set_num_threads", lambda count: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert sorted(path.name for path in tmp_path.iterdir()) == before
