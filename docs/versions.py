"""Lists the versions of the published site: `switcher.json` for the menu of versions, `index.html` for visitors."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

LATEST = "main"


def write_versions(pages: Path, url: str) -> list[str]:
    """Write `switcher.json` and `index.html`.

    Args:
        pages: Folder of the published site; each version is a folder with an `index.html`.
        url: Address of this folder on the web.

    Returns:
        The versions: `main`, then the releases, the newest first. Visitors are sent to the newest release,
        or to `main` before the first.
    """
    known = {path.parent.name for path in pages.glob("*/index.html")}
    releases = sorted(
        (name for name in known if re.fullmatch(r"v\d+\.\d+\.\d+", name)),
        key=lambda name: tuple(map(int, name[1:].split("."))),
        reverse=True,
    )
    versions = [LATEST] * (LATEST in known) + releases
    entries = [{"name": name, "version": name, "url": f"{url}/{name}/"} for name in versions]
    (pages / "switcher.json").write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    first = (releases or [LATEST])[0]
    (pages / "index.html").write_text(
        f'<!doctype html><meta http-equiv="refresh" content="0; url={first}/"><a href="{first}/">quadvel</a>\n',
        encoding="utf-8",
    )
    return versions


if __name__ == "__main__":
    print(*write_versions(Path(sys.argv[1]), sys.argv[2]))
