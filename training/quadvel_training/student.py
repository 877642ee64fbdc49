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

from . import clock, gait, ground
from .command_map import CommandCorrection, CommandMap
from .env import TICK, VelocityEnv
from .legs import Legs
from .networks import Recurrent, State, mlp

ACTION_SCALE = 0.4  # rad a unit of the network's output
MEMORY = 256
HIDDEN = (192, 128)
PARTS = [MEMORY, clock.SIZE, clock.SIZE, ground.SIZE]
PARTS.append(MEMORY + DEFAULT_OBSERVATION.size - sum(PARTS))  # of no use: both halves have one size
"""What the first half of a policy's state is put together of."""


class Policy(Recurrent):
    """The policy of Section 4.1 on top of a trotting gait that it carries along (docs/decisions/0016).

    Behind the LSTM's memory the first part of the state goes on with the gait's clock, what is added to it (half a cycle for
    a robot in the mirror, else nothing) and the ground that the feet feel; the second with the observation of the tick
    before. So the gait's joint targets are known before the tick: the network adds to them. What the LSTM sees the layers
    behind it see as well.
    """

    offset: Tensor
    expect: Tensor
    expect_offset: Tensor

    def __init__(
        self, offset: np.ndarray = robot.NOMINAL_Q, command_map: CommandMap | None = None
    ) -> None:
        """offset: joint angles (12,) rad at action zero. command_map: of the gait as its teacher walks it."""
        seen = DEFAULT_OBSERVATION.size + clock.FEATURES + 4 + ground.SIZE + 12
        super().__init__(seen, 12, MEMORY, HIDDEN)
        self.body = mlp([MEMORY + seen, *HIDDEN, 12])
        with torch.no_grad():
            self.body[-1].weight.mul_(0.1)
        self.lead = CommandCorrection(command_map or CommandMap(), 4).requires_grad_(False)
        self.register_buffer("offset", torch.tensor(offset, dtype=torch.float32))
        for name, array in zip(("expect", "expect_offset"), _expectation(), strict=True):
            self.register_buffer(name, torch.as_tensor(array, dtype=torch.float32), persistent=False)

    def initial_state(self, n: int, mirrored: bool = False) -> State:
        """Of `n` robots, before their first tick; `mirrored`: of their mirror images."""
        first, second = torch.zeros(1, n, sum(PARTS)), torch.zeros(1, n, sum(PARTS))
        if mirrored:
            _unpack(first)[2].copy_(torch.tensor(clock.HALF_CYCLE))
        return first, second

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Actions (T, N, 12) and the new state from x (T, N, 48) and the state (1, N, 304); N may be missing in all."""
        return self.act(*self.follow(x, state))

    def follow(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """What the layers see (T, N, 73), the gait's targets at its end; and the state without the memory's progress.

        Nothing is learned here: x, then the clock, the feet that should be down, the ground, and the targets as actions.
        """
        memory, now, ahead, below, rest = _unpack(state[0])
        cell, before = state[1].split([MEMORY, DEFAULT_OBSERVATION.size], dim=-1)
        past = torch.cat([before, x[:-1]]) if len(x) > 1 else before
        roll_pitch, q, velocity, turn = (past @ self.expect + self.expect_offset).split([2, 12, 3, 3], dim=-1)
        feet, up = Legs(q).feet, gait.upward(roll_pitch)
        times, grounds = [], []
        for tick in range(len(x)):
            one = slice(tick, tick + 1)
            now = clock.advance(now, past[one, ..., :4])
            times.append(now + ahead)
            pace, phase = clock.pace_and_phase(times[-1])
            down = gait.wants_contact(phase, pace)
            below = ground.advance(below, feet[one], up[one], velocity[one], down)
            grounds.append(below)
        time, known = _joined(times), _joined(grounds)
        pace, phase = clock.pace_and_phase(time)
        slope, height = known[..., 1:], known[..., :1] + gait.HEIGHT
        body = gait.Body(q, velocity, turn, roll_pitch, slope, height)
        base = (gait.targets(phase, pace + self.lead(pace), body) - self.offset) / ACTION_SCALE
        contacts = gait.wants_contact(phase, pace).to(x.dtype)
        seen = torch.cat([x, clock.features(time), contacts, 10 * known, base], dim=-1)
        first = torch.cat([memory, now, ahead, below, rest], dim=-1)
        return seen, (first, torch.cat([cell, x[-1:]], dim=-1))

    def act(self, seen: Tensor, state: State) -> tuple[Tensor, State]:
        """Actions (T, N, 12) and the new state, of what `follow` returns."""
        (h, gait_state), (c, before) = (half.split([MEMORY, half.shape[-1] - MEMORY], dim=-1) for half in state)
        y, (h, c) = self.lstm(seen, (h.contiguous(), c.contiguous()))
        y = seen[..., -12:] + self.body(torch.cat([nn.functional.silu(y), seen], dim=-1))
        return y, (torch.cat([h, gait_state], dim=-1), torch.cat([c, before], dim=-1))


def _unpack(first: Tensor) -> tuple[Tensor, ...]:
    """Memory, clock, what is added to it, ground and nothing, of the first part of a policy's state."""
    return first.split(PARTS, dim=-1)


def _joined(ticks: list[Tensor]) -> Tensor:
    return torch.cat(ticks) if len(ticks) > 1 else ticks[0]


def _expectation() -> tuple[np.ndarray, np.ndarray]:
    """A, b: x A + b are roll, pitch, q, linear and angular velocity (20,) one tick after an observation x (48,)."""
    spec, first = DEFAULT_OBSERVATION, 0
    rows: dict[str, slice] = {}
    for term in spec.terms:
        rows[term.name] = slice(first, first := first + term.size)
    pick = np.zeros((spec.size, 20))
    for columns, name, rate in ((slice(0, 2), "roll_pitch", "angular_velocity"), (slice(2, 14), "q", "dq")):
        size = columns.stop - columns.start
        pick[rows[name], columns] = np.eye(size)
        pick[rows[rate], columns][:size] = TICK * np.eye(size)
    for columns, name in ((slice(14, 17), "linear_velocity"), (slice(17, 20), "angular_velocity")):
        pick[rows[name], columns] = np.eye(3)
    return pick / spec.scale[:, None], spec.offset @ pick


def actor_of(weights: dict[str, Tensor]) -> Recurrent:
    """The policy with these weights; those made before it carried a gait along go on without one."""
    bare = "offset" not in weights
    actor = Recurrent(DEFAULT_OBSERVATION.size, 12, MEMORY, HIDDEN) if bare else Policy()
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
