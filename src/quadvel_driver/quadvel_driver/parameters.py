"""The parameters of the node `driver`. Knows no ROS."""

from __future__ import annotations

import attrs

from quadvel_nodes.scheduling import Scheduling

from .calibration import Calibration
from .link import NO_CALIBRATION, LinkConfig
from .remote import RemoteConfig

FASTEST = 1000  # Hz, of a board's states


@attrs.frozen(kw_only=True)
class DriverParameters(LinkConfig, RemoteConfig, Scheduling):
    """Those of link, remote and scheduling, and what the node adds to them."""

    state_rate: int = attrs.field(
        default=200,
        metadata={"description": "rate of low_state, Hz, up to 1000; the board's own is the highest"},
    )
    calibration: str = attrs.field(
        default="", metadata={"description": "file that `quadvel calibrate` wrote of this robot; empty: none"}
    )
    dry_run: bool = attrs.field(
        default=False,
        metadata={"description": "send nothing, hear nothing, and show once a second what would be sent"},
    )

    @state_rate.validator
    def _is_rate(self, attribute: object, value: int) -> None:
        if not 50 <= value <= FASTEST:
            raise ValueError(f"state_rate is {value} Hz, expected 50 to {FASTEST}")

    def correction(self) -> Calibration:
        """What states and commands are set right by. CalibrationError names the file that is none."""
        return Calibration.load(self.calibration) if self.calibration else NO_CALIBRATION
