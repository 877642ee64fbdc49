"""Which processes of a robot have ended. The operator's page is no part of the robot: without it the robot goes on."""

from __future__ import annotations

from .processes import Output, ProcessGroup
from .stack import VIEW


class PageWatch:
    """Looks at a group of processes. page_ended: whether the page has ended."""

    def __init__(self, group: ProcessGroup, say: Output) -> None:
        self._group, self._say = group, say
        self.page_ended = False

    def ended(self) -> dict[str, int]:
        """Exit codes of the robot's own processes that have ended, by name; says once, and at once, that the page did."""
        codes = self._group.ended()
        code = codes.pop(VIEW, None)
        if code is not None and not self.page_ended:
            self.page_ended = True
            self._say(
                VIEW,
                f"ended with exit code {code}: the robot goes on without its page and the STOP on it; "
                "`quadvel view` serves another page, `quadvel mode passive` stops the robot",
            )
        return codes
