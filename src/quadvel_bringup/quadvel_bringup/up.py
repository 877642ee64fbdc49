"""`quadvel up`: all processes of a robot, started and stopped together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext

from rich.console import Console

import quadvel_dds

from .exclusivity import domain_claimed
from .node_output import PrefixedOutput
from .page_watch import PageWatch
from .preflight import check_stack
from .processes import ProcessGroup, StopSignals
from .stack import VIEW, Stack


def up(stack: Stack, view: bool = False) -> int:
    """Run the processes of a robot until Ctrl-C or until one of its nodes ends.

    After Ctrl-C the exit code is 0 if every node ended with 0. A node that ends by itself is a
    fault: the others are stopped, and its exit code is returned, or 1 if that was 0. The page is the
    exception: if it ends, the robot goes on (`PageWatch`). Errors pass through: ValueError or OSError for a wrong
    parameter or file, RobotAlreadyRunningError for a second robot.

    Args:
        stack: The nodes and their parameters.
        view: Whether to add the operator page.

    Returns:
        The exit code.
    """
    check_stack(stack)
    with only_robot() if stack.brings_robot else nullcontext():
        return _run(stack.commands(view))


def _run(nodes: Mapping[str, Sequence[str]]) -> int:
    """Run processes until Ctrl-C or until one of the nodes ends, and return the exit code of `up`."""
    say = PrefixedOutput(["quadvel", *nodes], Console(markup=False, soft_wrap=True))
    with StopSignals() as signals, ProcessGroup(say) as group:
        say("quadvel", f"starting {', '.join(nodes)}; Ctrl-C stops them, `quadvel status` shows their health")
        for name, command in nodes.items():
            if not signals.received:
                group.start(name, command)
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


@contextmanager
def only_robot() -> Iterator[None]:
    """Claim this ROS domain for a robot.

    Yields:
        Nothing.

    Raises:
        RobotAlreadyRunningError: Another program has claimed it, or a robot or simulator publishes in it.
    """
    quadvel_dds.install()
    from .session import Session

    with ExitStack() as claim:
        with Session("look_for_others") as session:
            claim.enter_context(domain_claimed(session.node))
        yield


def _positive(code: int) -> int:
    """Convert an exit code to the shell's convention: 128 + n for a process ended by signal n."""
    return code if code > 0 else 128 - code
