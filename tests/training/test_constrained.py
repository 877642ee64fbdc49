"""Stage 3: schedules of pull and constraints, resumption, and the policy file."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_policy.policy_file import PolicyFile  # noqa: E402
from quadvel_training import constrained, loop  # noqa: E402
from quadvel_training.constrained import ConstrainedConfig, ConstrainedRun  # noqa: E402
from quadvel_training.dagger import DaggerConfig, DaggerRun  # noqa: E402
from quadvel_training.privileged import PrivilegedConfig, PrivilegedRun  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

SMALL = ConstrainedConfig(n=8, threads=1, length=8, critic_first=0, pull_samples=1e4, constraint_samples=1e4)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stages")
    teacher, student = folder / "privileged.pt", folder / "dagger.pt"
    run = PrivilegedRun(PrivilegedConfig(n=4, threads=1, length=2))
    for command in ((0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.7)):
        run.grid.record(np.tile([*command, 0.0], (4, 1)), np.zeros((4, 2)), np.zeros(4, bool))
    loop.save(run.state(), teacher)
    loop.save(DaggerRun(DaggerConfig(n=8, threads=1, length=2), teacher).state(), student)
    return student, teacher


def weights(run):
    return torch.cat([p.detach().ravel() for p in run.actor.network.parameters()])


def test_the_pull_fades_and_the_constraints_grow(files):
    run = ConstrainedRun(SMALL, *files)
    first = run.step(0.0)
    assert first["away"] >= 0.0
    run.samples = 5_000
    later = run.step(0.5)
    run.samples = 20_000
    last = run.step(0.9)
    assert first["pull"] > later["pull"] > last["pull"] == 0.0
    assert run.teacher is None  # it is not asked any more
    assert 0.0 <= first["constraints"] < later["constraints"] < last["constraints"] == 1.0
    assert all(np.isfinite(value) for seen in (first, later, last) for value in seen.values())


def test_the_pull_alone_brings_the_policy_to_its_teacher(files):
    still = attrs.evolve(SMALL.ppo, learning_rate=0.02, symmetry=0.0, smoothness=0.0)
    run = ConstrainedRun(attrs.evolve(SMALL, ppo=still), *files)
    rollout, _ = run.collect()
    rollout = attrs.evolve(rollout, reward=0 * rollout.reward, label=rollout.label + 0.3)
    away = [run.ppo.update(rollout, pull=100.0)["away"] for _ in range(60)]
    assert away[-1] < 0.5 * away[0]


def test_it_starts_as_its_student_and_resumes_from_a_checkpoint(files, tmp_path):
    run = ConstrainedRun(SMALL, *files)
    known = loop.load(files[0])["average"]
    assert all(torch.equal(known[name], value) for name, value in run.policy().state_dict().items())
    run.step(0.0)
    loop.save(run.state(), tmp_path / "constrained.pt")
    again = ConstrainedRun(SMALL, *files)
    again.restore(loop.load(tmp_path / "constrained.pt"))
    assert torch.equal(weights(again), weights(run))
    assert (again.samples, again.updates) == (run.samples, run.updates)


def test_the_policy_is_the_average_of_what_it_was(files):
    run = ConstrainedRun(attrs.evolve(SMALL, averaged=3), *files)
    average = np.zeros(weights(run).numel())
    for update in range(1, 6):
        run.step(0.0)
        share = 1 / min(update, 3)
        average += share * (weights(run).numpy() - average)
    found = torch.cat([p.detach().ravel() for p in run.policy().parameters()])
    assert found.numpy() == pytest.approx(average, abs=1e-6)
    assert not torch.equal(found, weights(run))


def test_exploration_shrinks(files):
    run = ConstrainedRun(attrs.evolve(SMALL, std=0.08, final_std=0.02, std_samples=1e4), *files)
    spread = []
    for samples in (0, 5_000, 20_000):
        run.samples = samples
        run.step(0.0)
        spread.append(float(run.actor.log_std.exp().mean()))
    assert spread == pytest.approx([0.08, 0.05, 0.02])


def test_a_start_of_its_own_brings_its_critic_and_needs_no_teacher(files, tmp_path):
    run = ConstrainedRun(SMALL, *files)
    run.step(0.0)
    loop.save(run.state(), tmp_path / "constrained.pt")
    tuned = ConstrainedRun(SMALL, tmp_path / "constrained.pt")
    assert all(
        torch.equal(run.average.state_dict()[name], value)
        for name, value in tuned.policy().state_dict().items()
    )
    for one, two in zip(run.critic.parameters(), tuned.critic.parameters(), strict=True):
        assert torch.equal(one, two)
    assert "away" not in tuned.step(0.0)
    with pytest.raises(loop.CheckpointError, match=r"privileged[.]pt: expected .* `dagger`"):
        ConstrainedRun(SMALL, files[1])


def test_the_policy_file_answers_as_the_network_does(files, tmp_path):
    run = ConstrainedRun(SMALL, *files)
    run.write_policy(tmp_path / "policy.onnx", {})
    policy = PolicyFile(ALIENGO, tmp_path / "policy.onnx")
    obs = np.random.default_rng(0).normal(size=(5, 48)).astype(np.float32)
    with torch.no_grad():
        expected, _ = run.policy()(torch.from_numpy(obs[:, None]), run.policy().initial_state(1))
    found = np.array([policy.step(one).copy() for one in obs])
    assert np.abs(found - expected[:, 0].numpy()).max() < 1e-4


def test_the_critic_has_the_inputs_of_the_shipped_checkpoint_so_that_it_can_be_tuned():
    assert constrained.CRITIC_SIZE == 106  # of training/checkpoints/constrained.pt at ff3dfa6
