"""Monitoring of a robot's processes.

The operator page is optional: the robot continues without it.
"""

from __future__ import annotations

from .processes import Output, ProcessGroup
from .stack import VIEW


class PageWatch:
    """Separates the end of the page from the end of the robot's own processes.

    Args:
        group: The processes.
        say: Receives name and line of a report.

    Attributes:
        page_ended: Whether the page has ended.
    """

    def __init__(self, group: ProcessGroup, say: Output) -> None:
        self._group, self._say = group, say
        self.page_ended = False

    def ended(self) -> dict[str, int]:
        """Return ended processes without the page, and report the end of the page once.

        Returns:
            Exit codes by name.
        """
        codes = self._group.ended()
        code = codes.pop(VIEW, None)
        if code is not None and not self.page_ended:
            self.page_ended = True
            self._say(
                VIEW,
                f"ended with exit code {code}: the robot continues without the page and its STOP; "
                "`quadvel view` serves another page, `quadvel mode passive` stops the robot",
            )
        return codes
