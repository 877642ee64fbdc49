"""How far training is from what its parts allow on this machine, as ratios measured in one run.

`environment`: a tick with actuators, sensing and rewards against bare `mujoco.batch` steps of the same model. `training`:
a whole update (rollout and learning, symmetry and smoothness on) against the bare steps and bare passes of the same
networks over the same sizes, and the shares that its parts have in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import attrs
import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from quadvel_description import robot
from quadvel_policy.observation import DEFAULT_OBSERVATION

from . import student
from .crl import PARTS, PRIVILEGED, CrlConfig, CrlRun
from .env import EnvConfig, VelocityEnv, training_model
from .networks import Mlp
from .rewards import RewardWeights, Table2


def _seconds(job: Callable[[], object], repeats: int) -> float:
    """The median time of a call, after one to warm up."""
    job()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        job()
        times.append(time.perf_counter() - started)
    return float(np.median(times))


def _bare_steps(config: EnvConfig, substeps: int) -> float:
    """Seconds of one tick's physics alone, (substeps) steps of the whole batch standing on its feet."""
    model = training_model(config.timestep, config.terrain)
    batch = Batch(model, config.n, config.threads)
    batch.reset(keyframe=model.key("stand").id, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    target = VelocityEnv(attrs.evolve(config, n=1)).stand_q

    def tick() -> None:
        ctrl[:] = robot.KP * (target - qpos[:, 7:]) - robot.KD * qvel[:, 6:]
        for _ in range(substeps):
            batch.step()

    for _ in range(40):  # land
        tick()
    return _seconds(tick, 40)


def environment(n: int = 512, threads: int = 2, timestep: float = 0.001) -> dict[str, float]:
    """Steps a second of the environment with everything on, of the bare batch, and their ratio."""
    config = EnvConfig(n=n, threads=threads, timestep=timestep)
    env = VelocityEnv(config)
    rewards = Table2(env, RewardWeights())
    action = np.zeros((n, 12), np.float32)

    def tick() -> None:
        student.observe(env, action)
        env.tick(np.tile(env.stand_q, (n, 1)))
        rewards(action)

    full, bare = _seconds(tick, 40), _bare_steps(config, env.substeps)
    steps = n * env.substeps
    return {"steps_per_s": steps / full, "bare_steps_per_s": steps / bare, "ratio": bare / full}


def _passes(config: CrlConfig) -> float:
    """Seconds of one update's bare network passes: inference, actor, mirrored actor and critic, forward and backward."""
    p, n, length = config.ppo, config.n, config.length
    actor, critic = student.new_actor(), Mlp(DEFAULT_OBSERVATION.size + PRIVILEGED, 1)
    one = torch.randn(1, n, DEFAULT_OBSERVATION.size)
    state = actor.initial_state(n)

    def infer() -> None:
        with torch.no_grad():
            actor(one, state)

    def learn(network: torch.nn.Module, inputs: int, envs: int) -> Callable[[], None]:
        x = torch.randn(length, envs, inputs)
        state = network.initial_state(envs)
        return lambda: network(x, state)[0].square().mean().backward()

    size = n // p.mini_batches
    batch = _seconds(learn(actor, DEFAULT_OBSERVATION.size, size), 3)
    batch += _seconds(learn(actor, DEFAULT_OBSERVATION.size, round(size * p.symmetric_share)), 3)
    batch += _seconds(learn(critic, DEFAULT_OBSERVATION.size + PRIVILEGED, size), 3)
    return length * _seconds(infer, 20) + p.epochs * p.mini_batches * batch


def training(config: CrlConfig | None = None, updates: int = 3) -> dict[str, float]:
    """Policy samples a second of the whole loop, of its bare parts, their ratio, and the shares of the loop's parts."""
    config = config or CrlConfig(critic_first=0)
    run = CrlRun(config)
    seen: list[dict[str, float]] = []
    whole = _seconds(lambda: seen.append(run.step(0.0)), updates)
    physics = config.length * _bare_steps(run.env.config, run.env.substeps)
    passes = _passes(config)
    samples = config.n * config.length
    return {
        "samples_per_s": samples / whole,
        "bare_samples_per_s": samples / (physics + passes),
        "ratio": (physics + passes) / whole,
        **{f"{part}_share": float(np.mean([one[part] for one in seen])) for part in PARTS},
    }
