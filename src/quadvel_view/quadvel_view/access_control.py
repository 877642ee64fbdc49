"""Access control of the page's server by request headers.

It checks the token if there is one, or else that the Host is a loopback name (against DNS
rebinding); and for WebSockets that the Origin is the page itself (against cross-origin requests).
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

import attrs
from websockets.http11 import Request

HOST = re.compile(r"(?P<name>\[(?P<v6>[0-9A-Fa-f:.]+)\]|[\w.-]+)(?P<port>:[0-9]{1,5})?", re.ASCII)

HANDSHAKE_HEADERS = (
    "Connection",
    "Sec-WebSocket-Key",
    "Sec-WebSocket-Version",
    "Sec-WebSocket-Extensions",
    "Sec-WebSocket-Protocol",
)
"""Headers that websockets reads."""


DOCUMENTATION_ADDRESS = "192.0.2.1"
"""Address that no host has (RFC 5737)."""


class RequestError(Exception):
    """A rejected request.

    Attributes:
        status: The HTTP status.
    """

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


@attrs.frozen
class Visitor:
    """An accepted request.

    Attributes:
        path: The path without the query.
        name: Host name of the Host header.
        port: Port of the Host header with its colon, or "".
        wants_socket: Whether it asks for a WebSocket.
    """

    path: str
    name: str
    port: str
    wants_socket: bool


@attrs.frozen
class AccessControl:
    """Accepts or rejects requests.

    Attributes:
        token: Secret that a request must have as a cookie of any name or in its query; "" on the
            loopback interface.
    """

    token: str

    def admit(self, request: Request) -> Visitor:
        """Check a request.

        Args:
            request: The HTTP request.

        Returns:
            The accepted request.

        Raises:
            RequestError: 400 for an invalid header, 403 for a missing token, a wrong Host or a
                wrong Origin.
        """
        visitor = _parse(request)
        if self.token:
            if not any(_equal_tokens(shown, self.token) for shown in self._shown(request)):
                raise _forbidden(
                    "this page needs the token: open the full address that `quadvel view` printed"
                )
        elif not is_loopback(visitor.name.strip("[]")):
            raise _forbidden(f"host '{visitor.name}' rejected: this page accepts this computer only")
        if visitor.wants_socket:
            _check_origin(_single_header(request, "Origin"), visitor)
            _check_handshake(request)
        return visitor

    @staticmethod
    def _shown(request: Request) -> list[str]:
        """Return all cookie values and query tokens.

        Cookies of other programs on this host may violate the standard.
        """
        cookies = ";".join(request.headers.get_all("Cookie")).split(";")
        return [cookie.partition("=")[2].strip() for cookie in cookies] + parse_qs(
            urlsplit(request.path).query
        ).get("token", [])


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is that of the loopback interface.

    Args:
        host: A name or an IP address without brackets.

    Returns:
        True for "localhost" and loopback addresses.
    """
    return ipaddress.ip_address(host).is_loopback if _is_address(host) else host == "localhost"


def reachable_host(host: str) -> str:
    """Return a host under which others reach a server that listens on `host`.

    Args:
        host: A name or an IP address without brackets.

    Returns:
        `host`; for the address of all interfaces, that of the default route or the name of this host.
    """
    if not _is_address(host) or not ipaddress.ip_address(host).is_unspecified:
        return host
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((DOCUMENTATION_ADDRESS, 9))  # sends nothing, but chooses a route
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()


def _parse(request: Request) -> Visitor:
    """Parse Host, path and Upgrade of a request."""
    host = HOST.fullmatch(_single_header(request, "Host"))
    if host is None or (host["v6"] and not _is_address(host["v6"])):
        raise _bad_request(request, "Host", "a name or an address, with a port or without")
    try:
        path = urlsplit(request.path).path
    except ValueError as error:
        raise RequestError(HTTPStatus.BAD_REQUEST, f"the path {request.path!a} is invalid: {error}") from None
    wants_socket = _single_header(request, "Upgrade").lower() == "websocket"
    return Visitor(path, host["name"], host["port"] or "", wants_socket)


def _is_address(text: str) -> bool:
    """Return whether a text is an IP address."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _check_origin(origin: str, visitor: Visitor) -> None:
    """Compare Origin and Host as text: browsers write both in the same way."""
    ours = f"{visitor.name}{visitor.port}"
    if origin not in (f"http://{ours}", f"https://{ours}"):
        raise _forbidden(f"cross-origin request from {origin!a} to '{ours}' rejected")


def _check_handshake(request: Request) -> None:
    """Refuse headers on which websockets fails instead of refusing them itself."""
    for name in HANDSHAKE_HEADERS:
        if not all(value.isascii() for value in request.headers.get_all(name)):
            raise _bad_request(request, name, "ASCII text")


def _single_header(request: Request, name: str) -> str:
    """Return a header that may occur once, or ""."""
    values = request.headers.get_all(name)
    if len(values) > 1:
        raise _bad_request(request, name, "one header")
    return values[0] if values else ""


def _equal_tokens(shown: str, token: str) -> bool:
    """Compare tokens in constant time."""
    return hmac.compare_digest(shown.encode("utf-8", "surrogateescape"), token.encode())


def _bad_request(request: Request, name: str, expected: str) -> RequestError:
    """Return the error for an invalid header."""
    found = ", ".join(map(ascii, request.headers.get_all(name))) or "missing"
    return RequestError(HTTPStatus.BAD_REQUEST, f"{name} is {found}, expected {expected}")


def _forbidden(why: str) -> RequestError:
    """Return the error for a request without access."""
    return RequestError(HTTPStatus.FORBIDDEN, why)
