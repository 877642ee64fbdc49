"""A set of checked logs with the same joints: those to fit and those held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs

from .checks import Inspection, inspect
from .findings import Finding
from .log import Log, LogError


@attrs.frozen(eq=False)
class Dataset:
    """Checked logs with the same joints.

    Attributes:
        fitted: Inspections of the logs to fit.
        heldout: Inspections of the logs that are only evaluated on.
    """

    fitted: tuple[Inspection, ...]
    heldout: tuple[Inspection, ...] = ()

    @classmethod
    def inspect_all(
        cls,
        fitted: Sequence[Log],
        heldout: Sequence[Log] = (),
        gains: tuple[float, float] | None = None,
        on_inspected: Callable[[Inspection], None] = lambda inspection: None,
    ) -> Dataset:
        """Check logs and reduce them to the joints of the first one.

        Args:
            fitted: Logs to fit, at least one.
            heldout: Logs to evaluate on.
            gains: Commanded kp (N m/rad) and kd (N m s/rad) of logs that hold none.
            on_inspected: Called with each inspection, before the log may be refused.

        Returns:
            The set of logs.

        Raises:
            LogError: A log is refused, or its joints or fields differ from the first one's.
        """
        first = fitted[0]
        found: tuple[list[Inspection], list[Inspection]] = [], []
        for part, logs in zip(found, (fitted, heldout), strict=True):
            for log in logs:
                part.append(inspect(_with_joints_of(log, first), gains))
                on_inspected(part[-1])
                part[-1].raise_refusal()
        one, two = (tuple(part) for part in found)
        return cls(one, two)

    @property
    def logs(self) -> list[Log]:
        """All corrected logs, those to fit first."""
        return [one.log for one in (*self.fitted, *self.heldout)]

    @property
    def findings(self) -> tuple[tuple[str, Finding], ...]:
        """All findings, each with the name of its log."""
        return tuple((one.log.name, f) for one in (*self.fitted, *self.heldout) for f in one.findings)


def _with_joints_of(log: Log, first: Log) -> Log:
    """The log with the joints of the first; raises LogError unless both or none hold torque."""
    if (log.tau is None) != (first.tau is None):
        lacking, other = (log, first) if log.tau is None else (first, log)
        raise LogError(f"{lacking.name}: tau: the field is missing, expected it as in {other.name}")
    if len(log.joints) > len(first.joints):
        extra = next(name for name in log.joints if name not in first.joints)
        raise LogError(f"{log.name}: joint_names: '{extra}' is not in {first.name}, expected the same joints")
    return log.select_joints(first.joints)
