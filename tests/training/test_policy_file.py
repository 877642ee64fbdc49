"""The exported policy is the trained network."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel[train]'")

from quadvel_policy.policy_file import PolicyFile  # noqa: E402
from quadvel_training import student  # noqa: E402
from quadvel_training.command_map import TERMS, CommandMap  # noqa: E402
from quadvel_training.env import CommandRange, EnvConfig, VelocityEnv  # noqa: E402


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    torch.manual_seed(0)
    actor = student.Policy()
    env = VelocityEnv(EnvConfig(n=2, threads=1, commands=CommandRange(vx=(-1.0, 1.5), vy=0.5, wz=1.2)))
    path = tmp_path_factory.mktemp("policy") / "policy.onnx"
    student.export_policy(actor, env, path, {"stage": "test"})
    return actor, env, path


def test_onnx_and_torch_agree_over_500_steps_with_a_reset(exported):
    actor, _, path = exported
    policy = PolicyFile(path)
    rng = np.random.default_rng(1)
    state = actor.initial_state(1)
    worst = 0.0
    for step in range(500):
        if step == 250:
            policy.reset()
            state = actor.initial_state(1)
        obs = rng.normal(size=48).astype(np.float32)
        with torch.no_grad():
            expected, state = actor(torch.from_numpy(obs)[None, None], state)
        worst = max(worst, float(np.abs(policy.step(obs) - expected.numpy()[0, 0]).max()))
    assert worst < 5e-3  # of 0.4 rad: less than an encoder's noise; sums of another order, fed back 250 times


def test_a_command_map_stands_in_front_of_the_network(exported, tmp_path):
    actor, env, _ = exported
    rng = np.random.default_rng(2)
    command_map = CommandMap(0.1 * rng.normal(size=(TERMS, 3)))
    command_map.weights[0] = 0.0  # so nothing is added to the zeros remembered before the first tick
    student.export_policy(actor, env, tmp_path / "mapped.onnx", {}, command_map)
    for stance in (0.0, 1.0):
        obs = rng.normal(size=(1, 48)).astype(np.float32)
        obs[0, 3] = stance
        given = obs.copy()
        given[:, :4] = command_map(obs[:, :4])
        assert (np.abs(given - obs).max() > 0.01) == (stance < 0.5)
        with torch.no_grad():
            expected, _ = actor(torch.from_numpy(np.tile(given, (9, 1, 1))), actor.initial_state(1))
        policy = PolicyFile(tmp_path / "mapped.onnx")
        found = [policy.step(obs[0]).copy() for _ in range(9)]  # of a command the gait hears a tick later
        assert np.abs(np.array(found) - expected.numpy()[:, 0]).max() < 1e-4


def test_metadata_says_how_to_run_it(exported):
    _, env, path = exported
    metadata = PolicyFile(path).metadata
    assert metadata.command_limits == {"vx": (-1.0, 1.5), "vy": (-0.5, 0.5), "wz": (-1.2, 1.2)}
    assert np.allclose(metadata.action_offset, env.stand_q)
    assert metadata.kp == (30.0,) * 12
    assert metadata.kd == (0.5,) * 12
    assert metadata.rate_hz == 200.0
    assert metadata.actuator["delta_kp"] == pytest.approx(-0.706)
