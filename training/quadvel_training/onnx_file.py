"""Export of a recurrent network as an ONNX file of one time step, with the metadata to run it.

`quadvel_policy.policy_file` and `quadvel_estimator.learned` read such files.
"""

from __future__ import annotations

import copy
import subprocess
import warnings
from collections.abc import Sequence
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

from quadvel_description.recurrent_network import METADATA_KEY

from .networks import Recurrent, State


class _Cell(nn.Module):
    """LSTM cell for one time step without batch: x (1, inputs), state (1, memory).

    Written as one matrix product: at batch size one this is faster than onnxruntime's LSTM.
    """

    def __init__(self, lstm: nn.LSTM) -> None:
        super().__init__()
        weight = torch.cat([lstm.weight_ih_l0, lstm.weight_hh_l0], dim=1)
        self.weight = nn.Parameter(weight.detach().T.contiguous())
        self.bias = nn.Parameter((lstm.bias_ih_l0 + lstm.bias_hh_l0).detach())

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        h, c = state
        # (i, f, g, o) = W [x, h] + b
        # c' = sigmoid(f) c + sigmoid(i) tanh(g), h' = sigmoid(o) tanh(c')
        gates = torch.addmm(self.bias, torch.cat([x, h], dim=1), self.weight)
        admit, forget, candidate, release = gates.split(h.shape[-1], dim=1)
        memory = forget.sigmoid() * c + admit.sigmoid() * candidate.tanh()
        hidden = release.sigmoid() * memory.tanh()
        return hidden, (hidden, memory)


class _Step(nn.Module):
    """One time step with the signature of the policy file."""

    def __init__(self, network: Recurrent, outputs: int) -> None:
        super().__init__()
        self.network, self.outputs = copy.deepcopy(network), outputs
        self.network.lstm = _Cell(network.lstm)

    def forward(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, ...]:
        y, (hidden, memory) = self.network(obs, (h.flatten(0, 1), c.flatten(0, 1)))
        outputs = y.split(y.shape[-1] // self.outputs, dim=1) if self.outputs > 1 else (y,)
        return (*outputs, hidden[None], memory[None])


def export(
    network: Recurrent,
    size: int,
    path: Path,
    outputs: Sequence[str],
    metadata: str,
) -> None:
    """Write a network as a one-step ONNX file, atomically.

    The file maps `(obs, h_in, c_in)` to `(*outputs, h_out, c_out)`.

    Args:
        network: the network.
        size: number of observations; `obs` has the shape (1, size).
        path: file.
        outputs: names of the outputs, which share the network's output equally.
        metadata: text stored in the file.
    """
    state = network.initial_state(1)
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # The tracer warns that a length and some tensors become constants: in a file of one step they are.
        warnings.simplefilter("ignore", torch.jit.TracerWarning)
        torch.onnx.export(
            _Step(network, len(outputs)).eval(),
            (torch.zeros(1, size), *state),
            str(part),
            input_names=["obs", "h_in", "c_in"],
            output_names=[*outputs, "h_out", "c_out"],
            opset_version=17,
            dynamo=False,
        )
    model = onnx.load(part)
    onnx.helper.set_model_props(model, {METADATA_KEY: metadata})
    onnx.save(model, part)
    part.replace(path)


def commit() -> str:
    """Short hash of the present commit.

    Returns:
        The hash, or "unknown" outside a checkout.
    """
    result = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    return result.stdout.strip() or "unknown"
