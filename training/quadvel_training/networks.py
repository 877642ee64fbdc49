"""Networks: an MLP, and the recurrent actor of Section 4.1.

Inputs have the shape (T, N, features): time, environments.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

from quadvel_description.symmetry import Mirror

State = tuple[Tensor, Tensor]
MEMORY, HIDDEN = 256, (192, 128)  # sizes of the paper's actor: LSTM, then linear layers


def select(state: State, ids: Tensor) -> State:
    """Select the memory of some environments.

    Args:
        state: hidden and cell state, (1, N, memory) each.
        ids: indices of the environments.

    Returns:
        Their memory.
    """
    return state[0][:, ids].contiguous(), state[1][:, ids].contiguous()


@torch.no_grad()  # type: ignore[untyped-decorator]
def follow_weights(average: nn.Module, network: nn.Module, share: float) -> None:
    """Update a running average of a network's weights: mean <- mean + share (weights - mean).

    Single steps of an optimiser leave steady errors that the mean of the weights does not have.

    Args:
        average: network that holds the average.
        network: network that learns.
        share: weight of its present weights.
    """
    for mean, now in zip(average.parameters(), network.parameters(), strict=True):
        mean.lerp_(now, share)


def torch_mirror(
    mirror: Mirror, device: torch.device | None = None
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Convert a mirror to a function of tensors.

    Args:
        mirror: permutation and signs.
        device: device of the tensors.

    Returns:
        A function that mirrors the last axis.
    """
    index = torch.as_tensor(mirror.index, device=device)
    sign = torch.as_tensor(mirror.sign, dtype=torch.float32, device=device)
    return lambda x: x[..., index] * sign


def mlp(sizes: list[int]) -> nn.Sequential:
    """Build linear layers with SiLU between them.

    Args:
        sizes: number of features, from input to output.

    Returns:
        The layers.
    """
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(sizes):
        layers += [nn.Linear(a, b), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


class Mlp(nn.Module):
    """Memoryless network with the signature of the recurrent one."""

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...] = (256, 128, 64)) -> None:
        """Create the network; its last layer starts small.

        Args:
            inputs: number of input features.
            outputs: number of output features.
            hidden: sizes of the hidden layers.
        """
        super().__init__()
        self.body = mlp([inputs, *hidden, outputs])
        with torch.no_grad():
            self.body[-1].weight.mul_(0.1)

    def initial_state(self, n: int) -> None:
        """Return None: the network has no memory.

        Args:
            n: number of environments.
        """
        return None

    def forward(self, x: Tensor, state: None = None) -> tuple[Tensor, None]:
        """Evaluate the network.

        Args:
            x: (..., inputs).
            state: None.

        Returns:
            (..., outputs), and None.
        """
        return self.body(x), None


class Recurrent(nn.Module):
    """LSTM followed by linear layers with SiLU; its memory is carried from sequence to sequence."""

    def __init__(
        self, inputs: int, outputs: int, memory: int = MEMORY, hidden: tuple[int, ...] = HIDDEN
    ) -> None:
        """Create the network; its last layer starts small.

        Args:
            inputs: number of input features.
            outputs: number of output features.
            memory: size of the LSTM.
            hidden: sizes of the hidden layers.
        """
        super().__init__()
        self.lstm = nn.LSTM(inputs, memory)
        self.body = mlp([memory, *hidden, outputs])
        with torch.no_grad():
            self.body[-1].weight.mul_(0.1)

    def initial_state(self, n: int) -> State:
        """Return the zero memory.

        Args:
            n: number of environments.

        Returns:
            Hidden and cell state, (1, n, memory) each.
        """
        zeros = torch.zeros(1, n, self.lstm.hidden_size)
        return zeros, zeros.clone()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Evaluate a sequence.

        Args:
            x: (T, N, inputs).
            state: memory before the sequence.

        Returns:
            (T, N, outputs), and the memory after it.
        """
        memory, state = self.lstm(x, state)
        return self.answer(memory), state

    def answer(self, memory: Tensor) -> Tensor:
        """Evaluate the linear layers.

        Args:
            memory: (T, N, memory), outputs of the LSTM.

        Returns:
            (T, N, outputs).
        """
        answer: Tensor = self.body(nn.functional.silu(memory))
        return answer


@torch.no_grad()  # type: ignore[untyped-decorator]
def lengthen_memory(lstm: nn.LSTM, cells: int, longest: float) -> None:
    """Let the first cells of an LSTM forget slowly from the start (Tallec and Ollivier, 2018).

    The forget gate of a new LSTM is about 1/2, so that it forgets within two ticks. Sequences of a
    second change that little in millions of samples.

    Args:
        lstm: LSTM, changed in place.
        cells: number of cells.
        longest: longest time constant, ticks; they are log-uniform from 1 tick on.
    """
    # f = sigmoid(ln(T - 1)) = 1 - 1/T forgets with a time constant of T ticks; i = 1 - f = 1/T.
    ticks = torch.logspace(0.0, 1.0, cells, base=longest).clamp(min=2.0)
    size = lstm.hidden_size  # PyTorch's gates are stacked: input, forget, cell, output
    lstm.bias_ih_l0[:cells] = -torch.log(ticks - 1.0)
    lstm.bias_ih_l0[size : size + cells] = torch.log(ticks - 1.0)
    lstm.bias_hh_l0[:cells] = 0.0
    lstm.bias_hh_l0[size : size + cells] = 0.0


class Gaussian(nn.Module):
    """Normal distribution of actions with a standard deviation independent of the state."""

    def __init__(self, network: nn.Module, actions: int, std: float) -> None:
        """Wrap a network.

        Args:
            network: mean of the actions.
            actions: number of actions.
            std: standard deviation at the start.
        """
        super().__init__()
        self.network = network
        self.log_std = nn.Parameter(torch.full((actions,), float(std)).log())

    def forward(self, x: Tensor, state: State | None = None) -> tuple[Tensor, State | None]:
        """Evaluate the mean.

        Args:
            x: (T, N, features).
            state: memory before the sequence, None for a memoryless network.

        Returns:
            Mean (T, N, actions), and the memory after it.
        """
        return self.network(x, state)

    def log_prob(self, mean: Tensor, action: Tensor) -> Tensor:
        """Log density of actions.

        Args:
            mean: (..., A).
            action: (..., A).

        Returns:
            (...,), summed over the actions.
        """
        # log N(a; mu, sigma) = -sum(z^2 / 2 + log sigma + log(2 pi) / 2), z = (a - mu) / sigma
        z = (action - mean) / self.log_std.exp()
        return -(0.5 * z * z + self.log_std + 0.9189385).sum(-1)

    def entropy(self) -> Tensor:
        """Entropy of one action.

        Returns:
            A number.
        """
        # H = sum(log sigma + log(2 pi e) / 2)
        return (self.log_std + 1.4189385).sum()
