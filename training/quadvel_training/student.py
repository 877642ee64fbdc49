"""The recurrent student: its network, what it observes of an environment, and its policy file (ONNX)."""

from __future__ import annotations

import copy
import subprocess
import warnings
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

from . import clock
from .command_map import CommandCorrection, CommandMap
from .env import VelocityEnv
from .networks import Recurrent, State, mlp

ACTION_SCALE = 0.4  # rad a unit of the network's output
MEMORY = 256
HIDDEN = (192, 128)
PARTS = [MEMORY, clock.SIZE, 4]
"""What a policy's state is put together of."""


class Policy(Recurrent):
    """The policy of Section 4.1 with a gait clock of its own beside the 48 observations (docs/decisions/0015).

    Behind the LSTM's memory the state's first part goes on with the clock and the command of the tick before, which moves
    the clock on: so what a tick sees of it is known before the tick. The second part goes on with what is added to the
    clock: half a cycle for a robot in the mirror, else nothing. What the LSTM sees the layers behind it see as well: what a
    joint is to do depends on where it is, and on the half of its cycle, more than on the past.
    """

    def __init__(self) -> None:
        seen = DEFAULT_OBSERVATION.size + clock.FEATURES
        super().__init__(seen, 12, MEMORY, HIDDEN)
        self.body = mlp([MEMORY + seen, *HIDDEN, 12])

    def initial_state(self, n: int, mirrored: bool = False) -> State:
        """Of `n` robots, before their first tick; `mirrored`: of their mirror images."""
        zeros = torch.zeros(1, n, sum(PARTS))
        ahead = zeros.clone()
        if mirrored:
            ahead.split(PARTS, dim=-1)[1].copy_(torch.tensor(clock.HALF_CYCLE))
        return zeros, ahead

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Actions (T, N, 12) and the new state from x (T, N, 48) and the state (1, N, 265); N may be missing in all."""
        (h, now, command), (c, ahead, rest) = (part.split(PARTS, dim=-1) for part in state)
        seen = []
        for tick in range(len(x)):
            now = clock.advance(now, command)
            seen.append(clock.features(now + ahead))
            command = x[tick : tick + 1, ..., :4]
        x = torch.cat([x, torch.cat(seen) if len(seen) > 1 else seen[0]], dim=-1)
        y, (h, c) = self.lstm(x, (h.contiguous(), c.contiguous()))
        y = self.body(torch.cat([nn.functional.silu(y), x], dim=-1))
        return y, (torch.cat([h, now, command], dim=-1), torch.cat([c, ahead, rest], dim=-1))


def new_actor() -> Policy:
    """A policy with random weights."""
    return Policy()


def actor_of(weights: dict[str, Tensor]) -> Recurrent:
    """The policy with these weights; those made before there was a clock go on without one."""
    size = DEFAULT_OBSERVATION.size
    bare = weights["lstm.weight_ih_l0"].shape[1] == size
    actor = Recurrent(size, 12, MEMORY, HIDDEN) if bare else new_actor()
    actor.load_state_dict(weights)
    return actor


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

    def __init__(self, network: Recurrent, outputs: int, correction: CommandCorrection | None) -> None:
        super().__init__()
        self.network, self.outputs, self.correction = copy.deepcopy(network), outputs, correction
        self.network.lstm = _Cell(network.lstm)

    def forward(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, ...]:
        x = obs + self.correction(obs) if self.correction else obs
        y, (hidden, memory) = self.network(x, (h.flatten(0, 1), c.flatten(0, 1)))
        outputs = y.split(y.shape[-1] // self.outputs, dim=1) if self.outputs > 1 else (y,)
        return (*outputs, hidden[None], memory[None])


def export(
    network: Recurrent,
    size: int,
    path: Path,
    outputs: Sequence[str],
    metadata: str,
    command_map: CommandMap | None = None,
) -> None:
    """Write `network` as a one-step ONNX (obs, h_in, c_in) -> (*outputs, h_out, c_out) with its metadata, whole or not at all.

    obs has the shape (1, size).
    `command_map`: what corrects the command, the observation's first four numbers.
    """
    state = network.initial_state(1)
    correction = CommandCorrection(command_map, size) if command_map else None
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", torch.jit.TracerWarning
        )  # one step has one length, and constants are constants
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
        state_shape=tuple(actor.initial_state(1)[0].shape),
        actuator=attrs.asdict(env.config.actuator),
        recipe=recipe,
        commit=commit(),
    )
    export(actor, DEFAULT_OBSERVATION.size, path, ["actions"], metadata.to_json(), command_map)
