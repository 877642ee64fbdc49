"""Simulated board behind `rt/lowcmd` and `rt/lowstate`, with the motion switcher of a Go2. No ROS.

At the start the robot's own controller holds the legs, as on a robot: it writes `rt/lowcmd` itself,
and commands of others are dropped until a client releases it. The physics are those of the
simulation behind the board, today the AlienGo's; the bytes, topics and requests are those of a Go2.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from cyclonedds.core import DDSException
from typing_extensions import override

from quadvel_dds.wire import Writer
from quadvel_description.state import JointCommand
from quadvel_driver.board_state import Battery
from quadvel_driver.calibration import Calibration
from quadvel_driver.link import NO_CALIBRATION
from quadvel_driver.packets import JOINTS
from quadvel_driver.unitree_dds import wire
from quadvel_driver.unitree_dds.bus import Bus
from quadvel_driver.unitree_dds.motion_switcher import REQUEST_TOPIC, RESPONSE_TOPIC, Api
from quadvel_driver.unitree_dds.transport import COMMAND_TOPIC, STATE_TOPIC
from quadvel_driver.unitree_dds.types import (
    LOW_CMD,
    LOW_STATE,
    Request,
    Response,
    ResponseHeader,
    ResponseStatus,
)
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.board import Board

OWN_CONTROLLER = "mcf"
"""Name of the robot's own controller at the start."""
HOLD_PERIOD_S = 0.004
"""Period of its commands, s."""
HOLD_KP, HOLD_KD = 100.0, 3.0
"""Its gains, N m/rad and N m s/rad: enough for the mass of the simulated AlienGo."""
NOT_IMPLEMENTED, WRONG_PARAMETER = 3203, 3204
"""Codes of the answers to an unknown request and to one that cannot be read."""
BATTERY = Battery(charge=90, voltage=29.0, current=-1.0)


class DdsBoard(Board):
    """DDS side of a simulated robot.

    Attributes:
        mode: Name of the robot's own controller that holds the legs, "" for none.
    """

    def __init__(
        self,
        bus: Bus,
        network: NetworkConfig,
        calibration: Calibration = NO_CALIBRATION,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Offer the topics of a robot.

        Args:
            bus: The robot's bus; the board leaves it at the end.
            network: Faults of the network between client and board.
            calibration: Joint zeros and IMU mounting errors that the simulated sensors have.
            clock: Returns the present time in s; must not be set back.
        """
        super().__init__(wire, network, calibration, clock)
        self.battery = BATTERY
        self.mode = ""
        self._bus = bus
        self._states = bus.writer(STATE_TOPIC, LOW_STATE)
        self._commands = bus.reader(COMMAND_TOPIC, LOW_CMD)
        self._requests = bus.reader(REQUEST_TOPIC, Request)
        self._responses = bus.writer(RESPONSE_TOPIC, Response)
        self._own_commands: Writer | None = None
        self._posture: np.ndarray | None = None  # that the own controller holds, rad
        self._held_at = -np.inf
        self.select(OWN_CONTROLLER)

    def select(self, mode: str) -> None:
        """Give the legs to one of the robot's own controllers, or to none.

        Args:
            mode: Name of the controller, "" for none.
        """
        self.mode, self._posture = mode, None
        if mode and self._own_commands is None:
            self._own_commands = self._bus.writer(COMMAND_TOPIC, LOW_CMD)
        elif not mode and self._own_commands is not None:
            self._own_commands.close()
            self._own_commands = None

    @override
    def _has_client(self) -> bool:
        return True

    @override
    def receive(self) -> JointCommand | None:
        """Take the packets that wait, as every board does; a controller of the robot goes before.

        Returns:
            The command of the robot's own controller if it holds the legs, else the newest valid
            one; None if there is none.
        """
        command = super().receive()
        return self._hold() if self.mode else command

    @override
    def _received(self) -> list[bytes]:
        """Answer requests and return commands."""
        for request in self._requests.dds.take(100):
            if request.sample_info.valid_data:
                self._responses.dds.write(self._answer(request))
        packets: list[bytes] = []
        while (sample := self._commands.take()) is not None:
            packets.append(sample[0])
        return packets

    def _answer(self, request: Any) -> Response:
        """Execute a request to the motion switcher."""
        api, code, data = request.header.identity.api_id, 0, ""
        if api == Api.CHECK_MODE:
            data = json.dumps({"form": "0", "name": self.mode})
        elif api == Api.RELEASE_MODE:
            self.select("")
        elif api == Api.SELECT_MODE:
            try:
                self.select(str(json.loads(request.parameter)["name"]))
            except (ValueError, TypeError, KeyError):
                code = WRONG_PARAMETER
        else:
            code = NOT_IMPLEMENTED
        return Response(ResponseHeader(request.header.identity, ResponseStatus(code)), data)

    def _hold(self) -> JointCommand | None:
        """Return a command of the present posture every HOLD_PERIOD_S, else None."""
        assert self.loop is not None
        now = self._clock()
        if now - self._held_at < HOLD_PERIOD_S:
            return None
        self._held_at = now
        if self._posture is None:
            self._posture = self.loop.simulator.data.qpos[7:].copy()
        command = JointCommand(q=self._posture, kp=np.full(JOINTS, HOLD_KP), kd=np.full(JOINTS, HOLD_KD))
        if self._own_commands is not None:
            self._own_commands.write(wire.encode_command(command))
        return self._as_answer(command)

    @override
    def _decode(self, packet: bytes) -> JointCommand | None:
        if not self.mode:
            return super()._decode(packet)
        self._count_dropped("held", f"the robot's own controller '{self.mode}' holds the legs")
        return None

    @override
    def _transmit(self, packet: bytes) -> None:
        try:
            self._states.write(packet)
        except DDSException as error:
            raise OSError(str(error)) from error

    @override
    def close(self) -> None:
        self._bus.close()
