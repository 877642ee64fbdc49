"""Ground and load: do the feet hold, and are slope, roughness and mass those of the training?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.quadruped import GRAVITY

from ..cause import Cause, Link, Measurement, Trace, worst_span
from ..legs import HELD_SHARE, WALKED_SLOPE_RAD, Legs
from ..signals import Signals

LOADED_SHARE = 0.35
"""Share of the weight. A foot with a larger force stands on the ground: it is not landing, lifting off or swinging. A
fast swing shows about 0.3, as the mass of the leg is left out.
"""
MIN_ROWS = 60
WINDOW_S = 1.0
"""Time after which a robot that walks from level onto rough ground shows it."""
MIN_WEIGHING_S = 1.0
"""Shorter means of the force are not the weight."""
FOUND_MASS_SHARE = 0.946
"""Share of the mass that massless legs show in the torques, on the mean of healthy walks."""
MASS_MARGIN_KG = 0.8


def _loaded(legs: Legs) -> Array:
    weight = GRAVITY * legs.run.robot.mass
    return np.asarray(legs.planted & (legs.force[..., 2] > LOADED_SHARE * weight))


class Slipping(Cause):
    """Loaded feet slide: the velocity that they show is not that of the trunk."""

    link = Link.GROUND
    unit = "m/s"
    least = 0.06
    needs = ("ground", "estimate")
    remedy = "Walk slower on this ground, with softer feet, or train with less friction"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, legs = signals.run, signals.legs
        loaded = _loaded(legs)
        if loaded.sum() < MIN_ROWS:
            return None
        world = (signals.estimate[:, None] @ legs.rotation.swapaxes(-1, -2))[:, 0]
        slip = np.linalg.norm((legs.velocity - world[:, None])[..., :2], axis=-1)
        value = float(np.percentile(slip[loaded], 75))
        force = legs.force[loaded]
        ratio = np.linalg.norm(force[:, :2], axis=1) / force[:, 2]
        per_state = np.where(loaded, slip, 0.0).max(axis=1)
        trace = Trace("slip of the fastest loaded foot, m/s", run.time, per_state, np.zeros(len(run.time)))
        sentence = (
            f"a quarter of the time loaded feet slide faster than {value:.2f} m/s; tangential force over normal force "
            f"{np.median(ratio):.2f} on the median"
        )
        return Measurement(value, sentence, worst_span(run.time, per_state), (trace,))


class SteepGround(Cause):
    """The ground is steeper than where the policy was shown to walk."""

    link = Link.GROUND
    unit = "rad"
    least = 0.0
    needs = ("ground",)
    remedy = "Take another way, or train on steeper ground (`terrain` of the recipe)"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        plane = signals.legs.plane
        if len(plane.time) < MIN_ROWS:
            return None
        angle = plane.angle
        trace = Trace(
            "height between planted feet and on that slope, m", plane.time, plane.heights, plane.on_slope
        )
        sentence = f"planted feet lie on a slope of {np.rad2deg(angle):.0f} degrees"
        return Measurement(
            angle,
            sentence,
            worst_span(plane.time, np.abs(plane.heights)),
            (trace,),
            limit=WALKED_SLOPE_RAD,
        )


class RoughGround(Cause):
    """The ground is rougher than in the training: planted feet lie further off one plane."""

    link = Link.GROUND
    unit = "m"
    least = 0.02
    needs = ("ground",)
    remedy = "Take another way, or train on rougher ground (`terrain` of the recipe)"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        plane = signals.legs.plane
        if len(plane.time) < MIN_ROWS:
            return None
        off = np.abs(plane.heights - plane.on_slope)
        value = max((float(np.percentile(off[rows], 80)) for rows in _windows(plane.time)), default=0.0)
        trace = Trace(
            "height between planted feet and on their mean slope, m",
            plane.time,
            plane.heights,
            plane.on_slope,
        )
        sentence = (
            f"for {WINDOW_S:g} s one in five pairs of planted feet lies more than {100 * value:.1f} cm off "
            "their mean slope"
        )
        return Measurement(value, sentence, worst_span(plane.time, off), (trace,))


def _windows(time: Array) -> Iterator[slice]:
    """Rows of each WINDOW_S, every half of it, with MIN_ROWS at least."""
    for begin in np.arange(time[0], time[-1] - 0.5 * WINDOW_S, 0.5 * WINDOW_S):
        rows = slice(*np.searchsorted(time, (begin, begin + WINDOW_S)))
        if rows.stop - rows.start >= MIN_ROWS:
            yield rows


class Payload(Cause):
    """The robot is heavier or lighter than in the training: the forces of the feet carry another mass."""

    link = Link.GROUND
    unit = "kg"
    least = 0.0
    needs = ("ground",)
    remedy = "Take load off, or train with it (`payload` of the recipe)"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        legs = signals.legs
        rows = legs.usable & signals.run.walking
        if rows.sum() * signals.run.period < MIN_WEIGHING_S:
            return None
        total = legs.force[..., 2].sum(axis=1)
        own = signals.run.robot.mass
        mass = float(total[rows].mean()) / GRAVITY / FOUND_MASS_SHARE - own
        if mass < -HELD_SHARE * own:
            return None  # it is held while it walks
        low, high = signals.trained.payload
        beyond = max(mass - high, low - mass, 0.0)
        expected = np.full(len(total), own * GRAVITY * FOUND_MASS_SHARE)
        trace = Trace("force of all feet and of the robot's weight, N", signals.run.time, total, expected)
        sentence = (
            f"the feet carry {mass:+.1f} kg more than the robot, trained from {low:+.0f} to {high:+.0f} kg"
        )
        torque = "torques that are reported too large look the same: weigh the robot"
        span = worst_span(signals.run.time, np.where(rows, np.abs(total - expected), 0.0))
        return Measurement(beyond, f"{sentence} ({torque})", span, (trace,), limit=MASS_MARGIN_KG)
