"""A node that hears nothing says so once, instead of waiting without a word."""

from __future__ import annotations

from collections.abc import Callable

SILENCE_LIMIT_S = 5
"""Time after the start from which a missing message is worth a warning, s."""


class SilenceWarning:
    """Warns once if nothing has arrived `SILENCE_LIMIT_S` after the start.

    Args:
        warn: Receives the sentence.
        topic: Topic that is missing.
        advice: What to look at, as a question.
    """

    def __init__(self, warn: Callable[[str], object], topic: str, advice: str) -> None:
        self._warn, self._topic, self._advice = warn, topic, advice
        self._seconds = 0

    def report(self, has_heard: bool, refusal: str = "") -> None:
        """Count a second; warn after the last one.

        Args:
            has_heard: Whether a valid message has ever arrived.
            refusal: Why the last message was refused, or "".
        """
        self._seconds += 1
        if self._seconds == SILENCE_LIMIT_S and not has_heard:
            missing = (
                f"no valid message on {self._topic} ({refusal})"
                if refusal
                else f"no message on {self._topic}"
            )
            self._warn(f"{missing} in {SILENCE_LIMIT_S} s: {self._advice}")
