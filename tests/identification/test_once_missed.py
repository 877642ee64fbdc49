"""Hidden effects that the tool once took for another one."""

import pytest

from tests.identification import adapter
from tests.identification.hidden.cases import make_case
from tests.identification.judge import judge


@pytest.mark.parametrize(
    ("kind", "index", "seed"),
    [
        ("velocity_filter", 0, 17),  # beside delays of 20 ms it promises little as long as these are wrong
        (
            "torque_saturation",
            0,
            606,
        ),  # it had led the plain fit's delays 10 ms astray, out of the grid's reach
        ("soft_stop", 1, 913),  # a spring and less than a period of cogging add up to any curve
        ("backlash", 2, 912),  # play goes with commands to come nearly as well as with those it answers
        pytest.param(
            "triple", 0, 606, marks=pytest.mark.long
        ),  # gains kept those of delays that a score test had to cut back
        pytest.param(
            "cross_coupling", 0, 17, marks=pytest.mark.long
        ),  # to an angle, whose zero is a convention
        pytest.param(
            "quadratic_drag", 1, 18, marks=pytest.mark.long
        ),  # every second row met commands at 500 Hz alike, which hid a wrong delay
        pytest.param(
            "backlash", 0, 21, marks=pytest.mark.long
        ),  # the right form keeps little of what it promises at delays that are not its own
        pytest.param(
            "close_pair", 1, 21, marks=pytest.mark.long
        ),  # cogging on three joints, a spring on one of them
        pytest.param(
            "close_pair", 3, 27, marks=pytest.mark.long
        ),  # the drag of a hip that moves slowly was out of bounds
        pytest.param(
            "close_pair", 1, 27, marks=pytest.mark.long
        ),  # given up before a spring replaced the offset
        pytest.param("pair", 2, 27, marks=pytest.mark.long),  # a lag that one joint shows alone
        pytest.param(
            "table_4", 5, 27, marks=pytest.mark.long
        ),  # of 20 logs one takes delays off the drive's steps by chance
        pytest.param(
            "speed_band_drag", 0, 28, marks=pytest.mark.long
        ),  # a drag that was read off the torque as commands that are lost
        pytest.param(
            "table_4", 6, 17, marks=pytest.mark.long
        ),  # the rows of the held-out log lie otherwise between their commands
    ],
)
def test_it_is_named_now(kind, index, seed, tmp_path):
    assert _judged(kind, index, seed, tmp_path)["verdict"] == "right"


@pytest.mark.parametrize(
    ("kind", "index", "seed"),
    [
        pytest.param(
            "armature", 14, 28, marks=pytest.mark.long
        ),  # feet that are lifted hardly tell which part of the delays comes after an inertia
    ],
)
def test_its_intervals_hold_the_truth_now(kind, index, seed, tmp_path):
    assert [one["covered"] for one in _judged(kind, index, seed, tmp_path)["intervals"]] == [True]


def _judged(kind, index, seed, tmp_path):
    case = make_case(kind, index, seed)
    logs = [path.rename(tmp_path / path.name) for path in case.save(tmp_path / "truth")]
    return judge(adapter.identify(logs[:1], logs[1:]), case.truth)
