"""Unitree's own Python client, unchanged, as a program: reads states, releases the controller, moves a joint.

It has a process of its own because it opens the DDS domain by its number, which the embedded middleware may have
opened. What it finds it prints, one JSON value a line; what the vendor's library prints goes to stderr. It goes on
from one step to the next at a line on stdin.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import redirect_stdout
from typing import Any

from unitree_sdk2py.comm.motion_switcher.motion_switcher_client import MotionSwitcherClient
from unitree_sdk2py.core.channel import ChannelFactoryInitialize, ChannelPublisher, ChannelSubscriber
from unitree_sdk2py.idl.default import unitree_go_msg_dds__LowCmd_
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_
from unitree_sdk2py.utils.crc import CRC

KP, KD, PERIOD_S = 100.0, 3.0, 0.002


class Sender(threading.Thread):
    """Sends one command again and again."""

    def __init__(self, target: list[float], crc_error: int) -> None:
        super().__init__(daemon=True)
        self._publisher = ChannelPublisher("rt/lowcmd", LowCmd_)
        self._publisher.Init()
        self._command = unitree_go_msg_dds__LowCmd_()
        self._command.head[:], self._command.level_flag = (0xFE, 0xEF), 0xFF
        for motor, q in zip(self._command.motor_cmd, target, strict=False):
            motor.mode, motor.q, motor.kp, motor.kd = 1, q, KP, KD
        self._command.crc = CRC().Crc(self._command) ^ crc_error

    def run(self) -> None:
        while True:
            self._publisher.Write(self._command)
            time.sleep(PERIOD_S)


def show(value: Any) -> None:
    print(json.dumps(value), file=sys.__stdout__, flush=True)


def main(domain: str, interface: str, target: str, crc_error: str) -> None:
    with redirect_stdout(sys.stderr):
        drive(domain, interface, target, crc_error)


def drive(domain: str, interface: str, target: str, crc_error: str) -> None:
    ChannelFactoryInitialize(int(domain), interface)
    states: list[Any] = []
    reader = ChannelSubscriber("rt/lowstate", LowState_)
    reader.Init(states.append, 10)
    while not states:
        time.sleep(0.01)
    state = states[-1]
    motors = state.motor_state[:12]
    show(
        {"q": [motor.q for motor in motors], "crc": CRC().Crc(state) - state.crc, "soc": state.bms_state.soc}
    )
    Sender(json.loads(target), int(crc_error)).start()
    sys.stdin.readline()
    switcher = MotionSwitcherClient()
    switcher.SetTimeout(20.0)
    switcher.Init()
    show([switcher.CheckMode(), switcher.ReleaseMode(), switcher.CheckMode()])
    sys.stdin.readline()


if __name__ == "__main__":
    main(*sys.argv[1:])
