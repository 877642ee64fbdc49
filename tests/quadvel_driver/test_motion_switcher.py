"""Requests to a robot's motion switcher, and answers that are not what they should be."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from quadvel_driver.unitree_dds.motion_switcher import Answer, Api, MotionSwitcher, read_answer
from quadvel_driver.unitree_dds.types import RequestIdentity, Response, ResponseHeader, ResponseStatus


def response(data: str, number: int = 1, api: int = Api.CHECK_MODE, code: int = 0) -> Any:
    made = Response(ResponseHeader(RequestIdentity(number, api), ResponseStatus(code)), data)
    made.sample_info = SimpleNamespace(valid_data=True)
    return made


class Bus:
    """The service's side: the requests that came, and the responses that wait."""

    def __init__(self) -> None:
        self.requests: list[Any] = []
        self.responses: list[Any] = []

    def writer(self, topic: str, kind: Any) -> Any:
        return SimpleNamespace(dds=SimpleNamespace(write=self.requests.append))

    def reader(self, topic: str, kind: Any) -> Any:
        return SimpleNamespace(dds=SimpleNamespace(take=self.take))

    def take(self, number: int) -> list[Any]:
        return self.responses


def test_only_answers_to_own_requests_count_and_each_once() -> None:
    bus = Bus()
    switcher = MotionSwitcher(bus)  # type: ignore[arg-type]
    switcher.ask(Api.CHECK_MODE)
    (request,) = bus.requests
    identity = request.header.identity
    assert (identity.api_id, request.parameter, request.header.policy.noreply) == (1001, "{}", False)
    foreign, own = response('{"name": "ai"}', identity.id + 1), response('{"name": ""}', identity.id)
    bus.responses = [foreign, own, own]
    assert switcher.answers() == [Answer(Api.CHECK_MODE, 0, "")]


@pytest.mark.parametrize(
    "data", ["", "{", "[]", "null", "7", "{}", '{"name": 3}', '{"name": null}', "[" * 4000, '"name"']
)
def test_data_that_are_no_mode_name_none(data: str) -> None:
    assert read_answer(response(data)) == Answer(Api.CHECK_MODE, 0, None)


def test_an_error_or_another_answer_names_no_mode() -> None:
    assert read_answer(response('{"name": ""}', code=3203)) == Answer(Api.CHECK_MODE, 3203, None)
    assert read_answer(response("", api=Api.RELEASE_MODE)) == Answer(Api.RELEASE_MODE, 0, None)


def test_a_response_that_cannot_be_read_does_not_end_the_link() -> None:
    bus = Bus()
    switcher = MotionSwitcher(bus)  # type: ignore[arg-type]

    def take(number: int) -> list[Any]:
        raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")

    bus.take = take  # type: ignore[method-assign]
    switcher = MotionSwitcher(bus)  # type: ignore[arg-type]
    assert switcher.answers() == []
