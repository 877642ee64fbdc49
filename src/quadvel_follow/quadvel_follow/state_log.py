"""Log lines about a changing state: lasting states, and a summary of short ones. No ROS."""

from __future__ import annotations

from collections import Counter

SETTLED_S = 1.0
"""Time after which a state is logged as a lasting one."""
FLAPPING_S = 10.0
"""Time of changes without a lasting state after which a summary is logged."""


class StateLog:
    """Limits the log lines about the state of a node."""

    def __init__(self) -> None:
        self._text, self._since = "", 0.0
        self._logged = ""
        self._short_states: Counter[str] = Counter()  # number of starts since the last line
        self._short_states_since = 0.0  # s, start of the first of these

    def next_line(self, now: float, text: str) -> str:
        """Return the line that is due.

        Args:
            now: Present time on a clock that is not set back, s.
            text: Present state.

        Returns:
            The line, or "".
        """
        if text != self._text:
            if not self._short_states:
                self._short_states_since = now
            self._text, self._since = text, now
            self._short_states[text] += 1
        if now - self._since >= SETTLED_S:
            return self._settled()
        return self._summary() if self._short_states and now - self._short_states_since >= FLAPPING_S else ""

    def _settled(self) -> str:
        """Return the line of a lasting state and the short states before it, unless logged."""
        is_new = self._text != self._logged
        self._short_states[self._text] -= 1
        passed = self._short_states_text()
        self._short_states.clear()
        self._logged = self._text
        if not (is_new or passed):
            return ""
        return f"{self._text} (before that, for moments: {passed})" if passed else self._text

    def _summary(self) -> str:
        """Return the line that summarizes short states."""
        passed = self._short_states_text()
        self._short_states.clear()
        self._short_states[self._text], self._short_states_since = 0, self._since
        self._logged = ""
        return f"changes all the time: {passed}"

    def _short_states_text(self) -> str:
        """Return the short states with their counts."""
        return ", ".join(f"{count}x {text}" for text, count in self._short_states.items() if count > 0)
