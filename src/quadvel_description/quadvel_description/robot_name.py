"""Names of robots in files: a policy, an estimator, an actuator model or a recording belongs to one robot."""

from __future__ import annotations

DEFAULT_ROBOT = "aliengo"
"""Robot of commands, nodes and recipes that name none."""
UNNAMED_ROBOT = "aliengo"
"""Robot of a file without a name; such files are older than the names."""
