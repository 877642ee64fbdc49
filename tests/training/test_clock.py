"""The gait's clock: one for teacher and student, and the gait that the policy carries in its memory."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel[train]'")

from quadvel_description import symmetry  # noqa: E402
from quadvel_training import clock, gait, student  # noqa: E402
from quadvel_training.env import TICK, CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.networks import Mlp, torch_mirror  # noqa: E402
from quadvel_training.randomisation import Randomisation  # noqa: E402
from quadvel_training.teacher import RESIDUAL, GaitState  # noqa: E402

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
    assert turned == pytest.approx(0.1 * float(gait.frequency(gait.speed(command))), abs=1e-4)


def test_its_hand_stands_still_with_the_robot():
    assert np.array_equal(clock.hand(*clock.pace_and_phase(torch.zeros(clock.SIZE))), [0, 0])
    quarter = torch.tensor([0.0, 0.0, 0.0, 0.25, 1.0])
    assert np.allclose(clock.hand(*clock.pace_and_phase(quarter)), [1, 0], atol=1e-6)


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
        own = student.parts_of(memory)[1][0][0].split(student.PARTS, dim=-1)[0].clone()
        seen.append((obs, teachers.pace, teachers.phase, own.numpy()))
        env.tick(np.tile(env.stand_q, (6, 1)))
        teachers.advance()
    return network, seen


def test_teacher_and_student_go_by_the_same_clock(walk):
    for _, pace, phase, own in walk[1]:
        assert np.array_equal(pace[:, :3], own[:, :3])
        assert np.array_equal(pace[:, 3], 1 - own[:, 4])
        assert np.array_equal(phase[:, 0], own[:, 3])
    assert {0.0, 1.0} <= {float(x) for _, pace, _, _ in walk[1] for x in pace[:, 3]}


def test_the_mirrored_policy_carries_the_mirrored_gait(walk):
    network, seen = walk
    obs = torch.from_numpy(np.array([row[0] for row in seen[:140]]))
    mirror, joints = torch_mirror(symmetry.OBSERVATION), torch_mirror(symmetry.JOINTS)
    with torch.no_grad():
        carried, _ = network.follow(obs, student.parts_of(network.initial_state(6))[1])
        state = network.initial_state(6, mirrored=True)
        mirrored, _ = network.follow(mirror(obs), student.parts_of(state)[1])
    signs = torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    assert np.allclose(mirrored[..., :6], carried[..., :6] * signs, atol=1e-4)
    off = (mirrored[..., -12:] - joints(carried[..., -12:])).abs()
    assert off[20:].median() < 0.01  # but for the trunk's lateral asymmetry
    assert carried[..., 4:6].abs().max() > 0.9


def test_a_student_begins_as_its_teacher(walk):
    """The same network on the same numbers, where the observation and the gait tell the teacher's."""
    obs, network = torch.from_numpy(np.array([row[0] for row in walk[1][:20]])), student.Policy()
    torch.manual_seed(3)
    actor = Mlp(67, 12)
    network.take_over(actor.body)
    with torch.no_grad():
        carried, _ = network.follow(obs, student.parts_of(network.initial_state(6))[1])
        action, _ = network(obs, network.initial_state(6))
        command, hand, down, known, last, spring, base = carried.split([4, 2, 4, 3, 12, 12, 12], dim=-1)
        added = (obs[..., 36:] - last) * student.ACTION_SCALE / RESIDUAL
        seen = [command, obs[..., 4:36], added, hand, 2 * spring, down, known[..., :1]]
        residual, _ = actor(torch.cat(seen, dim=-1))
    assert np.allclose(action, base + residual * RESIDUAL / student.ACTION_SCALE, atol=1e-5)


def test_a_sequence_followed_once_gives_what_single_ticks_give(walk):
    network, seen = walk
    obs = torch.from_numpy(np.array([row[0] for row in seen[:40]]))
    state = network.initial_state(6)
    followed = student.Followed(network, obs, state)
    with torch.no_grad():
        some = followed.actions(torch.tensor([1, 4]))
        for tick in range(40):
            action, state = network(obs[tick : tick + 1], state)
            assert np.allclose(some[tick], action[0, [1, 4]], atol=1e-5)
    for half, expected in zip(followed.end(), state, strict=True):
        assert np.allclose(half, expected, atol=1e-4)
