"""Guards of the velocity of the trunk, which the policy needs. No ROS.

`guard.GuardSet` runs them; the supervisor replaces a rejected estimate by `backup_velocity`.
Velocities are in the body frame, m/s.
"""

from __future__ import annotations

import math

from typing_extensions import override

from ..guard import WALK_MODES, Guard, GuardInput, Level


class EstimateStale(Guard):
    """There is no fresh velocity estimate, or it is not finite: the Kalman filter replaces it."""

    level = Level.LIMIT
    modes = WALK_MODES

    @override
    def check(self, data: GuardInput) -> str | None:
        return _estimate_problem(data)


class EstimateWrong(Guard):
    """The velocity estimate deviates from the Kalman filter by more than `max_velocity_error`: the
    Kalman filter replaces it until both have agreed for `velocity_trust_time`.
    """

    level = Level.LIMIT
    modes = WALK_MODES

    def __init__(self) -> None:
        self._agreement_time = 0.0
        self._found: str | None = None

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.velocity is None or data.backup is None:
            return self._found
        config, error = data.config, math.dist(data.velocity.tolist(), data.backup.tolist())
        if not error <= config.max_velocity_error:
            self._agreement_time = 0.0
            self._found = f"the velocity estimate is {error:.1f} m/s off the Kalman filter's, limit {config.max_velocity_error:.1f}"
        else:
            self._agreement_time += data.gap
            if self._agreement_time > config.velocity_trust_time:
                self._found = None
        return self._found


class NoVelocity(Guard):
    """Neither the velocity estimate nor the Kalman filter has a velocity."""

    level = Level.STANCE
    modes = WALK_MODES

    @override
    def check(self, data: GuardInput) -> str | None:
        lost = _estimate_problem(data)
        return f"{lost}, nor has the Kalman filter one" if lost and data.backup is None else None


def _estimate_problem(data: GuardInput) -> str | None:
    """Return why the velocity estimate cannot be used, in one sentence, or None."""
    if data.velocity is None:
        refusal = data.refused.get("velocity_estimate")
        return (
            f"velocity_estimate is refused: {refusal}" if refusal else "there is no fresh velocity estimate"
        )
    return None if all(map(math.isfinite, data.velocity.tolist())) else "the velocity estimate is not finite"
