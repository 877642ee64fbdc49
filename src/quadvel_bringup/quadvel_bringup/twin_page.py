"""The one page of `quadvel twin`: for each plant what was found, and how far the model is from it, before and after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from quadvel_actuator.identify.page import document, number, table, tiles

Entry = Mapping[str, Any]

ROWS: tuple[tuple[str, Callable[[Entry], float]], ...] = (
    ("torque on the recorded motion, mean square, N² m²", lambda model: model["torque_mse"]),
    ("open loop: torque, N m", lambda model: model["tau"]),
    ("open loop: q, rad", lambda model: model["q"]),
    ("open loop: dq, rad/s", lambda model: model["dq"]),
    ("velocity that it predicts, m/s", lambda model: model["tracking"]["xy"]),
    ("yaw rate that it predicts, rad/s", lambda model: model["tracking"]["wz"]),
)
"""What is compared with the plant: name, and where it stands in an entry's "before" and "after"."""

NOTE = (
    "Before: the stack's own model. After: the model that `quadvel identify` made of one recorded walk. All errors are "
    "on a second walk that was not fitted. Open loop: the recorded commands are replayed over stretches of 0.2 s, each "
    "from the recorded state; root mean square over all joints. Velocity: the shipped policy walks the same commands in "
    "the model; mean distance to the plant's mean velocities."
)


def twin_page(results: Sequence[Entry]) -> str:
    """The page as HTML. results: the plants' entries of `twin.json`."""
    body = f'<p class="note">{escape(NOTE)}</p>' + "".join(map(_plant, results))
    return document("Closing the loop on the stack itself", decision(results), body)


def decision(results: Sequence[Entry]) -> str:
    """One sentence: how much nearer the corrected models are to their plants."""
    cuts = [
        100 * (1 - sum(value(one["after"]) / value(one["before"]) for one in results) / len(results))
        for _, value in ROWS
    ]
    plants = "the plant" if len(results) == 1 else f"{len(results)} plants"
    return (
        f"With what was identified on {plants}, the model's torque error falls by {cuts[0]:.0f} %, its open-loop error "
        f"of q by {cuts[2]:.0f} % and of dq by {cuts[3]:.0f} %, the gap of its velocity tracking by {cuts[4]:.0f} %."
    )


def _plant(entry: Entry) -> str:
    before, after = entry["before"], entry["after"]
    rows = [
        (escape(name), number(value(before)), number(value(after)), f"{_cut(value(before), value(after))} %")
        for name, value in ROWS
    ]
    repeat = entry["repeat"]
    text = (
        f"<section><h2>{escape(entry['name'])}</h2><p><b>{escape(entry['decision'])}</b> "
        f'<a href="{escape(entry["name"])}/identify/report.html">The report</a>.</p>'
    )
    text += tiles(
        [
            (escape(", ".join(entry["effects"]) or "nothing"), "identified"),
            (number(entry["fit"]["eam"]), "held-out error of the plain EAM, N² m²"),
            (number(entry["fit"]["corrected"]), "of the corrected model, N² m²"),
            (number(entry["noise_floor"]), "noise floor, N² m²"),
        ]
    )
    text += table(("error of the model against the plant", "#before", "#after", "#less"), rows)
    text += (
        f'<p class="note">The plant against itself, one walk and the other: {number(repeat["xy"])} m/s, '
        f"{number(repeat['wz'])} rad/s.</p>"
    )
    columns = ("command vx, vy, wz", "#plant", "#model before", "#model after")
    keys = ("command", "plant", "before", "after")
    return (
        text + table(columns, [[_velocity(s[key]) for key in keys] for s in entry["segments"]]) + "</section>"
    )


def _cut(before: float, after: float) -> str:
    return f"{100 * (1 - after / before):.0f}" if before else "–"


def _velocity(values: Sequence[float]) -> str:
    return ", ".join(f"{value:+.3f}" for value in values)
