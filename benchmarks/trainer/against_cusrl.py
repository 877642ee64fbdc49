"""Speed of our learner compared with cusrl's recurrent PPO (docs/decisions/0007-own-learner.md).

Both have the same networks, environments, sequence length, epochs and mini-batches, run on one
thread, and take turns. It measures processor time, so that the ratios hold on a busy machine. It
does not measure how well either learns.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import attrs
import numpy as np
import torch
import typer
from typing_extensions import override

from quadvel_description import symmetry
from quadvel_policy.observation import OBSERVATION_SIZE
from quadvel_training import constrained, dagger, networks
from quadvel_training.constrained import ConstrainedConfig, ConstrainedRun
from quadvel_training.networks import Gaussian, Mlp, Recurrent, torch_mirror
from quadvel_training.ppo import Ppo, Rollout

try:
    import cusrl  # type: ignore[import-not-found,import-untyped,unused-ignore]
except ModuleNotFoundError:
    raise SystemExit("This comparison needs cusrl: pip install cusrl==1.2.2") from None

OBS = OBSERVATION_SIZE
STATE = constrained.CRITIC_SIZE
CRITIC = (256, 128, 64)
MIRROR_OBS, MIRROR_ACTION = torch_mirror(symmetry.OBSERVATION), torch_mirror(symmetry.JOINTS)
Jobs = tuple[Callable[[], object], Callable[[], object]]


class OurLearner:
    """Inference and update of `ConstrainedRun` on random observations without resets."""

    def __init__(self, config: ConstrainedConfig) -> None:
        """Create policy, critic and learner.

        Args:
            config: configuration of stage 3.
        """
        self.config = config
        self.actor = Gaussian(Recurrent(OBS, 12), 12, config.std)
        self.actor.log_std.requires_grad_(False)
        self.ppo = Ppo(self.actor, Mlp(STATE, 1, CRITIC), config.ppo, MIRROR_OBS, MIRROR_ACTION)
        self.seen = self.ppo.mirrored_count(config.n)
        self.state = self.actor.network.initial_state(config.n)
        self.mirrored = self.actor.network.initial_state(self.seen)

    def update(self) -> None:
        """One rollout, one update."""
        shape = (self.config.length, self.config.n)
        obs, critic_obs = torch.randn(*shape, OBS), torch.randn(shape[0] + 1, shape[1], STATE)
        start, mirrored, means = self.state, self.mirrored, []
        with torch.no_grad():
            for now in obs:
                mean, self.state = self.actor(now[None], self.state)
                means.append(mean[0])
            _, self.mirrored = self.actor(MIRROR_OBS(obs[:, : self.seen]), mirrored)
        mean, never = torch.stack(means), torch.zeros(shape)
        action = mean + self.config.std * torch.randn_like(mean)
        past = (obs, critic_obs[:-1], action, mean, torch.randn(shape), never, never, 1 - never)
        self.ppo.update(Rollout(*past, torch.zeros_like(mean[0]), critic_obs[-1], start, mirrored))


class Noise(cusrl.Environment):
    """Random observations without resets, with the robot's sizes and mirrors."""

    def __init__(self, n: int) -> None:
        """Set sizes and mirrors.

        Args:
            n: number of environments.
        """
        # the symmetry loss requires a mirror of the critic's input but never calls it
        mirrors = {"mirror_action": MIRROR_ACTION, "mirror_state": MIRROR_OBS}
        super().__init__(OBS, 12, num_instances=n, state_dim=STATE, mirror_observation=MIRROR_OBS, **mirrors)

    @override
    def reset(self, **_: Any) -> tuple[Any, ...]:
        return torch.randn(self.num_instances, OBS), torch.randn(self.num_instances, STATE), {}

    @override
    def step(self, action: torch.Tensor) -> tuple[Any, ...]:
        never = torch.zeros(self.num_instances, 1, dtype=torch.bool)
        return *self.reset()[:2], torch.randn(self.num_instances, 1), never, never, {}


class Walk(Noise):
    """The environment, rewards and sensing of a `ConstrainedRun`."""

    def __init__(self, run: ConstrainedRun) -> None:
        """Wrap a training run.

        Args:
            run: its environments and rewards are used.
        """
        super().__init__(run.config.n)
        self.run, self.action = run, np.zeros((run.config.n, 12), np.float32)

    def _observe(self) -> tuple[torch.Tensor, torch.Tensor]:
        obs = dagger.observe(self.run.env, self.action)
        return torch.from_numpy(obs), torch.from_numpy(self.run.critic_obs())

    @override
    def reset(self, *, indices: Any = None, **_: Any) -> tuple[Any, ...]:
        ids = np.arange(self.num_instances) if indices is None else np.asarray(indices)
        self.run.env.reset(ids)
        self.run.rewards.reset(ids)
        self.action[ids] = 0.0
        obs, state = self._observe()
        return obs[ids], state[ids], {}

    @override
    def step(self, action: torch.Tensor) -> tuple[Any, ...]:
        env, self.action = self.run.env, action.numpy().copy()
        env.tick(self.run.map.targets(self.action))
        reward = self.run.rewards(self.action).astype(np.float32)
        columns = (reward, env.fallen, env.timed_out & ~env.fallen)
        return *self._observe(), *(torch.from_numpy(column[:, None]) for column in columns), {}


class PartSymmetry(cusrl.hook.MirrorSymmetryLoss):
    """The symmetry loss on a quarter of each mini-batch, as in ours."""

    @override
    def objective(self, metadata: dict[str, Any], batch: dict[str, Any]) -> Any:
        names = {"observation", "done", "curr_action_dist", "mirrored_actor_memory"} & set(batch)
        seen = batch["done"].shape[1] // 4
        part = {name: cusrl.utils.nest.map_nested(lambda x: x[:, :seen], batch[name]) for name in names}
        return super().objective(metadata, part)


def cusrl_agent(config: ConstrainedConfig, env: Noise, recurrent_critic: bool, lean: bool) -> Any:
    """Create cusrl's PPO with our sizes, and its defaults where they cost no time.

    Args:
        config: configuration of stage 3.
        env: environment.
        recurrent_critic: whether the critic is an LSTM, too.
        lean: symmetry on a quarter of each mini-batch, and no statistics pass after each update.

    Returns:
        The agent.
    """
    p, preset, hook = config.ppo, cusrl.preset, cusrl.hook
    mlp = partial(cusrl.Mlp.Factory, activation_fn="SiLU", ends_with_activation=True)
    lstm = [cusrl.Lstm.Factory(hidden_size=networks.MEMORY), mlp(hidden_dims=networks.HIDDEN)]
    recurrent = cusrl.Sequential.Factory(lstm, [networks.MEMORY])
    hooks = preset.ppo.ppo_hook_suite(desired_kl_divergence=p.target_kl)
    if lean:
        extra = (hook.OnPolicyStatistics, hook.AdaptiveLRSchedule)
        hooks = [h for h in hooks if not isinstance(h, extra)] + [hook.MiniBatchWiseLRSchedule(p.target_kl)]
    mirror = (PartSymmetry if lean else hook.MirrorSymmetryLoss)(p.symmetry)
    after = next(i for i, h in enumerate(hooks) if isinstance(h, hook.EntropyLoss))
    hooks[after:after] = [mirror, hook.ActionSmoothnessLoss(weight_2nd_order=p.smoothness)]
    return cusrl.ActorCritic.Factory(
        num_steps_per_update=config.length,
        actor_factory=cusrl.Actor.Factory(recurrent, cusrl.NormalDist.Factory(init_std=config.std)),
        critic_factory=cusrl.Value.Factory(recurrent if recurrent_critic else mlp(hidden_dims=CRITIC)),
        optimizer_factory=preset.optimizer.AdamFactory(defaults={"lr": p.learning_rate}),
        sampler=cusrl.AutoMiniBatchSampler(num_epochs=p.epochs, num_mini_batches=p.mini_batches),
        hooks=hooks,
        device="cpu",
    ).from_environment(env)


class TheirLoop:
    """Rollout and update of cusrl, as its trainer does them, without logging."""

    def __init__(self, config: ConstrainedConfig, env: Noise, recurrent_critic: bool, lean: bool) -> None:
        """Create the agent.

        Args:
            config: configuration of stage 3.
            env: environment.
            recurrent_critic: whether the critic is an LSTM, too.
            lean: as in `cusrl_agent`.
        """
        self.env, self.agent = env, cusrl_agent(config, env, recurrent_critic, lean)
        self.seen = env.reset()[:2]

    def update(self) -> None:
        """One rollout, one update."""
        template, ready = cusrl.template.environment, False
        while not ready:
            obs, state, reward, ended, cut, _ = self.env.step(self.agent.act(*self.seen))
            ready = self.agent.step(obs, reward, ended, cut, state)
            if over := template.get_done_indices(ended, cut):
                fresh = self.env.reset(indices=over)[:2]
                obs, state = template.update_observation_and_state(obs, state, over, *fresh)
            self.seen = obs, state
        self.agent.update()


def contestants(config: ConstrainedConfig) -> dict[str, Jobs]:
    """Create what is compared.

    Args:
        config: configuration of stage 3.

    Returns:
        By name: a call of the learner alone, and one of the whole loop with physics.
    """
    everywhere = attrs.evolve(config, ppo=attrs.evolve(config.ppo, symmetric_share=1.0))
    jobs: dict[str, Jobs] = {}
    for name, c in {"ours, symmetry on a quarter": config, "ours, symmetry on all": everywhere}.items():
        jobs[name] = OurLearner(c).update, partial(ConstrainedRun(c).step, 0.0)
    critics = {"LSTM critic": (True, False), "MLP critic": (False, False), "MLP critic, lean": (False, True)}
    for name, options in critics.items():
        environments = Noise(config.n), Walk(ConstrainedRun(config))
        alone, whole = (TheirLoop(config, env, *options).update for env in environments)
        jobs[f"cusrl, {name}"] = alone, whole
    return jobs


def main(repeats: Annotated[int, typer.Option(help="Updates of each contestant, in turns.")] = 3) -> None:
    """Compare our learner with cusrl's recurrent PPO on one thread."""
    torch.set_num_threads(1)
    config = ConstrainedConfig(threads=1, critic_first=0)
    jobs = contestants(config)
    seconds = np.zeros((repeats, len(jobs), 2))
    for turn, row, column in np.ndindex(seconds.shape):
        started = time.process_time()
        list(jobs.values())[row][column]()
        seconds[turn, row, column] = time.process_time() - started
    median = np.median(seconds, axis=0)
    print(f"{'samples per processor second':30}{'learner':>9}{'whole':>9}   first row is as fast, times")
    for name, spent, rate in zip(jobs, median, config.n * config.length / median, strict=True):
        ratio = spent / median[0]
        print(f"{name:30}{rate[0]:9.0f}{rate[1]:9.0f}{ratio[0]:9.2f}{ratio[1]:9.2f}")


if __name__ == "__main__":
    typer.run(main)
