"""Benchmark of training: its speed as a ratio to what its parts allow on this machine.

`environment` compares a tick with actuators, sensing and rewards to bare `mujoco.batch` steps from
the same states. `training` compares a whole update (rollout and learning, with symmetry and
smoothness) to bare steps and bare passes of the same networks over the same sizes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
import torch
from mujoco.batch import Batch

from quadvel_description.arrays import Array
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_eval.bench import Benchmark
from quadvel_policy.observation import OBSERVATION_SIZE

from . import dagger
from .constrained import CRITIC_SIZE, PARTS, ConstrainedConfig, ConstrainedRun
from .env import EnvConfig, VelocityEnv, training_model
from .networks import Mlp, Recurrent
from .rewards import RewardWeights, Table2


def _time_interleaved(jobs: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, Array]:
    """Time jobs in turn, after a warm-up call of each; return seconds (rounds,) of each job.

    In each round the jobs run one after the other, so that a slow phase of the machine affects all
    of them: ratios within a round hold where times do not.
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


def _rate_and_ratio(amount: str, count: int, whole: Array, bare: Array) -> dict[str, float]:
    """Return median rates per second of the whole and its bare parts, and their ratio."""
    return {
        f"{amount}_per_s": count / float(np.median(whole)),
        f"bare_{amount}_per_s": count / float(np.median(bare)),
        "ratio": float(np.median(bare / whole)),
    }


def _bare_tick(env: VelocityEnv) -> Callable[[], None]:
    """Physics of one tick for nominal robots, from the states and torques of `env`.

    It uses the same states because robots on their feet are faster to simulate than robots that
    stumble.
    """
    batch = Batch(
        training_model(env.robot, env.config.timestep, env.config.terrain), env.config.n, env.config.threads
    )
    rows = [(batch.bind(name), env.batch.bind(name)) for name in ("qpos", "qvel", "ctrl")]

    def tick() -> None:
        for own, given in rows:
            own[:] = given
        for _ in range(env.substeps):
            batch.step()

    return tick


def environment(n: int = 512, threads: int = 2, timestep: float = 0.001) -> dict[str, float]:
    """Measure the environment against the bare batch.

    Args:
        n: number of robots.
        threads: threads of the physics.
        timestep: s, of the physics.

    Returns:
        Steps per second of both, and their ratio.
    """
    config = EnvConfig(robot=load_robot(DEFAULT_ROBOT), n=n, threads=threads, timestep=timestep)
    env = VelocityEnv(config)
    rewards = Table2(env, RewardWeights())
    action = np.zeros((n, 12), np.float32)

    def tick() -> None:
        dagger.observe(env, action)
        env.tick(np.tile(env.stand_q, (n, 1)))
        rewards(action)

    seconds = _time_interleaved({"whole": tick, "bare": _bare_tick(env)}, 60)
    return _rate_and_ratio("steps", n * env.substeps, seconds["whole"], seconds["bare"])


def _bare_parts(run: ConstrainedRun) -> dict[str, tuple[Callable[[], object], float]]:
    """Physics and network passes that an update needs at least, each with its number of calls.

    The passes are inference, and forward and backward passes of actor, mirrored actor and critic.
    """
    config, size = run.config, OBSERVATION_SIZE
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
    few = 16  # ticks per call, long enough to be timed next to an update
    return {
        "physics": (_repeated(_bare_tick(run.env), few), length / few),
        "inference": (_repeated(infer, few), length / few),
        "actor": (learn(actor, size, batch), batches),
        "mirrored": (learn(actor, size, round(batch * p.symmetric_share)), batches),
        "critic": (learn(critic, CRITIC_SIZE, batch), batches),
    }


def _repeated(job: Callable[[], object], times: int) -> Callable[[], None]:
    """Return a function that calls `job` several times."""

    def repeated() -> None:
        for _ in range(times):
            job()

    return repeated


def training(config: ConstrainedConfig | None = None, updates: int = 5) -> dict[str, float]:
    """Measure a whole update against its bare parts.

    Args:
        config: configuration of stage 3, the default if None.
        updates: number of updates.

    Returns:
        Policy samples per second of both, their ratio, and the shares of the parts.
    """
    config = config or ConstrainedConfig(critic_first=0)
    run = ConstrainedRun(config)
    seen: list[dict[str, float]] = []
    parts = _bare_parts(run)
    seconds = _time_interleaved(
        {"whole": lambda: seen.append(run.step(0.0))} | {name: job for name, (job, _) in parts.items()},
        updates,
    )
    bare = np.sum([calls * seconds[name] for name, (_, calls) in parts.items()], axis=0)
    shares = {f"{part}_share": float(np.mean([one[part] for one in seen])) for part in PARTS}
    return _rate_and_ratio("samples", config.n * config.length, seconds["whole"], bare) | shares


ENVIRONMENT = Benchmark(
    environment,
    (
        ("steps_per_s", "training environment, steps/s", ""),
        ("ratio", "divided by that of the bare batch", "0.7 or more"),
    ),
)
TRAINING = Benchmark(
    training,
    (
        ("samples_per_s", "training, policy samples/s", ""),
        ("ratio", "divided by that of bare steps and passes", "0.6 or more"),
        ("physics_share", "share of training time: physics and actuators", ""),
        ("sensing_share", "share: observations and rewards", ""),
        ("inference_share", "share: inference", ""),
        ("learning_share", "share: learning", ""),
    ),
)
"""Entry points of `quadvel bench`, as ENVIRONMENT."""
