"""Figures of an identification report, as SVG text in the text colour of the page.

`page` places the figures; the series come from `identification.Identification`.
"""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadvel_description.arrays import Array

from .identification import Shape, Trace
from .rendering import html_figure, short_joint_name

MEASURED, PD, BEFORE, AFTER = "#7d8590", "#b58900", "#d9622b", "#1a8fc4"
"""Colours of the models, readable on white and on black."""
_INK = "#010203"
"""Placeholder that becomes the text colour of the page."""
_MAX_POINTS = 1600
"""Maximum number of points of one line."""
_ZOOM_S = 0.4
"""Duration of the enlarged window, s."""
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "quadvel",
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), _INK),
}


def svg_figure(width: float, height: float, draw: Callable[[Figure], None]) -> str:
    """Render a Matplotlib figure as an SVG element.

    Ids get a prefix from a checksum, so that several figures fit on one page.

    Args:
        width: Width, inches.
        height: Height, inches.
        draw: Draws on the figure.

    Returns:
        HTML text of a `div` with the SVG.
    """
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()[text.getvalue().index("<svg") :].replace(_INK, "currentColor")
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    prefix = f"f{zlib.crc32(svg.encode()):08x}-"  # several figures share one page
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    svg = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{prefix}", svg)
    return html_figure(svg, width)


def torque_figure(trace: Trace) -> str:
    """Plot measured and predicted torque over the held-out time.

    A second panel enlarges the window with the largest improvement.

    Args:
        trace: Held-out torque series of a joint.

    Returns:
        HTML text.
    """

    def draw(figure: Figure) -> None:
        whole, zoom = figure.subplots(2, 1, height_ratios=(2, 3))
        gain = np.nan_to_num((trace.measured - trace.before) ** 2 - (trace.measured - trace.after) ** 2)
        start = _best_window(trace.t, gain, _ZOOM_S)
        within = (start <= trace.t) & (trace.t < start + _ZOOM_S)
        _torques(whole, trace, np.ones(len(trace.t), bool), 0.7)
        whole.axvspan(start, start + _ZOOM_S, color=MEASURED, alpha=0.25, lw=0)
        _torques(zoom, trace, within, 1.3)
        zoom.set_xlim(start, start + _ZOOM_S)
        zoom.set_xlabel(f"time, s (below: {start:.2f} to {start + _ZOOM_S:.2f} s)")
        whole.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4)

    return svg_figure(9.5, 4.6, draw)


def _torques(panel: Axes, trace: Trace, within: Any, width: float) -> None:
    """Plot measured and predicted torque of the rows `within` on one panel."""
    lines = (
        ("measured", trace.measured, MEASURED, "-", 1.8),
        ("ideal PD", trace.pd, PD, ":", 0.8),
        ("plain EAM", trace.before, BEFORE, "-", 1.0),
        ("corrected", trace.after, AFTER, "-", 1.0),
    )
    for label, torque, colour, style, weight in lines:
        x, y = _decimate(*_break_at_gaps(trace.t[within], torque[within]))
        panel.plot(x, y, colour, linestyle=style, lw=width * weight, label=label)
    panel.set_ylabel("torque, N m")
    panel.grid(alpha=0.2)


def _best_window(t: Array, gain: Array, seconds: float) -> float:
    """Start (s) of the window with the largest sum of `gain`."""
    total = np.concatenate([[0.0], np.cumsum(gain)])
    end = np.searchsorted(t, t + seconds)
    return float(t[np.argmax(total[end] - total[:-1])])


def _break_at_gaps(t: Array, y: Array) -> tuple[Array, Array]:
    """The line with a NaN at every gap in time, so that gaps stay empty."""
    if len(t) < 3:
        return t, y
    gaps = np.flatnonzero(np.diff(t) > 5 * np.median(np.diff(t))) + 1
    return np.insert(t, gaps, t[gaps]), np.insert(y, gaps, np.nan)


def _decimate(t: Array, y: Array) -> tuple[Array, Array]:
    """At most `_MAX_POINTS` points, which keep the extremes of every bin."""
    if len(t) <= _MAX_POINTS:
        return t, y
    keep: list[int] = []
    for rows in np.array_split(np.arange(len(t)), _MAX_POINTS // 2):
        values = y[rows]
        if np.isnan(values).any():
            keep.append(int(rows[np.flatnonzero(np.isnan(values))[0]]))
        if not np.isnan(values).all():
            keep += [int(rows[np.nanargmin(values)]), int(rows[np.nanargmax(values)])]
    rows = np.unique(keep)
    return t[rows], y[rows]


def distribution_figure(traces: Mapping[str, Trace], floor: float) -> str:
    """Plot the distribution of each joint's residual before and after the correction.

    Bars show the median, the quartiles, 5 to 95 % and 1 to 99 %. The shaded band is the range from
    5 to 95 % of the noise alone.

    Args:
        traces: Held-out torque series, by joint name.
        floor: Variance of the noise, N^2 m^2.

    Returns:
        HTML text.
    """

    def draw(figure: Figure) -> None:
        panel = figure.subplots()
        panel.axhspan(
            *np.multiply([-1.645, 1.645], np.sqrt(max(floor, 0.0))), color=MEASURED, alpha=0.18, lw=0
        )
        for place, trace in enumerate(traces.values()):
            for shift, colour, predicted in ((-0.16, BEFORE, trace.before), (0.16, AFTER, trace.after)):
                residual = (trace.measured - predicted)[np.isfinite(trace.measured - predicted)]
                if not len(residual):
                    continue
                a, b, c, d, e, f, g = np.quantile(residual, (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99))
                at = place + shift
                panel.vlines(at, a, g, colour, lw=0.8)
                panel.vlines(at, b, f, colour, lw=2.4)
                panel.vlines(at, c, e, colour, lw=8.0)
                panel.plot(at, d, "_", color="white", ms=7, mew=1.2)
        panel.axhline(0.0, color=_INK, lw=0.5, alpha=0.5)
        panel.set_xticks(
            range(len(traces)), [short_joint_name(name) for name in traces], rotation=30, ha="right"
        )
        panel.set_ylabel("measured - predicted, N m")
        for label, colour in (("plain EAM", BEFORE), ("corrected", AFTER)):
            panel.plot([], [], color=colour, lw=8, label=label)
        panel.fill_between([], [], [], color=MEASURED, alpha=0.25, label="noise floor")
        panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
        panel.grid(axis="y", alpha=0.2)

    return svg_figure(max(5.0, 0.72 * len(traces) + 1.5), 3.6, draw)


def shape_figure(shapes: Sequence[Shape]) -> str:
    """Plot residuals over the signal that explains them: samples, and means of equally filled bins.

    Args:
        shapes: Residuals of up to three joints.

    Returns:
        HTML text.
    """

    def draw(figure: Figure) -> None:
        for panel, shape in zip(figure.subplots(1, len(shapes), squeeze=False)[0], shapes, strict=True):
            for label, residual, colour in (
                ("plain EAM", shape.before, BEFORE),
                ("corrected", shape.after, AFTER),
            ):
                sound = np.isfinite(shape.x) & np.isfinite(residual)
                x, y = shape.x[sound], residual[sound]
                some = np.random.default_rng(0).permutation(len(x))[:500]
                panel.plot(x[some], y[some], ".", color=colour, ms=1.6, alpha=0.35, rasterized=True)
                panel.plot(*_bin_means(x, y), color=colour, lw=2.0, label=label)
            panel.axhline(0.0, color=_INK, lw=0.5, alpha=0.5)
            panel.set_title(short_joint_name(shape.joint), fontsize="medium", loc="left")
            panel.set_xlabel(f"{shape.signal}, {shape.unit}")
            panel.grid(alpha=0.2)
        figure.axes[0].set_ylabel("measured - predicted, N m")
        figure.axes[0].legend(loc="upper right", fontsize="small")

    return svg_figure(0.6 + 3.1 * len(shapes), 2.9, draw)


def _bin_means(x: Array, y: Array, bins: int = 32) -> tuple[Array, Array]:
    """Mean x and y of bins with equally many samples."""
    parts = np.array_split(np.argsort(x), max(1, min(bins, len(x) // 10)))
    parts = [part for part in parts if len(part)]
    return np.array([x[part].mean() for part in parts]), np.array([y[part].mean() for part in parts])


def candidate_figure(names: Sequence[str], gains: Sequence[float], selected: Sequence[bool]) -> str:
    """Plot the held-out gain of every candidate as bars.

    Args:
        names: Names of the candidates, best first.
        gains: Gains, N^2 m^2.
        selected: Whether each candidate is part of the model; these bars are coloured.

    Returns:
        HTML text.
    """

    def draw(figure: Figure) -> None:
        panel = figure.subplots()
        rows = range(len(names))
        panel.barh(rows, gains, color=[AFTER if one else MEASURED for one in selected], height=0.7)
        panel.set_yticks(rows, names)
        panel.invert_yaxis()
        panel.axvline(0.0, color=_INK, lw=0.6)
        panel.set_xlabel("held-out gain, N² m²")
        panel.grid(axis="x", alpha=0.2)

    return svg_figure(7.0, 0.7 + 0.24 * len(names), draw)
