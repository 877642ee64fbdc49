"""The gait's clock: one for teacher and student, carried in the policy's memory."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel[train]'")

from quadvel_description import symmetry  # noqa: E402
from quadvel_training import clock, gait, student  # noqa: E402
from quadvel_training.env import TICK, CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.randomisation import Randomisation  # noqa: E402
from quadvel_training.teacher import GaitState, torch_mirror  # noqa: E402

STANCE = torch.tensor([0.0, 0.0, 0.0, 1.0])


def run(command: torch.Tensor, seconds: float, now: torch.Tensor) -> torch.Tensor:
    for _ in range(round(seconds / TICK)):
        now = clock.advance(now, command)
    return now


def test_the_pace_follows_the_command_by_a_bounded_acceleration_and_stands_once_at_rest():
    fast = torch.tensor([2.5, -0.6, 1.0, 0.0])
    now = run(fast, 0.5, torch.zeros(clock.SIZE))
    assert np.allclose(now[:3], [1.25, -0.6, 1.0], atol=1e-5)
    now = run(fast, 1.0, now)
    assert np.allclose(now[:3], fast[:3])
    now = run(STANCE, 0.5, now)
    assert now[4] == 1.0
    now = run(STANCE, 0.6, now)
    assert np.array_equal(now, np.zeros(clock.SIZE))


def test_the_phase_turns_at_the_gaits_frequency():
    command = torch.tensor([0.8, 0.3, -0.5, 0.0])
    now = run(command, 2.0, torch.zeros(clock.SIZE))
    later = run(command, 0.1, now)
    turned = float(later[3] - now[3]) % 1.0
    assert turned == pytest.approx(0.1 * gait.frequency(command[None].numpy())[0], abs=1e-4)


def test_what_is_seen_of_it_stands_still_with_the_robot():
    assert np.array_equal(clock.features(torch.zeros(clock.SIZE)), np.zeros(clock.FEATURES))
    quarter = torch.tensor([0.0, 0.0, 0.0, 0.25, 1.0])
    assert np.allclose(clock.features(quarter), [0, 0, 0, 1, 1, 0], atol=1e-6)


@pytest.fixture(scope="module")
def walk():
    """Six robots with changing commands, two of which start over: observations, the teacher's clocks, the policy's."""
    commands = CommandRange(stance=0.4, hold=(0.1, 0.4))
    env = VelocityEnv(EnvConfig(n=6, threads=1, commands=commands, randomisation=Randomisation.calm()))
    torch.manual_seed(0)
    network, teachers = student.Policy(), GaitState(env)
    memory, previous = network.initial_state(6), np.zeros((6, 12), np.float32)
    seen = []
    for tick in range(300):
        if tick == 150:
            over = np.array([1, 4])
            env.reset(over)
            teachers.reset(over)
            for part in memory:
                part[:, over] = 0.0
        obs = student.observe(env, previous)
        with torch.no_grad():
            _, memory = network(torch.from_numpy(obs[None]), memory)
        own = memory[0][0].split(student.PARTS, dim=-1)[1].clone()
        seen.append((obs, teachers.pace, teachers.phase, own.numpy()))
        env.tick(np.tile(env.stand_q, (6, 1)))
        teachers.advance()
    return network, seen


def test_teacher_and_student_go_by_the_same_clock(walk):
    for _, pace, phase, own in walk[1]:
        assert np.array_equal(pace[:, :3], own[:, :3])
        assert np.array_equal(pace[:, 3], 1 - own[:, 4])
        assert np.array_equal(phase, own[:, 3])
    assert {0.0, 1.0} <= {float(x) for _, pace, _, _ in walk[1] for x in pace[:, 3]}


def test_the_mirrored_policy_sees_the_other_diagonal_pair_begin(walk):
    network, seen = walk
    features = []
    network.lstm.register_forward_pre_hook(lambda _, given: features.append(given[0][..., 48:]))
    obs = torch.from_numpy(np.array([row[0] for row in seen[:140]]))
    mirror = torch_mirror(symmetry.OBSERVATION)
    with torch.no_grad():
        network(obs, network.initial_state(6))
        network(mirror(obs), network.initial_state(6, mirrored=True))
    signs = torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    assert np.allclose(features[1], features[0] * signs, atol=1e-4)
    assert np.abs(features[0][..., 4:]).max() > 0.9


def test_a_policy_from_before_there_was_a_clock_goes_on_without_one():
    bare = student.Recurrent(48, 12, student.MEMORY, student.HIDDEN)
    for network in (bare, student.Policy()):
        again = student.actor_of(network.state_dict())
        assert type(again) is type(network)
        x, state = torch.ones(1, 1, 48), network.initial_state(1)
        with torch.no_grad():
            assert torch.equal(again(x, state)[0], network(x, state)[0])
