"""What the log says of a state that may change many times a second: what lasts, and a summary of what does not. No ROS."""

from __future__ import annotations

from collections import Counter

SETTLED_S = 1.0
"""s, that a state lasts before it has a line of its own"""
FLAPPING_S = 10.0
"""s of changes without a state that lasts, after which a line sums them up"""


class StateLog:
    """Lines for the log, from the text of the state at each step."""

    def __init__(self) -> None:
        self._text, self._since = "", 0.0
        self._logged = ""
        self._passing: Counter[str] = Counter()  # texts since the last line, by how often they began
        self._began = 0.0  # s, when the first of these came

    def line(self, now: float, text: str) -> str:
        """The line that is due, or "".

        Args:
            now: s, on a clock that is not set back.
            text: the state, as people read it.
        """
        if text != self._text:
            if not self._passing:
                self._began = now
            self._text, self._since = text, now
            self._passing[text] += 1
        if now - self._since >= SETTLED_S:
            return self._settled()
        return self._summary() if self._passing and now - self._began >= FLAPPING_S else ""

    def _settled(self) -> str:
        """The state that lasts, unless it has its line already, with what passed before it."""
        is_new = self._text != self._logged
        self._passing[self._text] -= 1
        passed = self._passed()
        self._passing.clear()
        self._logged = self._text
        if not (is_new or passed):
            return ""
        return f"{self._text} (before that, for moments: {passed})" if passed else self._text

    def _summary(self) -> str:
        passed = self._passed()
        self._passing.clear()
        self._passing[self._text], self._began = 0, self._since
        self._logged = ""
        return f"changes all the time: {passed}"

    def _passed(self) -> str:
        return ", ".join(f"{count}x {text}" for text, count in self._passing.items() if count > 0)
