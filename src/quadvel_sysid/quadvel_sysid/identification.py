"""What an identification hands to its report: the numbers, the corrected model, and the series for the pictures.

Records only: `identify` fills them, `report` writes them down.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.parameters import ActuatorParameters

Array = NDArray[np.float64]


@attrs.frozen(eq=False)
class Trace:
    """One joint over held-out time, each (n,): measured torque and what each model predicts, N m.

    Where a sample cannot be compared it is NaN; gaps in `t` (s) are where nothing was held out.
    """

    t: Array
    measured: Array
    pd: Array
    """ideal PD law"""
    before: Array
    """plain EAM"""
    after: Array
    """corrected model"""


@attrs.frozen(eq=False)
class Shape:
    """Residual of one joint (measured minus predicted, N m) over the signal that explains it, each (n,)."""

    effect: str
    joint: str
    signal: str
    """as in the report: q, dq, tau@history, FR_thigh_joint/dq, ..."""
    unit: str
    x: Array
    before: Array
    after: Array


@attrs.frozen(eq=False)
class Identification:
    """What `identify` found."""

    report: Mapping[str, Any]
    """the content of report.json"""
    parameters: ActuatorParameters
    """the corrected model"""
    traces: Mapping[str, Trace]
    """by joint name"""
    shapes: tuple[Shape, ...] = ()
    """one or more for each effect, in the report's order of effects"""
