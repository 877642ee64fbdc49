"""HTML building blocks (tables, tiles, figures) that several pages share; values are escaped.

`page` decides what the report of the identification shows, `figures` draws, and
`templates/report.html.j2` places it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader


def number_text(value: float | None, digits: int = 3) -> str:
    """Format a number for people.

    Args:
        value: The number, or None.
        digits: Significant digits.

    Returns:
        The number; a dash for None and for numbers that are not finite.
    """
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}g}"


def short_joint_name(joint: str) -> str:
    """Shorten the name of a joint: `FR_calf` for `FR_calf_joint`.

    Args:
        joint: Full name.

    Returns:
        Name without `_joint`.
    """
    return joint.removesuffix("_joint")


_ENVIRONMENT = Environment(
    loader=PackageLoader("quadvel_sysid.report"), autoescape=True, trim_blocks=True, lstrip_blocks=True
)
_ENVIRONMENT.filters["number"] = number_text
_ENVIRONMENT.filters["short"] = short_joint_name
_ENVIRONMENT.filters["file"] = lambda path: PurePath(path).name


def render(template: str, **values: Any) -> str:
    """Render a template.

    Args:
        template: Name of the template.
        **values: Its values; the template escapes all but the figures.

    Returns:
        HTML.
    """
    return _ENVIRONMENT.get_template(template).render(values)


def html_document(title: str, decision: str, body: str) -> str:
    """Render a page in the style of the report.

    Args:
        title: Title, plain text.
        decision: Summary below the title, plain text.
        body: Content, HTML.

    Returns:
        HTML text of the whole page.
    """
    return render("document.html.j2", title=title, decision=decision, body=body)


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Render a table.

    Args:
        head: Column titles, plain text; `#` at the start marks a column of numbers.
        rows: Cells, HTML.

    Returns:
        HTML text.
    """
    return render("cells.html.j2", titles=head, rows=rows)


def html_tiles(entries: Iterable[tuple[str, str]]) -> str:
    """Render key figures in large type.

    Args:
        entries: Value and description of each, plain text.

    Returns:
        HTML text.
    """
    return _part("tiles", entries)


def html_figure(svg: str, width: float) -> str:
    """Render a figure.

    Args:
        svg: The picture, an SVG element.
        width: Largest width, inches.

    Returns:
        HTML text of a `div` with the picture.
    """
    return _part("figure", svg, f"{width:g}")


def _part(name: str, *values: Any) -> str:
    """Render one macro of `parts.html.j2`."""
    macro: Any = getattr(_ENVIRONMENT.get_template("parts.html.j2").module, name)
    return str(macro(*values))
