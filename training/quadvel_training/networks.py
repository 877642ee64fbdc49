"""The networks: an MLP, and the recurrent actor of Section 4.1. Shapes are (T, N, features): time, environments."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

from quadvel_description.symmetry import Mirror

State = tuple[Tensor, Tensor]
MEMORY, HIDDEN = 256, (192, 128)  # of the paper's actor: LSTM, then linear layers


def select(state: State, ids: Tensor) -> State:
    """The state of some environments."""
    return state[0][:, ids].contiguous(), state[1][:, ids].contiguous()


def torch_mirror(
    mirror: Mirror, device: torch.device | None = None
) -> Callable[[torch.Tensor], torch.Tensor]:
    """The same mirror on tensors of `device`."""
    index = torch.as_tensor(mirror.index, device=device)
    sign = torch.as_tensor(mirror.sign, dtype=torch.float32, device=device)
    return lambda x: x[..., index] * sign


def mlp(sizes: list[int]) -> nn.Sequential:
    """Linear layers with SiLU between them."""
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(sizes):
        layers += [nn.Linear(a, b), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


class Mlp(nn.Module):
    """A memoryless network with the recurrent one's signature."""

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...] = (256, 128, 64)) -> None:
        super().__init__()
        self.body = mlp([inputs, *hidden, outputs])
        with torch.no_grad():
            self.body[-1].weight.mul_(0.1)

    def initial_state(self, n: int) -> None:
        """Nothing is remembered."""
        return None

    def forward(self, x: Tensor, state: None = None) -> tuple[Tensor, None]:
        return self.body(x), None


class Recurrent(nn.Module):
    """LSTM, then linear layers with SiLU; one state (layers, N, hidden) pair is carried from sequence to sequence."""

    def __init__(
        self, inputs: int, outputs: int, memory: int = MEMORY, hidden: tuple[int, ...] = HIDDEN
    ) -> None:
        super().__init__()
        self.lstm = nn.LSTM(inputs, memory)
        self.body = mlp([memory, *hidden, outputs])
        with torch.no_grad():
            self.body[-1].weight.mul_(0.1)

    def initial_state(self, n: int) -> State:
        """Zero state of `n` environments."""
        zeros = torch.zeros(1, n, self.lstm.hidden_size)
        return zeros, zeros.clone()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        y, state = self.lstm(x, state)
        return self.body(nn.functional.silu(y)), state


class Gaussian(nn.Module):
    """A network whose output is the mean of a normal distribution with a state-independent spread."""

    def __init__(self, network: nn.Module, actions: int, std: float) -> None:
        super().__init__()
        self.network = network
        self.log_std = nn.Parameter(torch.full((actions,), float(std)).log())

    def forward(self, x: Tensor, state: State | None = None) -> tuple[Tensor, State | None]:
        return self.network(x, state)

    def log_prob(self, mean: Tensor, action: Tensor) -> Tensor:
        """Log density of `action`, summed over the last axis."""
        z = (action - mean) / self.log_std.exp()
        return -(0.5 * z * z + self.log_std + 0.9189385).sum(-1)

    def entropy(self) -> Tensor:
        """Of one action."""
        return (self.log_std + 1.4189385).sum()
