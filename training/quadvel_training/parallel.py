"""Several processes as one learner, started by torchrun: mean gradients, one start, one end, one writer.

Each process has its share of the robots. A single process, started without torchrun, passes through here for free.
"""

from __future__ import annotations

import atexit
import importlib
import os
from typing import Any

import numpy as np
import torch
import torch.distributed as dist


def join(device: str) -> torch.device:
    """Become one of torchrun's processes where it started this one; the device that this process computes on."""
    if "LOCAL_RANK" not in os.environ:
        return torch.device(device)
    if not dist.is_initialized():
        importlib.import_module("torch._dynamo")  # imported later, by an optimiser, it keeps the group
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
        atexit.register(leave)
    local = int(os.environ["LOCAL_RANK"])
    return torch.device(device, local) if device == "cuda" else torch.device(device)


def leave() -> None:
    """Be one of several no more: a process that ends with threads of its group at work can abort."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """The number of this process; 0 writes."""
    return int(dist.get_rank()) if dist.is_initialized() else 0


def size() -> int:
    """How many processes learn together."""
    return int(dist.get_world_size()) if dist.is_initialized() else 1


def share(n: int) -> int:
    """Of `n` robots those of this process. Raises ValueError where they cannot be shared out."""
    if n % size():
        raise ValueError(f"n is {n} robots, expected a multiple of the {size()} processes")
    return n // size()


def seed_of(seed: int) -> int:
    """Of this process's draws, where all are given `seed`."""
    return seed + 1000 * rank()


def go_on_drawing(kept: dict[str, Any], rng: np.random.Generator, seed: int, samples: int) -> None:
    """Random numbers that go on after `samples`: those of a checkpoint, `kept`; of several processes new ones for each.

    kept: {"learner": of torch, "environments": of `rng`}, as one process left them.
    """
    if size() == 1:
        torch.set_rng_state(kept["learner"])
        rng.bit_generator.state = kept["environments"]
    else:
        torch.manual_seed(seed + samples)
        rng.bit_generator.state = np.random.default_rng([seed, samples, rank()]).bit_generator.state


def mean(value: torch.Tensor) -> torch.Tensor:
    """Of all processes' values."""
    if size() > 1:
        value = value.detach().clone()
        dist.all_reduce(value)
        value /= size()
    return value


def share_gradients(module: torch.nn.Module) -> None:
    """Give every process the mean of all gradients."""
    if size() == 1:
        return
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    shared = mean(torch.cat([g.flatten() for g in gradients]))
    for own, part in zip(gradients, shared.split([g.numel() for g in gradients]), strict=True):
        own.copy_(part.view_as(own))


def from_first(value: Any) -> Any:
    """What process 0 has."""
    if size() == 1:
        return value
    kept = [value]
    dist.broadcast_object_list(kept, src=0, device=torch.device("cpu"))
    return kept[0]


def gather(value: Any) -> list[Any]:
    """What each process has, the first one's first."""
    kept = [value] * size()
    if size() > 1:
        dist.all_gather_object(kept, value)
    return kept
