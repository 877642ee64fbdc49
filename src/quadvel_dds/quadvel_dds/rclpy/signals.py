"""Options for the signals that `rclpy.init` would handle; here it handles none.

Ctrl-C therefore raises KeyboardInterrupt in the main thread, and SIGTERM ends the process. A node
that must end cleanly after repeated signals needs its own handlers, see `quadvel_nodes.node.run`.
"""

from enum import IntFlag


class SignalHandlerOptions(IntFlag):
    """Signals to handle, as in rclpy; ignored."""

    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3
