"""Proximal policy optimisation with the paper's two constraints (Eq. 6 to 8), for memoryless and recurrent actors alike.

Sequences are cut at fixed lengths. Those of a recurrent actor never contain a reset: an environment that ends within a
sequence is masked from there on and starts over with the next one, so a recurrent pass is one call of the fused LSTM.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import attrs
import numpy as np
import torch
from torch import Tensor

from . import parallel
from .loop import set_rate
from .networks import Gaussian, State, select

LOG_RATIO_BOUND = 10.0  # of the likelihoods now and when it was drawn; the clip of PPO lies far inside
FAR = (
    0.5  # of the network's unit: what a teacher asks of a robot that is about to fall must not drown all else
)
QUIET_SHARE = 0.25  # of the robots, the last ones, explore little:
QUIET = 0.3  # of what the others do, so that a policy works without noise, too
ADVANTAGE_BOUND = 10.0  # standard deviations: a fall must not drown what all others show


@attrs.frozen
class PpoConfig:
    """Hyperparameters; names and defaults follow Table 3 where it speaks."""

    discount: float = 0.99
    gae: float = 0.95
    clip: float = 0.2
    epochs: int = 4
    mini_batches: int = 4
    critic_steps: int = 1  # for one of the actor: without a memory, many small ones cost no more
    learning_rate: float = 5e-4
    max_learning_rate: float = 1e-3
    target_kl: float | None = 0.01
    """of an update, as if exploration were white, and that of all robots the same: correlated, lasting shifts would count too
    little; None keeps the rate, as it must where an update is a single step, before which nothing has shifted yet"""
    entropy: float = 0.0
    symmetry: float = 0.5  # w_sym of Eq. 8
    smoothness: float = 0.0  # w_smooth of Eq. 8
    symmetric_share: float = 1.0  # of the environments, the first ones, that the symmetry term sees
    correlation: float = 0.0  # of the exploration from sample to sample
    max_grad_norm: float = 1.0
    momentum: float = (
        0.0  # above 0: plain gradient steps. Adam steps in all weights alike, most of which see but noise
    )


GENTLE = PpoConfig(
    discount=0.995,
    gae=0.97,
    epochs=1,
    mini_batches=1,
    critic_steps=16,
    learning_rate=1.5e-4,
    target_kl=None,
    momentum=0.95,
    max_grad_norm=4.0,
    symmetry=0.01,
    smoothness=0.05,
    symmetric_share=0.25,
    correlation=0.9,
)
"""For a recurrent policy at 200 Hz that walks already: one small step a rollout, exploration that lasts"""


@attrs.define
class Rollout:
    """One stretch of experience; time first. `mask` is 1 while the sequence is alive."""

    obs: Tensor  # (T, N, O)
    critic_obs: Tensor  # (T, N, C)
    action: Tensor  # (T, N, A)
    mean: Tensor  # (T, N, A) of the policy that acted
    reward: Tensor  # (T, N)
    ended: Tensor  # (T, N) 1 where the episode failed at the end of the sample
    cut: Tensor  # (T, N) 1 where it timed out instead
    mask: Tensor  # (T, N)
    noise: Tensor  # (N, A) exploration at the sample before the first
    last_critic_obs: Tensor  # (N, C)
    state: State | None = None  # of the actor at the start
    mirrored_state: State | None = None  # of the actor on the mirrored past, of those the symmetry term sees
    label: Tensor | None = None  # (T, N, A) what a teacher would have done
    spread: Tensor | None = None  # (N, 1) of each robot's exploration, a share of the policy's; None: 1
    standing: Tensor | None = (
        None  # (T, N) 1 on four feet, where it may prefer a side: it has to begin with one
    )


def living_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Over the living samples of all processes: the mean of what each process returns here, and so of its gradients."""
    return (values * mask).sum() / parallel.mean(mask.sum()).clamp(min=1)


def spreads(n: int) -> np.ndarray:
    """How much each of `n` robots explores, (n, 1), as a share of the policy's exploration.

    What noise alone does for most of them, such as to begin with one of two legs, the policy has to do for the quiet ones.
    """
    return np.where(np.arange(n)[:, None] < (1.0 - QUIET_SHARE) * n, 1.0, QUIET).astype(np.float32)


class Ppo:
    """One learner: an actor, a critic on the simulator's true state, an optimiser."""

    def __init__(
        self,
        actor: Gaussian,
        critic: torch.nn.Module,
        config: PpoConfig,
        mirror_obs: Callable[[Tensor], Tensor],
        mirror_action: Callable[[Tensor], Tensor],
    ) -> None:
        self.actor, self.critic, self.config = actor, critic, config
        self.mirror_obs, self.mirror_action = mirror_obs, mirror_action
        rate, momentum = config.learning_rate, config.momentum
        self.actor_optimiser: torch.optim.Optimizer = (
            torch.optim.SGD(actor.parameters(), lr=rate, momentum=momentum)
            if momentum
            else torch.optim.Adam(actor.parameters(), lr=rate)
        )
        self.critic_optimiser = torch.optim.Adam(critic.parameters(), lr=1e-3)
        self.learning_rate = config.learning_rate

    def mirrored(self, n: int) -> int:
        """How many of `n` environments the symmetry term sees."""
        return max(1, round(n * self.config.symmetric_share))

    def state(self) -> dict[str, Any]:
        """The optimisers, for a checkpoint."""
        return {
            "actor_optimiser": self.actor_optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "learning_rate": self.learning_rate,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`; at the configuration's own learning rate where that is not adapted."""
        self.actor_optimiser.load_state_dict(state["actor_optimiser"])
        self.critic_optimiser.load_state_dict(state["critic_optimiser"])
        if self.config.target_kl is not None:
            self.learning_rate = state["learning_rate"]
        set_rate(self.actor_optimiser, self.learning_rate)

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def advantages(self, r: Rollout) -> tuple[Tensor, Tensor]:
        """Generalised advantage estimates and value targets, (T, N) each."""
        c = self.config
        value = self.critic(torch.cat([r.critic_obs, r.last_critic_obs[None]]))[0][..., 0]
        advantage = torch.zeros_like(r.reward)
        running = torch.zeros_like(r.reward[0])
        for t in reversed(range(len(r.reward))):
            going = 1.0 - r.ended[t]
            following = torch.where(r.cut[t] > 0, value[t], value[t + 1])  # a timeout is no failure
            delta = r.reward[t] + c.discount * following * going - value[t]
            running = delta + c.discount * c.gae * going * (1.0 - r.cut[t]) * running
            running = running * r.mask[t]
            advantage[t] = running
        return advantage, advantage + value[:-1]

    def update(
        self, r: Rollout, learn_actor: bool = True, pull: float = 0.0, constraints: float = 1.0
    ) -> dict[str, float]:
        """Several epochs over one rollout; returns means of the loss terms.

        pull: weight of the distance to the rollout's labels; constraints: share of the configuration's weights.
        """
        advantage, target = self.advantages(r)
        explained = 1 - living_mean(advantage**2, r.mask) / target[r.mask > 0].var().clamp(min=1e-8)
        centre = parallel.mean(living_mean(advantage, r.mask))
        spread = parallel.mean(living_mean((advantage - centre) ** 2, r.mask)).sqrt()
        advantage = ((advantage - centre) / (spread + 1e-6)).clamp(-ADVANTAGE_BOUND, ADVANTAGE_BOUND)
        with torch.no_grad():
            old_log_prob = self._log_prob(r, slice(None), r.mean)
        total: dict[str, float] = {}
        batches = 0
        for ids in self._mini_batches(r.reward.shape[1], r.reward.device):
            mask = r.mask[:, ids]
            terms = self._critic_step(r.critic_obs[:, ids], target[:, ids], mask)
            if learn_actor:
                weights = pull, constraints
                terms |= self._actor_step(r, ids, advantage[:, ids], old_log_prob[:, ids], mask, weights)
            for name, value in terms.items():
                total[name] = total.get(name, 0.0) + value
            batches += 1
        means = {name: value / batches for name, value in total.items()}
        if learn_actor and self.config.target_kl is not None:
            self._adapt_rate(means["kl"], self.config.target_kl)
        return means | {"explained_variance": float(explained), "learning_rate": self.learning_rate}

    def _draws(self, noise: Tensor, before: Tensor) -> Tensor:
        """What was drawn anew in every sample of correlated exploration (T, N, A), of which `before` (N, A) was the last."""
        return noise - self.config.correlation * torch.cat([before[None], noise[:-1]])

    def _log_prob(self, r: Rollout, ids: Tensor | slice, mean: Tensor) -> Tensor:
        """Log density of the actions that robots `ids` took, (T, N), if the policy meant `mean`, but for a constant.

        Of the draws given the whole past: what the actions deviate by now depends on what the mean was then. With the
        decayed noise taken as a given offset, the gradient would be that of a mean which changes along with the noise.
        """
        draws = self._draws(r.action[:, ids] - mean, r.noise[ids])
        if r.spread is not None:
            draws = draws / r.spread[ids]
        return self.actor.log_prob(torch.zeros_like(draws), draws)

    def _mini_batches(self, n: int, device: torch.device) -> Iterator[Tensor]:
        for _ in range(self.config.epochs):
            yield from torch.randperm(n).to(device).chunk(self.config.mini_batches)

    def _critic_step(self, obs: Tensor, target: Tensor, mask: Tensor) -> dict[str, float]:
        steps, total = self.config.critic_steps, 0.0
        parts = zip(*(x.tensor_split(steps, dim=1) for x in (obs, target, mask)), strict=True)
        for part_obs, part_target, part_mask in parts:
            loss = living_mean((self.critic(part_obs)[0][..., 0] - part_target) ** 2, part_mask)
            self._step(self.critic_optimiser, self.critic, loss)
            total += float(loss.detach())
        return {"value_loss": total / steps}

    def _actor_step(
        self,
        r: Rollout,
        ids: Tensor,
        advantage: Tensor,
        old_log_prob: Tensor,
        mask: Tensor,
        weights: tuple[float, float],
    ) -> dict[str, float]:
        c, actor = self.config, self.actor
        pull, constraints = weights
        mean, _ = actor(r.obs[:, ids], r.state and select(r.state, ids))
        log_ratio = self._log_prob(r, ids, mean) - old_log_prob
        ratio = log_ratio.clamp(
            -LOG_RATIO_BOUND, LOG_RATIO_BOUND
        ).exp()  # one that overflows spoils all weights
        clipped = ratio.clamp(1 - c.clip, 1 + c.clip)
        surrogate = -living_mean(torch.minimum(ratio * advantage, clipped * advantage), mask)
        variance = (2 * actor.log_std).exp().detach()

        seen = ids < self.mirrored(r.reward.shape[1])
        before = r.mirrored_state and select(r.mirrored_state, ids[seen])
        with torch.set_grad_enabled(c.symmetry > 0.0):  # else the term is but watched
            mirrored, _ = actor(self.mirror_obs(r.obs[:, ids[seen]]), before)
        gap = (mean[:, seen] - self.mirror_action(mirrored)) ** 2 / (2 * variance)
        stepping = mask[:, seen] if r.standing is None else mask[:, seen] * (1 - r.standing[:, ids[seen]])
        symmetry = living_mean(gap.sum(-1), stepping)
        bend = mean[2:] - 2 * mean[1:-1] + mean[:-2]
        smoothness = living_mean(bend.norm(dim=-1), mask[2:])

        constrained = constraints * (c.symmetry * symmetry + c.smoothness * smoothness)
        loss = surrogate + constrained - c.entropy * actor.entropy()
        terms = {"surrogate": surrogate, "symmetry": symmetry, "smoothness": smoothness}
        if r.label is not None:
            away = torch.nn.functional.huber_loss(mean, r.label[:, ids], reduction="none", delta=FAR)
            terms["away"] = living_mean(away.mean(-1), mask)
            loss = loss + pull * terms["away"]
        self._step(self.actor_optimiser, actor, loss)
        if c.target_kl is not None:
            shift = ((mean.detach() - r.mean[:, ids]) ** 2 / (2 * variance)).sum(-1)
            terms["kl"] = parallel.mean(living_mean(shift, mask))
        return {name: float(term.detach()) for name, term in terms.items()}

    def _step(self, optimiser: torch.optim.Optimizer, module: torch.nn.Module, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()
        parallel.share_gradients(module)
        norm = torch.nn.utils.clip_grad_norm_(module.parameters(), self.config.max_grad_norm)
        if not torch.isfinite(norm):
            raise FloatingPointError(
                "the gradient is not finite: the run ends before it spoils its weights; go on from its checkpoint"
            )
        optimiser.step()

    def _adapt_rate(self, kl: float, target: float) -> None:
        """Keep the KL divergence of an update near its target."""
        if kl > 2 * target:
            self.learning_rate /= 1.5
        elif kl < 0.5 * target:
            self.learning_rate *= 1.2
        self.learning_rate = min(max(self.learning_rate, 1e-6), self.config.max_learning_rate)
        set_rate(self.actor_optimiser, self.learning_rate)
