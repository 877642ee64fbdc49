"""The learner against closed-form solutions."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_description import symmetry  # noqa: E402
from quadvel_training.networks import Gaussian, Mlp, Recurrent, torch_mirror  # noqa: E402
from quadvel_training.ppo import Ppo, PpoConfig, Rollout, exploration_scales, select  # noqa: E402

MIRROR_OBS, MIRROR_ACTION = torch_mirror(symmetry.OBSERVATION), torch_mirror(symmetry.JOINTS)


def rollout(reward, ended=None, cut=None, mask=None, t=6, n=1, network=None):
    zeros = torch.zeros(t, n)
    state = network.initial_state(n) if network else None
    return Rollout(
        obs=torch.randn(t, n, 48),
        critic_obs=torch.zeros(t, n, 5),
        action=torch.zeros(t, n, 12),
        mean=torch.zeros(t, n, 12),
        noise=torch.zeros(n, 12),
        reward=zeros + torch.as_tensor(reward, dtype=torch.float32),
        ended=zeros if ended is None else ended,
        cut=zeros if cut is None else cut,
        mask=torch.ones(t, n) if mask is None else mask,
        last_critic_obs=torch.zeros(n, 5),
        state=state,
        mirrored_state=state,
    )


class ConstantCritic(torch.nn.Module):
    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = torch.nn.Parameter(torch.tensor(value))

    def forward(self, x):
        return self.value.expand(*x.shape[:-1], 1), None


def learner(critic_value=2.0, network=None, **config):
    actor = Gaussian(network or Mlp(48, 12), 12, 0.3)
    return Ppo(actor, ConstantCritic(critic_value), PpoConfig(**config), MIRROR_OBS, MIRROR_ACTION)


def test_advantage_is_the_discounted_sum_of_temporal_differences():
    ppo = learner(discount=0.9, gae=0.8)
    advantage, target = ppo.advantages(rollout(1.0))
    delta = 1.0 + 0.9 * 2.0 - 2.0
    expected = [sum((0.9 * 0.8) ** k * delta for k in range(6 - i)) for i in range(6)]
    assert advantage[:, 0].tolist() == pytest.approx(expected, rel=1e-5)
    assert target[:, 0].tolist() == pytest.approx([e + 2.0 for e in expected], rel=1e-5)


def test_a_fall_ends_the_future_and_a_timeout_does_not():
    last = torch.zeros(6, 1)
    last[5] = 1.0
    fell, _ = learner(discount=0.9).advantages(rollout(1.0, ended=last))
    late, _ = learner(discount=0.9).advantages(rollout(1.0, cut=last))
    assert fell[5, 0].item() == pytest.approx(1.0 - 2.0)
    assert late[5, 0].item() == pytest.approx(1.0 + 0.9 * 2.0 - 2.0)


@pytest.mark.parametrize("steps", [1, 16])
def test_the_critic_takes_its_steps_for_one_of_the_actor(steps):
    ppo = learner(0.0, epochs=1, mini_batches=1, critic_steps=steps)
    ppo.update(rollout(1.0, n=16), learn_actor=False)
    assert float(ppo.critic.value.detach()) == pytest.approx(1e-3 * steps, rel=0.01)  # Adam's rate a step


def test_an_overflowing_likelihood_ratio_keeps_the_weights_finite():
    ppo = learner(epochs=2, mini_batches=1)
    one = rollout([[1.0], [-1.0]] * 3)
    one.mean[:] = 500.0  # from which the action, held to its bounds, was far
    ppo.update(one)
    assert all(torch.isfinite(weight).all() for weight in ppo.actor.parameters())


def test_a_run_ends_before_it_spoils_its_weights():
    ppo = learner()
    one = rollout(1.0)
    one.obs[0] = torch.nan
    with pytest.raises(FloatingPointError, match="gradient is not finite"):
        ppo.update(one)
    assert all(torch.isfinite(weight).all() for weight in ppo.actor.parameters())


@pytest.mark.parametrize(("target_kl", "rate"), [(None, 2e-3), (0.01, 1e-3)])
def test_a_fixed_learning_rate_comes_from_the_recipe_when_a_run_resumes(target_kl, rate):
    again = learner(learning_rate=2e-3, target_kl=target_kl)
    again.restore(learner(learning_rate=1e-3).state())
    assert again.learning_rate == again.actor_optimiser.param_groups[0]["lr"] == rate


def test_masked_samples_have_no_advantage():
    mask = torch.ones(6, 1)
    mask[3:] = 0.0
    advantage, _ = learner().advantages(rollout(1.0, mask=mask))
    assert (advantage[3:] == 0).all()
    assert (advantage[:3] != 0).all()


def test_an_update_makes_the_better_action_likelier():
    torch.manual_seed(0)
    ppo = learner(critic_value=0.0, symmetry=0.0, discount=0.0, learning_rate=1e-3)
    r = rollout(0.0, t=8, n=32)
    r.action = 0.3 * torch.randn(8, 32, 12)
    r.reward = r.action[..., 0]
    before = ppo.actor(r.obs)[0][..., 0].mean()
    for _ in range(5):
        ppo.update(r)
    assert ppo.actor(r.obs)[0][..., 0].mean() > before + 0.02


@pytest.mark.parametrize(("signal", "low", "high"), [(1.0, 0.7, 1.0), (0.0, -0.3, 0.3)])
def test_halves_of_the_robots_agree_on_a_signal_and_not_on_noise(signal, low, high):
    torch.manual_seed(0)
    ppo = learner(critic_value=0.0, discount=0.0, epochs=1, mini_batches=1)
    r = rollout(0.0, t=8, n=512)
    r.mean = ppo.actor(r.obs)[0].detach()
    noise = 0.3 * torch.randn(8, 512, 12)
    r.action = r.mean + noise
    r.reward = signal * noise[..., 0] + (1.0 - signal) * torch.randn(8, 512)
    assert low < ppo.update(r, learn_actor=False, measure_agreement=True)["agreement"] < high


def test_the_symmetry_term_makes_a_recurrent_policy_symmetric():
    torch.manual_seed(0)
    network = Recurrent(48, 12, memory=16, hidden=(16,))
    for parameter in network.body[-1].parameters():
        parameter.data.mul_(10.0)
    ppo = learner(network=network, symmetry=1.0, max_learning_rate=3e-3, learning_rate=3e-3, target_kl=1e3)
    r = rollout(0.0, t=8, n=32, network=network)
    r.mean = ppo.actor(r.obs, r.state)[0].detach()
    first = ppo.update(r)["symmetry"]
    for _ in range(30):
        last = ppo.update(r)["symmetry"]
    assert last < 0.2 * first


def test_who_stands_may_prefer_a_side():
    torch.manual_seed(0)
    ppo = learner(epochs=1, mini_batches=1)
    r = rollout(0.0, t=5, n=4)
    mean = ppo.actor(r.obs)[0].detach()
    gap = ((mean - MIRROR_ACTION(ppo.actor(MIRROR_OBS(r.obs))[0].detach())) ** 2).sum(-1)
    r.standing = torch.zeros(5, 4)
    r.standing[2:, 1] = r.standing[:, 2] = 1.0
    expected = gap[r.standing == 0.0].mean() / (2 * (2 * ppo.actor.log_std.detach()).exp().mean())
    assert ppo.update(r)["symmetry"] == pytest.approx(float(expected), rel=1e-4)


def test_the_mirrored_sequence_of_a_mirrored_memory_is_the_mirror_of_the_past():
    """A mirrored sequence gives the same as two parts with the mirrored memory carried over."""
    torch.manual_seed(0)
    network = Recurrent(48, 12, memory=16, hidden=(16,))
    obs = torch.randn(10, 3, 48)
    whole, _ = network(MIRROR_OBS(obs), network.initial_state(3))
    _, memory = network(MIRROR_OBS(obs[:6]), network.initial_state(3))
    rest, _ = network(MIRROR_OBS(obs[6:, [0, 2]]), select(memory, torch.tensor([0, 2])))
    assert torch.allclose(rest, whole[6:, [0, 2]], atol=1e-6)


def test_smoothness_is_the_mean_norm_of_the_second_difference():
    torch.manual_seed(0)
    ppo = learner(epochs=1, mini_batches=1)
    r = rollout(0.0, t=5, n=4)
    mean = ppo.actor(r.obs)[0].detach().numpy()
    expected = np.linalg.norm(np.diff(mean, n=2, axis=0), axis=-1).mean()
    assert ppo.update(r)["smoothness"] == pytest.approx(expected, rel=1e-4)


def test_each_robots_actions_are_judged_by_its_own_spread():
    torch.manual_seed(0)
    ppo = learner(correlation=0.9)
    r = rollout(0.0, t=5, n=8)
    r.action, r.spread = 0.1 * torch.randn(5, 8, 12), torch.from_numpy(exploration_scales(8))
    ids = torch.tensor([7, 2, 6, 0])
    assert torch.equal(ppo._log_prob(r, ids, r.mean[:, ids]), ppo._log_prob(r, slice(None), r.mean)[:, ids])


def test_the_gradient_under_correlated_exploration_is_that_of_the_return():
    """A mean that oscillates at 8 Hz; correlated noise turns a naive gradient's phase by 60 degrees."""
    torch.manual_seed(0)
    t, n, correlation, wanted = 75, 40000, 0.9, torch.tensor([1.0, 0.0])
    angle = 2 * torch.pi * 8.0 * 0.005 * torch.arange(t)
    wave = torch.stack([angle.cos(), angle.sin()], dim=-1)  # (t, 2)

    class Swing(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.theta = torch.nn.Parameter(torch.zeros(2))

        def forward(self, x, state=None):
            return (wave @ self.theta)[:, None, None].expand(t, x.shape[1], 1), None

    network = Swing()
    actor = Gaussian(network, 1, 0.1)
    ppo = Ppo(actor, ConstantCritic(0.0), PpoConfig(correlation=correlation), lambda x: x, lambda x: x)
    noise, spread = torch.zeros(t, n, 1), torch.from_numpy(exploration_scales(n))
    for k in range(t):
        noise[k] = (correlation * noise[k - 1] if k else 0.0) + 0.1 * spread * torch.randn(n, 1)
    reward = -((noise - (wave @ wanted)[:, None, None]) ** 2)[..., 0]
    advantage = reward.flip(0).cumsum(0).flip(0)
    advantage = advantage - advantage.mean(1, keepdim=True)
    r = rollout(0.0, t=t, n=n)
    r.action, r.noise, r.spread = noise, torch.zeros(n, 1), spread
    (ppo._log_prob(r, slice(None), network(noise)[0]) * advantage).mean(1).sum().backward()
    expected = 2 * wave.T @ (wave @ wanted)  # of the sum of rewards
    found = network.theta.grad
    assert torch.allclose(found, expected, atol=0.15 * expected.norm().item())
