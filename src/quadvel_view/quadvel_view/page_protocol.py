"""Schema of the messages that a page sends to `/words`, one record per order.

`server` receives the messages; `view_node` and `replay` execute the orders.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import msgspec

MAX_MESSAGE_BYTES = 4096
"""Largest size of one message."""
MAX_REASON_CHARS = 120
"""Longest rejection sentence; the close frame of a WebSocket holds 123 bytes."""


class PageMessageError(ValueError):
    """A message does not match the schema.

    One ASCII sentence of at most MAX_REASON_CHARS characters.
    """

    def __init__(self, error: object) -> None:
        super().__init__(f"not understood: {error}".encode("ascii", "replace").decode()[:MAX_REASON_CHARS])


class _Order(msgspec.Struct, tag_field="do", forbid_unknown_fields=True):
    """Base of all orders. The field `do` selects the record; unknown fields are rejected."""


class Stop(_Order, tag="stop"):
    """Damp the joints at once, until Release."""


class Release(_Order, tag="release"):
    """Release the STOP."""


class Hold(_Order, tag="hold"):
    """Hold a velocity.

    Attributes:
        velocity: vx, vy (m/s), wz (rad/s), body frame.
    """

    velocity: tuple[float, float, float]


class LetGo(_Order, tag="let_go"):
    """End the hold."""


class Record(_Order, tag="record"):
    """Start a recording, or finish the current one."""


class ModeRequest(_Order):
    """Request the mode of the controller that has the name of the order."""

    @property
    def mode(self) -> str:
        """The mode requested."""
        return str(self.__struct_config__.tag)


class Passive(ModeRequest, tag="passive"):
    """Damp the joints; also resets a fault."""


class StandUp(ModeRequest, tag="stand_up"):
    """Stand up."""


class Stance(ModeRequest, tag="stance"):
    """Stand in the nominal posture."""


class Walk(ModeRequest, tag="walk"):
    """Walk with the policy."""


class LieDown(ModeRequest, tag="lie_down"):
    """Lie down."""


class Allow(_Order, tag="allow"):
    """Permit walking."""


class Reset(_Order, tag="reset"):
    """Reset the simulated robot.

    Attributes:
        terrain: The new terrain; "" keeps the present one.
    """

    terrain: Literal["", "flat", "slope", "rough"] = ""


class Push(_Order, tag="push"):
    """Push the simulated robot sideways.

    Attributes:
        to: The direction.
    """

    to: Literal["left", "right"]


class Play(_Order, tag="play"):
    """Toggle play and pause of a recording."""


class Seek(_Order, tag="seek"):
    """Jump to a time of a recording.

    Attributes:
        time: s since its start.
    """

    time: float


class Pace(_Order, tag="pace"):
    """Set the playback speed.

    Attributes:
        pace: Multiple of real time.
    """

    pace: float


PageMessage: TypeAlias = (
    Stop | Release | Hold | LetGo | Record | Allow | Reset | Push
    | Passive | StandUp | Stance | Walk | LieDown
    | Play | Seek | Pace
)  # fmt: skip
_DECODER: msgspec.json.Decoder[PageMessage] = msgspec.json.Decoder(PageMessage)


def parse_message(text: str | bytes) -> PageMessage:
    """Parse one message of a page.

    Args:
        text: JSON of at most MAX_MESSAGE_BYTES.

    Returns:
        The record of the order; all its numbers are finite.

    Raises:
        PageMessageError: The text is too long, is not JSON, or does not match the schema.
    """
    if len(text) > MAX_MESSAGE_BYTES:
        raise PageMessageError(f"{len(text)} bytes, expected at most {MAX_MESSAGE_BYTES}")
    try:
        return _DECODER.decode(text)
    except (ValueError, RecursionError) as error:
        raise PageMessageError(error) from None
