"""One update of a policy on some of 8 robots; as a program, the second of two processes with the last 4."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import torch

from quadvel_training import loop, process_group
from quadvel_training.privileged import PrivilegedConfig, PrivilegedRun
from tests.training.test_ppo import learner, rollout


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


def run(checkpoint: Path) -> tuple[dict[str, torch.Tensor], np.ndarray, np.ndarray, int]:
    """Two updates of stage 1, and one more of a resumed run: the weights, grid, commands and samples of this process."""
    config = PrivilegedConfig(n=8, threads=1, length=4)
    loop.train(PrivilegedRun(config), loop.Budget(2 * 8 * 4, 10.0), checkpoint)
    again = PrivilegedRun(config)
    assert loop.train(again, loop.Budget(3 * 8 * 4, 10.0), checkpoint)
    return again.actor.state_dict(), again.grid.success, again.env.command, again.samples


def all_end(part: str, seconds: float) -> bool:
    """Whether all threads of this process with this part in their name end; the kernel lists one a moment longer."""
    until = time.monotonic() + seconds
    while any(part in _name(thread) for thread in Path("/proc/self/task").iterdir()):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def _name(thread: Path) -> str:
    try:
        return (thread / "comm").read_text()
    except (FileNotFoundError, ProcessLookupError):  # it ended since it was listed
        return ""


if __name__ == "__main__":
    process_group.join("cpu")
    update(slice(4, 8))
    process_group.gather(run(Path(sys.argv[1])))
    assert process_group.broadcast("second") == "first"
    assert process_group.gather("second") == ["first", "second"]
    process_group.destroy_group()
    assert all_end("gloo", seconds=20.0), "threads of the group outlive it"
