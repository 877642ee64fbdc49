"""Regression tests: hidden effects that the identification once named wrongly."""

import pytest

from benchmarks.identification import adapter
from benchmarks.identification.contest import GENERATORS
from benchmarks.identification.verdicts import score_report


@pytest.mark.parametrize(
    ("kind", "index", "seed"),
    [
        ("velocity_filter", 0, 17),  # with wrong delays of 20 ms its score is low
        pytest.param(
            "torque_saturation", 0, 606, marks=pytest.mark.long
        ),  # it biased the delays of the plain fit by 10 ms, beyond the grid
        pytest.param(
            "soft_stop", 1, 913, marks=pytest.mark.long
        ),  # a spring and less than a period of cogging can form any curve
        ("backlash", 2, 912),  # backlash fits later commands nearly as well as the true ones
        pytest.param(
            "triple", 0, 606, marks=pytest.mark.long
        ),  # gains kept the values for delays that the score test had clipped
        pytest.param(
            "cross_coupling", 0, 17, marks=pytest.mark.long
        ),  # coupling to an angle, whose zero is a convention
        pytest.param(
            "quadratic_drag", 1, 18, marks=pytest.mark.long
        ),  # every second row had the same phase to commands at 500 Hz, which hid a wrong delay
        pytest.param(
            "backlash", 0, 21, marks=pytest.mark.long
        ),  # at other delays than its own the right form has a low score
        pytest.param(
            "close_pair", 1, 21, marks=pytest.mark.long
        ),  # cogging on three joints, a spring on one of them
        pytest.param(
            "close_pair", 3, 27, marks=pytest.mark.long
        ),  # the drag of a slow hip exceeded its bounds
        pytest.param(
            "close_pair", 1, 27, marks=pytest.mark.long
        ),  # the search stopped before a spring replaced the offset
        pytest.param("pair", 2, 27, marks=pytest.mark.long),  # a lag that only one joint shows
        pytest.param(
            "table_4", 5, 27, marks=pytest.mark.long
        ),  # in 1 of 20 logs the delays leave the drive's steps by chance
        pytest.param(
            "speed_band_drag", 0, 28, marks=pytest.mark.long
        ),  # a drag that was identified as lost commands
        pytest.param(
            "table_4", 6, 17, marks=pytest.mark.long
        ),  # held-out rows have another phase to their commands
    ],
)
def test_the_effect_is_named_correctly(kind, index, seed, tmp_path):
    assert _scored(kind, index, seed, tmp_path)["verdict"] == "right"


@pytest.mark.parametrize(
    ("kind", "index", "seed"),
    [
        pytest.param(
            "armature", 14, 28, marks=pytest.mark.long
        ),  # lifted feet hardly separate the two delays of an inertia
    ],
)
def test_the_intervals_contain_the_truth(kind, index, seed, tmp_path):
    assert [one["covered"] for one in _scored(kind, index, seed, tmp_path)["intervals"]] == [True]


@pytest.mark.parametrize(
    "index",
    [
        8,  # an average over three rows was too wide for the fastest of six joints
        pytest.param(1, marks=pytest.mark.long),  # instants of the drive alternate by 0.2 ms: a false inertia
        pytest.param(3, marks=pytest.mark.long),  # speeds between rows that are 20 ms apart are not known
    ],
)
def test_a_log_without_effects_gets_none(index, tmp_path):
    assert _scored("none", index, 9, tmp_path, "other")["named"] == []


@pytest.mark.parametrize(
    ("kind", "index"),
    [
        ("torque_saturation", 3),  # nearly always at its limit: refused for another unit of its gain
        pytest.param("armature", 6, marks=pytest.mark.long),  # a learned term was 1 % better
    ],
)
def test_the_effect_of_the_second_generator_is_named_correctly(kind, index, tmp_path):
    assert _scored(kind, index, 9, tmp_path, "other")["verdict"] == "right"


@pytest.mark.parametrize(
    ("kind", "index"),
    [
        ("none", 2),  # a filter of angles took over kd, and so had less encoder noise
        pytest.param("viscous_friction", 2, marks=pytest.mark.long),  # a factor of dq took over kd
    ],
)
def test_no_learned_term_takes_over_the_gains(kind, index, tmp_path):
    assert _scored(kind, index, 5, tmp_path, "other")["extra"] == []


def _scored(kind, index, seed, tmp_path, generator="first"):
    case = GENERATORS[generator].make_case(kind, index, seed)
    logs = [path.rename(tmp_path / path.name) for path in case.save(tmp_path / "truth")]
    return score_report(adapter.identify(logs[:1], logs[1:]), case.truth)
