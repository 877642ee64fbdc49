"""Results that are not those of a PD-controlled joint."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from quadvel_sysid.data.signals import Samples
from quadvel_sysid.data.split import DataSplit
from quadvel_sysid.model.torque_model import Model
from quadvel_sysid.report.sanity_checks import implausibilities
from tests.quadvel_sysid.simulated_joints import parameters, record


@pytest.fixture(scope="module")
def model() -> Model:
    """A model of two joints with the commanded gains."""
    samples = Samples.of([record(parameters(joints=2), 2, 1.0, 500)])
    delays = np.repeat([[0.007], [0.001]], 2, axis=1)
    one = np.zeros(2, dtype=np.intp)
    return Model(samples, 0.0, np.ones((2, 2)), one, delays, one)


def reasons(model: Model, noise_overlap: int = 0) -> str:
    rows = model.samples.evaluated
    parts = DataSplit(rows, rows, rows, np.zeros(1, dtype=np.intp), noise_overlap)
    return "; ".join(implausibilities(model, parts))


def test_gains_near_the_commanded_ones_are_plausible(model: Model) -> None:
    assert reasons(model) == ""


@pytest.mark.parametrize(("row", "name"), [(0, "kp"), (1, "kd")])
@pytest.mark.parametrize("ratio", [0.1, 4.0])
def test_gains_far_from_the_commanded_ones_are_not(model: Model, row: int, name: str, ratio: float) -> None:
    gains = model.gains.copy()
    gains[row, 1] = ratio
    text = reasons(attrs.evolve(model, gains=gains))
    joint = model.samples.joints[1]
    assert text.startswith(f"{name} is ")
    assert f"on {joint}, but" in text
    assert "likely:" in text


def test_a_delay_at_its_bound_is_not_plausible(model: Model) -> None:
    late = model.with_delays(np.repeat([[0.02], [0.001]], 2, axis=1))
    assert reasons(late).startswith("the input delay reaches its bound of 20 ms")
    later = model.with_delays(np.repeat([[0.007], [0.006]], 2, axis=1))
    assert reasons(later).startswith("the output delay reaches its bound of 6 ms")
    assert reasons(later, noise_overlap=1) == ""  # the torque follows from the motion
