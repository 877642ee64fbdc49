"""Tests that names, parameters and defaults are those of rclpy 7.1.3 (Jazzy) or unsupported."""

import importlib
import inspect
import json
from pathlib import Path

import pytest

from quadvel_dds import UnsupportedError
from quadvel_dds.errors import Partial

API = json.loads((Path(__file__).parent / "rclpy_api.json").read_text())["modules"]


def parameters_of(function: object) -> str:
    """Parameters and defaults in the form of rclpy_api.json."""
    text = []
    signature = inspect.signature(function)
    for parameter in signature.parameters.values():
        if parameter.kind == parameter.KEYWORD_ONLY and "*" not in text:
            text.append("*")
        default = parameter.default
        if default is parameter.empty:
            stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
            text.append(stars + parameter.name)
            continue
        shown = default.__name__ if isinstance(default, type) else repr(default)
        if type(default).__name__ == "ClockType":
            shown = f"ClockType.{default.name}"
        if type(default).__name__ == "QoSProfile":
            shown = "QoSProfile"
        text.append(f"{parameter.name}={shown}")
    return ", ".join(text)


def functions() -> list[tuple[str, str, str]]:
    return [
        (module, name, s) for module, names in API.items() for name, s in names.items() if isinstance(s, str)
    ]


def members() -> list[tuple[str, str, str, str]]:
    return [
        (module, name, member, expected)
        for module, names in API.items()
        for name, contents in names.items()
        if isinstance(contents, dict)
        for member, expected in contents.items()
        if member not in ("bases", "is a", "members") and not expected.startswith("self, /")
    ]


@pytest.mark.parametrize(("module", "name", "expected"), functions())
def test_function_or_value_is_offered_as_in_rclpy(module: str, name: str, expected: str) -> None:
    found = getattr(importlib.import_module(module), name)
    if expected != "value":
        assert parameters_of(found) == expected


@pytest.mark.parametrize(("module", "name", "member", "expected"), members())
def test_member_is_as_in_rclpy_or_says_that_it_is_not_offered(
    module: str, name: str, member: str, expected: str
) -> None:
    cls = getattr(importlib.import_module(module), name)
    found = inspect.getattr_static(cls, "__init__" if member == "init" else member, None)
    if found is None:
        assert expected == "property" or issubclass(cls, Partial)
    elif isinstance(found, property):
        assert expected == "property"
    else:
        found = getattr(found, "__func__", found)
        assert parameters_of(found).removeprefix("cls, ") == expected


def test_enumerations_have_the_members_of_rclpy() -> None:
    for module, names in API.items():
        for name, contents in names.items():
            if isinstance(contents, dict) and "members" in contents:
                found = getattr(importlib.import_module(module), name)
                assert list(found.__members__) == contents["members"], name


def test_exceptions_are_exceptions() -> None:
    for module, names in API.items():
        for name, contents in names.items():
            if isinstance(contents, dict) and "is a" in contents:
                assert issubclass(getattr(importlib.import_module(module), name), Exception), name


def test_a_member_that_is_not_offered_says_so_and_is_missing_to_those_who_look_for_it() -> None:
    from rclpy.clock import Clock

    with pytest.raises(UnsupportedError, match=r"Clock\.sleep_for is not offered"):
        Clock().sleep_for(None)
    assert not hasattr(Clock(), "create_jump_callback")


def test_what_is_not_offered_says_so() -> None:
    import rclpy

    with pytest.raises(UnsupportedError, match=r"rclpy\.action is not offered"):
        importlib.import_module("rclpy.action")
    with pytest.raises(UnsupportedError, match=r"rclpy\.spin_some is not offered"):
        _ = rclpy.spin_some
    with pytest.raises(UnsupportedError, match=r"rclpy\.qos\.qos_check_compatible"):
        from rclpy.qos import qos_check_compatible  # noqa: F401


def test_a_module_that_is_not_offered_is_missing_to_those_who_look_for_it() -> None:
    with pytest.raises(ImportError, match=r"rclpy\.experimental is not offered"):
        importlib.import_module("rclpy.experimental")
