"""Several processes as one learner, started by torchrun.

Gradients are averaged; start, end and writing are common. Each process has its share of the robots.
In a single process, started without torchrun, these functions do nothing.
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
    """Join the process group if torchrun started this process.

    Args:
        device: `cpu` or `cuda`.

    Returns:
        The device of this process.
    """
    if "LOCAL_RANK" not in os.environ:
        return torch.device(device)
    if not dist.is_initialized():
        importlib.import_module(
            "torch._dynamo"
        )  # a later import, by an optimiser, would keep the group alive
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
        atexit.register(destroy_group)
    local = int(os.environ["LOCAL_RANK"])
    return torch.device(device, local) if device == "cuda" else torch.device(device)


def destroy_group() -> None:
    """Destroy the process group: a process that ends while threads of its group run can abort."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process.

    Returns:
        0 for the process that writes.
    """
    return int(dist.get_rank()) if dist.is_initialized() else 0


def size() -> int:
    """Number of processes.

    Returns:
        1 without torchrun.
    """
    return int(dist.get_world_size()) if dist.is_initialized() else 1


def local_share(n: int) -> int:
    """Share of the robots that this process has.

    Args:
        n: number of robots.

    Returns:
        n over the number of processes.

    Raises:
        ValueError: n is no multiple of the number of processes.
    """
    if n % size():
        raise ValueError(f"n is {n} robots, expected a multiple of the {size()} processes")
    return n // size()


def process_seed(seed: int) -> int:
    """Derive the seed of this process from the common one.

    Args:
        seed: common seed.

    Returns:
        Seed of this process.
    """
    return seed + 1000 * rank()


def resume_random(kept: dict[str, Any], rng: np.random.Generator, seed: int, samples: int) -> None:
    """Resume random numbers from a checkpoint; several processes draw new ones each.

    Args:
        kept: `learner`, the state of torch, and `environments`, that of `rng`, as one process left
            them.
        rng: generator of the environments, changed in place.
        seed: common seed.
        samples: number of samples so far.
    """
    if size() == 1:
        torch.set_rng_state(kept["learner"])
        rng.bit_generator.state = kept["environments"]
    else:
        torch.manual_seed(seed + samples)
        rng.bit_generator.state = np.random.default_rng([seed, samples, rank()]).bit_generator.state


def mean(value: torch.Tensor) -> torch.Tensor:
    """Mean over all processes.

    Args:
        value: tensor of the same shape in each process.

    Returns:
        The mean.
    """
    if size() > 1:
        value = value.detach().clone()
        dist.all_reduce(value)
        value /= size()
    return value


def share_gradients(module: torch.nn.Module) -> None:
    """Replace the gradients by their mean over all processes.

    Args:
        module: network with gradients.
    """
    if size() == 1:
        return
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    shared = mean(torch.cat([g.flatten() for g in gradients]))
    for own, part in zip(gradients, shared.split([g.numel() for g in gradients]), strict=True):
        own.copy_(part.view_as(own))


def broadcast(value: Any) -> Any:
    """Return the value of process 0.

    Args:
        value: value of this process.

    Returns:
        The value of process 0.
    """
    if size() == 1:
        return value
    kept = [value]
    dist.broadcast_object_list(kept, src=0, device=torch.device("cpu"))
    return kept[0]


def gather(value: Any) -> list[Any]:
    """Collect the values of all processes.

    Args:
        value: value of this process.

    Returns:
        Values in the order of the processes.
    """
    kept = [value] * size()
    if size() > 1:
        dist.all_gather_object(kept, value)
    return kept
