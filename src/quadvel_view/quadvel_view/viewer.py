"""The page as a whole: viser's scene, the web server, and what both show. Where the picture comes from is others' matter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .operator import Operator
from .panel import panel
from .picture import RobotPicture
from .scene import Scene
from .scene_server import SceneServer, SceneServerError
from .server import AddressError, PageServer
from .words import Word

FRAME = 1.0 / 30.0
"""s, between two pictures"""
PORT = 8770
"""TCP port of the page, unless told otherwise"""
LARGEST_PORT = 65535
"""of TCP"""


class Viewer:
    """Serves the page from the time it is made until `close`. on_word, on_leave: as of PageServer, in its thread."""

    def __init__(
        self,
        host: str,
        port: int,
        on_word: Callable[[int, Word], None],
        on_leave: Callable[[int], None],
    ) -> None:
        try:
            self._scene_server = SceneServer()
        except SceneServerError as error:
            raise AddressError(f"the scene can't be drawn: {error}") from None
        try:
            self._scene = Scene(self._scene_server.viser)
            self._page = PageServer(host, port, self._scene_server.path, on_word, on_leave)
        except BaseException:
            self._scene_server.close()
            raise
        self.url = self._page.url

    @property
    def is_watched(self) -> bool:
        """Whether somebody has the page open."""
        return self._page.is_watched

    def show(self, picture: RobotPicture, operator: Operator, now: float, **more: Any) -> None:
        """One picture, and the readings, to which `more` is added. now: s, on the clock of the picture."""
        self._scene.draw(picture)
        self._page.tell({**panel(picture, operator, now), **more})

    def close(self) -> None:
        """End both servers."""
        self._page.close()
        self._scene_server.close()
