"""Who may come in to the page, by the headers of a request alone. What is served there is `server`'s matter.

Three things are checked: the token where there is one; a Host that is this host's own where there is none, against names that
somebody lets point at this host; and for WebSockets an Origin that is our own page, against other pages in the browser.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

import attrs
from websockets.http11 import Request

HOST = re.compile(r"(?P<name>\[(?P<v6>[0-9A-Fa-f:.]+)\]|[\w.-]+)(?P<port>:[0-9]{1,5})?", re.ASCII)


class RequestError(Exception):
    """A request that gets no answer but this one: a status, and a sentence."""

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


@attrs.frozen
class Visitor:
    """What an accepted request asks for. name, port: of its Host header, the port with its colon, or empty."""

    path: str
    name: str
    port: str
    wants_socket: bool


@attrs.frozen
class Guard:
    """Decides who may come in.

    Attributes:
        token: What every request must show, as a cookie of any name or in its address; empty on the loopback interface, where
            other hosts do not come.
    """

    token: str

    def admit(self, request: Request) -> Visitor:
        """Check a request.

        Raises:
            RequestError: 400 where a header makes no sense, 403 for who may not come in.
        """
        visitor = _read(request)
        if self.token:
            if not any(_same(shown, self.token) for shown in self._shown(request)):
                raise _forbidden(
                    "this page needs the token that `quadvel view` printed: open the whole address"
                )
        elif not is_loopback(visitor.name.strip("[]")):
            raise _forbidden(f"this page is for this host alone, and not for '{visitor.name}'")
        if visitor.wants_socket:
            _check_origin(_single(request, "Origin"), visitor)
        return visitor

    @staticmethod
    def _shown(request: Request) -> list[str]:
        """What may be the token. Cookies of other programs on this host come along, and need not follow any standard."""
        cookies = ";".join(request.headers.get_all("Cookie")).split(";")
        return [cookie.partition("=")[2].strip() for cookie in cookies] + parse_qs(
            urlsplit(request.path).query
        ).get("token", [])


def is_loopback(host: str) -> bool:
    """Whether a name or address means this host, by its loopback interface."""
    return ipaddress.ip_address(host).is_loopback if _is_address(host) else host == "localhost"


def _read(request: Request) -> Visitor:
    host = HOST.fullmatch(_single(request, "Host"))
    if host is None or (host["v6"] and not _is_address(host["v6"])):
        raise _bad(request, "Host", "a name or an address, with a port or without")
    try:
        path = urlsplit(request.path).path
    except ValueError as error:
        raise RequestError(
            HTTPStatus.BAD_REQUEST, f"the path {request.path!a} makes no sense: {error}"
        ) from None
    wants_socket = _single(request, "Upgrade").lower() == "websocket"
    return Visitor(path, host["name"], host["port"] or "", wants_socket)


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _check_origin(origin: str, visitor: Visitor) -> None:
    """Compare as text: browsers write both headers in the same way."""
    ours = f"{visitor.name}{visitor.port}"
    if origin not in (f"http://{ours}", f"https://{ours}"):
        raise _forbidden(f"a page of {origin!a} may not connect to the page of '{ours}'")


def _single(request: Request, name: str) -> str:
    """A header that may be there once."""
    values = request.headers.get_all(name)
    if len(values) > 1:
        raise _bad(request, name, "one header")
    return values[0] if values else ""


def _same(shown: str, token: str) -> bool:
    return hmac.compare_digest(shown.encode("utf-8", "surrogateescape"), token.encode())


def _bad(request: Request, name: str, expected: str) -> RequestError:
    found = ", ".join(map(ascii, request.headers.get_all(name))) or "missing"
    return RequestError(HTTPStatus.BAD_REQUEST, f"{name} is {found}, expected {expected}")


def _forbidden(why: str) -> RequestError:
    return RequestError(HTTPStatus.FORBIDDEN, why)
