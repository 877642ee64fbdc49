"""Multi-person tracker for laser scans that handles occlusion, crossing and static objects.

Every possible leg in a scan belongs to a hypothesis, that of a table as well as that of a person.
So static objects keep their own readings and do not attract people. A hypothesis is confirmed as a
person when the detector classified its legs and it has walked. Each hypothesis is a Kalman filter
with constant velocity.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from quadvel_description.arrays import Array, Bools
from quadvel_description.fields import positive

from .clusters import Scan
from .free_space import MEMORY_S, MIN_AGE_S, ScanHistory, check_places, to_frame, to_sensor
from .leg_detector import LegDetector
from .scan_motion import ScanOdometry

GATE_CHI2 = 13.8
"""Gate of the squared Mahalanobis distance in the plane: one leg in 1000 exceeds it."""
UNASSIGNED_COST = 9.0
"""Cost of a leg that belongs to no hypothesis."""
PERSON_BONUS = 3.0
"""Reduction of the cost of a leg of a confirmed person."""
MISMATCH_COST = 4.0
"""Cost of a static leg for a walking person, and of a new leg for a static object."""
PROBABILITY_ERROR = 0.02
"""Error of the classifier's probabilities; bounds the log odds."""
STANDING_EVIDENCE = 3.0
"""Excess of occupied over empty checks from which an object is static."""
WALKING_SPEED = 0.4
"""Speed in m/s from which a person walks."""
FORBIDDEN_COST = 1e6
"""Cost of an assignment outside the gate."""
SECOND_LEG_COST = 2.0
"""Cost of a second leg: of two legs between two people, each gets one."""
MERGED_WIDTH_M = 0.25
"""Width from which a cluster is two legs next to each other."""
MAX_STRIDE_M = 0.5
"""Largest distance between the legs of one person."""
RECENT_S = 1.0
"""Time constant of recent means."""
EVIDENCE_TIME_S = 2.0
"""Time constant with which evidence fades."""
SWING_TIME_S = 0.2
"""Correlation time of the error between the legs' middle and the person's centre."""
PERSON_OFFSETS_M = np.array([-0.2, -0.1, 0.0, 0.1, 0.2])
"""Lateral offsets at which a person's place is checked."""


@attrs.frozen
class TrackerConfig:
    """Parameters of the tracker.

    Raises:
        ValueError: A value is not a finite positive number.

    Attributes:
        acceleration: Density of the white noise that changes the velocity, m^2/s^3.
        both_legs: Standard deviation of a position from the middle of both legs, m.
        one_leg: Standard deviation of a position from one leg, m.
        first_speed: Standard deviation of the initial velocity, m/s.
        reach: Largest distance from the predicted position to a leg, m.
        min_leg_probability: Smallest probability of a possible leg.
        min_distance: Smallest distance of a person from its first position, m.
        min_moved_share: Smallest share of checks that found its places empty before or after it was there.
        max_mean_error: Largest mean distance from predicted to measured position of a person, m.
        min_pair_share: Smallest share of scans that show both legs of a person.
        min_mean_probability: Smallest mean probability of the legs of a person.
        min_age: Smallest time since a person was first seen, s.
        min_sightings: Smallest number of scans in which a person was seen.
        min_seen_share: Smallest share of scans in which a person was seen.
        hidden_timeout: Time for which a hidden person is kept, s.
        empty_place_timeout: Time for which a person is kept while its place is seen empty, s.
        candidate_timeout: Time without a leg, s, after which an unconfirmed hypothesis is removed; after the
            same time a confirmed one is not moved into places that are seen empty, and its `reach`
            grows.
    """

    acceleration: float = positive(0.1)
    both_legs: float = positive(0.1)
    one_leg: float = positive(0.3)
    first_speed: float = positive(0.8)
    reach: float = positive(0.9)
    min_leg_probability: float = positive(0.15)
    min_distance: float = positive(0.5)
    min_moved_share: float = positive(0.55)
    max_mean_error: float = positive(0.22)
    min_pair_share: float = positive(0.3)
    min_mean_probability: float = positive(0.6)
    min_age: float = positive(1.0)
    min_sightings: int = positive(8, whole=True)
    min_seen_share: float = positive(0.7)
    hidden_timeout: float = positive(3.0)
    empty_place_timeout: float = positive(1.5)
    candidate_timeout: float = positive(0.5)


def deviation(covariance: Array) -> float:
    """Compute the largest standard deviation in any direction.

    Args:
        covariance: Covariance of a position, (2, 2), m^2.

    Returns:
        Square root of its largest eigenvalue, m.
    """
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


@attrs.frozen
class Track:
    """Estimate of a person, or of a candidate, at the time of the scan.

    Attributes:
        id: Identity; does not change.
        position: Position in the tracking frame, (2,), m.
        velocity: Velocity, (2,), m/s.
        covariance: Covariance of x, y (m), vx, vy (m/s), (4, 4).
        age: Time since it was first seen, s.
        seen: Time of the last scan with one of its legs, s.
        confirmed: Whether it is a person.
    """

    id: int
    position: Array
    velocity: Array
    covariance: Array
    age: float
    seen: float
    confirmed: bool

    @property
    def deviation(self) -> float:
        """Largest standard deviation of the position, m."""
        return deviation(self.covariance[:2, :2])


@attrs.frozen
class _Legs:
    """Possible legs of a scan in the tracking frame: (K, 2) in m, and arrays (K,).

    Attributes:
        position: Positions, m.
        probability: Probability of a leg or pair.
        merged: Whether two legs touch.
        empty: Number of past scans that show the place empty.
        occupied: Number of past scans that show it occupied.
    """

    position: Array
    probability: Array
    merged: Bools
    empty: Array
    occupied: Array


@attrs.define
class _Hypothesis:
    """Object with legs: a person, or something static.

    Attributes:
        id: Identity.
        state: x, y in m, vx, vy in m/s, (4,).
        covariance: Covariance of the state, (4, 4).
        born: Time of the first scan with it, s.
        seen: Time of the last scan with one of its legs, s.
        origin: First position, (2,), m.
        belief: Mean probability of its legs.
        scans: Number of scans since it was first seen.
        sightings: Number of scans in which it was seen.
        confirmed: Whether it is a person.
        surprise: Recent mean distance from the predicted position to the middle of its legs, m.
        pairs: Recent share of scans with both legs.
        empty: Evidence that its places were empty before it came or after it left.
        occupied: Evidence that its places were occupied at those times.
        trail: Recent times (s) and positions (2,) of its legs.
    """

    id: int
    state: Array
    covariance: Array
    born: float
    seen: float
    origin: Array
    belief: float
    scans: int = 0
    sightings: int = 1
    confirmed: bool = False
    surprise: float = 0.1
    pairs: float = 0.5
    empty: float = 0.0
    occupied: float = 0.0
    trail: deque[tuple[float, Array]] = attrs.field(factory=deque)

    def correct(self, position: Array, variance: float) -> None:
        """Correct the Kalman filter by a position (2,) in m with a variance per axis in m^2.

        K = P H^T (H P H^T + R)^-1, x += K (z - H x), P -= K H P, where H selects x, y.
        """
        gain = self.covariance[:, :2] @ np.linalg.inv(self.covariance[:2, :2] + variance * np.eye(2))
        self.state = self.state + gain @ (position - self.state[:2])
        covariance = self.covariance - gain @ self.covariance[:2]
        self.covariance = 0.5 * (covariance + covariance.T)

    @property
    def moved(self) -> float:
        """Share of checks that found its places empty while it was elsewhere."""
        return self.empty / (self.empty + self.occupied + 2.0)


def _is_leg_of(hypothesis: _Hypothesis, walker: _Hypothesis) -> bool:
    """Return whether it is the other leg of a person: nearby, newer, and at a free place."""
    return (
        walker.id < hypothesis.id
        and hypothesis.occupied <= hypothesis.empty
        and bool(np.hypot(*(walker.state[:2] - hypothesis.state[:2])) < MAX_STRIDE_M)
    )


class PersonTracker:
    """Tracks people from scan to scan.

    Attributes:
        config: Parameters.
    """

    def __init__(self, config: TrackerConfig | None = None, detector: LegDetector | None = None) -> None:
        """Create a tracker without tracks.

        Args:
            config: Parameters; None: the defaults.
            detector: Leg detector; None: the shipped one.
        """
        self.config = config or TrackerConfig()
        self._detector = detector or LegDetector()
        self._hypotheses: list[_Hypothesis] = []
        self._history = ScanHistory()
        self._odometry = ScanOdometry()
        self._time: float | None = None  # s, of the last scan
        self._has_external_pose: bool | None = None  # whether the sensor's pose comes from outside
        self._next_id = 1

    def update(
        self,
        time: float,
        ranges: ArrayLike,
        angle_min: float,
        angle_increment: float,
        sensor_pose: Sequence[float] | None = None,
    ) -> list[Track]:
        """Process a scan. After an error the tracker is unchanged.

        Args:
            time: Time of the scan, s.
            ranges: Ranges, (rays,), m, as in `LegDetector.detect`.
            angle_min: Angle of the first ray, rad.
            angle_increment: Angle between two rays, rad.
            sensor_pose: Pose of the sensor in a fixed frame such as the odometry's, (3,): x, y in
                m, yaw in rad. None, for all scans or for none: tracks are in the sensor frame, and
                the motion of the sensor is estimated from the scans.

        Returns:
            Tracks of people and candidates, confirmed ones first.

        Raises:
            ValueError: A value is malformed; the message names field, value and expectation.
        """
        scan = Scan.validated(ranges, angle_min, angle_increment)
        dt = self._check_time(time)
        pose = self._sensor_pose(sensor_pose, scan)
        self._time, self._has_external_pose = time, sensor_pose is not None
        legs = self._find_legs(time, scan, pose)
        self._predict(time, dt, scan, pose)
        assignment = self._assign(time, legs)
        self._correct(time, dt, assignment, legs)
        self._start_hypotheses(time, legs, assignment)
        self._check_former_places(time, dt, scan, pose)
        self._confirm_and_prune(time, scan, pose)
        self._history.add(time, scan, pose)
        tracks = [
            self._make_track(h, time, pose) for h in self._hypotheses if h.confirmed or self._is_plausible(h)
        ]
        return sorted(tracks, key=lambda track: (not track.confirmed, track.id))

    def _check_time(self, time: float) -> float:
        """Return the time since the previous scan, s."""
        if not np.isfinite(time):
            raise ValueError(f"time is {time}, expected a finite time, s")
        if self._time is None:
            return 0.0
        if time <= self._time:
            raise ValueError(
                f"time is {time}, expected a later one than that of the scan before, {self._time}"
            )
        return time - self._time

    def _sensor_pose(self, pose: Sequence[float] | None, scan: Scan) -> Array:
        """Return the pose of the sensor: as given, or as estimated from the scans."""
        if self._has_external_pose is not None and self._has_external_pose != (pose is not None):
            raise ValueError(
                f"sensor_pose is {pose}, expected {'one' if self._has_external_pose else 'None'} as for the scans before"
            )
        if pose is not None:
            if np.shape(pose) != (3,) or not np.isfinite(np.asarray(pose, float)).all():
                raise ValueError(
                    f"sensor_pose is {pose}, expected x, y (m) and yaw (rad), three finite numbers"
                )
            return np.asarray(pose, float)
        return self._odometry.update(scan)

    def _find_legs(self, time: float, scan: Scan, pose: Array) -> _Legs:
        """Return the possible legs of a scan."""
        found = self._detector.find_candidates(scan)
        likely = found.probability > self.config.min_leg_probability
        position = to_frame(found.position[likely], pose)
        empty, occupied = self._history.count_evidence(time, position, pose)
        return _Legs(
            position, found.probability[likely], found.width[likely] > MERGED_WIDTH_M, empty, occupied
        )

    def _predict(self, time: float, dt: float, scan: Scan, pose: Array) -> None:
        """Predict all hypotheses; a hidden one does not move into space that is seen empty.

        White-noise acceleration of density q: Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] per axis.
        """
        if not self._hypotheses:
            return
        states = np.array([h.state for h in self._hypotheses])
        moved = states.copy()
        moved[:, :2] += dt * states[:, 2:]
        unseen = np.array([time - h.seen for h in self._hypotheses]) - dt > self.config.candidate_timeout
        is_blocked = unseen & check_places(scan, to_sensor(moved[:, :2], pose), PERSON_OFFSETS_M)[0]
        moved[is_blocked, :2] = states[is_blocked, :2]
        transition = np.eye(4)
        transition[0, 2] = transition[1, 3] = dt
        noise = self.config.acceleration * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        covariances = transition @ np.array([h.covariance for h in self._hypotheses]) @ transition.T + noise
        for hypothesis, state, covariance in zip(self._hypotheses, moved, covariances, strict=True):
            hypothesis.state, hypothesis.covariance = state, covariance

    def _assign(self, time: float, legs: _Legs) -> list[list[int]]:
        """Return the legs (up to two) of each hypothesis by the assignment of lowest cost."""
        assignment: list[list[int]] = [[] for _ in self._hypotheses]
        if not assignment or not len(legs.position):
            return assignment
        states = np.array([h.state[:2] for h in self._hypotheses])
        spread = np.array([h.covariance[:2, :2] for h in self._hypotheses])
        spread += self.config.one_leg**2 * np.eye(2)
        off = legs.position[None] - states[:, None]
        squared = np.einsum("hli,hij,hlj->hl", off, np.linalg.inv(spread), off)
        unseen = np.array([time - h.seen for h in self._hypotheses])
        reach = self.config.reach + self.config.first_speed * np.maximum(
            unseen - self.config.candidate_timeout, 0.0
        )
        near = (squared < GATE_CHI2) & (np.hypot(off[..., 0], off[..., 1]) < reach[:, None])
        cost = (
            squared + np.log(np.linalg.det(spread) / self.config.one_leg**4)[:, None] + self._type_cost(legs)
        )
        cost = np.where(near, cost, FORBIDDEN_COST)
        # Assignment problem (Jonker-Volgenant): each hypothesis has two rows, one for each leg; the
        # zero columns leave a row without a leg.
        twice = np.concatenate([cost, cost + SECOND_LEG_COST])
        rows, columns = linear_sum_assignment(np.hstack([twice, np.zeros((len(twice), len(twice)))]))
        for row, column in zip(rows, columns, strict=True):
            if column < len(legs.position) and twice[row, column] < 0.0:
                assignment[row % len(assignment)].append(int(column))
        return assignment

    def _type_cost(self, legs: _Legs) -> Array:
        """Return the cost (hypotheses, legs) of their types, relative to an unassigned leg.

        A leg of a person looks like a leg. Who walks comes to places that were empty; what stands
        does not.
        """
        confirmed = np.array([h.confirmed for h in self._hypotheses])
        walks = confirmed & np.array([np.hypot(*h.state[2:]) > WALKING_SPEED for h in self._hypotheses])
        stands = ~confirmed & np.array([h.occupied > h.empty + STANDING_EVIDENCE for h in self._hypotheses])
        unlike = np.log((1.0 - legs.probability + PROBABILITY_ERROR) / (legs.probability + PROBABILITY_ERROR))
        rested, came = (legs.occupied > 0.0) & (legs.empty == 0.0), legs.empty > legs.occupied
        cost: Array = np.where(confirmed[:, None], unlike - PERSON_BONUS, 0.0) - UNASSIGNED_COST
        return cost + MISMATCH_COST * (walks[:, None] & rested) + MISMATCH_COST * (stands[:, None] & came)

    def _correct(self, time: float, dt: float, assignment: list[list[int]], legs: _Legs) -> None:
        """Correct each hypothesis by the middle of its legs and update its statistics."""
        recent = min(1.0, dt / RECENT_S)
        for hypothesis, pair in zip(self._hypotheses, assignment, strict=True):
            if not pair:
                continue
            both = len(pair) == 2 or bool(legs.merged[pair[0]])
            middle, leg = legs.position[pair].mean(0), pair[0]
            off = float(np.hypot(*(middle - hypothesis.state[:2])))
            # Legs swing: the error of the middle is correlated over SWING_TIME_S, so that the
            # variance of each of several scans in this time is increased.
            hypothesis.correct(middle, self._deviation(both) ** 2 * max(1.0, SWING_TIME_S / dt))
            hypothesis.surprise += recent * (off - hypothesis.surprise)
            hypothesis.pairs += recent * (float(both) - hypothesis.pairs)
            share = dt / (dt + min(time - hypothesis.born, EVIDENCE_TIME_S))
            hypothesis.belief += share * (float(legs.probability[pair].max()) - hypothesis.belief)
            hypothesis.empty += float(legs.empty[leg])
            hypothesis.occupied += float(legs.occupied[leg])
            hypothesis.seen = time
            hypothesis.sightings += 1
            hypothesis.trail.append((time, legs.position[leg]))

    def _deviation(self, both: bool) -> float:
        """Return the standard deviation of a measured position, m."""
        return self.config.both_legs if both else self.config.one_leg

    def _start_hypotheses(self, time: float, legs: _Legs, assignment: list[list[int]]) -> None:
        """Start hypotheses at unassigned legs; two legs next to each other start one."""
        assigned = {leg for pair in assignment for leg in pair}
        remaining = [leg for leg in range(len(legs.position)) if leg not in assigned]
        while remaining:
            pair = [remaining.pop(0)]
            if remaining:
                distances = np.hypot(*(legs.position[remaining] - legs.position[pair[0]]).T)
                if distances.min() < MAX_STRIDE_M:
                    pair.append(remaining.pop(int(distances.argmin())))
            position = legs.position[pair].mean(0)
            deviations = [self._deviation(len(pair) == 2)] * 2 + [self.config.first_speed] * 2
            self._hypotheses.append(
                _Hypothesis(
                    self._next_id,
                    np.array([*position, 0.0, 0.0]),
                    np.diag(np.square(deviations)),
                    born=time,
                    seen=time,
                    origin=position,
                    belief=float(legs.probability[pair].max()),
                )
            )
            self._next_id += 1

    def _check_former_places(self, time: float, dt: float, scan: Scan, pose: Array) -> None:
        """Check whether former places of the legs are empty now; old evidence fades."""
        fading = np.exp(-dt / EVIDENCE_TIME_S)
        for hypothesis in self._hypotheses:
            hypothesis.scans += 1
            hypothesis.empty *= fading
            hypothesis.occupied *= fading
            while hypothesis.trail and time - hypothesis.trail[0][0] > MEMORY_S:
                hypothesis.trail.popleft()
        former = [
            (hypothesis, place)
            for hypothesis in self._hypotheses
            if hypothesis.seen == time
            for then, place in hypothesis.trail
            if time - then >= MIN_AGE_S
        ]
        if former:
            empty, occupied = check_places(scan, to_sensor(np.array([place for _, place in former]), pose))
            for (hypothesis, _), is_empty, is_occupied in zip(former, empty, occupied, strict=True):
                hypothesis.empty += is_empty
                hypothesis.occupied += is_occupied

    def _confirm_and_prune(self, time: float, scan: Scan, pose: Array) -> None:
        """Confirm people that have walked; remove lost hypotheses and second legs."""
        if not self._hypotheses:
            return
        kept = []
        places = np.array([h.state[:2] for h in self._hypotheses])
        seen_empty, _ = check_places(scan, to_sensor(places, pose), PERSON_OFFSETS_M)
        for hypothesis, is_empty in zip(self._hypotheses, seen_empty, strict=True):
            hypothesis.confirmed = hypothesis.confirmed or self._has_walked(hypothesis, time)
            timeout = self.config.empty_place_timeout if is_empty else self.config.hidden_timeout
            if time - hypothesis.seen <= (timeout if hypothesis.confirmed else self.config.candidate_timeout):
                kept.append(hypothesis)
        walkers = [h for h in kept if h.confirmed or h.moved > self.config.min_moved_share]
        self._hypotheses = [
            h for h in kept if h.confirmed or not any(_is_leg_of(h, other) for other in walkers)
        ]

    def _has_walked(self, hypothesis: _Hypothesis, time: float) -> bool:
        """Return whether it moves like a person: on legs, steadily, to places that were empty."""
        config = self.config
        return (
            hypothesis.moved > config.min_moved_share
            and hypothesis.belief > config.min_mean_probability
            and hypothesis.surprise < config.max_mean_error
            and hypothesis.pairs > config.min_pair_share
            and time - hypothesis.born > config.min_age
            and hypothesis.sightings >= max(config.min_sightings, config.min_seen_share * hypothesis.scans)
            and bool(np.hypot(*(hypothesis.state[:2] - hypothesis.origin)) > config.min_distance)
        )

    def _is_plausible(self, hypothesis: _Hypothesis) -> bool:
        """Return whether an unconfirmed hypothesis is reported."""
        return hypothesis.sightings > 2 and hypothesis.belief > self.config.min_mean_probability

    def _make_track(self, hypothesis: _Hypothesis, time: float, pose: Array) -> Track:
        """Return the track in the frame of the given pose, or in the sensor frame."""
        state, covariance = hypothesis.state.copy(), hypothesis.covariance.copy()
        if not self._has_external_pose:
            turn = np.kron(
                np.eye(2), [[np.cos(pose[2]), np.sin(pose[2])], [-np.sin(pose[2]), np.cos(pose[2])]]
            )
            state[:2] -= pose[:2]
            state, covariance = turn @ state, turn @ covariance @ turn.T
        age, seen = time - hypothesis.born, hypothesis.seen
        return Track(hypothesis.id, state[:2], state[2:], covariance, age, seen, hypothesis.confirmed)
