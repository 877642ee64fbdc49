"""The report page of `quadvel twin`.

It shows what was identified in each plant, and the error of the model before and after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import attrs
import numpy as np
from matplotlib.figure import Figure

from quadvel_eval.replay import GROWTH_INTERVAL_MS
from quadvel_sysid.report.figures import AFTER, BEFORE, MEASURED, svg_figure
from quadvel_sysid.report.rendering import html_document, html_table, html_tiles, number_text

Entry = Mapping[str, Any]


@attrs.frozen
class Row:
    """A compared quantity.

    Attributes:
        name: Its name.
        unit: Its unit.
        error: Function from the "before" or "after" part of an entry to its error.
        noise: Function from an entry to the error that noise alone causes, or None.
    """

    name: str
    unit: str
    error: Callable[[Entry], float]

    noise: Callable[[Entry], float | None] = lambda entry: None

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}"


TORQUE = Row(
    "torque on the recorded motion", "N² m²", lambda m: m["torque_mse"], lambda entry: entry["noise_floor"]
)
Q = Row("q in open loop", "rad", lambda m: m["q"])
DQ = Row("dq in open loop", "rad/s", lambda m: m["dq"])
VELOCITY = Row(
    "predicted velocity", "m/s", lambda m: m["tracking"]["xy"], lambda entry: entry["repeat"]["xy"]
)
YAW = Row("predicted yaw rate", "rad/s", lambda m: m["tracking"]["wz"], lambda entry: entry["repeat"]["wz"])
ROWS = (TORQUE, Q, DQ, VELOCITY, YAW)

NOTE = (
    "Before: the stack's own model. After: the model that `quadvel identify` fitted to one recorded walk. All errors are "
    "on a second, held-out walk. Torque: mean square error on the recorded motion; its noise is that of the "
    "drives. Open loop: replay of the recorded commands over stretches of 0.2 s, each from the recorded state; root "
    "mean square error over all joints. Velocity: the shipped policy walks the same commands in the model; mean distance "
    "to the plant's mean velocities, of two walks each; its noise is the difference between the plant's two walks."
)


def twin_page(results: Sequence[Entry]) -> str:
    """Return the page as HTML.

    Args:
        results: The plants' entries of `twin.json`.

    Returns:
        The HTML document.
    """
    body = _overview(results) + f'<p class="note">{escape(NOTE)}</p>' + "".join(map(_plant, results))
    return html_document("Closing the loop on the stack itself", summary_sentence(results), body)


def summary_sentence(results: Sequence[Entry]) -> str:
    """Summarise the error reduction of the corrected models.

    Args:
        results: The plants' entries of `twin.json`.

    Returns:
        One sentence.
    """

    def cut(row: Row) -> str:
        """Describe the mean relative change of an error."""
        share = float(np.mean([row.error(one["after"]) / row.error(one["before"]) for one in results]))
        return f"falls by {100 * (1 - share):.0f} %" if share < 1.0 else f"grows by {100 * (share - 1):.0f} %"

    plants = "the plant" if len(results) == 1 else f"{len(results)} plants"
    return (
        f"With what was identified on {plants}, the model's torque error {cut(TORQUE)}, its open-loop error of q "
        f"{cut(Q)} and of dq {cut(DQ)}, the gap of its velocity tracking {cut(VELOCITY)}."
    )


def _overview(results: Sequence[Entry]) -> str:
    """Return figure and table of all plants."""
    rows = [
        (
            f'<a href="#{escape(one["name"])}">{escape(one["name"])}</a>',
            escape(", ".join(dict.fromkeys(one["effects"])) or "nothing"),
            *(_before_after(one, row) for row in ROWS),
        )
        for one in results
    ]
    head = ("plant", "identified", *(f"#{row.title}" for row in ROWS))
    return svg_figure(9.5, 2.9, lambda figure: draw_overview(figure, results)) + html_table(head, rows)


def _before_after(entry: Entry, row: Row) -> str:
    """Return both errors of an entry as HTML."""
    return f"{number_text(row.error(entry['before']))} → <b>{number_text(row.error(entry['after']))}</b>"


def draw_overview(figure: Figure, results: Sequence[Entry]) -> None:
    """Draw a panel for each quantity: errors before and after by plant, and the noise.

    Args:
        figure: An empty figure.
        results: The plants' entries of `twin.json`.
    """
    places = np.arange(len(results))
    for panel, row in zip(figure.subplots(1, len(ROWS)), ROWS, strict=True):
        for shift, colour, when in ((-0.19, BEFORE, "before"), (0.19, AFTER, "after")):
            panel.bar(
                places + shift, [row.error(one[when]) for one in results], 0.36, color=colour, label=when
            )
        for place, one in zip(places, results, strict=True):
            if (noise := row.noise(one)) is not None:
                panel.hlines(noise, place - 0.42, place + 0.42, MEASURED, lw=2.0, label="noise")
        panel.set_title(f"{row.name}\n{row.unit}", fontsize="small", loc="left")
        panel.set_xticks(places, [one["name"] for one in results], rotation=30, ha="right")
        panel.grid(axis="y", alpha=0.2)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    known = dict(zip(labels, handles, strict=True))
    figure.legend(known.values(), known, loc="outside upper left", ncols=len(known))


def draw_plant(figure: Figure, entry: Entry) -> None:
    """Draw the growth of the open-loop error of q, and the velocity errors by command.

    Args:
        figure: An empty figure.
        entry: A plant's entry of `twin.json`.
    """
    growth, velocity = figure.subplots(1, 2, width_ratios=(2, 3))
    commands = [f"{x:g}, {y:g}, {w:g}" for x, y, w in (s["command"] for s in entry["segments"])]
    places = np.arange(len(commands))
    for shift, colour, when in ((-0.19, BEFORE, "before"), (0.19, AFTER, "after")):
        error = entry[when]["growth"]
        growth.plot(
            GROWTH_INTERVAL_MS * (np.arange(len(error)) + 0.5), error, color=colour, lw=1.8, label=when
        )
        off = [np.hypot(*np.subtract(s[when], s["plant"])[:2]) for s in entry["segments"]]
        velocity.bar(places + shift, off, 0.36, color=colour, label=when)
    velocity.axhline(entry["repeat"]["xy"], color=MEASURED, lw=2.0, label="noise")
    growth.set(xlabel="time in open loop, ms", ylabel="error of q, rad", ylim=(0.0, None), xlim=(0.0, None))
    velocity.set(xlabel="command vx, vy, wz", ylabel="error of the mean velocity, m/s")
    velocity.set_xticks(places, commands, fontsize="small")
    for panel in (growth, velocity):
        panel.grid(alpha=0.2)
        panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)


def _plant(entry: Entry) -> str:
    """Return the section of a plant as HTML."""
    rows = []
    for row in ROWS:
        before, after = row.error(entry["before"]), row.error(entry["after"])
        noise = number_text(row.noise(entry))
        rows.append(
            (escape(row.title), number_text(before), number_text(after), _reduction(before, after), noise)
        )
    name = escape(entry["name"])
    text = (
        f'<section id="{name}"><h2>{name}</h2><p><b>{escape(entry["decision"])}</b> '
        f'<a href="{name}/identify/report.html">The report</a>.</p>'
    )
    text += html_tiles(
        [
            (number_text(entry["fit"]["eam"]), "held-out error of the plain EAM, N² m²"),
            (number_text(entry["fit"]["corrected"]), "of the corrected model, N² m²"),
            (number_text(entry["noise_floor"]), "noise floor, N² m²"),
        ]
    )
    text += html_table(("error of the model against the plant", "#before", "#after", "#less", "#noise"), rows)
    text += svg_figure(9.5, 2.9, lambda figure: draw_plant(figure, entry))
    columns = ("command vx, vy, wz", "#plant", "#model before", "#model after")
    keys = ("command", "plant", "before", "after")
    velocities = html_table(columns, [[_velocity(s[key]) for key in keys] for s in entry["segments"]])
    return f"{text}<details><summary>mean velocities, m/s and rad/s</summary>{velocities}</details></section>"


def _reduction(before: float, after: float) -> str:
    """Return the relative error reduction as text."""
    return f"{100 * (1 - after / before):.0f} %" if before else "–"


def _velocity(values: Sequence[float]) -> str:
    """Return a velocity as text."""
    return ", ".join(f"{value:+.3f}" for value in values)
