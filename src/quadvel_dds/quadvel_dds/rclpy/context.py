"""State of ROS communication in this process: arguments, domain, and whether it runs."""

from __future__ import annotations

import atexit
import os
import sys
import weakref
from collections.abc import Sequence
from threading import Lock
from typing import Any

from quadvel_dds import arguments, wire
from quadvel_dds.errors import Partial

from ._graph import GraphAnnouncer
from .logging import set_levels

_contexts: weakref.WeakSet[Context] = weakref.WeakSet()
_default_context: Context | None = None
_default_lock = Lock()


class Context(Partial):
    """Communication context, see rclpy's Context; there is one at a time.

    Attributes:
        arguments: ROS arguments of the command line.
    """

    def __init__(self) -> None:
        """Create a context that does not run."""
        self._running = False
        self._participant: wire.Participant | None = None
        self._participant_lock = Lock()
        self._announcer: GraphAnnouncer | None = None
        self._nodes: list[Any] = []
        self._wakers: weakref.WeakSet[Any] = weakref.WeakSet()
        self._domain_id = 0
        self.arguments = arguments.RosArguments()

    def init(self, args: Sequence[str] | None, domain_id: int | None = None) -> None:
        """Parse the arguments and start communication; the domain is joined at its first use.

        Args:
            args: Command line; None: `sys.argv`.
            domain_id: Number of the domain; None: ROS_DOMAIN_ID.

        Raises:
            RuntimeError: It runs already.
            ValueError: ROS_DOMAIN_ID is invalid, or security is enabled.
        """
        if self._running:
            raise RuntimeError("Context.init() must only be called once")
        if domain_id is None:
            text = os.environ.get("ROS_DOMAIN_ID") or "0"
            if not text.isdecimal() or int(text) > 232:
                raise ValueError(f"ROS_DOMAIN_ID is '{text}', expected a number from 0 to 232")
            domain_id = int(text)
        if os.environ.get("ROS_SECURITY_ENABLE") == "true":
            raise ValueError(
                "ROS_SECURITY_ENABLE is 'true', but the embedded middleware has no security; use ROS 2's rclpy"
            )
        self._domain_id = domain_id
        self.arguments = arguments.parse(sys.argv if args is None else args)
        set_levels(self.arguments.log_levels)
        self._running = True
        _contexts.add(self)

    def ok(self) -> bool:
        """Return whether communication runs.

        Returns:
            True between `init` and `shutdown`.
        """
        return self._running

    @property
    def participant(self) -> wire.Participant:
        """Participant of this process; it joins the domain at its first use."""
        with self._participant_lock:
            if self._participant is None:
                self._participant = wire.Participant(self._domain_id)
                self._announcer = GraphAnnouncer(self._participant)
            return self._participant

    def _announce_nodes(self) -> None:
        """Announce the nodes of this process."""
        if self._announcer is not None and self._running:
            self._announcer.announce(self._nodes)

    def shutdown(self) -> None:
        """Stop communication.

        Raises:
            RuntimeError: It does not run.
        """
        if not self._running:
            raise RuntimeError("Context must be initialized before it can be shutdown")
        self.try_shutdown()

    def try_shutdown(self) -> None:
        """Stop communication if it runs; a signal handler may call this."""
        if self._running:
            self._running = False
            for executor in list(self._wakers):
                executor.wake()
            self._leave()

    def _leave(self, unless_used: bool = True) -> None:
        """Leave the domain once the context is shut down and its last node destroyed."""
        if unless_used and (self._running or self._nodes):
            return
        participant, self._participant, self._announcer = self._participant, None, None
        if participant is not None:
            participant.close()


def get_default_context(*, shutting_down: bool = False) -> Context:
    """Return the context of this process; after its shutdown a new one.

    Args:
        shutting_down: Whether the caller shuts it down, so that the next call creates a new one.

    Returns:
        The context.
    """
    global _default_context
    with _default_lock:
        context = _default_context = _default_context or Context()
        if shutting_down:
            _default_context = None
        return context


@atexit.register
def _leave_all() -> None:
    """Leave the domain when the process exits, while Cyclone's threads can still call Python."""
    for context in list(_contexts):
        context.try_shutdown()
        context._leave(unless_used=False)
    wire.leave_domains()
