"""SIGINT and SIGTERM: they shut down the contexts of this process.

Then the handler that was there before is called, as with rclpy: Python's own raises KeyboardInterrupt in the
main thread. Under a launcher Ctrl-C reaches a node twice; later SIGINTs are ignored, so that neither clean-up
nor the interpreter's end is cut short (SIGTERM and SIGQUIT stay as a way out).
"""

from __future__ import annotations

import signal
import socket
import threading
from enum import IntFlag
from types import FrameType
from typing import Any

from .context import live_contexts


class SignalHandlerOptions(IntFlag):
    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3


_former: dict[int, Any] = {}
_waker: socket.socket | None = None


def _on_signal(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGINT:
        signal.signal(number, signal.SIG_IGN)
    for context in live_contexts():
        context.try_shutdown()
    former = _former.get(number)
    if callable(former):
        former(number, frame)


def _wake_on_signals(receiver: socket.socket) -> None:
    """Wake the executors at every signal: Python runs its handlers only after the wait for data returns."""
    while receiver.recv(1):
        for context in live_contexts():
            context._wake()


def install_signal_handlers(options: SignalHandlerOptions = SignalHandlerOptions.ALL) -> None:
    """Take over the signals named; does nothing outside the main thread, where Python allows no handlers."""
    global _waker
    if threading.current_thread() is not threading.main_thread() or not options:
        return
    if _waker is None:
        receiver, _waker = socket.socketpair()
        _waker.setblocking(False)
        threading.Thread(target=_wake_on_signals, args=(receiver,), daemon=True, name="signals").start()
        signal.set_wakeup_fd(_waker.fileno(), warn_on_full_buffer=False)
    for option, number in (
        (SignalHandlerOptions.SIGINT, signal.SIGINT),
        (SignalHandlerOptions.SIGTERM, signal.SIGTERM),
    ):
        if options & option:
            _former.setdefault(number, signal.getsignal(number))
            signal.signal(number, _on_signal)


def uninstall_signal_handlers() -> None:
    """Give the signals back, SIGINT only if it never came (see the module's text)."""
    if threading.current_thread() is not threading.main_thread():
        return
    for number in list(_former):
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, _former.pop(number))
