"""Tests of the selection of a person, and of the sensor's pose."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_follow import Track
from quadvel_follow.pose_history import PoseHistory
from quadvel_follow.selection import Selection

HERE = (0.0, 0.0, 0.0)


def person(identity: int, x: float, y: float, confirmed: bool = True) -> Track:
    return Track(identity, np.array([x, y]), np.zeros(2), np.eye(4), 2.0, 5.0, confirmed)


def test_nobody_is_meant_until_somebody_is_ahead() -> None:
    selection = Selection()
    assert selection.update(1.0, [person(1, -2.0, 0.0)], HERE) is None
    behind_and_ahead = [person(1, -2.0, 0.0), person(2, 4.0, 0.5), person(3, 2.0, 0.5, confirmed=False)]
    assert selection.update(1.1, behind_and_ahead, HERE).id == 2  # type: ignore[union-attr]


def test_who_is_meant_stays_so_when_somebody_comes_nearer() -> None:
    selection = Selection()
    selection.update(1.0, [person(2, 4.0, 0.0)], HERE)
    found = selection.update(1.1, [person(2, 4.0, 0.0), person(5, 1.0, 0.0)], HERE)
    assert found is not None
    assert found.id == 2


def test_a_person_may_be_asked_for_by_id_or_as_the_nearest_ahead() -> None:
    selection, tracks = (
        Selection(nearest_at_first=False),
        [person(2, 4.0, 0.0), person(5, 1.0, 0.0, confirmed=False)],
    )
    assert selection.update(1.0, tracks, HERE) is None
    assert selection.select(5, tracks, HERE).id == 5
    assert selection.select(0, tracks, HERE).id == 2
    assert selection.select(0, tracks[1:], HERE).id == 5
    with pytest.raises(ValueError, match="id is 9, expected one that is tracked: 2, 5"):
        selection.select(9, tracks, HERE)
    with pytest.raises(ValueError, match="no person is ahead"):
        selection.select(0, tracks, (0.0, 0.0, np.pi))


def test_who_was_lost_is_found_again_near_by_and_not_elsewhere_or_much_later() -> None:
    selection = Selection()
    selection.update(1.0, [person(2, 4.0, 0.0)], HERE)
    assert selection.update(2.0, [person(7, 4.0, 3.0)], HERE) is None
    again = selection.update(3.0, [person(8, 4.5, 0.5)], HERE)
    assert again is not None
    assert again.id == 8
    assert selection.update(14.0, [person(9, 4.5, 0.5)], HERE) is None


def test_the_sensor_s_pose_is_interpolated_across_half_a_turn() -> None:
    poses = PoseHistory(mounting=(0.5, 0.0, 0.1))
    poses.add(1.0, (0.0, 0.0, np.pi - 0.1))
    poses.add(2.0, (1.0, 0.0, -np.pi + 0.1))
    np.testing.assert_allclose(poses.sensor_at(1.5), [0.0, 0.0, np.pi + 0.1], atol=1e-9)
    with pytest.raises(
        ValueError, match=r"time is 2\.500 s, expected one of the poses' times, 1\.000 to 2\.000"
    ):
        poses.sensor_at(2.5)
    with pytest.raises(ValueError, match="expected finite numbers"):
        poses.add(3.0, (np.nan, 0.0, 0.0))


def test_poses_begin_anew_where_time_is_set_back() -> None:
    poses = PoseHistory()
    poses.add(50.0, (9.0, 0.0, 0.0))
    poses.add(1.0, (0.0, 0.0, 0.0))
    poses.add(2.0, (1.0, 0.0, 0.0))
    assert poses.sensor_at(1.5)[0] == pytest.approx(0.5)
