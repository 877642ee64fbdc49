"""Options of an identification: what a user chooses, and what the search tries.

Each field states its description, unit and bounds in its metadata.
"""

from __future__ import annotations

import math
from typing import Any

import attrs
from attrs import validators

from quadvel_actuator.parameters import ActuatorParameters


def _option(default: Any, description: str, bounds: tuple[float, float] | None = None, unit: str = "") -> Any:
    """A field; numbers are checked against the bounds here, pairs of numbers where they are used."""
    is_number = isinstance(default, (int, float))
    validator = [validators.ge(bounds[0]), validators.le(bounds[1])] if bounds and is_number else None
    metadata = {"description": description, "unit": unit, "bounds": bounds}
    return attrs.field(default=default, validator=validator, metadata=metadata)


def _switch(description: str) -> Any:
    """A field for what is on unless an ablation switches it off."""
    return _option(True, description, (False, True))


@attrs.frozen
class SearchOptions:
    """What the search tries, and how thoroughly; the ablation study measures the score without each.

    The data that the search works on are included. The defaults are those of `quadvel identify`.
    """

    even_clocks: bool = _switch("restore the even clock of jittering stamps")
    averaged_encoders: bool = _switch("average encoder noise that the drive did not act on")
    sharp_accelerations: bool = _switch("keep accelerations sharp where a command arrives")
    instants_per_row: int = _option(2, "instants of a row, for effects that act between rows", (1, 8))
    cluster_motion_rad: float = _option(0.02, "motion of some joint that ends a cluster", (0.0, 1.0), "rad")
    kurtosis_test: bool = _switch("test the residual for kurtosis as well as for autocorrelation")
    delay_starts: int = _option(3, "points of the grid of delays from which fits start", (1, 100))
    far_delays: bool = _switch("try delays up to 8 ms from the present ones")
    central_delays: bool = _switch("choose the middle of equivalent delays, and whole drive steps")
    screening_grid: bool = _switch("screen candidates on a grid of delays")
    memory_cost: float = _option(
        0.5, "further parameters of an effect with memory or one like a delay", (0.0, 10.0)
    )
    lost_commands_at_random: bool = _switch("accept lost commands only if they are lost at random")
    fitted_effects: int = _option(6, "effects that are fitted after a screening", (1, 100))
    fitted_regressors: int = _option(4, "regressors that are fitted after a screening", (1, 100))
    finished_fits: int = _option(3, "best candidates after a few steps whose fits are finished", (1, 100))
    second_starts: bool = _switch("fit effects that shift the torque from two starts")
    regressors_at_nearby_delays: bool = _switch("refit regressors from nearby delays")
    finer_regressors: bool = _switch("refine the shapes of regressors after their screening")
    effects_before_regressors: bool = _switch(
        "prefer effects to regressors that explain the log equally well"
    )
    special_cases: bool = _switch("replace an effect by its special case where the rows do not need it")
    no_repeats: bool = _switch("reject an effect that is nested with one on the same joints")
    elimination: bool = _switch("remove effects that became unnecessary")
    gains_of_each_joint: bool = _switch("try gains and delays of each joint")


SEARCH_DEFAULTS = SearchOptions()
"""Everything on, as in `quadvel identify`."""


@attrs.frozen
class IdentifyOptions:
    """What a user chooses about an identification."""

    gains: tuple[float, float] | None = _option(
        None,
        "commanded kp and kd of logs that hold none; None to fit them",
        (0.0, math.inf),
        "N m/rad, N m s/rad",
    )
    max_values: int = _option(60_000, "torque values of the fitted logs; longer logs are cut", (1000, 10**9))
    base: ActuatorParameters | None = _option(
        None, "model whose torque limits are kept; None for the default"
    )
    robot: str | None = _option(None, "legs that replay the commands: aliengo, go2, an MJCF or URDF file")
    cores: int = _option(1, "worker processes; the report does not depend on them", (1, 1024))
    search: SearchOptions = _option(SEARCH_DEFAULTS, "what the search tries; an ablation switches some off")


DEFAULTS = IdentifyOptions()
"""Options of `quadvel identify` without arguments, on one core."""
