"""Options of an identification: what a user chooses, and the devices that an ablation switches off.

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


def _device(description: str) -> Any:
    """A field for a device, which is on unless an ablation switches it off."""
    return _option(True, description, (False, True))


@attrs.frozen
class Devices:
    """Devices of the identification; the ablation study measures the score without each of them.

    The defaults are those of `quadvel identify`.
    """

    even_clocks: bool = _device("restore the even clock of jittering stamps")
    averaged_encoders: bool = _device("average encoder noise that the drive did not act on")
    sharp_accelerations: bool = _device("keep accelerations sharp where a command arrives")
    instants_per_row: int = _option(2, "instants of a row, for effects that act between rows", (1, 8))
    cluster_motion_rad: float = _option(0.02, "motion of some joint that ends a cluster", (0.0, 1.0), "rad")
    kurtosis_test: bool = _device("test the residual for kurtosis as well as for autocorrelation")
    delay_starts: int = _option(3, "points of the grid of delays from which fits start", (1, 100))
    far_delays: bool = _device("try delays up to 8 ms from the present ones")
    longest_delays: bool = _device("choose the longest equivalent delays, and whole drive steps")
    screening_grid: bool = _device("screen candidates on a grid of delays")
    memory_cost: float = _option(
        0.5, "further parameters of a law with memory or one like a delay", (0.0, 10.0)
    )
    lost_commands_at_random: bool = _device("accept lost commands only if the command's age does not predict")
    fitted_laws: int = _option(6, "laws that are fitted after a screening", (1, 100))
    fitted_terms: int = _option(4, "terms that are fitted after a screening", (1, 100))
    shared_trials: int = _option(3, "best candidates for which sharing across joints is tested", (0, 100))
    second_starts: bool = _device("fit laws that shift the torque from two starts")
    terms_at_nearby_delays: bool = _device("refit terms from nearby delays")
    finer_terms: bool = _device("refine the shapes of terms after their screening")
    laws_before_terms: bool = _device("prefer laws to terms that explain the log equally well")
    special_cases: bool = _device("replace a law by its special case where the rows do not need it")
    no_repeats: bool = _device("reject a law that is nested with one on the same joints")
    elimination: bool = _device("remove effects that became unnecessary")
    gains_of_each_joint: bool = _device("try gains and delays of each joint")


DEVICES = Devices()
"""All devices."""


@attrs.frozen
class IdentifyOptions:
    """What a user chooses about an identification."""

    gains: tuple[float, float] | None = _option(
        None,
        "commanded kp and kd of logs that hold none; None to fit them",
        (0.0, math.inf),
        "N m/rad, N m s/rad",
    )
    max_values: int = _option(60_000, "torque values of all logs; longer logs are cut", (1000, 10**9))
    base: ActuatorParameters | None = _option(
        None, "model whose torque limits are kept; None for the default"
    )
    robot: str | None = _option(None, "legs that replay the commands: aliengo, go2, an MJCF or URDF file")
    cores: int = _option(1, "worker processes; the report does not depend on them", (1, 1024))
    devices: Devices = _option(DEVICES, "devices of the search; an ablation switches some off")


DEFAULTS = IdentifyOptions()
"""Options of `quadvel identify` without arguments, on one core."""
