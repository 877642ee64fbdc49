"""Stage 2: the student, its teacher at every tick, and the policy file."""

from __future__ import annotations

import attrs
import numpy as np
import onnx
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_policy.observation import VelocityCommandLimits  # noqa: E402
from quadvel_policy.policy_file import PolicyFile  # noqa: E402
from quadvel_training import dagger, loop, privileged, teacher  # noqa: E402
from quadvel_training.__main__ import app  # noqa: E402
from quadvel_training.dagger import DaggerConfig, DaggerRun  # noqa: E402
from quadvel_training.privileged import PrivilegedConfig, PrivilegedRun  # noqa: E402
from quadvel_training.random_walks import RandomCommands  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

SMALL = DaggerConfig(n=8, threads=1, length=6, mini_batches=2, learning_rate=3e-3)


@pytest.fixture(scope="module")
def teacher_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("teacher") / "privileged.pt"
    run = PrivilegedRun(PrivilegedConfig(n=4, threads=1, length=2))
    followed = [(0.5, 0, 0), (1.0, 0, 0), (1.5, 0, 0), (2.0, 0, 0), (0, 0.4, 0), (0, 0, 0.7)]
    for command in followed:
        run.grid.record(np.tile([*command, 0.0], (4, 1)), np.zeros((4, 2)), np.zeros(4, bool))
    loop.save(run.state(), path)
    return path


@pytest.fixture
def run(teacher_file):
    return DaggerRun(SMALL, teacher_file)


def test_the_file_is_the_papers_network_and_nothing_else(run, tmp_path):
    dagger.export_policy(run.average, run.env, run.grid.config.answered, tmp_path / "policy.onnx", {})
    model = onnx.load(tmp_path / "policy.onnx")
    assert len(model.graph.node) <= 40
    sizes = {x.name: [d.dim_value for d in x.type.tensor_type.shape.dim] for x in model.graph.input}
    assert sizes == {"obs": [1, 48], "h_in": [1, 1, 256], "c_in": [1, 1, 256]}
    weights = sum(np.prod(w.dims) for w in model.graph.initializer)
    layers = 304 * 1024 + 1024 + 256 * 192 + 192 + 192 * 128 + 128 + 128 * 12 + 12
    assert layers <= weights < layers + 50


def test_the_file_does_what_the_network_does(run, tmp_path):
    dagger.export_policy(run.average, run.env, run.grid.config.answered, tmp_path / "policy.onnx", {})
    policy = PolicyFile(ALIENGO, tmp_path / "policy.onnx")
    obs = np.random.default_rng(0).normal(size=(50, 48)).astype(np.float32)
    with torch.no_grad():
        expected, _ = run.average(torch.from_numpy(obs[:, None]), run.student.initial_state(1))
    found = np.array([policy.step(one).copy() for one in obs])
    assert np.abs(found - expected[:, 0].numpy()).max() < 1e-4


def test_the_file_holds_its_command_limits_and_how_to_run_it(run, tmp_path):
    limits = VelocityCommandLimits((-1.0, -0.4, -0.7), (2.0, 0.5, 0.7), 3.0)
    dagger.export_policy(run.average, run.env, limits, tmp_path / "policy.onnx", {})
    metadata = PolicyFile(ALIENGO, tmp_path / "policy.onnx").metadata
    assert metadata.limits == limits
    assert np.allclose(metadata.action_offset, run.env.stand_q)
    assert metadata.kp == (30.0,) * 12
    assert metadata.kd == (0.5,) * 12
    assert metadata.rate_hz == 200.0
    assert metadata.actuator["delta_kp"] == pytest.approx(-0.706)


def test_a_new_student_has_cells_that_remember_for_seconds(run):
    """A memory that is set once and fed zeros decays with its cells' time constants."""
    _, cell = run.student.initial_state(1)
    state = (torch.zeros_like(cell), torch.ones_like(cell))
    with torch.no_grad():
        _, (_, after) = run.student.lstm(torch.zeros(100, 1, 48), state)
    left = after[0, 0]
    assert (left[dagger.SLOW_CELLS :].abs() < 0.5).all()
    assert 0.5 < left[dagger.SLOW_CELLS - 4 : dagger.SLOW_CELLS].mean() < 1.0


def test_the_teacher_knows_what_was_done_20_ms_ago(run):
    teacher, seen = run.teacher, []
    for i in range(6):
        seen.append(teacher._executed[0][0, 0])
        teacher.advance(run.env.command, np.full((8, 12), i, np.float32))
    assert seen == [0, 0, 0, 0, 0, 1]


def test_the_teachers_actions_lag_as_held_ones_do_and_restart_with_a_robot(run, monkeypatch):
    teacher, values = run.teacher, iter([0.3, 0.6, 0.9, 1.2])
    monkeypatch.setattr(privileged, "joint_offsets", lambda env, past: np.zeros((8, 12)))
    teacher.actor = lambda obs: (torch.full((8, 12), next(values)), None)
    said = [teacher.action()[:, 0] for _ in range(3)]
    assert [one[0] for one in said] == pytest.approx([0.3, 0.4, 0.6])
    teacher.reset(np.array([5]))
    assert teacher.action()[[0, 5], 0] == pytest.approx([0.9, 1.2])


def test_a_label_is_the_mean_of_the_actions_around_its_tick_while_the_robot_is_up():
    actions = np.random.default_rng(0).standard_normal((30, 2, 12)).astype(np.float32)
    mask = np.ones((30, 2), np.float32)
    mask[20:, 1] = 0.0
    labels = teacher.smooth_labels(actions, mask)
    before, after = teacher.LABEL_BEFORE, teacher.LABEL_AFTER
    assert labels[10, 0] == pytest.approx(actions[10 - before : 11 + after, 0].mean(axis=0), abs=1e-6)
    assert labels[0, 0] == pytest.approx(actions[: 1 + after, 0].mean(axis=0), abs=1e-6)
    assert labels[19, 1] == pytest.approx(actions[19 - before : 20, 1].mean(axis=0), abs=1e-6)
    assert labels[29, 0] == pytest.approx(actions[29 - before :, 0].mean(axis=0), abs=1e-6)


def test_labels_do_not_jump_where_the_teacher_does():
    jump = np.zeros((30, 1, 12), np.float32)
    jump[15:] = 1.0
    steps = np.diff(teacher.smooth_labels(jump, np.ones((30, 1), np.float32))[:, 0, 0])
    assert steps.max() == pytest.approx(1 / (1 + teacher.LABEL_BEFORE + teacher.LABEL_AFTER))


def test_who_drives_changes_with_an_episode_alone(run):
    before = run.driven.copy()
    run.samples = 10**9  # the student is to drive nearly all
    run._start_over(np.array([1, 2]))
    kept = np.delete(np.arange(8), [1, 2])
    assert np.array_equal(run.driven[kept], before[kept])
    for _ in range(3):  # however often the student's robots start over
        run._start_over(np.arange(8))
        assert run.driven.mean() == pytest.approx(SMALL.driven, abs=0.1)


def test_the_student_gets_its_share_as_soon_as_it_grows(run):
    run.samples = 10**9
    run.step(0.0)
    assert run.driven.mean() == pytest.approx(SMALL.driven, abs=0.1)


def test_the_student_learns_to_imitate_the_teacher_and_to_recall_the_past(run):
    start = run._memory
    experience, standing, _ = run.collect()
    losses = [run.learn(experience.with_mirror_images(standing), start) for _ in range(25)]
    assert losses[-1]["imitation"] < 0.5 * losses[0]["imitation"]
    assert losses[-1]["recall"] < 0.5 * losses[0]["recall"]


def test_a_robot_that_fell_teaches_nothing_until_it_starts_over(run):
    run.env._qpos[3, 2] = 0.05
    experience, *_ = run.collect()
    mask = experience.mask
    assert mask[0, 3] == 1.0
    assert (mask[1:, 3] == 0.0).all()
    memory = [part.clone() for part in run._memory]
    run._start_over(np.flatnonzero(mask[-1].numpy() == 0.0))
    assert (run._memory[0][0, [3, 3 + SMALL.n]] == 0.0).all()  # that of its mirror image, too
    assert torch.equal(run._memory[0][0, 0], memory[0][0, 0])
    assert not run.env.fallen[3]


def test_the_student_learns_mirror_images_of_robots_that_do_not_stand(run):
    start = run._memory
    experience, standing, _ = run.collect()
    standing[2:4, 5] = 1.0
    both = experience.with_mirror_images(standing)
    assert both.mask[:, : SMALL.n].equal(experience.mask)
    assert both.mask[:, SMALL.n :].equal(experience.mask * (1 - standing))
    left, right = (
        both.label[:, 0].unflatten(-1, (4, 3))[:, 0],
        both.label[:, SMALL.n].unflatten(-1, (4, 3))[:, 1],
    )
    assert left.equal(right * torch.tensor([-1.0, 1.0, 1.0]))  # FR as FL
    assert both.recalled[:, SMALL.n, 6:8].equal(
        experience.recalled[:, 0, 6:8] * torch.tensor([1.0, -1.0])
    )  # lag
    _, end = run.student(both.obs, start)
    assert (
        run._memory[0].isclose(end[0], atol=1e-5).all()
    )  # that of the mirror images saw what they learn from


def test_half_of_what_is_learned_are_mirror_images(teacher_file, monkeypatch):
    def learned(chosen: int, swapped: bool) -> torch.Tensor:
        run = DaggerRun(SMALL, teacher_file)
        start = run._memory
        experience, standing, _ = run.collect()
        both = experience.with_mirror_images(0.0 * standing)
        if swapped:
            turn = torch.arange(2 * SMALL.n).roll(SMALL.n)
            both = dagger.Experience(*(x[:, turn] for x in (both.obs, both.label, both.recalled, both.mask)))
            start = (start[0][:, turn], start[1][:, turn])
        monkeypatch.setattr(torch, "randint", lambda low, high, size: torch.full(size, chosen))
        run.learn(both, start)
        return torch.nn.utils.parameters_to_vector(run.student.parameters())

    assert learned(1, swapped=False).equal(learned(0, swapped=True))
    assert not learned(1, swapped=False).equal(learned(0, swapped=False))


def test_robots_that_have_not_lifted_a_foot_count_as_standing(run):
    *_, standing, _ = run.collect()
    assert (standing == 1.0).all()
    run.teacher.past.air[5, 2] = 0.2
    run.env.contact[5, 2] = False
    *_, standing, _ = run.collect()
    assert (standing[:, 5] == 0.0).all()
    assert (standing[:, 4] == 1.0).all()
    run._start_over(np.array([5]))
    *_, standing, _ = run.collect()
    assert (standing[:, 5] == 1.0).all()


def test_labels_are_smoothed(run, monkeypatch):
    monkeypatch.setattr(dagger, "smooth_labels", lambda actions, mask: 0.0 * actions + 7.0)
    experience, *_ = run.collect()
    assert (experience.label == 7.0).all()


def test_the_student_learns_the_commands_that_are_taught(teacher_file):
    taught = VelocityCommandLimits((-0.3, -0.2, -0.5), (0.4, 0.2, 0.5), 4.0)
    run = DaggerRun(attrs.evolve(SMALL, grid=attrs.evolve(SMALL.grid, taught=taught)), teacher_file)
    drawn = run.grid.draw(np.random.default_rng(0), 500)[:, :3]
    assert drawn.min(axis=0) == pytest.approx(taught.low, abs=0.1)
    assert (drawn >= np.array(taught.low) - 1e-9).all()
    assert (drawn <= np.array(taught.high) + 1e-9).all()


def test_the_file_holds_the_mean_of_the_last_weights(run):
    seen = []
    for _ in range(3):
        run.step(0.0)
        seen.append(torch.nn.utils.parameters_to_vector(run.student.parameters()).detach().clone())
    averaged = torch.nn.utils.parameters_to_vector(run.average.parameters())
    assert averaged.isclose(torch.stack(seen).mean(dim=0), atol=1e-6).all()


def test_a_killed_run_resumes(run, teacher_file, tmp_path):
    run.step(0.0)
    loop.save(run.state(), tmp_path / "dagger.pt")
    other = DaggerRun(SMALL, teacher_file)
    other.restore(loop.load(tmp_path / "dagger.pt"))
    assert other.samples == run.samples == 48
    for one, two in zip(run.student.parameters(), other.student.parameters(), strict=True):
        assert torch.equal(one, two)


def test_tuning_starts_from_the_weights_of_the_policy_file_and_counts_its_own_samples(
    run, teacher_file, tmp_path
):
    run.step(0.0)
    loop.save(run.state(), tmp_path / "dagger.pt")
    tuned = DaggerRun(SMALL, teacher_file)
    tuned.start_from(tmp_path / "dagger.pt")
    for name, value in tuned.student.state_dict().items():
        assert value.equal(run.average.state_dict()[name])
    assert tuned.samples == 0
    with pytest.raises(loop.CheckpointError, match="expected a checkpoint of `dagger`"):
        tuned.start_from(teacher_file)


def test_every_second_robot_does_not_explore(run):
    run.collect()
    assert not run._noise[::2].any()
    assert run._noise[1::2].any(axis=1).all()


def test_random_walks_count_those_who_fall_or_move_a_joint_too_fast(teacher_file, tmp_path, capsys):
    recipe = tmp_path / "slow.yaml"
    recipe.write_text("grid: {answered: {low: [-0.3, -0.2, -0.5], high: [0.5, 0.2, 0.5]}}")
    common = ["random-walks", "--teacher", str(teacher_file), "--recipe", str(recipe), "--robots", "4"]
    common += ["--seconds", "1.5"]
    app(common, standalone_mode=False)
    assert "4 robots: 0 fell, 0 fell or" in capsys.readouterr().out
    run = DaggerRun(SMALL, teacher_file)
    with torch.no_grad():
        list(run.average.parameters())[-1][:] = torch.tensor(
            [0.0, 5.0, -5.0] * 4
        )  # bias of the joint targets
    loop.save(run.state(), tmp_path / "dagger.pt")
    app([*common, "--policy", str(tmp_path / "dagger.pt")], standalone_mode=False)
    assert "4 robots: 4 fell, 4 fell or" in capsys.readouterr().out


def test_random_commands_stay_within_the_limits_of_the_policy():
    limits = VelocityCommandLimits((-1.0, -0.5, -2.0), (2.0, 0.5, 2.0), curve=2.0)
    commands = RandomCommands(limits).draw(np.random.default_rng(0), 500)
    clamped = np.array([limits.clamp(one) for one in commands[:, :3].tolist()])
    assert clamped == pytest.approx(commands[:, :3])
    assert 0.1 < commands[:, 3].mean() < 0.3
    assert (commands[:, :3].any(axis=1) == (commands[:, 3] == 0.0)).all()
