"""A reverse proxy before MuJoCo's web viewer: it admits only browsers that have the page's address.

The viewer listens on every address, checks no Origin, and accepts any model that is dropped on its
page. Here it listens on a Unix socket in a folder of this user. The proxy listens on a port, and
refuses with 403

* a request without the token, which the printed address contains and a cookie keeps;
* a Host other than the page's (DNS rebinding), and an Origin other than the Host (another web
  page);
* uploads: every method except GET, and every WebSocket except the two that the page needs.
"""

import asyncio
import contextlib
import ipaddress
import re
import secrets
import socket
import threading
from asyncio import StreamReader, StreamWriter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from elastic_env.core.errors import ConfigurationError, SystemFailedError, quote

LOOPBACK = "127.0.0.1"
"""Default address of a page."""

_FIRST_PORTS = range(8080, 8100)
_MAX_HEAD = 32768
"""Longest head of a request or a response [bytes]."""
_HEAD_TIMEOUT_S = 10.0
"""Time in which the head of a request must arrive [s]."""
_TOKEN = "token="
_CURE = "open the address that elastic view has printed"
_UPLOAD = "/drop"
_SOCKETS = ("/ui", "/state")
_UPGRADE = "(?i)upgrade|connection|sec-websocket-(key|version|protocol|extensions)"
"""Headers that open a WebSocket, which the viewer gets."""
_PRIVACY_HEADERS = (
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
)
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[^\[\]:@/\s]+)(:(?P<port>\d+))?")
_CONNECTION_ERRORS = (asyncio.IncompleteReadError, TimeoutError, OSError)


class RefusedError(Exception):
    """A request that the page refuses, with the reason as text."""


@dataclass(frozen=True)
class Head:
    """The first line and the headers of a request or a response.

    Attributes:
        line: The first line.
        headers: Names and values, in order.
    """

    line: str
    headers: Sequence[tuple[str, str]]

    @staticmethod
    def parse(data: bytes) -> "Head":
        """Parse a received head, with the empty line at its end.

        Raises:
            RefusedError: A header is malformed.
        """
        line, *others = data.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
        headers = []
        for other in others:
            name, colon, value = other.partition(":")
            if not colon or not name or name != name.strip():
                raise RefusedError("a header is malformed")
            headers.append((name, value.strip()))
        return Head(line, headers)

    def values(self, name: str) -> list[str]:
        """All values of a header."""
        return [value for other, value in self.headers if other.lower() == name.lower()]

    def encode(self) -> bytes:
        """Encode the head for sending."""
        lines = [self.line, *(f"{name}: {value}" for name, value in self.headers)]
        return "\r\n".join([*lines, "", ""]).encode("latin-1")


@dataclass(frozen=True)
class AdmittedRequest:
    """A request that may pass.

    Attributes:
        path: Requested path, without the token.
        is_socket: True if it opens a WebSocket.
        has_address: True if its address has the token, as in the first request of a page.
    """

    path: str
    is_socket: bool
    has_address: bool


@dataclass(frozen=True)
class Access:
    """Address of a page, and rules of access to it.

    Attributes:
        host: Address or name at which the page listens, as given by the user.
        port: Port of the page.
        token: Secret that the address contains.
    """

    host: str
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def address(self) -> str:
        """Address that a browser opens."""
        name = socket.gethostname() if self._is_everywhere else self.host
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self.port}/?{_TOKEN}{self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie, with the port: browsers send cookies to all ports of a host."""
        return f"elastic_view_{self.port}"

    @property
    def is_local(self) -> bool:
        """True if only programs on this machine reach the page."""
        if self.host.lower() == "localhost":
            return True
        return _is_address(self.host) and ipaddress.ip_address(self.host).is_loopback

    @property
    def _is_everywhere(self) -> bool:
        return self.host in ("", "0.0.0.0", "::")

    def admit(self, request: Head) -> AdmittedRequest:
        """Check a request.

        Raises:
            RefusedError: It is not for this page, or comes from another one.
        """
        method, _, rest = request.line.partition(" ")
        target, _, version = rest.partition(" ")
        path, _, query = target.partition("?")
        is_http = version in ("HTTP/1.1", "HTTP/1.0") and target.startswith("/")
        _require(is_http, "the request is malformed")
        self._require_own_host(request)
        parts = [part for part in query.split("&") if part]
        others = [part for part in parts if not part.startswith(_TOKEN)]
        has_address = self._has_token(parts, _TOKEN)
        cookies = ";".join(request.values("Cookie")).split(";")
        has_cookie = self._has_token(map(str.strip, cookies), f"{self.cookie}=")
        _require(has_address or has_cookie, f"the token is missing: {_CURE}")
        is_socket = bool(request.values("Upgrade"))
        _require(path.rstrip("/").lower() != _UPLOAD, "this page takes no uploads")
        has_body = any(map(request.values, ("Content-Length", "Transfer-Encoding")))
        is_download = method == "GET" and not has_body
        _require(is_download, "this page only answers GET without a body")
        is_known = not is_socket or path in _SOCKETS
        _require(is_known, f"WebSockets are {', '.join(_SOCKETS)}")
        query = f"?{'&'.join(others)}" if others else ""
        return AdmittedRequest(path + query, is_socket, has_address)

    def _require_own_host(self, request: Head) -> None:
        """Check that Host and Origin are those of the page.

        Raises:
            RefusedError: One of them is not.
        """
        hosts = [host.lower() for host in request.values("Host")]
        origins = [origin.lower() for origin in request.values("Origin")]
        is_own = len(hosts) == 1 and self._is_own(hosts[0])
        _require(is_own, f"the Host is not this page's: {_CURE}")
        is_here = origins in ([], [f"http://{hosts[0]}"])
        _require(is_here, "the request comes from another page")

    def _is_own(self, host: str) -> bool:
        """Return True if a Host is one of the names of the page, with its port."""
        match = _HOST.fullmatch(host)
        if match is None or int((match["port"] or "80")[:6]) != self.port:
            return False
        name = match["name"].strip("[]")
        if self._is_everywhere and _is_address(name):
            return True  # DNS rebinding needs a name, and this is an address
        names = {self.host.lower()}
        if self.is_local or self._is_everywhere:
            names |= {"localhost", LOOPBACK, "::1"}
        if not self.is_local:
            names |= {socket.gethostname().lower()}
        return name in names

    def _has_token(self, parts: Iterable[str], prefix: str) -> bool:
        """Return True if one of some parts is the prefix with the token."""
        expected = f"{prefix}{self.token}".encode()
        return any(secrets.compare_digest(part.encode(), expected) for part in parts)


def _require(condition: bool, reason: str) -> None:
    """Refuse a request for a reason unless a condition holds."""
    if not condition:
        raise RefusedError(reason)


def _is_address(name: str) -> bool:
    """Return True if a name is an IP address."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def open_listener(host: str = LOOPBACK, port: int = 0) -> socket.socket:
    """Open a socket that listens for browsers.

    Args:
        host: Address or name of this machine; "0.0.0.0" or "::" for all its addresses.
        port: Port of the socket; 0 takes the first free one from 8080 on.

    Raises:
        ConfigurationError: The host is invalid.
        SystemFailedError: The port is in use, or this machine does not have the address.
    """
    kind = {"type": socket.SOCK_STREAM, "flags": socket.AI_PASSIVE}
    try:
        family = socket.getaddrinfo(host or None, port, **kind)[0][0]
    except (socket.gaierror, UnicodeError):
        raise ConfigurationError(
            f"--host must be an address or a name of this machine, such as {LOOPBACK},"
            f" got {quote(host)}"
        ) from None
    problem = OSError()
    has_both = host == "::"
    for candidate in [port] if port else [*_FIRST_PORTS, 0]:
        try:
            return socket.create_server((host, candidate), family=family, dualstack_ipv6=has_both)
        except OSError as error:
            problem = error
    raise SystemFailedError(
        f"the page cannot listen at {quote(host)}, port {port}: {problem.strerror};"
        " name another --port, or 0 for a free one"
    ) from None


class Proxy:
    """Answers browsers in a thread, until it is closed.

    Args:
        listener: Socket for browsers, see `open_listener`.
        viewer: Path of the Unix socket of the viewer.
        access: Rules of access.
    """

    def __init__(self, listener: socket.socket, viewer: str, access: Access) -> None:
        self._listener = listener
        self._viewer = viewer
        self._access = access
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        """Run the server in the thread."""
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(asyncio.start_server(self._answer, sock=self._listener, limit=_MAX_HEAD))
            self._loop.run_forever()

    async def _answer(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Answer a connection, which has one request."""
        with contextlib.suppress(*_CONNECTION_ERRORS):
            try:
                request = await _read_head(reader)
                admitted = self._access.admit(request)
            except RefusedError as error:
                writer.write(_refusal(str(error)))
                await writer.drain()
            else:
                await self._forward(request, admitted, reader, writer)
        writer.close()

    async def _forward(
        self, request: Head, admitted: AdmittedRequest, reader: StreamReader, writer: StreamWriter
    ) -> None:
        """Forward a request to the viewer and its answer to the browser, until one side closes."""
        viewer, to_viewer = await asyncio.open_unix_connection(self._viewer, limit=_MAX_HEAD)
        try:
            to_viewer.write(_viewer_head(request, admitted).encode())
            answer = Head.parse(await viewer.readuntil(b"\r\n\r\n"))
            writer.write(self._browser_head(answer, admitted).encode())
            copies = [asyncio.ensure_future(_copy(viewer, writer))]
            if admitted.is_socket:
                copies.append(asyncio.ensure_future(_copy(reader, to_viewer)))
            try:
                await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in copies:
                    task.cancel()
                await asyncio.gather(*copies, return_exceptions=True)
        finally:
            to_viewer.close()

    def _browser_head(self, answer: Head, admitted: AdmittedRequest) -> Head:
        """Head of an answer that no other page may read; the first one sets the cookie."""
        headers = [pair for pair in answer.headers if not _is_sharing(pair[0])]
        headers += _PRIVACY_HEADERS
        if not admitted.is_socket:
            headers = [pair for pair in headers if pair[0].lower() != "connection"]
            headers.append(("Connection", "close"))
        if admitted.has_address:
            pair = f"{self._access.cookie}={self._access.token}"
            headers.append(("Set-Cookie", f"{pair}; Path=/; HttpOnly; SameSite=Strict"))
        return Head(answer.line, headers)


async def _read_head(reader: StreamReader) -> Head:
    """Read the head of a request.

    Raises:
        RefusedError: It is too long or malformed.
    """
    try:
        async with asyncio.timeout(_HEAD_TIMEOUT_S):
            return Head.parse(await reader.readuntil(b"\r\n\r\n"))
    except asyncio.LimitOverrunError:
        raise RefusedError(f"a request may have {_MAX_HEAD} bytes of headers") from None


def _viewer_head(request: Head, admitted: AdmittedRequest) -> Head:
    """Head of a request for the viewer: without token, cookies and Origin."""
    headers = [("Host", "viewer")]
    if admitted.is_socket:
        headers += [pair for pair in request.headers if re.fullmatch(_UPGRADE, pair[0])]
    return Head(f"GET {admitted.path} HTTP/1.1", headers)


def _is_sharing(name: str) -> bool:
    """Return True if a header of the viewer lets other pages read an answer."""
    name = name.lower()
    return name.startswith("access-control-") or name == "cross-origin-resource-policy"


def _refusal(reason: str) -> bytes:
    """Answer to a refused request."""
    body = f"403: {reason}\n"
    headers = [
        ("Content-Type", "text/plain; charset=utf-8"),
        ("Content-Length", str(len(body.encode()))),
        ("Connection", "close"),
        *_PRIVACY_HEADERS,
    ]
    return Head("HTTP/1.1 403 Forbidden", headers).encode() + body.encode()


async def _copy(source: StreamReader, target: StreamWriter) -> None:
    """Copy bytes until the source ends."""
    while data := await source.read(_MAX_HEAD):
        target.write(data)
        await target.drain()
