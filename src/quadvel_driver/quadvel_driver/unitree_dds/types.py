"""DDS types on the bus of Unitree's robots: `unitree_go` for the joints, `unitree_api` for requests.

Names and order of the fields are the vendor's: DDS compares them before it connects two programs.
Samples of LowCmd and LowState stay bytes, which `wire` reads; requests are records.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from cyclonedds.idl import IdlStruct, make_idl_struct, types

_Array: Any = types.array  # mypy does not know types.array[...]
_BYTE, _WORD, _FLOAT = types.uint8, types.uint32, types.float32


def _struct(name: str, **fields: Any) -> Any:
    return make_idl_struct(name, f"unitree_go::msg::dds_::{name}", fields)


def _bytes_of(struct: Any) -> Any:
    """Make the samples of a type hold CDR bytes as `data`."""
    struct.__init__ = lambda sample, data: setattr(sample, "data", data)
    struct.serialize = lambda sample, **options: sample.data
    struct.deserialize = struct.deserialize_key = classmethod(lambda cls, data, **options: cls(data))
    return struct


_HEAD = {
    "head": _Array[_BYTE, 2],
    "level_flag": _BYTE,
    "frame_reserve": _BYTE,
    "sn": _Array[_WORD, 2],
    "version": _Array[_WORD, 2],
    "bandwidth": types.uint16,
}
_MOTOR_CMD = _struct(
    "MotorCmd_",
    mode=_BYTE,
    **dict.fromkeys(("q", "dq", "tau", "kp", "kd"), _FLOAT),
    reserve=_Array[_WORD, 3],
)
_BMS_CMD = _struct("BmsCmd_", off=_BYTE, reserve=_Array[_BYTE, 3])
_IMU_STATE = _struct(
    "IMUState_",
    quaternion=_Array[_FLOAT, 4],
    gyroscope=_Array[_FLOAT, 3],
    accelerometer=_Array[_FLOAT, 3],
    rpy=_Array[_FLOAT, 3],
    temperature=_BYTE,
)
_MOTOR_STATE = _struct(
    "MotorState_",
    mode=_BYTE,
    **dict.fromkeys(("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw"), _FLOAT),
    temperature=_BYTE,
    lost=_WORD,
    reserve=_Array[_WORD, 2],
)
_BMS_STATE = _struct(
    "BmsState_",
    **dict.fromkeys(("version_high", "version_low", "status", "soc"), _BYTE),
    current=types.int32,
    cycle=types.uint16,
    bq_ntc=_Array[_BYTE, 2],
    mcu_ntc=_Array[_BYTE, 2],
    cell_vol=_Array[types.uint16, 15],
)
LOW_CMD: Any = _bytes_of(
    _struct(
        "LowCmd_",
        **_HEAD,
        motor_cmd=_Array[_MOTOR_CMD, 20],
        bms_cmd=_BMS_CMD,
        wireless_remote=_Array[_BYTE, 40],
        led=_Array[_BYTE, 12],
        fan=_Array[_BYTE, 2],
        gpio=_BYTE,
        reserve=_WORD,
        crc=_WORD,
    )
)
LOW_STATE: Any = _bytes_of(
    _struct(
        "LowState_",
        **_HEAD,
        imu_state=_IMU_STATE,
        motor_state=_Array[_MOTOR_STATE, 20],
        bms_state=_BMS_STATE,
        foot_force=_Array[types.int16, 4],
        foot_force_est=_Array[types.int16, 4],
        tick=_WORD,
        wireless_remote=_Array[_BYTE, 40],
        bit_flag=_BYTE,
        adc_reel=_FLOAT,
        temperature_ntc1=_BYTE,
        temperature_ntc2=_BYTE,
        power_v=_FLOAT,
        power_a=_FLOAT,
        fan_frequency=_Array[types.uint16, 4],
        reserve=_WORD,
        crc=_WORD,
    )
)


_Bytes = Annotated[Sequence[int], types.sequence(types.uint8)]


def _api(name: str) -> str:
    return f"unitree_api::msg::dds_::{name}_"


@dataclass
class RequestIdentity(IdlStruct, typename=_api("RequestIdentity")):
    """Number of a request, and what is asked for."""

    id: types.int64 = 0
    api_id: types.int64 = 0


@dataclass
class RequestLease(IdlStruct, typename=_api("RequestLease")):
    """Lease of a client; 0 for none."""

    id: types.int64 = 0


@dataclass
class RequestPolicy(IdlStruct, typename=_api("RequestPolicy")):
    """Priority, and whether no response is wanted."""

    priority: types.int32 = 0
    noreply: bool = False


@dataclass
class RequestHeader(IdlStruct, typename=_api("RequestHeader")):
    """Header of a request."""

    identity: RequestIdentity = field(default_factory=RequestIdentity)
    lease: RequestLease = field(default_factory=RequestLease)
    policy: RequestPolicy = field(default_factory=RequestPolicy)


@dataclass
class Request(IdlStruct, typename=_api("Request")):
    """Request to a service of the robot; the parameter is JSON."""

    header: RequestHeader = field(default_factory=RequestHeader)
    parameter: str = ""
    binary: _Bytes = field(default_factory=list)


@dataclass
class ResponseStatus(IdlStruct, typename=_api("ResponseStatus")):
    """Result of a request, 0 for success."""

    code: types.int32 = 0


@dataclass
class ResponseHeader(IdlStruct, typename=_api("ResponseHeader")):
    """Header of a response; the identity is that of the request."""

    identity: RequestIdentity = field(default_factory=RequestIdentity)
    status: ResponseStatus = field(default_factory=ResponseStatus)


@dataclass
class Response(IdlStruct, typename=_api("Response")):
    """Response of a service of the robot; the data are JSON."""

    header: ResponseHeader = field(default_factory=ResponseHeader)
    data: str = ""
    binary: _Bytes = field(default_factory=list)
