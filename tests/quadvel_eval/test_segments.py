from __future__ import annotations

import numpy as np
import pytest

from quadvel_eval.segments import Segment, measure_segment, response_delay, rounded, tracking_errors

TIME = np.arange(0.0, 6.0, 0.005)


def test_mean_of_a_sine_over_whole_periods_is_its_offset() -> None:
    velocity = np.column_stack([0.5 + 0.2 * np.sin(np.pi * TIME), 0.1 + 0 * TIME, -0.3 + 0 * TIME])
    segment = measure_segment(TIME, velocity, (0.5, 0.0, 0.0), 2.0, 6.0)
    np.testing.assert_allclose(segment.mean, [0.5, 0.1, -0.3], atol=1e-12)
    assert segment.error_xy == pytest.approx(0.1)
    assert segment.error_wz == pytest.approx(0.3)


def test_samples_of_the_transition_do_not_count() -> None:
    velocity = np.where(TIME[:, None] < 2.0, 9.0, [1.0, 0.0, 0.0])
    assert measure_segment(TIME, velocity, (1.0, 0.0, 0.0), 2.0, 6.0).error_xy == pytest.approx(0.0)


def test_error_xy_is_the_length_of_the_difference_and_leaves_the_turn_out() -> None:
    segment = Segment(np.array([1.0, 1.0, 1.0]), np.array([0.7, 0.6, 3.0]))
    assert segment.error_xy == pytest.approx(0.5)  # 3, 4, 5
    assert segment.error_wz == pytest.approx(2.0)


def test_error_is_that_of_the_mean_velocity_not_the_mean_of_errors() -> None:
    sway = np.column_stack([np.where(np.arange(len(TIME)) % 2, 1.5, 0.5), 0 * TIME, 0 * TIME])
    assert measure_segment(TIME, sway, (1.0, 0.0, 0.0), 0.0, 6.0).error_xy == pytest.approx(0.0)


def test_a_stretch_without_samples_is_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match=r"between 7\.00 and 8\.00 s"):
        measure_segment(TIME, np.zeros((len(TIME), 3)), (0.0, 0.0, 0.0), 7.0, 8.0)


def test_aggregates_are_the_largest_and_the_mean_error() -> None:
    segments = [Segment(np.zeros(3), np.array([x, 0.0, -2 * x])) for x in (0.1, 0.2, 0.6)]
    assert tracking_errors(segments) == pytest.approx(
        {"max_error_xy": 0.6, "mean_error_xy": 0.3, "max_error_wz": 1.2, "mean_error_wz": 0.6}
    )


def test_delay_is_that_of_a_first_order_response_and_knows_no_steady_error() -> None:
    asked = np.minimum(TIME, 1.0)
    late = np.zeros_like(asked)
    for k in range(1, len(late)):
        late[k] = late[k - 1] + (asked[k - 1] - late[k - 1]) * (TIME[1] - TIME[0]) / 0.3
    assert response_delay(asked, 0.8 * late, TIME[1] - TIME[0]) == pytest.approx(0.3, abs=0.02)
    assert response_delay(asked, 0.3 * late, TIME[1] - TIME[0]) is None


def test_numbers_in_files_are_plain_and_short() -> None:
    assert rounded(np.float32(0.1)) == 0.1
    assert rounded(np.array([1.0, 2.00000049])) == [1.0, 2.0]
    assert type(rounded(np.float64(1.5))) is float


def test_a_number_that_is_not_there_is_none_in_a_file() -> None:
    assert rounded(float("nan")) is None
    assert rounded([[1.0, float("nan")], [float("inf"), 0.1234567]]) == [[1.0, None], [None, 0.123457]]
