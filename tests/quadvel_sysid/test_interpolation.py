"""Compiled interpolation equals NumPy's, for times in any order."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_sysid.data import interpolation

RNG = np.random.default_rng(5)
TIMES = np.cumsum(RNG.uniform(0.0005, 0.003, 400))
VALUES = RNG.normal(size=(400, 3))
EVEN = np.linspace(-0.05, TIMES[-1] + 0.05, 700)
ORDERS = {
    "rising": EVEN,
    "falling": EVEN[::-1],
    "shuffled": RNG.permutation(EVEN),
    "on the rows": TIMES,
    "none": EVEN[:0],
}


@pytest.mark.parametrize("order", ORDERS)
def test_the_row_in_force_is_the_last_one_before(order: str) -> None:
    at = ORDERS[order]
    assert (
        interpolation.rows_at(TIMES, at) == np.maximum(np.searchsorted(TIMES, at, side="right") - 1, 0)
    ).all()


@pytest.mark.parametrize("order", ORDERS)
def test_values_between_rows_are_linear_and_end_where_the_rows_end(order: str) -> None:
    at = ORDERS[order]
    expected = np.stack([np.interp(at, TIMES, one) for one in VALUES.T], axis=1)
    np.testing.assert_allclose(
        interpolation.interpolate(VALUES, *interpolation.locate(TIMES, at)), expected, atol=1e-12
    )
    late = np.array([[0.0, 0.001, -0.002], [0.02, 0.5, 2.0]])
    found = interpolation.interpolate_shifted(VALUES, TIMES, at, late)
    assert found.shape == (2, len(at), 3)
    for b, j in np.ndindex(late.shape):
        np.testing.assert_allclose(
            found[b, :, j], np.interp(at - late[b, j], TIMES, VALUES[:, j]), atol=1e-12
        )


def test_a_series_with_known_slopes_is_a_parabola_between_rows() -> None:
    values, slopes = (np.stack([one, -one]).T for one in (4.0 * TIMES**2 - TIMES, 8.0 * TIMES - 1.0))
    bends = interpolation.bend(TIMES, slopes)
    at = np.linspace(TIMES[0], TIMES[-1], 300)
    expected = np.stack([4.0 * at**2 - at, at - 4.0 * at**2]).T
    found = interpolation.interpolate(values, *interpolation.locate(TIMES, at), bends)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    shifted = interpolation.interpolate_shifted(values, TIMES, at, np.zeros(2), bends)
    np.testing.assert_allclose(shifted, expected, atol=1e-12)


def test_hold_integral_is_the_sum_of_values_times_durations() -> None:
    spacing = np.diff(TIMES, append=TIMES[-1] + 1.0)[:, None]
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(VALUES * spacing, axis=0)])
    at = np.array([TIMES[0], TIMES[7], 0.25 * TIMES[7] + 0.75 * TIMES[8], TIMES[-1] + 0.5])
    expected = [
        [
            sum(
                v * max(0.0, min(t, end) - begin)
                for v, begin, end in zip(column, TIMES, [*TIMES[1:], 1e9], strict=True)
            )
            for column in VALUES.T
        ]
        for t in at
    ]
    np.testing.assert_allclose(interpolation.hold_integral(VALUES, sums, TIMES, at), expected, atol=1e-12)
