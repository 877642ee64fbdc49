"""Who walks where: persons followed from scan to scan, through occlusion and crossing, and told from what stands about.

Everything in a scan that may be a leg belongs to some hypothesis, a table's as well as a person's, so that what stands
about keeps its own readings and none of them draws a person away. A hypothesis is confirmed as a person when the
detector has believed in its legs and it has walked. Each hypothesis is a Kalman filter of constant velocity.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from .clusters import Scan
from .leg_detector import LegDetector
from .looking import AGE, MEMORY, Past, look, to_frame, to_sensor
from .scan_motion import ScanOdometry

Array = NDArray[np.float64]

GATE = 13.8  # squared Mahalanobis distance in the plane that one leg in 1000 exceeds
UNASSIGNED_COST = 9.0  # cost at which a leg rather belongs to none
PERSONS = 3.0  # by which it costs less that a leg is a person's than that it is something else's
UNLIKE_IT = 4.0  # cost of a leg that was there before, for one who walks; of one that came, for what stands
UNSURE = 0.02  # by which a probability may be wrong
STANDING = 3.0  # looks more that found it in its place than not, for what stands
WALKING = 0.4  # m/s, from which somebody walks
FORBIDDEN = 1e6  # cost of an assignment beyond the gate
SECOND_LEG = 2.0  # cost of a second leg: two legs between two persons are one of each
MERGED = 0.25  # m, width from which a thing is two legs beside each other
STRIDE = 0.5  # m, between the legs of a person, as far as they are made one
RECENT = 1.0  # s, that is of late
BELIEVING = 2.0  # s, over which what was found out about a hypothesis counts
SWING = 0.2  # s, for which the error of a person's middle is the same
PERSON = np.array([-0.2, -0.1, 0.0, 0.1, 0.2])  # m, from the middle of a person to its sides


def _positive(default: float) -> Any:
    def check(_: object, field: Any, value: float) -> None:
        if not 0.0 < value < np.inf:
            raise ValueError(f"{field.name} is {value}, expected a finite number above 0")

    return attrs.field(default=default, validator=check)


@attrs.frozen
class TrackerConfig:
    """What the tracker takes for granted of persons and scanners.

    acceleration: m^2/s^3, density of the white noise that changes a velocity
    both_legs, one_leg: m, standard deviation of a person's position by the middle of both legs, by one alone
    first_speed: m/s, standard deviation of the velocity of what was seen first
    reach: m, from a person's expected position to its leg at most
    possible: probability from which a thing may be a leg
    walked: m, from where it was first seen, after which a hypothesis may be a person
    moved: share of the looks at its places, then and now, that found them empty, from which it may be one
    steady: share of the scans in which it was seen, from which it may be one
    surprise: m, from where it is expected to the middle of its legs, up to which it may be one
    pairs: share of scans with both legs, from which it may be one
    belief: mean probability of its legs, from which it may be one
    watched, sightings: s since it was first seen, and scans in which it was, from which it may be one
    patience: s, for which a person who is hidden is waited for
    patience_in_view: s, the same where the scanner looks at an empty place
    forgotten: s, without a leg, after which a hypothesis is given up
    """

    acceleration: float = _positive(0.1)
    both_legs: float = _positive(0.1)
    one_leg: float = _positive(0.3)
    first_speed: float = _positive(0.8)
    reach: float = _positive(0.9)
    possible: float = _positive(0.15)
    walked: float = _positive(0.5)
    moved: float = _positive(0.55)
    surprise: float = _positive(0.22)
    pairs: float = _positive(0.3)
    belief: float = _positive(0.6)
    watched: float = _positive(1.0)
    sightings: int = _positive(8)
    steady: float = _positive(0.7)
    patience: float = _positive(3.0)
    patience_in_view: float = _positive(1.5)
    forgotten: float = _positive(0.5)


def deviation(covariance: Array) -> float:
    """Largest standard deviation, in any direction, of something with this covariance (2, 2)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


@attrs.frozen
class Track:
    """A person, or what may become one, at the time of the scan.

    id: stays with it; position (2,): m, velocity (2,): m/s, covariance (4, 4) of x, y, vx, vy: in the frame of the sensor's
    pose; age: s since it was first seen; seen: time at which a leg of it was seen last, s, on the clock of the scans;
    confirmed: whether it is taken for a person.
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
        """Standard deviation of the position in the direction in which it is largest, m."""
        return deviation(self.covariance[:2, :2])


@attrs.frozen
class _Legs:
    """What may be legs in a scan: position (K, 2) in the tracks' frame; probability; whether two in one; how many scans of
    the past show the place empty, how many taken; all (K,).
    """

    position: Array
    probability: Array
    merged: NDArray[np.bool_]
    empty: Array
    taken: Array


@attrs.define
class _Hypothesis:
    """Something with legs. state (4,): x, y, vx, vy; belief: mean probability of its legs over the time it was seen."""

    id: int
    state: Array
    covariance: Array
    born: float
    seen: float
    origin: Array
    belief: float
    scans: int = 0  # since it began
    sightings: int = 1
    confirmed: bool = False
    surprise: float = 0.1  # m, from where it was expected to the middle of its legs, of late
    pairs: float = 0.5  # share of scans with both its legs, of late
    empty: float = 0.0  # looks at its places that found them empty before it came or after it left
    taken: float = 0.0  # looks that found something there
    trail: deque[tuple[float, Array]] = attrs.field(factory=deque)  # when its legs were seen where

    def correct(self, position: Array, variance: float) -> None:
        """The Kalman filter's correction by a measured position (2,), m, whose coordinates have this variance, m^2."""
        gain = self.covariance[:, :2] @ np.linalg.inv(self.covariance[:2, :2] + variance * np.eye(2))
        self.state = self.state + gain @ (position - self.state[:2])
        covariance = self.covariance - gain @ self.covariance[:2]
        self.covariance = 0.5 * (covariance + covariance.T)

    @property
    def moved(self) -> float:
        """The share of looks that found its places empty, when it was not there."""
        return self.empty / (self.empty + self.taken + 2.0)


def _is_leg_of(hypothesis: _Hypothesis, walker: _Hypothesis) -> bool:
    """Whether it is but the other leg of one who walks: it is beside, came later, and was not there before."""
    return (
        walker.id < hypothesis.id
        and hypothesis.taken <= hypothesis.empty
        and bool(np.hypot(*(walker.state[:2] - hypothesis.state[:2])) < STRIDE)
    )


class PersonTracker:
    """Takes one scan after the other."""

    def __init__(self, config: TrackerConfig | None = None, detector: LegDetector | None = None) -> None:
        self.config = config or TrackerConfig()
        self._detector = detector or LegDetector()
        self._hypotheses: list[_Hypothesis] = []
        self._past = Past()
        self._odometry = ScanOdometry()
        self._time: float | None = None  # s, of the last scan
        self._given: bool | None = None  # whether the sensor's pose comes from outside
        self._next_id = 1

    def update(
        self,
        time: float,
        ranges: ArrayLike,
        angle_min: float,
        angle_increment: float,
        sensor_pose: Sequence[float] | None = None,
    ) -> list[Track]:
        """The persons, and what may become some, at `time` (s), confirmed ones first.

        ranges, angles: as `LegDetector.detect` takes them. sensor_pose: x, y (m) and yaw (rad) of the sensor in the
        frame, at rest, in which tracks are wanted, such as the odometry's. None, for all scans or for none: the tracks
        are in the sensor's own frame, and how it moves is told from the scans. Raises ValueError, with the field, what
        it is and what was expected; all is then as it was before.
        """
        scan = Scan.checked(ranges, angle_min, angle_increment)
        dt = self._checked_step(time)
        pose = self._checked_pose(sensor_pose, scan)
        self._time, self._given = time, sensor_pose is not None
        legs = self._legs(time, scan, pose)
        self._predict(time, dt, scan, pose)
        theirs = self._assign(time, legs)
        self._correct(time, dt, theirs, legs)
        self._begin(time, legs, theirs)
        self._watch(time, dt, scan, pose)
        self._judge(time, scan, pose)
        self._past.add(time, scan, pose)
        tracks = [self._track(h, time, pose) for h in self._hypotheses if h.confirmed or self._tells(h)]
        return sorted(tracks, key=lambda track: (not track.confirmed, track.id))

    def _checked_step(self, time: float) -> float:
        if not np.isfinite(time):
            raise ValueError(f"time is {time}, expected a finite time, s")
        if self._time is None:
            return 0.0
        if time <= self._time:
            raise ValueError(
                f"time is {time}, expected a later one than that of the scan before, {self._time}"
            )
        return time - self._time

    def _checked_pose(self, pose: Sequence[float] | None, scan: Scan) -> Array:
        """The sensor's pose: as it is given, or after what it moved since the scan before."""
        if self._given is not None and self._given != (pose is not None):
            raise ValueError(
                f"sensor_pose is {pose}, expected {'one' if self._given else 'None'} as for the scans before"
            )
        if pose is not None:
            if np.shape(pose) != (3,) or not np.isfinite(np.asarray(pose, float)).all():
                raise ValueError(
                    f"sensor_pose is {pose}, expected x, y (m) and yaw (rad), three finite numbers"
                )
            return np.asarray(pose, float)
        return self._odometry.follow(scan)

    def _legs(self, time: float, scan: Scan, pose: Array) -> _Legs:
        found = self._detector.find(scan)
        likely = found.probability > self.config.possible
        position = to_frame(found.position[likely], pose)
        empty, taken = self._past.counts(time, position, pose)
        return _Legs(position, found.probability[likely], found.width[likely] > MERGED, empty, taken)

    def _predict(self, time: float, dt: float, scan: Scan, pose: Array) -> None:
        """Constant velocity, changed by white noise; who is out of sight does not walk on into what is seen to be empty."""
        if not self._hypotheses:
            return
        states = np.array([h.state for h in self._hypotheses])
        moved = states.copy()
        moved[:, :2] += dt * states[:, 2:]
        unseen = np.array([time - h.seen for h in self._hypotheses]) - dt > self.config.forgotten
        stays = unseen & look(scan, to_sensor(moved[:, :2], pose), PERSON)[0]
        moved[stays, :2] = states[stays, :2]
        transition = np.eye(4)
        transition[0, 2] = transition[1, 3] = dt
        noise = self.config.acceleration * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        covariances = transition @ np.array([h.covariance for h in self._hypotheses]) @ transition.T + noise
        for hypothesis, state, covariance in zip(self._hypotheses, moved, covariances, strict=True):
            hypothesis.state, hypothesis.covariance = state, covariance

    def _assign(self, time: float, legs: _Legs) -> list[list[int]]:
        """Which legs (none, one or two) belong to each hypothesis: the likeliest way for all together."""
        theirs: list[list[int]] = [[] for _ in self._hypotheses]
        if not theirs or not len(legs.position):
            return theirs
        states = np.array([h.state[:2] for h in self._hypotheses])
        spread = np.array([h.covariance[:2, :2] for h in self._hypotheses])
        spread += self.config.one_leg**2 * np.eye(2)
        off = legs.position[None] - states[:, None]
        squared = np.einsum("hli,hij,hlj->hl", off, np.linalg.inv(spread), off)
        unseen = np.array([time - h.seen for h in self._hypotheses])
        reach = self.config.reach + self.config.first_speed * np.maximum(unseen - self.config.forgotten, 0.0)
        near = (squared < GATE) & (np.hypot(off[..., 0], off[..., 1]) < reach[:, None])
        cost = squared + np.log(np.linalg.det(spread) / self.config.one_leg**4)[:, None] + self._liking(legs)
        cost = np.where(near, cost, FORBIDDEN)
        twice = np.concatenate([cost, cost + SECOND_LEG])
        rows, columns = linear_sum_assignment(np.hstack([twice, np.zeros((len(twice), len(twice)))]))
        for row, column in zip(rows, columns, strict=True):
            if column < len(legs.position) and twice[row, column] < 0.0:
                theirs[row % len(theirs)].append(int(column))
        return theirs

    def _liking(self, legs: _Legs) -> Array:
        """Cost (hypotheses, legs) by what both are, against a leg that belongs to none of them.

        A leg is rather a person's, and looks like one. Who walks comes to places that were empty; what stands does not.
        """
        confirmed = np.array([h.confirmed for h in self._hypotheses])
        walks = confirmed & np.array([np.hypot(*h.state[2:]) > WALKING for h in self._hypotheses])
        stands = ~confirmed & np.array([h.taken > h.empty + STANDING for h in self._hypotheses])
        unlike = np.log((1.0 - legs.probability + UNSURE) / (legs.probability + UNSURE))
        rested, came = (legs.taken > 0.0) & (legs.empty == 0.0), legs.empty > legs.taken
        cost: Array = np.where(confirmed[:, None], unlike - PERSONS, 0.0) - UNASSIGNED_COST
        return cost + UNLIKE_IT * (walks[:, None] & rested) + UNLIKE_IT * (stands[:, None] & came)

    def _correct(self, time: float, dt: float, theirs: list[list[int]], legs: _Legs) -> None:
        """Correct each hypothesis by the middle of its legs, and keep what they tell of it."""
        recent = min(1.0, dt / RECENT)
        for hypothesis, pair in zip(self._hypotheses, theirs, strict=True):
            if not pair:
                continue
            both = len(pair) == 2 or bool(legs.merged[pair[0]])
            middle, leg = legs.position[pair].mean(0), pair[0]
            off = float(np.hypot(*(middle - hypothesis.state[:2])))
            # Legs swing: what the middle of a person is off by stays nearly the same from one quick scan to the next.
            hypothesis.correct(middle, self._deviation(both) ** 2 * max(1.0, SWING / dt))
            hypothesis.surprise += recent * (off - hypothesis.surprise)
            hypothesis.pairs += recent * (float(both) - hypothesis.pairs)
            share = dt / (dt + min(time - hypothesis.born, BELIEVING))
            hypothesis.belief += share * (float(legs.probability[pair].max()) - hypothesis.belief)
            hypothesis.empty += float(legs.empty[leg])
            hypothesis.taken += float(legs.taken[leg])
            hypothesis.seen = time
            hypothesis.sightings += 1
            hypothesis.trail.append((time, legs.position[leg]))

    def _deviation(self, both: bool) -> float:
        return self.config.both_legs if both else self.config.one_leg

    def _begin(self, time: float, legs: _Legs, theirs: list[list[int]]) -> None:
        """New hypotheses of legs that belong to none: two beside each other make one."""
        taken = {leg for pair in theirs for leg in pair}
        left = [leg for leg in range(len(legs.position)) if leg not in taken]
        while left:
            pair = [left.pop(0)]
            if left:
                distances = np.hypot(*(legs.position[left] - legs.position[pair[0]]).T)
                if distances.min() < STRIDE:
                    pair.append(left.pop(int(distances.argmin())))
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

    def _watch(self, time: float, dt: float, scan: Scan, pose: Array) -> None:
        """Look whether the places where legs were are empty now; what was seen long ago counts less."""
        fading = np.exp(-dt / BELIEVING)
        for hypothesis in self._hypotheses:
            hypothesis.scans += 1
            hypothesis.empty *= fading
            hypothesis.taken *= fading
            while hypothesis.trail and time - hypothesis.trail[0][0] > MEMORY:
                hypothesis.trail.popleft()
        left = [
            (hypothesis, place)
            for hypothesis in self._hypotheses
            if hypothesis.seen == time
            for then, place in hypothesis.trail
            if time - then >= AGE
        ]
        if left:
            empty, taken = look(scan, to_sensor(np.array([place for _, place in left]), pose))
            for (hypothesis, _), is_empty, is_taken in zip(left, empty, taken, strict=True):
                hypothesis.empty += is_empty
                hypothesis.taken += is_taken

    def _judge(self, time: float, scan: Scan, pose: Array) -> None:
        """Confirm who has walked, give up who is gone, and what is a person's other leg."""
        if not self._hypotheses:
            return
        kept = []
        places = np.array([h.state[:2] for h in self._hypotheses])
        in_view = look(scan, to_sensor(places, pose), PERSON)[0]
        for hypothesis, visible in zip(self._hypotheses, in_view, strict=True):
            hypothesis.confirmed = hypothesis.confirmed or self._has_walked(hypothesis, time)
            patience = self.config.patience_in_view if visible else self.config.patience
            if time - hypothesis.seen <= (patience if hypothesis.confirmed else self.config.forgotten):
                kept.append(hypothesis)
        walkers = [h for h in kept if h.confirmed or h.moved > self.config.moved]
        self._hypotheses = [
            h for h in kept if h.confirmed or not any(_is_leg_of(h, other) for other in walkers)
        ]

    def _has_walked(self, hypothesis: _Hypothesis, time: float) -> bool:
        """As a person does: on legs, steadily, to places that were empty."""
        config = self.config
        return (
            hypothesis.moved > config.moved
            and hypothesis.belief > config.belief
            and hypothesis.surprise < config.surprise
            and hypothesis.pairs > config.pairs
            and time - hypothesis.born > config.watched
            and hypothesis.sightings >= max(config.sightings, config.steady * hypothesis.scans)
            and bool(np.hypot(*(hypothesis.state[:2] - hypothesis.origin)) > config.walked)
        )

    def _tells(self, hypothesis: _Hypothesis) -> bool:
        return hypothesis.sightings > 2 and hypothesis.belief > self.config.belief

    def _track(self, hypothesis: _Hypothesis, time: float, pose: Array) -> Track:
        """In the frame of the pose that was given, or in the sensor's."""
        state, covariance = hypothesis.state.copy(), hypothesis.covariance.copy()
        if not self._given:
            turn = np.kron(
                np.eye(2), [[np.cos(pose[2]), np.sin(pose[2])], [-np.sin(pose[2]), np.cos(pose[2])]]
            )
            state[:2] -= pose[:2]
            state, covariance = turn @ state, turn @ covariance @ turn.T
        age, seen = time - hypothesis.born, hypothesis.seen
        return Track(hypothesis.id, state[:2], state[2:], covariance, age, seen, hypothesis.confirmed)
