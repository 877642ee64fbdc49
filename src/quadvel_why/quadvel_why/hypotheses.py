"""Hypotheses about states and commands together: what the drives cannot show, the planted feet do.

If order, sign or zero are wrong in states and commands alike, every drive follows its command. But then the legs
contradict each other: planted feet give different velocities of the trunk, and stand at different heights.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import attrs
import numpy as np

from quadvel_description.arrays import Array, Indices
from quadvel_description.kinematics import foot_kinematics
from quadvel_description.quadruped import JOINT_NAMES

from .explanation import REORDERINGS
from .legs import Legs
from .run import Run

VELOCITY_SCALE_M_S, HEIGHT_SCALE_M = 0.05, 0.003
"""Contradictions that weigh alike; twice what a healthy walk shows."""
HEALTHY, DOUBTED = 1.35, 2.0
"""Contradiction up to which legs agree, and from which the usual conventions are doubted; healthy walks show 0.9."""
CLEAR_HEIGHT_M = 0.01
"""Unevenness that sliding feet do not cause."""
EXCHANGE, EXCHANGED_SIDES = "left and right legs exchanged", -0.3
"""Correlation of roll moment and roll below which the sides are exchanged; healthy walks show 0.3 to 0.7."""
MIN_IMPROVEMENT = 0.45
"""Share of the contradiction that an accepted convention may leave."""
SLOPE_SHARE = 0.1
"""Share of the unevenness that a slope leaves if it explains it."""
MIN_PAIR_ROWS = 40
"""Fewest rows with two planted feet that give a contradiction."""
OFFSET_SHARE = 0.8
"""Share of the unevenness that a wrong zero leaves at most; in healthy walks 0.96."""
OFFSET_ROUNDS = 8
"""Iterations of the fit of an offset."""


@attrs.frozen(eq=False)
class Convention:
    """An order and signs of the joints.

    Attributes:
        kind: "order" or "sign".
        order: Index of the recorded joint for each true one, (12,).
        sign: (12,).
    """

    kind: str
    order: Indices
    sign: Array


def _flips() -> dict[str, Convention]:
    groups = {name: [k] for k, name in enumerate(JOINT_NAMES)}
    groups |= {f"all {kind} joints": list(range(k, 12, 3)) for k, kind in enumerate(("hip", "thigh", "calf"))}
    groups |= {"right hips": [0, 6], "left hips": [3, 9]}
    found = {}
    for name, joints in groups.items():
        sign = np.ones(12)
        sign[joints] = -1.0
        found[f"the sign of {name} turned"] = Convention("sign", np.arange(12), sign)
    return found


CONVENTIONS: Mapping[str, Convention] = {
    **{name: Convention("order", np.array(order), np.ones(12)) for name, order in REORDERINGS.items()},
    **_flips(),
}


@attrs.frozen(eq=False)
class Tried:
    """Legs under a convention.

    Attributes:
        name: Key of CONVENTIONS, or "as recorded".
        legs: The legs.
    """

    name: str
    legs: Legs

    @cached_property
    def contradiction(self) -> float:
        """Disagreement of planted legs about velocity and height, in units of the scales."""
        rows = sum(int(both.sum()) for _, _, both in self.legs.pair_rows())
        if rows < MIN_PAIR_ROWS:
            return float("inf")
        return float(
            np.hypot(self.legs.disagreement / VELOCITY_SCALE_M_S, self.legs.unevenness / HEIGHT_SCALE_M)
        )

    @property
    def text(self) -> str:
        """One sentence about the disagreement of planted legs: velocity in m/s, height in mm."""
        return (
            f"{self.legs.disagreement:.2f} m/s and {1e3 * self.legs.unevenness:.0f} mm between planted legs"
        )


def best_convention(run: Run) -> tuple[Tried | None, Tried]:
    """Find the order or sign that makes planted feet agree while the robot walks.

    Args:
        run: The run.

    Returns:
        The best convention, None if the recorded one is as good, and the recorded one.
    """
    usual = Tried("as recorded", Legs(run, walking_only=True))
    if usual.contradiction == float("inf"):
        return None, usual
    if usual.legs.roll_balance < EXCHANGED_SIDES:
        return _tried(run, EXCHANGE), usual
    if usual.contradiction < DOUBTED:
        return None, usual
    if (
        usual.legs.unevenness > CLEAR_HEIGHT_M
        and usual.legs.plane.spread < SLOPE_SHARE * usual.legs.unevenness
    ):
        return None, usual  # the feet lie on one slope
    best = min((_tried(run, name) for name in CONVENTIONS), key=lambda each: each.contradiction)
    # Velocities alone contradict each other where feet slide, heights alone on a slope.
    explains = best.contradiction < HEALTHY or usual.legs.unevenness > CLEAR_HEIGHT_M
    contradicts_more = best.legs.disagreement > max(usual.legs.disagreement, VELOCITY_SCALE_M_S)
    if best.contradiction > MIN_IMPROVEMENT * usual.contradiction or contradicts_more or not explains:
        return None, usual
    return best, usual


def _tried(run: Run, name: str) -> Tried:
    """Legs under a convention."""
    assert run.tau is not None
    one = CONVENTIONS[name]
    q, dq, tau = (one.sign * values[:, one.order] for values in (run.q, run.dq, run.tau))
    return Tried(name, Legs(run, (q, dq, tau), walking_only=True))


@attrs.frozen(eq=False)
class OffsetFit:
    """The offset of one joint that puts the planted feet on one plane.

    Attributes:
        joint: Index of the joint.
        offset: Offset of the recorded angle, rad.
        size: Magnitude of the offset that is certain, rad.
        before: Robust standard deviation of the heights from a plane, m.
        after: The same after the offset is removed, m.
        time: Times of the heights, (k,), s.
        measured: Heights between pairs of feet, (k,), m.
        expected: Heights between the same pairs on one plane, (k,), m.
    """

    joint: int
    offset: float
    size: float
    before: float
    after: float
    time: Array
    measured: Array
    expected: Array


def best_offset(legs: Legs) -> OffsetFit | None:
    """Fit a plane and the offset of one joint to the heights between planted feet.

    For feet i and k of one state, with the ground's slope s and the offset b of joint j of foot i,

        z_i - z_k = s . (p_i - p_k)_xy + b (R dp_i/dq_j)_z

    Args:
        legs: The legs.

    Returns:
        The joint whose offset explains most; None with too few planted feet.
    """
    heights, plane, effects, times = _height_equations(legs)
    if len(heights) < MIN_PAIR_ROWS:
        return None
    base, weight = _robust_fit(plane, heights)
    before = _spread(heights - plane @ base)
    best: tuple[float, int, Array, Array] | None = None
    for joint in range(12):
        x = np.column_stack([plane, effects[:, joint]])
        found, weight = _robust_fit(x, heights)
        after = _spread(heights - x @ found)
        if best is None or after < best[0]:
            best = after, joint, found, weight
    assert best is not None
    after, joint, found, weight = best
    lever = float(np.sqrt(np.mean((effects[:, joint] * weight) ** 2)))
    # Rows of one step are no independent observations: a tenth of them counts.
    doubt = after / max(lever, 1e-6) / np.sqrt(max(weight.sum() / 10.0, 1.0))
    offset = float(found[2])
    size = max(abs(offset) - 3.0 * doubt, 0.0) if after < OFFSET_SHARE * before else 0.0
    return OffsetFit(joint, offset, size, before, after, times, heights, plane @ base)


def _height_equations(legs: Legs) -> tuple[Array, Array, Array, Array]:
    """Heights (k,), horizontal distances (k, 2), effects of the joints (k, 12) and times (k,) of all pairs."""
    _, jacobians = foot_kinematics(legs.run.robot, legs.run.q)
    up: Array = legs.rotation[:, 2, :]  # z of a body vector in the world: R[2] . v
    effect = np.einsum("na,nlaj->nlj", up, jacobians)  # (n, 4, 3)
    world = np.asarray(legs.feet @ legs.rotation.swapaxes(-1, -2))
    heights, plane, effects, times = [], [], [], []
    for i, k, rows in legs.pair_rows():
        heights.append((legs.height[:, i] - legs.height[:, k])[rows])
        plane.append((world[:, i, :2] - world[:, k, :2])[rows])
        columns = np.zeros((int(rows.sum()), 12))
        columns[:, 3 * i : 3 * i + 3], columns[:, 3 * k : 3 * k + 3] = effect[rows, i], -effect[rows, k]
        effects.append(columns)
        times.append(legs.run.time[rows])
    time = np.concatenate(times)
    order = np.argsort(time, kind="stable")
    return tuple(np.concatenate(part)[order] for part in (heights, plane, effects, times))  # type: ignore[return-value]


def _robust_fit(x: Array, y: Array) -> tuple[Array, Array]:
    """Trimmed least squares: weights and which rows count."""
    use = np.ones(len(y), bool)
    weights: Array = np.zeros(x.shape[1])
    for _ in range(OFFSET_ROUNDS):
        gram = x[use].T @ x[use] + 1e-9 * np.eye(x.shape[1])
        weights = np.asarray(np.linalg.solve(gram, x[use].T @ y[use]), np.float64)
        off = np.abs(y - x @ weights)
        use = off <= 3.0 * 1.4826 * np.median(off[use]) + 1e-9
    return weights, use.astype(float)


def _spread(values: Array) -> float:
    return float(1.4826 * np.median(np.abs(values)))
