"""Runs the teacher of stage 1 at every tick (200 Hz) for stage 2, where it drives robots and labels actions.

Shapes: n robots; T ticks of N robots in sequences.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch

from quadvel_description import symmetry

from . import privileged
from .env import TICK_S, VelocityEnv
from .past import Past
from .privileged import ACTION_BOUND
from .walking_rewards import SAMPLE_S

HOLD_TICKS = round(SAMPLE_S / TICK_S)  # for which the teacher's actions were held when it learned
RECALLED_MIRROR = symmetry.concatenate_mirrors(
    [
        privileged.PLANAR,  # error over a stride
        privileged.PLANAR,  # lasting error
        privileged.PLANAR,  # lag
        symmetry.sign_mirror(-1, -1),  # phase of the steps
        privileged.PLANAR,  # planned velocity
        symmetry.sign_mirror(1, -1),  # slope of the ground
    ]
)
RECALLED_SIZE = len(RECALLED_MIRROR.index)
AVERAGED_TICKS = 3
"""Ticks over which a teacher that drives averages its actions; this delays them as much as holding them did."""
LABEL_BEFORE, LABEL_AFTER = 3, 1
"""Ticks before and after its own over which a label is averaged; the mean delay is one tick, as above."""


class Teacher:
    """Teacher of a checkpoint, evaluated at every tick, with averaged actions.

    Actions are averaged over `AVERAGED_TICKS`, because it learned with actions held for 20 ms.
    Evaluated at every tick without the average, it falls where it does not fall otherwise (decision
    43).

    Attributes:
        actor: policy of the teacher.
        env: environments.
        past: past of the robots.
        latest: (n, 12), last action before the average, in units of `privileged.ACTION_SCALE` (rad).
    """

    def __init__(self, checkpoint: dict[str, Any], env: VelocityEnv) -> None:
        """Load the teacher.

        Args:
            checkpoint: content of a checkpoint of `privileged`.
            env: environments.
        """
        self.actor = privileged.load_teacher(checkpoint)
        self.env, self.past = env, Past(env)
        n = env.config.n
        self._executed = deque([np.zeros((n, 12), np.float32) for _ in range(HOLD_TICKS)], HOLD_TICKS)
        self._recent = np.zeros((AVERAGED_TICKS, n, 12), np.float32)  # newest first
        self._starts = np.ones(n, bool)
        self.latest = np.zeros((n, 12), np.float32)

    def reset(self, ids: np.ndarray) -> None:
        """Clear the past of some robots.

        Args:
            ids: their indices.
        """
        self.past.reset(ids)
        for action in self._executed:
            action[ids] = 0.0
        self._starts[ids] = True

    def action(self) -> np.ndarray:
        """Evaluate the teacher; call it once per tick.

        Returns:
            (n, 12), action, in units of `privileged.ACTION_SCALE` (rad).
        """
        obs = privileged.observe(self.env, self.past, self._executed[0])
        with torch.no_grad():
            correction: np.ndarray = self.actor(torch.from_numpy(obs))[0].numpy()
        self.latest = now = privileged.total_action(self.env, self.past, correction)
        self._recent = np.concatenate([now[None], self._recent[:-1]])
        self._recent[:, self._starts] = now[self._starts]
        self._starts[:] = False
        mean: np.ndarray = self._recent.mean(axis=0)
        return mean

    def advance(self, command: np.ndarray, executed: np.ndarray) -> None:
        """Record a tick.

        Args:
            command: (n, 4), command that was in force: vx, vy (m/s), yaw rate (rad/s), 1 to stand.
            executed: (n, 12), actions taken, in units of `privileged.ACTION_SCALE` (rad).
        """
        self.past.advance(command)
        self._executed.append(executed.clip(-ACTION_BOUND, ACTION_BOUND))

    def recalled_features(self) -> np.ndarray:
        """Return what the teacher observes of past and ground, which a memory has to keep or to infer.

        Returns:
            (n, RECALLED_SIZE), scaled to about 1: errors over a stride (3) and lasting ones (3), lag behind
            the plan (3), sine and cosine of the phase of the steps (2), planned velocity (3), slope of
            the ground (2).
        """
        past, slope = self.past, self.env.ground_slope
        return np.concatenate(
            [3 * past.stride, 12 * past.lasting, 8 * past.lag, past.clock.observation(), 5 * slope], axis=1
        ).astype(np.float32)


def smooth_labels(actions: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Average the teacher's actions around each tick.

    The teacher's targets jump where it plans a touchdown or a lift-off, and its student would copy the
    jumps. It knows them in advance, so that later actions may count as well; the mean delay is that of
    the average with which the teacher drives.

    Args:
        actions: (T, N, 12), actions of the teacher.
        mask: (T, N), 1 for robots that are up; actions of others do not count.

    Returns:
        (T, N, 12), means over `LABEL_BEFORE` ticks before to `LABEL_AFTER` after, fewer at the ends of the sequence.
    """
    ticks = np.arange(len(actions))
    first, last = np.maximum(ticks - LABEL_BEFORE, 0), np.minimum(ticks + LABEL_AFTER, len(actions) - 1)

    def window_sum(values: np.ndarray) -> np.ndarray:
        """Sum of the values (T, N, k) in the window of each tick."""
        running = np.concatenate([np.zeros_like(values[:1], float), values.cumsum(axis=0, dtype=float)])
        return np.asarray(running[last + 1] - running[first])

    count = np.maximum(window_sum(mask[..., None]), 1.0)
    return np.asarray(window_sum(actions * mask[..., None]) / count, np.float32)
