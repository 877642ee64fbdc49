"""The recurrent student: its network, what it observes of an environment, and its policy file (ONNX)."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import torch
from torch import Tensor, nn

from quadvel_description import robot
from quadvel_policy.observation import DEFAULT_OBSERVATION, ActionMap, PolicyMetadata, build_observation

from . import clock, gait, ground
from .command_map import CommandCorrection, CommandMap
from .env import TICK, VelocityEnv
from .legs import Legs, columns, joints
from .networks import Recurrent, State, mlp, select
from .onnx_file import commit, export
from .teacher import RESIDUAL

ACTION_SCALE = 0.4  # rad a unit of the network's output
MEMORY = 256
HIDDEN = (256, 128, 64)
PARTS = [clock.SIZE, clock.SIZE, ground.SIZE, 12]
PARTS.append(DEFAULT_OBSERVATION.size - sum(PARTS))  # of no use: both halves of a state have one size
"""What the first half of the gait's state is put together of."""

COMMAND = 4  # numbers, the observation's first
CARRIED = COMMAND + 2 + 4 + ground.SIZE + 3 * 12
"""Command and hand of the clock, feet that should be down, ground, the gait's last targets, how far
its next are from the joints, and these targets."""
GROUND = 5.0  # of the network's unit, for 1 m and for a slope of 1


class Policy(Recurrent):
    """The policy of Section 4.1 on top of a trotting gait that it carries along (docs/decisions/0017).

    Behind the LSTM's memory the first half of the state goes on with the gait's clock, what is added to it (half a cycle for
    a robot in the mirror, else nothing) and the ground that the feet feel; the second with the observation of the tick
    before. So the gait's joint targets are known before the tick: the network adds to them. What the LSTM sees the layers
    behind it see as well.
    """

    offset: Tensor
    expect: Tensor
    expect_offset: Tensor

    def __init__(self, offset: np.ndarray = robot.NOMINAL_Q) -> None:
        """offset: joint angles (12,) rad at action zero."""
        seen = DEFAULT_OBSERVATION.size - COMMAND + CARRIED
        super().__init__(seen, 12, MEMORY, HIDDEN)
        self.body = mlp([MEMORY + seen, *HIDDEN, 12])
        with torch.no_grad():
            self.body[-1].weight.mul_(0.1)
        self.lead = CommandCorrection(CommandMap(), COMMAND)  # of the gait, as its teacher walks it
        self.correction: CommandCorrection | None = None  # of the commands that the policy is given
        self.register_buffer("offset", torch.tensor(offset, dtype=torch.float32))
        for name, array in zip(("expect", "expect_offset"), _expectation(), strict=True):
            self.register_buffer(name, torch.as_tensor(array, dtype=torch.float32), persistent=False)

    def initial_state(self, n: int, mirrored: bool = False) -> State:
        """Of `n` robots, before their first tick; `mirrored`: of their mirror images."""
        size = MEMORY + DEFAULT_OBSERVATION.size
        state = torch.zeros(1, n, size), torch.zeros(1, n, size)
        if mirrored:
            state[0][..., MEMORY:].split(PARTS, dim=-1)[1].copy_(torch.tensor(clock.HALF_CYCLE))
        return state

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Actions (T, N, 12) and the new state from x (T, N, 48) and the state (1, N, 304); N may be missing in all."""
        memory, gait_state = parts_of(state)
        carried, gait_state = self.follow(x, gait_state)
        y, memory = self.act(x, carried, memory)
        return y, whole(memory, gait_state)

    def act(self, x: Tensor, carried: Tensor, memory: State) -> tuple[Tensor, State]:
        """What is learned: actions (T, N, 12) and the LSTM's new memory, from x and what `follow` says of the gait.

        Of the command the layers know what the gait made of it.
        """
        seen = torch.cat([x[..., COMMAND:], carried], dim=-1)
        y, (h, c) = self.lstm(seen, memory)
        return carried[..., -12:] + self.body(torch.cat([nn.functional.silu(y), seen], dim=-1)), (h, c)

    def follow(self, x: Tensor, gait_state: State) -> tuple[Tensor, State]:
        """The gait carried along over x (T, N, 48): (T, N, CARRIED), and its new state."""
        (now, ahead, below, last, rest), before = gait_state[0].split(PARTS, dim=-1), gait_state[1]
        past = torch.cat([before, x[:-1]]) if len(x) > 1 else before
        roll_pitch, q, velocity, turn = (past @ self.expect + self.expect_offset).split([2, 12, 3, 3], dim=-1)
        q, up = columns(q), gait.upward(roll_pitch)
        times, grounds = [], []
        commands = past[..., :COMMAND]
        if self.correction:
            commands = commands + self.correction(commands)
        for command in commands.split(1):
            now = clock.advance(now, command)
            times.append(now + ahead)
        time = _joined(times)
        pace, phase = clock.pace_and_phase(time)
        cycle = gait.Cycle(phase, pace + self.lead(pace))
        for feet in zip(*(part.split(1) for part in (Legs(q).feet, up, velocity, cycle.down)), strict=True):
            below = ground.advance(below, *feet)
            grounds.append(below)
        known = _joined(grounds)
        height, slope = known.split([1, 2], dim=-1)
        body = gait.Body(q, velocity, turn, roll_pitch, slope, height + gait.HEIGHT)
        targets = gait.targets(cycle, body)
        base, spring = (targets - self.offset) / ACTION_SCALE, (targets - joints(q)).clamp(-1, 1)
        last = torch.cat([last, base[:-1]]) if len(x) > 1 else last
        hand, down = clock.hand(pace, phase), cycle.down.to(x.dtype)
        carried = torch.cat([cycle.command, hand, down, GROUND * known, last, spring, base], dim=-1)
        return carried, (torch.cat([now, ahead, below, base[-1:], rest], dim=-1), x[-1:] if len(x) > 1 else x)

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def take_over(self, teacher: nn.Sequential) -> None:
        """Begin as this memoryless network, which corrects the same gait by the true state (`teacher.observe`).

        What it reads of that state is read of the observation, of the clock and of what the feet feel instead.
        """
        first, *others = (layer for layer in teacher if isinstance(layer, nn.Linear))
        command, moving, q, rest, added, hand, ahead, down, height = first.weight.split(
            [4, 2, 12, 18, 12, 2, 12, 4, 1], dim=1
        )
        unit = ACTION_SCALE / RESIDUAL
        none = [torch.zeros(len(first.weight), size) for size in (MEMORY, ground.SIZE - 1, 12)]
        x = [moving, q, rest, unit * added]
        carried = [command, hand, down, height * 5 / GROUND, none[1], -unit * added, 2 * ahead, none[2]]
        own = [layer for layer in self.body if isinstance(layer, nn.Linear)]
        own[0].weight.copy_(torch.cat([none[0], *x, *carried], dim=1))
        own[0].bias.copy_(first.bias)
        for mine, given in zip(own[1:], others, strict=True):
            mine.load_state_dict(given.state_dict())
        own[-1].weight.div_(unit)
        own[-1].bias.div_(unit)


def parts_of(state: State) -> tuple[State, State]:
    """The memory of the LSTM and the gait's state."""
    (h, first), (c, second) = (half.split([MEMORY, half.shape[-1] - MEMORY], dim=-1) for half in state)
    return (h.contiguous(), c.contiguous()), (first, second)


def whole(memory: State, gait_state: State) -> State:
    """The state of these parts."""
    return torch.cat([memory[0], gait_state[0]], dim=-1), torch.cat([memory[1], gait_state[1]], dim=-1)


class Followed:
    """One sequence x (T, N, 48) from a state on, its gait followed once for many passes over parts of it."""

    def __init__(self, network: Policy, x: Tensor, state: State) -> None:
        self._network, self._x = network, x
        self._memory, gait_state = parts_of(state)
        with torch.no_grad():
            self._carried, self._gait_state = network.follow(x, gait_state)

    def actions(self, ids: Tensor) -> Tensor:
        """Of some robots, (T, n, 12)."""
        memory = select(self._memory, ids)
        return self._network.act(self._x[:, ids], self._carried[:, ids], memory)[0]

    def end(self) -> State:
        """The state after the sequence."""
        with torch.no_grad():
            _, memory = self._network.act(self._x, self._carried, self._memory)
        return whole(memory, self._gait_state)


def _joined(ticks: list[Tensor]) -> Tensor:
    return torch.cat(ticks) if len(ticks) > 1 else ticks[0]


def _expectation() -> tuple[np.ndarray, np.ndarray]:
    """A, b: x A + b are roll, pitch, q, linear and angular velocity (20,) one tick after an observation x (48,)."""
    spec, first = DEFAULT_OBSERVATION, 0
    rows: dict[str, slice] = {}
    for term in spec.terms:
        rows[term.name] = slice(first, first := first + term.size)
    pick = np.zeros((spec.size, 20))
    for place, name, rate in ((slice(0, 2), "roll_pitch", "angular_velocity"), (slice(2, 14), "q", "dq")):
        size = place.stop - place.start
        pick[rows[name], place] = np.eye(size)
        pick[rows[rate], place][:size] = TICK * np.eye(size)
    for place, name in ((slice(14, 17), "linear_velocity"), (slice(17, 20), "angular_velocity")):
        pick[rows[name], place] = np.eye(3)
    return pick / spec.scale[:, None], spec.offset @ pick


def actor_of(weights: dict[str, Tensor]) -> Policy:
    """The policy with these weights."""
    actor = Policy()
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


def export_policy(
    actor: Policy,
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
        curve_limit=c.curve,
        state_shape=tuple(actor.initial_state(1)[0].shape),
        actuator=attrs.asdict(env.config.actuator),
        recipe=recipe,
        commit=commit(),
    )
    mapped = copy.deepcopy(actor)
    mapped.correction = CommandCorrection(command_map, COMMAND) if command_map else None
    export(mapped, DEFAULT_OBSERVATION.size, path, ["actions"], metadata.to_json())
