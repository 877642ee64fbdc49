"""Units of a table's columns in the spellings of loggers, spreadsheets and papers."""

from __future__ import annotations

import math

import pytest

from quadvel_sysid.logs.readers.units import si_factor, split_unit

DEGREE = math.pi / 180.0
SPELLINGS: dict[str, tuple[float, str]] = {
    "torque": (1.0, "Nm|N m|N.m|N-m|N*m|N·m|N⋅m|N\\cdot m|newton metre|Newton-Meters|newtonmetres|NM|N_m"),
    "torque in thousandths": (1e-3, "mNm|mN·m|N mm|N-mm|millinewton metres|newton millimetre"),
    "angle": (1.0, "rad|rads|radian|Radians|RAD"),
    "thousandths of a radian": (1e-3, "mrad|mrads|milliradians"),
    "angle in degrees": (DEGREE, "deg|degs|deg.|degree|Degrees|°|º"),
    "speed": (
        1.0,
        "rad/s|rads/s|radians/s|radian/second|rad / sec|rad/sec.|rad*s^-1|rad s-1|rad s^-1|rad·s⁻¹|rad.s-1"
        "|rad s^{-1}|rad s**-1|rads^-1|rad s^(-1)|rad s−1|radians per second|Rad/Seconds|rad seconds^-1",
    ),
    "speed in degrees": (DEGREE, "deg/s|degrees/second|°/s|dps|deg s-1|deg·s^-1|degrees per sec|degs/sec"),
    "speed in turns": (math.pi / 30.0, "rpm|RPM|rev/min|r/min|revolutions per minute|turn/minute|rev min^-1"),
    "turns": (2.0 * math.pi, "rev|turns|revolutions|rev/s|turns/second|revs/sec"),
    "time": (1.0, "s|sec|secs|Seconds|sec."),
    "milliseconds": (1e-3, "ms|msec|msecs|millisecond|Milliseconds|millisec"),
    "microseconds": (1e-6, "us|µs|μs|usec|usecs|microseconds"),
    "nanoseconds": (1e-9, "ns|nsec|nanoseconds"),
    "minutes": (60.0, "min|mins|minute|minutes"),
    "stiffness": (1.0, "Nm/rad|N.m/rad|N·m·rad^-1|Nm rad-1|newton metres per radian|N-m/radians"),
    "damping": (1.0, "Nms/rad|N m s/rad|N.m.s/rad|N·m·s·rad⁻¹|Nm*s/rad|Nm/(rad/s)|Nm-sec/rad"),
    "voltage": (1.0, "V|volt|Volts"),
    "temperature": (1.0, "C|°C|degC|deg C|degrees Celsius|celsius"),
    "none": (1.0, "1|-"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("factor", "unit"), [(factor, unit) for factor, text in SPELLINGS.values() for unit in text.split("|")]
)
def test_every_spelling_of_a_unit_has_its_factor(factor: float, unit: str) -> None:
    assert si_factor(unit) == pytest.approx(factor)
    assert split_unit(f"q/knee [{unit}]")[1] == unit or unit == "1" or "(" in unit


@pytest.mark.parametrize(
    "unit",
    ["counts", "A", "m", "m/s", "m s-1", "rad/s^2", "rad s-2", "rad/s2", "rad.s", "1/s", "s-1", "Hz",
     "kg", "%", "", "N", "N/m", "rad s-10", "second hand", "degF", "knee", "0", "2"],
)  # fmt: skip
def test_another_unit_is_unknown(unit: str) -> None:
    assert si_factor(unit) is None
