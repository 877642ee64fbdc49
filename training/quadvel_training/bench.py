"""How far training is from what its parts allow on this machine, as ratios measured in one run.

`environment`: a tick with actuators, sensing and rewards against bare `mujoco.batch` steps from the same states. `training`:
a whole update (rollout and learning, symmetry and smoothness on) against the bare steps and bare passes of the same
networks over the same sizes, and the shares that its parts have in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray

from quadvel_policy.observation import DEFAULT_OBSERVATION

from . import dagger
from .constrained import CRITIC_SIZE, PARTS, ConstrainedConfig, ConstrainedRun
from .env import EnvConfig, VelocityEnv, training_model
from .networks import Mlp, Recurrent
from .rewards import RewardWeights, Table2


def _in_turn(jobs: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, NDArray[np.float64]]:
    """Seconds (rounds,) that each job took, after a call of each to warm up.

    In each round they run one after the other, so that what slows the machine down for a while falls on all of them
    alike: ratios within a round hold where times do not.
    """
    for job in jobs.values():
        job()
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            started = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - started)
    return {name: np.array(times) for name, times in seconds.items()}


def _rate_and_ratio(
    amount: str, count: int, whole: NDArray[np.float64], bare: NDArray[np.float64]
) -> dict[str, float]:
    """How many of `count` a second the whole and its bare parts do, and the ratio of both; medians over the rounds."""
    return {
        f"{amount}_per_s": count / float(np.median(whole)),
        f"bare_{amount}_per_s": count / float(np.median(bare)),
        "ratio": float(np.median(bare / whole)),
    }


def _bare_tick(env: VelocityEnv) -> Callable[[], None]:
    """One tick's physics alone: the steps of as many robots, none of them varied, from the states of `env` and on its torques.

    From the same states, as robots on their feet are quicker to simulate than robots pushed and stumbling.
    """
    batch = Batch(training_model(env.config.timestep, env.config.terrain), env.config.n, env.config.threads)
    rows = [(batch.bind(name), env.batch.bind(name)) for name in ("qpos", "qvel", "ctrl")]

    def tick() -> None:
        for own, given in rows:
            own[:] = given
        for _ in range(env.substeps):
            batch.step()

    return tick


def environment(n: int = 512, threads: int = 2, timestep: float = 0.001) -> dict[str, float]:
    """Steps a second of the environment with everything on, of the bare batch, and their ratio."""
    config = EnvConfig(n=n, threads=threads, timestep=timestep)
    env = VelocityEnv(config)
    rewards = Table2(env, RewardWeights())
    action = np.zeros((n, 12), np.float32)

    def tick() -> None:
        dagger.observe(env, action)
        env.tick(np.tile(env.stand_q, (n, 1)))
        rewards(action)

    seconds = _in_turn({"whole": tick, "bare": _bare_tick(env)}, 60)
    return _rate_and_ratio("steps", n * env.substeps, seconds["whole"], seconds["bare"])


def _bare_parts(run: ConstrainedRun) -> dict[str, tuple[Callable[[], object], float]]:
    """What an update can't do without, each with how often it needs it: physics, and passes of networks of its sizes.

    The passes are inference, and forward and backward those of actor, mirrored actor and critic.
    """
    config, size = run.config, DEFAULT_OBSERVATION.size
    p, n, length = config.ppo, config.n, config.length
    actor, critic = Recurrent(size, 12), Mlp(CRITIC_SIZE, 1)
    one, state = torch.randn(1, n, size), actor.initial_state(n)

    def infer() -> None:
        with torch.no_grad():
            actor(one, state)

    def learn(network: torch.nn.Module, inputs: int, envs: int) -> Callable[[], None]:
        x = torch.randn(length, envs, inputs)
        state = network.initial_state(envs)
        return lambda: network(x, state)[0].square().mean().backward()

    batch, batches = n // p.mini_batches, p.epochs * p.mini_batches
    few = 16  # ticks at once, to be seen beside a whole update
    return {
        "physics": (_repeated(_bare_tick(run.env), few), length / few),
        "inference": (_repeated(infer, few), length / few),
        "actor": (learn(actor, size, batch), batches),
        "mirrored": (learn(actor, size, round(batch * p.symmetric_share)), batches),
        "critic": (learn(critic, CRITIC_SIZE, batch), batches),
    }


def _repeated(job: Callable[[], object], times: int) -> Callable[[], None]:
    def repeated() -> None:
        for _ in range(times):
            job()

    return repeated


def training(config: ConstrainedConfig | None = None, updates: int = 5) -> dict[str, float]:
    """Policy samples a second of the whole loop, of its bare parts, their ratio, and the shares of the loop's parts."""
    config = config or ConstrainedConfig(critic_first=0)
    run = ConstrainedRun(config)
    seen: list[dict[str, float]] = []
    parts = _bare_parts(run)
    seconds = _in_turn(
        {"whole": lambda: seen.append(run.step(0.0))} | {name: job for name, (job, _) in parts.items()},
        updates,
    )
    bare = np.sum([calls * seconds[name] for name, (_, calls) in parts.items()], axis=0)
    shares = {f"{part}_share": float(np.mean([one[part] for one in seen])) for part in PARTS}
    return _rate_and_ratio("samples", config.n * config.length, seconds["whole"], bare) | shares
