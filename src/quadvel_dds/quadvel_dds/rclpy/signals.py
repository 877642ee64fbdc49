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
    if threading.current_thread() is not threading.main_thread() or not options:
        return
    if not _former:
        receiver, waker = socket.socketpair()
        waker.setblocking(False)
        threading.Thread(target=_wake_on_signals, args=(receiver,), daemon=True, name="signals").start()
        signal.set_wakeup_fd(waker.detach(), warn_on_full_buffer=False)
    for option in (SignalHandlerOptions.SIGINT, SignalHandlerOptions.SIGTERM):
        if options & option:
            number = signal.Signals[str(option.name)]
            _former.setdefault(number, signal.getsignal(number))
            signal.signal(number, _on_signal)
