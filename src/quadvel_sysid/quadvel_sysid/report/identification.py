"""Result records of an identification: report, corrected model and series for the figures.

`identify` fills these records, and `report` writes them. "Plain EAM" is the empirical actuator
model without effects (`data.plain_model`); "corrected model" is the same model with the effects
found.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import attrs

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.arrays import Array


@attrs.frozen(eq=False, kw_only=True)
class Trace:
    """Held-out torque series of one joint, (n,) each.

    Attributes:
        t: Times of the held-out rows, s; with gaps, since the rows between them were fitted.
        measured: Measured torque, N m. It and the predictions are NaN where samples are invalid.
        pd: Torque of the ideal PD law, N m.
        before: Torque of the plain EAM, N m.
        after: Torque of the corrected model, N m.
    """

    t: Array
    measured: Array
    pd: Array
    before: Array
    after: Array


@attrs.frozen(eq=False, kw_only=True)
class Shape:
    """Residual of one joint over the signal that explains it.

    Attributes:
        effect: Name of the effect.
        joint: Name of the joint.
        signal: Name of the signal as in the report: `q`, `dq`, `tau@history`, `FR_thigh_joint/dq`.
        unit: Unit of the signal.
        x: Values of the signal, (n,).
        before: Measured minus predicted torque of the plain EAM, (n,), N m.
        after: The same for the corrected model, (n,), N m.
    """

    effect: str
    joint: str
    signal: str
    unit: str
    x: Array
    before: Array
    after: Array


@attrs.frozen(eq=False)
class Identification:
    """Result of an identification.

    Attributes:
        report: Content of report.json.
        parameters: Corrected actuator model.
        traces: Held-out torque series, by joint name.
        shapes: One or more for each effect, in the order of the report's effects.
    """

    report: Mapping[str, Any]
    parameters: ActuatorParameters
    traces: Mapping[str, Trace]
    shapes: tuple[Shape, ...] = ()
