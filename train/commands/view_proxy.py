"""A reverse proxy before MuJoCo's web viewer, which lets in only who has the page's own address.

The viewer listens on every address, checks no Origin, and takes any model that is dropped on its
page. Here it listens on a Unix socket in a folder of this user's. The proxy listens on a port, and
refuses with 403

* a request without the token, which the printed address carries and a cookie keeps;
* a Host that is not the page's (DNS rebinding), and an Origin that is not the Host's (another web
  page);
* uploads: every method but GET, and every WebSocket but the two that the page draws from.
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
"""The address of a page unless somebody asks for another one."""

_FIRST_PORTS = range(8080, 8100)
_LARGEST_HEAD = 32768
"""Of a request or a response [bytes]."""
_HEAD_S = 10.0
"""For a request to arrive [s]."""
_TOKEN = "token="
_CURE = "open the address that elastic view has printed"
_UPLOAD = "/drop"
_SOCKETS = ("/ui", "/state")
_UPGRADED = "(?i)upgrade|connection|sec-websocket-(key|version|protocol|extensions)"
"""Headers of a WebSocket's opening that the viewer gets."""
_PRIVATE = (
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
)
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[^\[\]:@/\s]+)(:(?P<port>\d+))?")
_CLOSED = (asyncio.IncompleteReadError, TimeoutError, OSError)


class RefusedError(Exception):
    """A request that the page does not answer; the text says why."""


@dataclass(frozen=True)
class Head:
    """The first line and the headers of a request or a response.

    Attributes:
        line: The first line.
        headers: Names and values, in their order.
    """

    line: str
    headers: Sequence[tuple[str, str]]

    @staticmethod
    def parse(data: bytes) -> "Head":
        """A head as it arrived, with the empty line at its end.

        Raises:
            RefusedError: It is none.
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
        """As it is sent."""
        lines = [self.line, *(f"{name}: {value}" for name, value in self.headers)]
        return "\r\n".join([*lines, "", ""]).encode("latin-1")


@dataclass(frozen=True)
class Asked:
    """A request that was let in.

    Attributes:
        path: What it asks for, without the token.
        is_socket: Whether it opens a WebSocket.
        has_address: Whether it has the token in its address, as the first request of a page.
    """

    path: str
    is_socket: bool
    has_address: bool


@dataclass(frozen=True)
class Access:
    """Who may see a page.

    Attributes:
        host: Where it listens, as it was asked for.
        port: Its port.
        token: What the address must carry.
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
        """Name of the cookie: browsers send cookies to all ports of a host."""
        return f"elastic_view_{self.port}"

    @property
    def is_local(self) -> bool:
        """True if only programs of this machine reach the page."""
        return _is_loopback(self.host)

    @property
    def _is_everywhere(self) -> bool:
        return self.host in ("", "0.0.0.0", "::")

    def admit(self, request: Head) -> Asked:
        """Read a request.

        Raises:
            RefusedError: It is not for this page, or not from it.
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
        query = "&".join(others)
        return Asked(f"{path}?{query}" if query else path, is_socket, has_address)

    def _require_own_host(self, request: Head) -> None:
        hosts = [host.lower() for host in request.values("Host")]
        origins = [origin.lower() for origin in request.values("Origin")]
        is_own = len(hosts) == 1 and self._is_own(hosts[0])
        _require(is_own, f"the Host is not this page's: {_CURE}")
        is_here = origins in ([], [f"http://{hosts[0]}"])
        _require(is_here, "the request comes from another page")

    def _is_own(self, host: str) -> bool:
        found = _HOST.fullmatch(host)
        if found is None or int((found["port"] or "80")[:6]) != self.port:
            return False
        name = found["name"].strip("[]")
        if self._is_everywhere and _is_address(name):
            return True  # a foreign page cannot make its own name stand for an address that is none
        names = {self.host.lower()}
        if self.is_local or self._is_everywhere:
            names |= {"localhost", LOOPBACK, "::1"}
        if not self.is_local:
            names |= {socket.gethostname().lower()}
        return name in names

    def _has_token(self, parts: Iterable[str], prefix: str) -> bool:
        """True if one of some parts is the token behind a prefix."""
        own = f"{prefix}{self.token}".encode()
        return any(secrets.compare_digest(part.encode(), own) for part in parts)


def _require(holds: bool, reason: str) -> None:
    if not holds:
        raise RefusedError(reason)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    is_name = host.lower() == "localhost"
    return is_name or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def open_listener(host: str = LOOPBACK, port: int = 0) -> socket.socket:
    """A socket that listens for browsers.

    Args:
        host: Address or name of this machine; "0.0.0.0" or "::" for all of its addresses.
        port: 0 takes the first free one from 8080 on.

    Raises:
        ConfigurationError: The host cannot be.
        SystemFailedError: The port is taken, or this machine has no such address.
    """
    kind = {"type": socket.SOCK_STREAM, "flags": socket.AI_PASSIVE}
    try:
        family = socket.getaddrinfo(host or None, port, **kind)[0][0]
    except (socket.gaierror, UnicodeError):
        raise ConfigurationError(
            f"--host must be an address or a name of this machine, such as {LOOPBACK}, got"
            f" {quote(host)}"
        ) from None
    problem = OSError()
    both = host == "::"
    for one in [port] if port else [*_FIRST_PORTS, 0]:
        try:
            return socket.create_server((host, one), family=family, dualstack_ipv6=both)
        except OSError as error:
            problem = error
    raise SystemFailedError(
        f"the page cannot listen at {quote(host)}, port {port}: {problem.strerror}; name another"
        " --port, or 0 for a free one"
    ) from None


class Proxy:
    """Answers browsers in a thread, until it is closed.

    Args:
        listener: Where browsers come in, see `open_listener`.
        viewer: Path of the Unix socket at which the viewer answers.
        access: Who is let in.
    """

    def __init__(self, listener: socket.socket, viewer: str, access: Access) -> None:
        self._listener = listener
        self._viewer = viewer
        self._access = access
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answer nobody any more."""
        with contextlib.suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        place = {"sock": self._listener, "limit": _LARGEST_HEAD}
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(asyncio.start_server(self._answer, **place))
            self._loop.run_forever()

    async def _answer(self, reader: StreamReader, writer: StreamWriter) -> None:
        """One connection, which is for one request."""
        with contextlib.suppress(*_CLOSED):
            try:
                request = await _read_head(reader)
                asked = self._access.admit(request)
            except RefusedError as error:
                writer.write(_refusal(str(error)))
                await writer.drain()
            else:
                await self._pass_on(request, asked, reader, writer)
        writer.close()

    async def _pass_on(
        self, request: Head, asked: Asked, reader: StreamReader, writer: StreamWriter
    ) -> None:
        opened = asyncio.open_unix_connection(self._viewer, limit=_LARGEST_HEAD)
        viewer, to_viewer = await opened
        try:
            to_viewer.write(_for_viewer(request, asked).encode())
            answer = Head.parse(await viewer.readuntil(b"\r\n\r\n"))
            writer.write(self._for_browser(answer, asked).encode())
            ways = [asyncio.ensure_future(_copy(viewer, writer))]
            if asked.is_socket:
                ways.append(asyncio.ensure_future(_copy(reader, to_viewer)))
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            to_viewer.close()

    def _for_browser(self, answer: Head, asked: Asked) -> Head:
        """An answer that no other page may read, and with the cookie where a page begins."""
        headers = [own for own in answer.headers if not _opens_page(own[0])]
        headers += _PRIVATE
        if not asked.is_socket:
            headers = [own for own in headers if own[0].lower() != "connection"]
            headers.append(("Connection", "close"))
        if asked.has_address:
            kept = f"{self._access.cookie}={self._access.token}"
            cookie = f"{kept}; Path=/; HttpOnly; SameSite=Strict"
            headers.append(("Set-Cookie", cookie))
        return Head(answer.line, headers)


async def _read_head(reader: StreamReader) -> Head:
    try:
        async with asyncio.timeout(_HEAD_S):
            return Head.parse(await reader.readuntil(b"\r\n\r\n"))
    except asyncio.LimitOverrunError:
        most = f"a request may have {_LARGEST_HEAD} bytes of headers"
        raise RefusedError(most) from None


def _for_viewer(request: Head, asked: Asked) -> Head:
    """A request as the viewer gets it: without token, cookies and Origin."""
    headers = [("Host", "viewer")]
    if asked.is_socket:
        headers += [own for own in request.headers if re.fullmatch(_UPGRADED, own[0])]
    return Head(f"GET {asked.path} HTTP/1.1", headers)


def _opens_page(name: str) -> bool:
    """True if a header of the viewer lets other pages read an answer."""
    name = name.lower()
    return name.startswith("access-control-") or name == "cross-origin-resource-policy"


def _refusal(reason: str) -> bytes:
    body = f"403: {reason}\n"
    headers = [
        ("Content-Type", "text/plain; charset=utf-8"),
        ("Content-Length", str(len(body.encode()))),
        ("Connection", "close"),
        *_PRIVATE,
    ]
    return Head("HTTP/1.1 403 Forbidden", headers).encode() + body.encode()


async def _copy(source: StreamReader, target: StreamWriter) -> None:
    while data := await source.read(_LARGEST_HEAD):
        target.write(data)
        await target.drain()
