"""Which signals `rclpy.init` would take over. Here it takes none: Python's own handlers stay.

So Ctrl-C raises KeyboardInterrupt in the main thread, and SIGTERM ends the process. A node that is to end cleanly
however often a signal comes has handlers of its own, as `quadvel_nodes.node.run` does.
"""

from enum import IntFlag


class SignalHandlerOptions(IntFlag):
    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3
