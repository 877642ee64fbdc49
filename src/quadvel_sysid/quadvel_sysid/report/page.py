"""HTML page of an identification report, self-contained in one file.

It displays the numbers of report.json and the figures, and computes no further results.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..excitation import propose
from . import figures
from .figures import short_joint_name
from .identification import Identification
from .summary_text import UNCORRELATED_TEXT

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --soft: #656d76; --paper: #ffffff; --card: #f5f7f9;
  --line: #d9dee4; --before: #d9622b; --after: #1a8fc4; --good: #1a7f4b; --bad: #b3391c; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --soft: #98a2ad; --paper: #14171b;
  --card: #1d2127; --line: #343b44; --good: #4fc58a; --bad: #f0835f; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2.5rem 1.5rem 5rem; max-width: 66rem; background: var(--paper); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: .95rem; font-weight: 600; color: var(--soft); margin: 0 0 .6rem; }
h2 { font-size: 1.15rem; margin: 3rem 0 .6rem; }
.decision { font-size: 1.5rem; line-height: 1.35; font-weight: 600; margin: 0 0 1.6rem; max-width: 50rem; }
.tiles { display: flex; flex-wrap: wrap; gap: .8rem; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: .6rem; padding: .7rem 1rem; min-width: 9rem; }
.tile b { display: block; font-size: 1.25rem; font-variant-numeric: tabular-nums; }
.tile span, .note, caption { color: var(--soft); font-size: .87rem; }
.note { max-width: 50rem; }
.scroll, .figure { overflow-x: auto; }
.figure svg { width: 100%; height: auto; display: block; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .4rem 0; }
th { text-align: left; font-weight: 600; color: var(--soft); font-size: .85rem; }
th, td { padding: .28rem .9rem .28rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.n, th.n { text-align: right; }
code { font: .88em ui-monospace, SFMono-Regular, Menlo, monospace; background: var(--card); padding: .1em .35em;
  border-radius: .3em; }
details { border-bottom: 1px solid var(--line); padding: .35rem 0; }
summary { cursor: pointer; font-weight: 600; }
.bars { position: relative; width: 11rem; height: 1.05rem; margin-top: .2rem; }
.bars i { position: absolute; left: 0; height: 45%; border-radius: 2px; }
.interval { position: relative; width: 13rem; height: 1.2rem; }
.interval i { position: absolute; background: var(--after); }
.white { color: var(--good); } .structured { color: var(--bad); }
"""


def report_page(identification: Identification) -> str:
    """Render the page of a report.

    Args:
        identification: The result to show.

    Returns:
        HTML text of the whole page.
    """
    report = identification.report
    sections = [
        ("Before and after, joint by joint", _joints(identification)),
        ("Measured and predicted torque", _torques(identification)),
        ("Commands replayed on the robot's legs", _replay(report)),
        ("What the residual depends on", _shapes(identification)),
        ("Candidates", _candidates(report)),
        ("Parameters", _parameters(report)),
        ("Residual that no effect explains", _unexplained(report)),
        ("What to record next", _next_recordings(report)),
        ("Findings in the logs before the fit", _findings(report)),
    ]
    body = "".join(f"<section><h2>{escape(title)}</h2>{text}</section>" for title, text in sections if text)
    return html_document("Identification of the actuators", report["decision"], _tiles(report) + body)


def html_document(title: str, decision: str, body: str) -> str:
    """Render a page in the style of the report.

    Args:
        title: Title, plain text.
        decision: Summary below the title, plain text.
        body: Content, HTML.

    Returns:
        HTML text of the whole page.
    """
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    top = f'<h1>{escape(title)}</h1><p class="decision">{escape(decision)}</p>'
    return (
        f'<!doctype html><html lang="en"><head>{head}<style>{_STYLE}</style></head>'
        f"<body>{top}{body}</body></html>\n"
    )


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Render a table.

    Args:
        head: Column titles, plain text; `#` at the start marks a column of numbers.
        rows: Cells, HTML.

    Returns:
        HTML text.
    """
    kinds = [' class="n"' if title.startswith("#") else "" for title in head]
    first = "".join(
        f"<th{kind}>{escape(title.removeprefix('#'))}</th>" for kind, title in zip(kinds, head, strict=True)
    )
    lines = (
        "<tr>" + "".join(f"<td{kind}>{cell}</td>" for kind, cell in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><tr>{first}</tr>{"".join(lines)}</table></div>'


def html_tiles(entries: Iterable[tuple[str, str]]) -> str:
    """Render key figures in large type.

    Args:
        entries: Value (HTML) and description (plain text) of each.

    Returns:
        HTML text.
    """
    each = (f'<div class="tile"><b>{value}</b><span>{escape(name)}</span></div>' for value, name in entries)
    return f'<div class="tiles">{"".join(each)}</div>'


def number_text(value: float | None, digits: int = 3) -> str:
    """Format a number for people.

    Args:
        value: The number, or None.
        digits: Significant digits.

    Returns:
        The number; a dash for None and for numbers that are not finite.
    """
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}g}"


def _tiles(report: Mapping[str, Any]) -> str:
    """Key figures: errors, gains and delays."""
    before, after = report["before"], report["after"]
    unit = f"{report['units'].get('mse', 'N² m²')}, held out"
    return html_tiles(
        [
            _error_tile(report["pd"], f"ideal PD, {unit}"),
            _error_tile(before, f"plain EAM, {unit}"),
            _error_tile(report["baselines"]["joint_pd"], "a PD law of each joint"),
            _error_tile(report["baselines"]["ridge"], "a linear filter over 16 ms"),
            _error_tile(after, f"corrected model, {unit}"),
            (number_text(report["noise_floor"]), "noise floor, N² m²"),
            (f"{before['delta_kp']:+.3g} / {before['delta_kd']:+.3g}", "ΔKp, ΔKd of the plain EAM"),
            (
                f"{before['input_delay_ms']:.2f} / {before['output_delay_ms']:.2f}",
                "its delays, ms, in and out",
            ),
        ]
    )


def _error_tile(entry: Mapping[str, Any], name: str) -> tuple[str, str]:
    """Tile of a held-out error and of the explained fraction of the torque's variance."""
    share = entry.get("heldout_explained")
    explained = "" if share is None else f"; explains {number_text(100.0 * share)} % of the torque's variance"
    return number_text(entry["heldout_mse"]), name + explained


def _joints(identification: Identification) -> str:
    """Table of errors before and after for each joint, and the distribution of residuals."""
    report, traces = identification.report, identification.traces
    before, after = report["before"]["per_joint"], report["after"]["per_joint"]
    largest = max([value for value in (*before, *after) if value is not None], default=1.0) or 1.0
    rows = [
        (
            short_joint_name(joint),
            number_text(old),
            number_text(new),
            _reduction_text(old, new),
            _bars(old, new, largest),
        )
        for joint, old, new in zip(report["joints"], before, after, strict=True)
    ]
    text = html_table(("joint", "#plain EAM", "#corrected", "#less", "held-out error, N² m²"), rows)
    if traces:
        text += figures.distribution_figure(traces, report["noise_floor"] or 0.0)
        text += (
            '<p class="note">Residual of each joint over the held-out samples: bars from 1 to 99 %, 5 to 95 %, '
            "and the quartiles.</p>"
        )
    return text


def _reduction_text(old: float | None, new: float | None) -> str:
    """Error reduction in percent; a dash if unknown."""
    return "–" if not old or new is None else f"{100 * (1 - new / old):.0f} %"


def _bars(old: float | None, new: float | None, largest: float) -> str:
    """Two bars with the errors before and after."""
    each = (
        f'<i style="top:{top}%;width:{100 * (value or 0.0) / largest:.1f}%;background:var(--{colour})"></i>'
        for value, colour, top in ((old, "before", 0), (new, "after", 50))
    )
    return f'<div class="bars">{"".join(each)}</div>'


def _torques(identification: Identification) -> str:
    """Torque figure of each joint, collapsed except for the joint with the largest gain."""
    report, traces = identification.report, identification.traces
    gains = {
        joint: (old or 0.0) - (new or 0.0)
        for joint, old, new in zip(
            report["joints"], report["before"]["per_joint"], report["after"]["per_joint"], strict=True
        )
        if joint in traces
    }
    best = max(gains, key=lambda joint: gains[joint], default=None)
    return "".join(
        f"<details{' open' if joint == best else ''}><summary>{escape(short_joint_name(joint))}</summary>"
        f"{figures.torque_figure(traces[joint])}</details>"
        for joint in gains
    )


def _shapes(identification: Identification) -> str:
    """Residual figures of each effect, three joints in a row."""
    text = ""
    for name in dict.fromkeys(shape.effect for shape in identification.shapes):
        mine = [shape for shape in identification.shapes if shape.effect == name]
        text += f"<h3>{escape(name)}</h3>"
        for first in range(0, len(mine), 3):
            text += figures.shape_figure(mine[first : first + 3])
    return text


def _replay(report: Mapping[str, Any]) -> str:
    """Table of the replay errors of each joint."""
    if "replay" not in report:
        return ""
    replay, rows = report["replay"], []
    for j, joint in enumerate(report["joints"]):
        sizes = [
            replay[when][f"{what}_per_joint"][j]
            for what in ("q_rms_rad", "dq_rms_rad_s")
            for when in ("before", "after")
        ]
        rows.append([f"<code>{escape(joint)}</code>", *(number_text(one) for one in sizes)])
    head = ("joint", "#angle before, rad", "#after", "#speed before, rad/s", "#after")
    note = (
        f"Root mean square after up to {1e3 * replay['stretch_s']:.0f} ms, {replay['after']['stretches']} stretches, "
        f"held out. {replay['text']}"
    )
    return f'<p class="note">{escape(note)}</p>{html_table(head, rows)}'


def _candidates(report: Mapping[str, Any]) -> str:
    """Figure and table of selected and rejected candidates."""
    selected = [
        (one["heldout_gain"], one["p_value"], one["name"], _placement_text(one, report["joints"]))
        for one in report["effects"]
    ]
    rejected = [(one["selecting_gain"], None, one["name"], one["reason"]) for one in report["rejected"]]
    ranked = sorted([*selected, *rejected], key=lambda entry: -entry[0])
    if not ranked:
        return "<p>No candidate was tried.</p>"
    gains, ps, names, reasons = zip(*ranked, strict=True)
    picture = figures.candidate_figure(names, gains, [one in selected for one in ranked])
    rows = zip(
        map(escape, names), map(number_text, gains), map(number_text, ps), map(escape, reasons), strict=True
    )
    note = (
        '<p class="note">The gain of rejected candidates is that on the selection rows.</p>'
        if rejected
        else ""
    )
    return picture + html_table(("candidate", "#gain, N² m²", "#p", ""), list(rows)) + note


def _placement_text(effect: Mapping[str, Any], joints: Sequence[str]) -> str:
    """Where an effect was added, and which effects are indistinguishable from it."""
    where = (
        "all joints"
        if len(effect["joints"]) == len(joints)
        else ", ".join(map(short_joint_name, effect["joints"]))
    )
    also = effect["indistinguishable"]
    return f"added, on {where}" + (f"; indistinguishable from {', '.join(also)}" if also else "")


def _parameters(report: Mapping[str, Any]) -> str:
    """Tables of gains, delays and effect parameters with intervals, and the warnings."""
    after, joints = report["after"], report["joints"]
    groups = [
        (
            "gains and delays",
            [
                row
                for name, title, unit in _EAM
                if f"{name}_ci95" in after
                for row in _parameter_rows(title, after[name], after[f"{name}_ci95"], unit, joints)
            ],
        )
    ]
    for effect in report["effects"]:
        each = effect["params"].items()
        rows = [
            r
            for name, p in each
            for r in _parameter_rows(name, p["value"], p["ci95"], p["unit"], effect["joints"])
        ]
        groups.append((effect["name"], rows))
    head = ("parameter", "#value", "#95 % interval", "unit", "from zero")
    text = "".join(f"<p>{escape(warning)}.</p>" for warning in report.get("warnings", ()))
    tables = (
        f"<details{' open' if len(rows) <= _MAX_UNFOLDED_ROWS else ''}><summary>{escape(name)}</summary>"
        f"{html_table(head, rows)}</details>"
        for name, rows in groups
        if rows
    )
    return text + "".join(tables)


_MAX_UNFOLDED_ROWS = 12
"""Maximum number of rows of a table that is shown expanded."""
_EAM = (
    ("delta_kp", "ΔKp", "N m/rad"),
    ("delta_kd", "ΔKd", "N m s/rad"),
    ("input_delay_ms", "input delay", "ms"),
    ("output_delay_ms", "output delay", "ms"),
)


def _parameter_rows(
    name: str, value: Any, interval: Any, unit: str, joints: Sequence[str]
) -> list[tuple[str, ...]]:
    """Rows of the parameter table: one if joints share the value, else one for each."""
    values, intervals = np.atleast_1d(value), np.atleast_2d(interval)
    return [
        (
            escape(f"{name} {short_joint_name(owner)}".strip()),
            number_text(one, 4),
            f"{number_text(low, 4)} … {number_text(high, 4)}",
            escape(unit),
            _interval(float(one), float(low), float(high)),
        )
        for owner, one, (low, high) in zip(_value_owners(len(values), joints), values, intervals, strict=True)
    ]


def _value_owners(count: int, joints: Sequence[str]) -> Sequence[str]:
    """Owner of each of `count` values: the joint, or the index."""
    if count == 1:
        return [""]
    return joints if count == len(joints) else [f"[{place}]" for place in range(count)]


def _interval(value: float, low: float, high: float) -> str:
    """Value and interval on an axis that contains zero."""
    left, right = min(low, value, 0.0), max(high, value, 0.0)
    if not np.isfinite([left, right]).all() or right == left:
        return ""

    def place(x: float) -> float:
        return 100 * (x - left) / (right - left)

    return (
        f'<div class="interval"><i style="left:{place(low):.1f}%;width:{place(high) - place(low):.1f}%;'
        f'top:40%;height:20%;min-width:2px"></i><i style="left:calc({place(value):.1f}% - 1px);width:3px;height:100%">'
        f'</i><i style="left:{place(0.0):.1f}%;width:1px;height:100%;background:var(--soft)"></i></div>'
    )


def _unexplained(report: Mapping[str, Any]) -> str:
    """Text on the remaining residual and its correlated signals."""
    rest = report["unexplained"]
    signals = ", ".join(f"<code>{escape(signal)}</code>" for signal in rest["depends_on"])
    where = ", ".join(escape(short_joint_name(joint)) for joint in rest["joints"])
    share = (
        ""
        if rest["fraction"] is None
        else f", {100 * rest['fraction']:.1f} % of the residual of the plain EAM"
    )
    text = f'<p>The remainder is <b class="{rest["verdict"]}">{escape(rest["verdict"])}</b>{share}.'
    if signals:
        text += (
            f" Beyond the effects of the registry it depends on {signals}{f' at {where}' if where else ''}."
        )
    elif rest["verdict"] != "white":
        text += f" It is {UNCORRELATED_TEXT}."
    text += "</p>"
    learned = next((e for e in report["effects"] if e["name"] == "learned_residual"), None)
    if learned:
        inputs = ", ".join(f"<code>{escape(signal)}</code>" for signal in learned["inputs"])
        text += f"<p>A bounded learned term explains a part of it, with the inputs {inputs}.</p>"
        text += html_table(
            ("term", "inputs", "joints", "#held-out gain, N² m²"),
            [
                (
                    escape(str(term["kind"]).replace("_", " ")),
                    ", ".join(f"<code>{escape(signal)}</code>" for signal in term["inputs"]),
                    escape(", ".join(map(short_joint_name, term["joints"]))),
                    number_text(term["heldout_gain"]),
                )
                for term in learned.get("terms", ())
            ],
        )
    return text


def _next_recordings(report: Mapping[str, Any]) -> str:
    """Indistinguishable effects, and the motions that would distinguish them."""
    text = "".join(
        f"<p>To distinguish {escape(effect['name'])} from {escape(', '.join(effect['indistinguishable']))}, record "
        f"{escape(effect['separated_by'])}.</p>"
        for effect in report["effects"]
        if effect.get("separated_by")
    )
    rows = [
        (escape(", ".join(one.separates)), escape(one.reason), f"<code>{escape(one.command)}</code>")
        for one in propose(report)
    ]
    if not rows:
        return "<p>No question is open that another motion would answer.</p>"
    return text + html_table(
        ("indistinguishable", "motion that distinguishes them", "command to record it"), rows
    )


def _findings(report: Mapping[str, Any]) -> str:
    """Table of the log checks' findings."""
    rows = [
        (escape(Path(finding["log"]).name), escape(finding["kind"]), escape(finding["text"]))
        for finding in report.get("findings", ())
    ]
    return html_table(("log", "", ""), rows) if rows else ""
