"""The schema of what a page may send to `/words`: one record for each order of the operator. No ROS, no sockets."""

from __future__ import annotations

from typing import Literal, TypeAlias

import msgspec

LARGEST_WORD = 4096
"""bytes of one message"""
LONGEST_REASON = 120
"""characters of a refusal; a WebSocket's close frame holds 123 bytes"""


class WordError(ValueError):
    """A message that the schema refuses; one sentence in ASCII, at most LONGEST_REASON characters."""

    def __init__(self, error: object) -> None:
        super().__init__(f"not understood: {error}".encode("ascii", "replace").decode()[:LONGEST_REASON])


class _Word(msgspec.Struct, tag_field="do", forbid_unknown_fields=True):
    """The field `do` names the order; no other fields than those of its record are accepted."""


class Stop(_Word, tag="stop"):
    """Brake the joints at once, until Release."""


class Release(_Word, tag="release"):
    """End the STOP."""


class Hold(_Word, tag="hold"):
    """The operator holds this velocity: vx, vy (m/s), wz (rad/s), body frame."""

    velocity: tuple[float, float, float]


class LetGo(_Word, tag="let_go"):
    """The operator holds nothing."""


class Record(_Word, tag="record"):
    """Start a recording, or finish the one that runs."""


class ModeRequest(_Word):
    """Request a mode of the controller, which is the name of the order."""

    @property
    def mode(self) -> str:
        """The mode requested."""
        return str(self.__struct_config__.tag)


class Passive(ModeRequest, tag="passive"):
    """The joints brake; the way out of a fault."""


class StandUp(ModeRequest, tag="stand_up"):
    """Stand up."""


class Stance(ModeRequest, tag="stance"):
    """Stand in the nominal posture."""


class Walk(ModeRequest, tag="walk"):
    """Let the policy drive."""


class LieDown(ModeRequest, tag="lie_down"):
    """Lie down."""


class Allow(_Word, tag="allow"):
    """Allow walking."""


class Reset(_Word, tag="reset"):
    """Put the simulated robot back; terrain: "" keeps the ground."""

    terrain: Literal["", "flat", "slope", "rough"] = ""


class Push(_Word, tag="push"):
    """Push the simulated robot to one side."""

    to: Literal["left", "right"]


class Play(_Word, tag="play"):
    """Play a recording, or pause it."""


class Seek(_Word, tag="seek"):
    """Go to a time of a recording, s since its beginning."""

    time: float


class Pace(_Word, tag="pace"):
    """Play at this multiple of real time."""

    pace: float


Word: TypeAlias = (
    Stop | Release | Hold | LetGo | Record | Allow | Reset | Push
    | Passive | StandUp | Stance | Walk | LieDown
    | Play | Seek | Pace
)  # fmt: skip
_DECODER: msgspec.json.Decoder[Word] = msgspec.json.Decoder(Word)


def read_word(text: str | bytes) -> Word:
    """Read one message of a page.

    Args:
        text: JSON, at most LARGEST_WORD long.

    Returns:
        The record of its order. All its numbers are finite.

    Raises:
        WordError: The text is too long, is not JSON, or does not match the schema.
    """
    if len(text) > LARGEST_WORD:
        raise WordError(f"{len(text)} bytes, expected at most {LARGEST_WORD}")
    try:
        return _DECODER.decode(text)
    except (ValueError, RecursionError) as error:
        raise WordError(error) from None
