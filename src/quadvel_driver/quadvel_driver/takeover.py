"""Who may command the joints: what a link may send. No ROS."""

from __future__ import annotations

from enum import Enum

from .board_state import BoardState


class Access(Enum):
    """What a link may send to the board."""

    NONE = "nothing"
    BRAKE = "damping only"
    FULL = "commands"


class Takeover:
    """Right to command the joints, for a board that obeys the first sender, such as the AlienGo's.

    Attributes:
        access: What may be sent now; read from any thread.
        problem: One sentence for the operator: why access is not full, or a note on it; "" if there
            is neither.
    """

    def __init__(self) -> None:
        self.access = Access.FULL
        self.problem = ""

    def update(self, now: float, newest: BoardState | None) -> None:
        """Check the right again; called in the link's thread, at least every 2 ms.

        Args:
            now: Time, s.
            newest: The newest state, None while the board is silent.
        """
