"""Tests of message classes and their bytes against rosbags' reference serialization."""

import array
import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from quadvel_dds import messages


def filled(typename: str, random: np.random.Generator) -> Any:
    """A message with random content in every field, sequences of random length."""
    message = messages.message_class(typename)()
    for name, description in messages.STORE.fielddefs[typename][1]:
        setattr(message, name, value(description, random))
    return message


def value(description: Any, random: np.random.Generator) -> Any:
    kind, detail = description
    if kind == Nodetype.NAME:
        return filled(detail, random)
    if kind == Nodetype.BASE:
        return scalar(detail[0], random)
    count = detail[1] if kind == Nodetype.ARRAY else int(random.integers(0, min(detail[1] or 4, 4) + 1))
    return [value(detail[0], random) for _ in range(count)]


def scalar(base: str, random: np.random.Generator) -> Any:
    if base == "string":
        return "".join(random.choice(list("abcä"), size=random.integers(0, 9)))
    if base == "bool":
        return bool(random.integers(2))
    if base == "byte":
        return bytes([random.integers(128)])  # rosbags takes an octet for a signed number
    if base in ("float32", "float64"):
        return float(np.float32(random.normal()))
    limits = np.iinfo("uint8" if base == "char" else base)
    return int(random.integers(limits.min, limits.max, endpoint=True, dtype=limits.dtype))


@cache
def reference_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register({name: d for name, d in messages.STORE.fielddefs.items() if name not in store.fielddefs})
    return store


def reference(message: Any) -> Any:
    """The same content in the plain form that rosbags serialises."""
    store = reference_store()

    def plain(description: Any, content: Any) -> Any:
        kind, detail = description
        if kind == Nodetype.NAME:
            fields = store.fielddefs[detail][1]
            return store.types[detail](**{n: plain(d, getattr(content, n)) for n, d in fields})
        if kind == Nodetype.BASE:
            return content[0] if detail[0] == "byte" else content
        item = detail[0]
        if item[0] == Nodetype.BASE and item[1][0] != "string":
            dtype = {"byte": "uint8", "char": "uint8"}.get(item[1][0], item[1][0])
            return np.array([plain(item, v) for v in content], dtype)
        return [plain(item, v) for v in content]

    return store.serialize_cdr(plain((Nodetype.NAME, message.TYPENAME), message), message.TYPENAME)


NAMES = sorted(name for name in messages.STORE.fielddefs if not name.startswith("rosbag2_interfaces"))


# Every kind of field after one that leaves the position unaligned.
AWKWARD = "test_msgs/msg/Awkward"
FIELDS = """
uint8[3] a
float64 b
string c
float64[] d
uint16[5] e
int64 f
float32[3] g
geometry_msgs/Vector3[2] h
bool i
geometry_msgs/Vector3[] j
byte[3] k
string[2] l
bool[] m
uint8[] n
geometry_msgs/Quaternion o
string[] p
uint16 q
uint64[<=3] r
int8 s
std_msgs/Header[] t
float32 u
"""
messages.STORE.register(get_types_from_msg(FIELDS, AWKWARD))


@pytest.mark.parametrize("typename", [*NAMES, AWKWARD])
def test_bytes_equal_the_reference_and_read_back(typename: str) -> None:
    random = np.random.default_rng(5)
    for _ in range(40 if typename == AWKWARD else 4):
        message = filled(typename, random)
        data = bytes(messages.serialize(message))
        expected = bytes(reference(message))
        assert data[: len(expected)] == expected
        assert len(data) - len(expected) < 4
        assert messages.deserialize(data, typename) == message


def test_truncated_or_foreign_bytes_are_refused() -> None:
    from std_msgs.msg import String

    data = bytes(messages.serialize(String(data="walk and stand")))
    with pytest.raises(ValueError, match=r"std_msgs/msg/String cannot be read"):
        messages.deserialize(data[:12], "std_msgs/msg/String")
    with pytest.raises(ValueError, match=r"encapsulation 0007 found"):
        messages.deserialize(b"\x00\x07" + data[2:], "std_msgs/msg/String")


def test_defaults_and_keyword_arguments() -> None:
    from geometry_msgs.msg import Pose, Quaternion

    from quadvel_msgs.msg import LowCmd

    assert Pose().orientation == Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    command = LowCmd(tick=7, q=[0.5] * 12)
    assert command.q.dtype == np.float32
    assert (command.q == 0.5).all()
    assert not command.kd.any()
    with pytest.raises(TypeError, match="torque"):
        LowCmd(torque=1.0)


def test_messages_share_no_default() -> None:
    from nav_msgs.msg import Odometry

    first, second = Odometry(), Odometry()
    first.pose.pose.position.x = 1.0
    first.pose.covariance[0] = 1.0
    assert second == Odometry()


def test_assignment_converts_numbers_to_one_block() -> None:
    from sensor_msgs.msg import JointState

    from quadvel_msgs.msg import LowState

    source = np.arange(12, dtype=np.float32)
    state, joints = LowState(q=source), JointState(position=source.tolist())
    source[0] = 9.0
    assert state.q[0] == 0.0
    assert joints.position == array.array("d", range(12))


def test_constants_are_class_attributes() -> None:
    from diagnostic_msgs.msg import DiagnosticStatus

    from quadvel_msgs.msg import ControllerState, LowCmd

    assert LowCmd.MODE_SERVO == 10
    assert ControllerState.FAULT == 5
    assert DiagnosticStatus.ERROR == b"\x02"


def test_services_have_request_and_response() -> None:
    from std_srvs.srv import SetBool, Trigger

    from quadvel_msgs.srv import Push

    assert SetBool.Request(data=True).data is True
    assert Trigger.Response(message="done").message == "done"
    assert Push.Request().wrench.force.z == 0.0


def test_unknown_message_is_an_import_error() -> None:
    with pytest.raises(ImportError, match="Twister"):
        from geometry_msgs.msg import Twister  # noqa: F401


UNCHECKED = """
import numpy as np, quadvel_dds
quadvel_dds.install()
from geometry_msgs.msg import Twist
from quadvel_msgs.msg import LowCmd
from sensor_msgs.msg import JointState
from quadvel_dds import messages
command, twist = LowCmd(), Twist()
command.q = [0.0] * 11
twist.linear.x = "fast"
joints = JointState(position=np.arange(3, dtype=np.float32))
print(joints.position.tolist(), LowCmd(q=range(12)).q.dtype)
for message in command, twist:
    try:
        messages.serialize(message)
    except ValueError as error:
        print(error)
"""


def run(program: str) -> str:
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return result.stdout


def test_bad_values_are_accepted_on_assignment_and_named_when_sent() -> None:
    converted, first, second = run(UNCHECKED).splitlines()
    assert converted == "[0.0, 1.0, 2.0] float32"
    assert first.startswith("quadvel_msgs/msg/LowCmd cannot be sent: field 'q' holds array([0.")
    assert second.startswith("geometry_msgs/msg/Twist cannot be sent: field 'x' holds 'fast': ")


def test_type_hash_and_dds_name_are_those_of_ros() -> None:
    # As `ros2 topic info -v /cmd_vel` of Jazzy prints it.
    assert messages.type_hash("geometry_msgs/msg/Twist") == (
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
    )
    assert messages.dds_name("quadvel_msgs/srv/Push_Request") == "quadvel_msgs::srv::dds_::Push_Request_"
