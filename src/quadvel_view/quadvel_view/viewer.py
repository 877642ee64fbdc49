"""The complete operator page: the 3-D scene, the web server, and the readings next to the scene.

The caller supplies the state of the robot as a `RobotPicture`: `view_node` from live topics,
`replay` from a recording. `panel` computes the readings, that is the numbers and texts of the page.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadvel_description.robot import Robot

from .operator import Operator
from .page_protocol import PageMessage
from .panel import panel
from .picture import RobotPicture
from .scene import Scene
from .scene_server import SceneServer, SceneServerError
from .server import AddressError, PageServer

FRAME_PERIOD_S = 1.0 / 30.0
"""Time between two frames."""
DEFAULT_PORT = 8770
"""Default TCP port of the page."""
MAX_PORT = 65535
"""Largest TCP port."""


class Viewer:
    """Serves the page from construction until `close`; `url` is its address.

    Args:
        robot: The robot.
        host: Address to listen on.
        port: TCP port, 0 for a free one.
        on_message: Receives the number of a page and its message, in the server's thread.
        on_disconnect: Receives the number of a page that disconnected, in the server's thread.

    Raises:
        AddressError: The address is unavailable, or the scene cannot start.
    """

    def __init__(
        self,
        robot: Robot,
        host: str,
        port: int,
        on_message: Callable[[int, PageMessage], object],
        on_disconnect: Callable[[int], None],
    ) -> None:
        try:
            self._scene_server = SceneServer()
        except SceneServerError as error:
            raise AddressError(f"the scene cannot be drawn: {error}") from None
        try:
            self._scene = Scene(self._scene_server.viser, robot)
            self._page = PageServer(host, port, self._scene_server.path, on_message, on_disconnect)
        except BaseException:
            self._scene_server.close()
            raise
        self.url = self._page.url

    @property
    def is_watched(self) -> bool:
        """Whether a page is open."""
        return self._page.is_watched

    def show(self, picture: RobotPicture, operator: Operator, now: float, **more: Any) -> None:
        """Draw a frame and send the readings.

        Args:
            picture: The state of the robot.
            operator: Velocity that the operator holds, and whether STOP is latched.
            now: Time, s, on the clock of the picture.
            more: Further readings by name, such as `recording`; values must be valid in JSON.
        """
        self._scene.draw(picture)
        self._page.send_to_pages({**panel(picture, operator, now), **more})

    def close(self) -> None:
        """Stop both servers."""
        self._page.close()
        self._scene_server.close()
