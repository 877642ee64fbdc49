"""Logs that are used together: each looked at once, with the joints of the first, to fit and to judge on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs

from .checks import Inspection, inspect
from .findings import Finding
from .log import Log, LogError


@attrs.frozen(eq=False)
class Dataset:
    """Logs that were looked at and fit together."""

    fitted: tuple[Inspection, ...]
    heldout: tuple[Inspection, ...] = ()

    @classmethod
    def of(
        cls,
        fitted: Sequence[Log],
        heldout: Sequence[Log] = (),
        gains: tuple[float, float] | None = None,
        tell: Callable[[Inspection], None] = lambda inspection: None,
    ) -> Dataset:
        """Looks at the logs, with these commanded gains where they hold none; each is told of before it may be refused.

        Raises LogError, one sentence, where a log is refused or does not go with the first.
        """
        first = fitted[0]
        found: tuple[list[Inspection], list[Inspection]] = [], []
        for part, logs in zip(found, (fitted, heldout), strict=True):
            for log in logs:
                part.append(inspect(_like(log, first), gains))
                tell(part[-1])
                part[-1].raise_refusal()
        one, two = (tuple(part) for part in found)
        return cls(one, two)

    @property
    def logs(self) -> list[Log]:
        """All logs, those to fit first."""
        return [one.log for one in (*self.fitted, *self.heldout)]

    @property
    def findings(self) -> tuple[tuple[str, Finding], ...]:
        """What was found, by log."""
        return tuple((one.log.name, f) for one in (*self.fitted, *self.heldout) for f in one.findings)


def _like(log: Log, first: Log) -> Log:
    """The log with the joints of the first; it must hold torque if that one does."""
    if (log.tau is None) != (first.tau is None):
        lacking, other = (log, first) if log.tau is None else (first, log)
        raise LogError(f"{lacking.name}: tau: the field is missing, expected it as in {other.name}")
    if len(log.joints) > len(first.joints):
        extra = next(name for name in log.joints if name not in first.joints)
        raise LogError(f"{log.name}: joint_names: '{extra}' is not in {first.name}, expected the same joints")
    return log.select(first.joints)
