"""Proximal policy optimisation (PPO) with the constraints of Eq. 6 to 8.

The constraints are symmetry and smoothness; actors are memoryless or recurrent.

Sequences have a fixed length. Those of a recurrent actor never contain a reset: an environment that
ends within a sequence is masked for the rest and starts over with the next one. So one pass is one
call of the fused LSTM.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import attrs
import numpy as np
import torch
from torch import Tensor

from . import process_group
from .loop import set_rate
from .networks import Gaussian, State, select

LOG_RATIO_BOUND = 10.0  # bound of |log r|, far outside the clip range of PPO
IMITATION_HUBER_DELTA = 0.5  # network's unit; labels of robots about to fall must not dominate
QUIET_ROBOT_SHARE = 0.25  # share of the robots, the last ones, that explore little
QUIET_NOISE_RATIO = 0.3  # their exploration relative to the others', so that noise is not relied on
ADVANTAGE_BOUND = 10.0  # standard deviations; one fall must not dominate an update


@attrs.frozen
class PpoConfig:
    """Hyperparameters of PPO; names and defaults follow Table 3 where it gives them.

    Attributes:
        discount: discount factor gamma per sample.
        gae: lambda of the generalised advantage estimate.
        clip: clip range epsilon of the likelihood ratio.
        epochs: passes over a rollout.
        mini_batches: mini-batches per epoch.
        critic_steps: critic steps per actor step; a memoryless critic affords many small ones.
        learning_rate: initial learning rate of the actor.
        max_learning_rate: upper bound of the adapted learning rate.
        target_kl: KL divergence per update that the learning rate is adapted to. It is computed as if
            exploration were white and equal for all robots, because lasting shifts would count too
            little with correlated noise. Use None if an update has one step: its KL is always 0.
        entropy: weight of the entropy bonus.
        symmetry: w_sym of Eq. 8.
        smoothness: w_smooth of Eq. 8.
        symmetric_share: share of the environments, the first ones, in the symmetry term.
        correlation: autocorrelation of the exploration noise from sample to sample.
        max_grad_norm: bound of the gradient norm.
        momentum: above 0 the actor uses SGD with this momentum instead of Adam, which takes equal
            steps in all weights, though most see noise only.
    """

    discount: float = 0.99
    gae: float = 0.95
    clip: float = 0.2
    epochs: int = 4
    mini_batches: int = 4
    critic_steps: int = 1
    learning_rate: float = 5e-4
    max_learning_rate: float = 1e-3
    target_kl: float | None = 0.01
    entropy: float = 0.0
    symmetry: float = 0.5
    smoothness: float = 0.0
    symmetric_share: float = 1.0
    correlation: float = 0.0
    max_grad_norm: float = 1.0
    momentum: float = 0.0


RECURRENT_PPO = PpoConfig(
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
"""For a recurrent policy that already walks: one small step per rollout, correlated exploration"""


@attrs.define
class Rollout:
    """Experience of T samples of N environments, time first.

    O, C and A are the sizes of observation, critic observation and action.

    Attributes:
        obs: (T, N, O), observations.
        critic_obs: (T, N, C), observations of the critic.
        action: (T, N, A), actions taken.
        mean: (T, N, A), mean of the policy that acted.
        reward: (T, N).
        ended: (T, N), 1 where the episode failed at the end of the sample.
        cut: (T, N), 1 where the episode timed out at the end of the sample.
        mask: (T, N), 1 while the sequence is alive.
        noise: (N, A), exploration noise of the sample before the first.
        last_critic_obs: (N, C), observations of the critic after the last sample.
        state: memory of the actor at the start.
        mirrored_state: memory of the actor on the mirrored past, of the environments in the
            symmetry term.
        label: (T, N, A), actions of a teacher.
        spread: (N, 1), exploration of each robot as a share of the policy's; None for 1.
        standing: (T, N), 1 for a robot on four feet; the symmetry term ignores it, as it has to
            start with one side.
    """

    obs: Tensor
    critic_obs: Tensor
    action: Tensor
    mean: Tensor
    reward: Tensor
    ended: Tensor
    cut: Tensor
    mask: Tensor
    noise: Tensor
    last_critic_obs: Tensor
    state: State | None = None
    mirrored_state: State | None = None
    label: Tensor | None = None
    spread: Tensor | None = None
    standing: Tensor | None = None


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over the living samples of all processes.

    Args:
        values: (T, N).
        mask: (T, N), 1 for living samples.

    Returns:
        A number whose mean over the processes is the mean over all samples; the same holds for its
        gradients.
    """
    return (values * mask).sum() / process_group.mean(mask.sum()).clamp(min=1)


def exploration_scales(n: int) -> np.ndarray:
    """Share of the policy's exploration that each robot uses.

    The last `QUIET_ROBOT_SHARE` of the robots explore little. What noise does for most of them,
    such as choosing the leg to start with, the policy has to do for the quiet ones.

    Args:
        n: number of robots.

    Returns:
        (n, 1).
    """
    return np.where(np.arange(n)[:, None] < (1.0 - QUIET_ROBOT_SHARE) * n, 1.0, QUIET_NOISE_RATIO).astype(
        np.float32
    )


class Ppo:
    """PPO learner: an actor, a critic on the simulator's true state, and their optimisers."""

    def __init__(
        self,
        actor: Gaussian,
        critic: torch.nn.Module,
        config: PpoConfig,
        mirror_obs: Callable[[Tensor], Tensor],
        mirror_action: Callable[[Tensor], Tensor],
    ) -> None:
        """Create the optimisers.

        Args:
            actor: policy.
            critic: value function, (..., C) to (..., 1).
            config: hyperparameters.
            mirror_obs: mirror image of observations.
            mirror_action: mirror image of actions.
        """
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

    def mirrored_count(self, n: int) -> int:
        """Number of environments in the symmetry term.

        Args:
            n: number of environments.

        Returns:
            At least 1.
        """
        return max(1, round(n * self.config.symmetric_share))

    def state(self) -> dict[str, Any]:
        """Return the state of the optimisers for a checkpoint.

        Returns:
            The state, for `restore`.
        """
        return {
            "actor_optimiser": self.actor_optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "learning_rate": self.learning_rate,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the optimisers; a learning rate that is not adapted comes from the configuration.

        Args:
            state: what `state` returned.
        """
        self.actor_optimiser.load_state_dict(state["actor_optimiser"])
        self.critic_optimiser.load_state_dict(state["critic_optimiser"])
        if self.config.target_kl is not None:
            self.learning_rate = state["learning_rate"]
        set_rate(self.actor_optimiser, self.learning_rate)

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def advantages(self, r: Rollout) -> tuple[Tensor, Tensor]:
        """Compute generalised advantage estimates and value targets (Schulman et al. 2016).

        Args:
            r: rollout.

        Returns:
            Advantages and value targets, (T, N) each.
        """
        c = self.config
        value = self.critic(torch.cat([r.critic_obs, r.last_critic_obs[None]]))[0][..., 0]
        advantage = torch.zeros_like(r.reward)
        running = torch.zeros_like(r.reward[0])
        # delta[t] = r[t] + gamma V[t+1] (1 - ended[t]) - V[t]
        # A[t] = delta[t] + gamma lambda (1 - ended[t]) (1 - cut[t]) A[t+1], target[t] = A[t] + V[t]
        # After a timeout the state goes on, but its successor belongs to another episode: V[t]
        # stands
        # for V[t+1].
        for t in reversed(range(len(r.reward))):
            going = 1.0 - r.ended[t]
            following = torch.where(r.cut[t] > 0, value[t], value[t + 1])  # a timeout is no failure
            delta = r.reward[t] + c.discount * following * going - value[t]
            running = delta + c.discount * c.gae * going * (1.0 - r.cut[t]) * running
            running = running * r.mask[t]
            advantage[t] = running
        return advantage, advantage + value[:-1]

    def update(
        self,
        r: Rollout,
        learn_actor: bool = True,
        pull: float = 0.0,
        constraints: float = 1.0,
        measure_agreement: bool = False,
    ) -> dict[str, float]:
        """Learn from one rollout.

        Args:
            r: rollout.
            learn_actor: whether the actor learns, too.
            pull: weight of the distance to the rollout's labels.
            constraints: share of the configured constraint weights, 0 to 1.
            measure_agreement: whether to measure `agreement` first.

        Returns:
            Means of the loss terms, explained variance, learning rate and, if measured, agreement,
            for the log.

        Raises:
            FloatingPointError: a gradient is not finite.
        """
        advantage, target = self.advantages(r)
        # Normalise over all processes; the bound keeps one fall from dominating the update:
        #     A <- clamp((A - mean(A)) / std(A), +-ADVANTAGE_BOUND)
        explained = 1 - masked_mean(advantage**2, r.mask) / target[r.mask > 0].var().clamp(min=1e-8)
        centre = process_group.mean(masked_mean(advantage, r.mask))
        spread = process_group.mean(masked_mean((advantage - centre) ** 2, r.mask)).sqrt()
        advantage = ((advantage - centre) / (spread + 1e-6)).clamp(-ADVANTAGE_BOUND, ADVANTAGE_BOUND)
        with torch.no_grad():
            old_log_prob = self._log_prob(r, slice(None), r.mean)
        seen = {"explained_variance": float(explained)}
        if measure_agreement:
            seen["agreement"] = self.agreement(r, advantage, old_log_prob)
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
        return means | seen | {"learning_rate": self.learning_rate}

    def agreement(self, r: Rollout, advantage: Tensor, old_log_prob: Tensor) -> float:
        """Compare the gradients of the reward on two random halves of the robots.

        Args:
            r: rollout.
            advantage: (T, N), normalised.
            old_log_prob: (T, N), of the actions under the policy that acted.

        Returns:
            Cosine of the angle between the two gradients of the actor: near 1 if the rollout is
            large enough, about 0 if the gradients are noise.
        """
        weights = [weight for weight in self.actor.parameters() if weight.requires_grad]
        gradients = []
        for ids in torch.randperm(r.reward.shape[1]).to(r.reward.device).chunk(2):
            mean, _ = self.actor(r.obs[:, ids], r.state and select(r.state, ids))
            loss = self._surrogate(r, ids, mean, advantage[:, ids], old_log_prob[:, ids])
            gradient = torch.cat([part.flatten() for part in torch.autograd.grad(loss, weights)])
            gradients.append(process_group.mean(gradient))
        return float(torch.nn.functional.cosine_similarity(*gradients, dim=0))

    def _surrogate(
        self, r: Rollout, ids: Tensor, mean: Tensor, advantage: Tensor, old_log_prob: Tensor
    ) -> Tensor:
        """PPO's clipped surrogate (Schulman et al. 2017) of the robots `ids`."""
        # With r = pi(a) / pi_old(a): L_clip = -mean(min(r A, clip(r, 1 - eps, 1 + eps) A))
        c = self.config
        log_ratio = self._log_prob(r, ids, mean) - old_log_prob
        # an overflow would destroy all weights
        ratio = log_ratio.clamp(-LOG_RATIO_BOUND, LOG_RATIO_BOUND).exp()
        clipped = ratio.clamp(1 - c.clip, 1 + c.clip)
        return -masked_mean(torch.minimum(ratio * advantage, clipped * advantage), r.mask[:, ids])

    def _innovations(self, noise: Tensor, before: Tensor) -> Tensor:
        """White innovations of AR(1) noise (T, N, A); `before` (N, A) precedes its first sample."""
        # n[t] = rho n[t-1] + w[t], so w[t] = n[t] - rho n[t-1]
        return noise - self.config.correlation * torch.cat([before[None], noise[:-1]])

    def _log_prob(self, r: Rollout, ids: Tensor | slice, mean: Tensor) -> Tensor:
        """Log density (T, N), up to a constant, of the actions of robots `ids` under `mean`.

        It is the density of the innovations, w[t] = n[t] - rho n[t-1] with n = action - mean, where
        both n[t] and n[t-1] depend on the policy. With n[t-1] as a constant the gradient would
        miss the second part.
        """
        draws = self._innovations(r.action[:, ids] - mean, r.noise[ids])
        if r.spread is not None:
            draws = draws / r.spread[ids]
        return self.actor.log_prob(torch.zeros_like(draws), draws)

    def _mini_batches(self, n: int, device: torch.device) -> Iterator[Tensor]:
        """Yield random mini-batches of environment indices for all epochs."""
        for _ in range(self.config.epochs):
            yield from torch.randperm(n).to(device).chunk(self.config.mini_batches)

    def _critic_step(self, obs: Tensor, target: Tensor, mask: Tensor) -> dict[str, float]:
        """Take the critic's steps on one mini-batch."""
        steps, total = self.config.critic_steps, 0.0
        parts = zip(*(x.tensor_split(steps, dim=1) for x in (obs, target, mask)), strict=True)
        for part_obs, part_target, part_mask in parts:
            # L_V = mean((V(s) - target)^2)
            loss = masked_mean((self.critic(part_obs)[0][..., 0] - part_target) ** 2, part_mask)
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
        """Take one step of the actor on one mini-batch."""
        c, actor = self.config, self.actor
        pull, constraints = weights
        mean, _ = actor(r.obs[:, ids], r.state and select(r.state, ids))
        surrogate = self._surrogate(r, ids, mean, advantage, old_log_prob)
        variance = (2 * actor.log_std).exp().detach()

        seen = ids < self.mirrored_count(r.reward.shape[1])
        before = r.mirrored_state and select(r.mirrored_state, ids[seen])
        with torch.set_grad_enabled(c.symmetry > 0.0):  # weight 0: only logged
            mirrored, _ = actor(self.mirror_obs(r.obs[:, ids[seen]]), before)
        # Symmetry, Eq. 6: KL divergence between mu(o) and the mirrored action of the mirrored
        # observation,
        #     L_sym = mean(sum |mu(o) - M_a mu(M_o o)|^2 / (2 sigma^2))
        gap = (mean[:, seen] - self.mirror_action(mirrored)) ** 2 / (2 * variance)
        stepping = mask[:, seen] if r.standing is None else mask[:, seen] * (1 - r.standing[:, ids[seen]])
        symmetry = masked_mean(gap.sum(-1), stepping)
        # Smoothness, Eq. 7: second difference of the mean action,
        #     L_smooth = mean(|mu[t+1] - 2 mu[t] + mu[t-1]|)
        bend = mean[2:] - 2 * mean[1:-1] + mean[:-2]
        smoothness = masked_mean(bend.norm(dim=-1), mask[2:])

        # Eq. 8: L = L_clip + constraints (w_sym L_sym + w_smooth L_smooth) - w_ent H
        #                 + pull mean(Huber(mu - label))
        constrained = constraints * (c.symmetry * symmetry + c.smoothness * smoothness)
        loss = surrogate + constrained - c.entropy * actor.entropy()
        terms = {"surrogate": surrogate, "symmetry": symmetry, "smoothness": smoothness}
        if r.label is not None:
            away = torch.nn.functional.huber_loss(
                mean, r.label[:, ids], reduction="none", delta=IMITATION_HUBER_DELTA
            )
            terms["away"] = masked_mean(away.mean(-1), mask)
            loss = loss + pull * terms["away"]
        self._step(self.actor_optimiser, actor, loss)
        # KL divergence of two Gaussians with one variance: |mu - mu_old|^2 / (2 sigma^2)
        if c.target_kl is not None:
            shift = ((mean.detach() - r.mean[:, ids]) ** 2 / (2 * variance)).sum(-1)
            terms["kl"] = process_group.mean(masked_mean(shift, mask))
        return {name: float(term.detach()) for name, term in terms.items()}

    def _step(self, optimiser: torch.optim.Optimizer, module: torch.nn.Module, loss: Tensor) -> None:
        """Take an optimiser step with the mean gradient of all processes, clipped in norm."""
        optimiser.zero_grad()
        loss.backward()
        process_group.share_gradients(module)
        norm = torch.nn.utils.clip_grad_norm_(module.parameters(), self.config.max_grad_norm)
        if not torch.isfinite(norm):
            raise FloatingPointError(
                "the gradient is not finite; the run stops before it changes the weights; resume from its checkpoint"
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
