"""The recurrent student: its network, what it observes of an environment, and its policy file (ONNX)."""

from __future__ import annotations

import copy
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import onnx
import torch
from torch import Tensor, nn

from quadvel_description import robot
from quadvel_description.recurrent_network import METADATA_KEY
from quadvel_policy.observation import DEFAULT_OBSERVATION, ActionMap, PolicyMetadata, build_observation

from .command_map import CommandCorrection, CommandMap
from .env import VelocityEnv
from .networks import Recurrent, State

ACTION_SCALE = 0.4  # rad a unit of the network's output
MEMORY = 256
HIDDEN = (192, 128)


def new_actor() -> Recurrent:
    """The policy of Section 4.1."""
    return Recurrent(DEFAULT_OBSERVATION.size, 12, MEMORY, HIDDEN)


def action_map(env: VelocityEnv) -> ActionMap:
    """Zero stands: the offset is the nominal posture with the gravity torque fed forward through kp."""
    return ActionMap(env.stand_q, ACTION_SCALE)


def observe(env: VelocityEnv, previous_action: np.ndarray, command: np.ndarray | None = None) -> np.ndarray:
    """The student's noisy observation (n, 48), with another command (n, 4) than the environment's if given."""
    return build_observation(
        DEFAULT_OBSERVATION,
        command=env.command if command is None else command,
        previous_action=previous_action,
        **env.sense(),
    )


class _Cell(nn.Module):
    """One time step of an LSTM without batch: x (1, inputs), state (1, memory).

    Written out as one matrix product: at batch size one it is quicker than onnxruntime's own LSTM. `added`: x goes on
    with as many numbers that are to be added to its first ones, and the product does that as well.
    """

    def __init__(self, lstm: nn.LSTM, added: int) -> None:
        super().__init__()
        inputs = lstm.weight_ih_l0
        weight = torch.cat([inputs, inputs[:, :added], lstm.weight_hh_l0], dim=1)
        self.weight = nn.Parameter(weight.detach().T.contiguous())
        self.bias = nn.Parameter((lstm.bias_ih_l0 + lstm.bias_hh_l0).detach())

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        h, c = state
        gates = torch.addmm(self.bias, torch.cat([x, h], dim=1), self.weight)
        admit, forget, candidate, release = gates.split(h.shape[-1], dim=1)
        memory = forget.sigmoid() * c + admit.sigmoid() * candidate.tanh()
        hidden = release.sigmoid() * memory.tanh()
        return hidden, (hidden, memory)


class _Step(nn.Module):
    """One time step with the signature of the policy file."""

    def __init__(self, network: Recurrent, outputs: int, correction: CommandCorrection | None) -> None:
        super().__init__()
        self.network, self.outputs, self.correction = copy.deepcopy(network), outputs, correction
        self.network.lstm = _Cell(network.lstm, 4 if correction else 0)

    def forward(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, ...]:
        x = torch.cat([obs, self.correction(obs)], dim=1) if self.correction else obs
        y, (hidden, memory) = self.network(x, (h.flatten(0, 1), c.flatten(0, 1)))
        outputs = y.split(y.shape[-1] // self.outputs, dim=1) if self.outputs > 1 else (y,)
        return (*outputs, hidden[None], memory[None])


def export(
    network: Recurrent,
    path: Path,
    outputs: Sequence[str],
    metadata: str,
    command_map: CommandMap | None = None,
) -> None:
    """Write `network` as a one-step ONNX (obs, h_in, c_in) -> (*outputs, h_out, c_out) with its metadata, whole or not at all.

    `command_map`: what corrects the command, the observation's first four numbers.
    """
    size = network.lstm.input_size
    state = network.initial_state(1)
    correction = CommandCorrection(command_map, size) if command_map else None
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        _Step(network, len(outputs), correction).eval(),
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
    """The commit that a file was made at, or "unknown" outside a checkout."""
    result = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    return result.stdout.strip() or "unknown"


def export_policy(
    actor: Recurrent,
    env: VelocityEnv,
    path: Path,
    recipe: dict[str, Any],
    command_map: CommandMap | None = None,
) -> None:
    """Write the policy file of `actor` as it was trained in `env`, behind a command map if given."""
    c = env.config.commands
    metadata = PolicyMetadata(
        action_offset=tuple(env.stand_q),
        action_scale=(ACTION_SCALE,) * 12,
        kp=(env.config.kp,) * 12,
        kd=(env.config.kd,) * 12,
        nominal_q=tuple(robot.NOMINAL_Q),
        command_limits={"vx": c.vx, "vy": (-c.vy, c.vy), "wz": (-c.wz, c.wz)},
        state_shape=(1, 1, MEMORY),
        actuator=attrs.asdict(env.config.actuator),
        recipe=recipe,
        commit=commit(),
    )
    export(actor, path, ["actions"], metadata.to_json(), command_map)
