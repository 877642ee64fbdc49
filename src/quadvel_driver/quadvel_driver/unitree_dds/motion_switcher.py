"""The robot's service `motion_switcher`: which of its own controllers holds the legs, and its release. No ROS.

Requests go to `rt/api/motion_switcher/request`, responses come on `rt/api/motion_switcher/response`,
also those to other programs. Parameters and data are JSON.
"""

from __future__ import annotations

import json
import time
from enum import IntEnum

import attrs

from .bus import Bus
from .types import Request, RequestHeader, RequestIdentity, Response

REQUEST_TOPIC = "rt/api/motion_switcher/request"
RESPONSE_TOPIC = "rt/api/motion_switcher/response"
MAX_DATA = 4096  # characters of a response that are read; those of the robot have about 30


class Api(IntEnum):
    """What can be asked."""

    CHECK_MODE = 1001  # name of the controller that holds the legs, "" for none
    SELECT_MODE = 1002
    RELEASE_MODE = 1003


@attrs.frozen
class Answer:
    """Answer of the service.

    Attributes:
        api: What was asked.
        code: 0 for success.
        mode: Name of the controller that holds the legs, "" for none; None if the answer names none.
    """

    api: int
    code: int
    mode: str | None = None


class MotionSwitcher:
    """Client of the service; no call waits."""

    def __init__(self, bus: Bus) -> None:
        """Connect to the service.

        Args:
            bus: The robot's bus.
        """
        self._requests = bus.writer(REQUEST_TOPIC, Request)
        self._responses = bus.reader(RESPONSE_TOPIC, Response)
        self._asked: set[int] = set()

    def ask(self, api: Api) -> None:
        """Send a request.

        Args:
            api: What to ask.
        """
        number = time.monotonic_ns()
        self._asked.add(number)
        self._requests.dds.write(Request(RequestHeader(RequestIdentity(number, api)), "{}"))

    def answers(self) -> list[Answer]:
        """Take the answers to own requests.

        Returns:
            Answers, oldest first; those that cannot be read are left out.
        """
        found = []
        try:
            responses = self._responses.dds.take(100)
        except Exception:  # the content is arbitrary, such as text that is not UTF-8, and so is the error
            return []
        for response in responses:
            if response.sample_info.valid_data and response.header.identity.id in self._asked:
                self._asked.discard(response.header.identity.id)
                found.append(read_answer(response))
        return found


def read_answer(response: Response) -> Answer:
    """Read a response.

    Args:
        response: The response.

    Returns:
        The answer; without a mode if the data are not the JSON of one.
    """
    api, code = response.header.identity.api_id, response.header.status.code
    if api != Api.CHECK_MODE or code:
        return Answer(api, code)
    try:
        mode = json.loads(response.data[:MAX_DATA])["name"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return Answer(api, code)
    return Answer(api, code, mode if isinstance(mode, str) else None)
