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

from .command_map import CommandMap, CommandMapped
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

    Written out as one matrix product: at batch size one it is quicker than onnxruntime's own LSTM.
    """

    def __init__(self, lstm: nn.LSTM) -> None:
        super().__init__()
        weight = torch.cat([lstm.weight_ih_l0, lstm.weight_hh_l0], dim=1)
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

    def __init__(self, network: Recurrent, outputs: int, before: nn.Module) -> None:
        super().__init__()
        self.network, self.outputs, self.before = copy.deepcopy(network), outputs, before
        self.network.lstm = _Cell(network.lstm)

    def forward(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, ...]:
        y, (hidden, memory) = self.network(self.before(obs), (h.flatten(0, 1), c.flatten(0, 1)))
        outputs = y.split(y.shape[-1] // self.outputs, dim=1) if self.outputs > 1 else (y,)
        return (*outputs, hidden[None], memory[None])


def export(
    network: Recurrent, path: Path, outputs: Sequence[str], metadata: str, before: nn.Module | None = None
) -> None:
    """Write `network` as a one-step ONNX (obs, h_in, c_in) -> (*outputs, h_out, c_out) with its metadata, whole or not at all.

    `before`: what the observation goes through first.
    """
    size = network.lstm.input_size
    state = network.initial_state(1)
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        _Step(network, len(outputs), before or nn.Identity()).eval(),
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
    before = CommandMapped(command_map) if command_map else None
    export(actor, path, ["actions"], metadata.to_json(), before)
