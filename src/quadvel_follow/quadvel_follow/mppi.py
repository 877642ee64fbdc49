"""Model predictive path integral control: many noisy copies of the last plan, averaged by how little they cost.

G. Williams et al., Information theoretic MPC for model-based reinforcement learning, ICRA 2017.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .rollouts import STEP, STEPS, Limits

Array = NDArray[np.float64]

ROLLOUTS = 192
KNOTS = 4  # between which the noise of a rollout goes straight
SPREAD = np.array([0.4, 0.2, 0.5])  # m/s, m/s, rad/s, standard deviation of the noise
TEMPERATURE = 0.05  # of the cost


class Mppi:
    """The noise is drawn once, so that neighbouring instants have neighbouring plans."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        half = rng.standard_normal((ROLLOUTS // 2, KNOTS, 3))
        at = np.linspace(0.0, KNOTS - 1.0, STEPS)
        left = np.minimum(at.astype(int), KNOTS - 2)
        share = (at - left)[:, None]
        smooth = (1.0 - share) * half[:, left] + share * half[:, left + 1]
        self._noise = SPREAD * np.stack([smooth, -smooth], axis=1).reshape(-1, STEPS, 3)
        self._plan = np.zeros((STEPS, 3))

    def reset(self) -> None:
        """Forget the last plan."""
        self._plan = np.zeros((STEPS, 3))

    def search(
        self, cost: Callable[[Array], Array], limits: Limits, command: Array, guesses: Array, elapsed: float
    ) -> Array:
        """The targets (STEPS, 3) to command; cost: of targets (K, STEPS, 3); guesses (n, STEPS, 3): targets that may be good."""
        at = np.arange(STEPS) + elapsed / STEP
        plan = np.column_stack([np.interp(at, np.arange(STEPS), axis) for axis in self._plan.T])
        half = ROLLOUTS // 2
        targets = np.concatenate(
            [plan + self._noise[:half], guesses[0] + self._noise[half:], guesses, [plan, np.zeros_like(plan)]]
        )
        targets = limits.held(targets)
        costs = cost(targets)
        weights = np.exp((costs.min() - costs) / TEMPERATURE)
        self._plan = np.einsum("k,ksa->sa", weights / weights.sum(), targets)
        return self._plan
