"""`quadvel up`: the whole robot as processes that start together and end together."""

from __future__ import annotations

from rich.console import Console

from .exclusivity import look_for_others
from .node_output import PrefixedOutput
from .nodes import command
from .page_watch import PageWatch
from .preflight import rehearse
from .processes import ProcessGroup, StopSignals
from .stack import VIEW, Stack


def up(stack: Stack, view: bool = False) -> int:
    """Run the stack until Ctrl-C or until one of its nodes ends; returns the exit code of the command. view: with a page.

    It is 0 after Ctrl-C if every node then ended with 0. A node that ends by itself is a fault: the others
    are stopped, and its exit code is ours (1 if that was 0). Without the page alone they go on.

    Raises ValueError or OSError where a parameter or a file is wrong, and NotAlone where a robot is there already that nobody
    asked for.
    """
    rehearse(stack)
    if stack.brings_robot:
        look_for_others()
    nodes = stack.arguments(view)
    say = PrefixedOutput(["quadvel", *nodes], Console(soft_wrap=True))
    with StopSignals() as signals, ProcessGroup(say) as group:
        say("quadvel", f"starting {', '.join(nodes)}; Ctrl-C stops them, `quadvel status` shows how they do")
        for name, arguments in nodes.items():
            if not signals.received:
                group.start(name, command(name, arguments))
        watch, ended = PageWatch(group, say), dict[str, int]()
        while not ended and not signals.wait(0.1):
            ended = watch.ended()
        for name, code in ended.items():
            say("quadvel", f"{name} ended with exit code {code}; stopping the others")
        codes = group.stop()
        if ended:
            return next((_positive(code) for code in ended.values() if code), 1)
        for name, code in codes.items():
            if code and not (name == VIEW and watch.page_ended):
                say("quadvel", f"{name} did not stop cleanly: exit code {code}")
    return 1 if any(codes.values()) else 0


def _positive(code: int) -> int:
    """As a shell reports it: 128 + n for a process that signal n ended."""
    return code if code > 0 else 128 - code
