"""One update of a policy on a part of 8 robots. As a program: a process of several, with the last 4 of them."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent))

from test_ppo import learner, rollout

from quadvel_training import parallel


def update(part: slice) -> dict[str, torch.Tensor]:
    """The weights and the KL divergence after one step; two of the robots fall early."""
    torch.manual_seed(0)
    config = {"epochs": 1, "mini_batches": 1, "momentum": 0.5, "symmetry": 0.1, "smoothness": 0.1}
    ppo = learner(0.5, learning_rate=0.1, max_learning_rate=1.0, **config)
    r = rollout(torch.randn(6, 8), t=6, n=8)
    r.action = 0.3 * torch.randn(6, 8, 12)
    r.mask[3:, 0] = r.mask[2:, 5] = 0.0
    for name in ("obs", "critic_obs", "action", "mean", "reward", "ended", "cut", "mask"):
        setattr(r, name, getattr(r, name)[:, part])
    for name in ("noise", "last_critic_obs"):
        setattr(r, name, getattr(r, name)[part])
    kl = ppo.update(r)["kl"]
    return ppo.actor.state_dict() | {"kl": torch.tensor(kl)}


if __name__ == "__main__":
    parallel.join("cpu")
    update(slice(4, 8))
    assert parallel.from_first("second") == "first"
    assert parallel.gather("second") == ["first", "second"]
    parallel.leave()
    names = [(thread / "comm").read_text() for thread in Path("/proc/self/task").iterdir()]
    assert not any("gloo" in name for name in names), names
