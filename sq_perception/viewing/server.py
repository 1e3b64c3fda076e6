"""The web server of the page: viser's, on a port that is ours, closed to other web pages and to the internet.

viser accepts a WebSocket from everywhere and offers to open a tunnel to a public server.  A page on the internet that
the user has open could so change the parameters of a node on this machine.  Here

- the port is bound before viser starts, so that one that is taken is an error and never another port;
- a request whose Host is a name that is neither localhost nor this machine's is refused: a name of the internet that
  resolves to this machine (DNS rebinding) is of no use to anybody;
- a WebSocket whose Origin is another page than the one that was served here is refused;
- the page is served with a policy that keeps the browser from loading anything from elsewhere;
- no tunnel is opened, whoever asks.

The one place where viser is not taken as it comes is its call of ``websockets.asyncio.server.serve``: there is no
option for these checks.  If a later viser does not make that call, nothing is served (:class:`ServerError`).
"""

from __future__ import annotations

import contextlib
import errno
import http
import ipaddress
import os
import re
import socket
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import rich
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Response

PORT = 8080
PORTS_TRIED = 10
"""Where no port was asked for: PORT and those after it."""
_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' data: blob:; "
    "style-src 'self' 'unsafe-inline' data: blob:; connect-src 'self' {sockets} data: blob:; "
    "worker-src 'self' data: blob:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
)
_HOST = re.compile(r"(?P<name>[A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\])(:\d{1,5})?")
_starting = threading.Lock()


class ServerError(OSError):
    """The page cannot be served; the message has the reason."""


class PageServer(viser.ViserServer):
    """viser's server; see the module."""

    connections: weakref.WeakSet[Any]
    """Open websockets; set by :func:`serve`."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: no tunnel to the internet."""
        return None

    def stop(self) -> None:
        """Stop serving, at once: viser would wait for a browser to take what was drawn, or to ask for something."""
        loop = self.get_event_loop()
        for connection in list(self.connections):
            # The loop may have ended.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(connection.transport.abort)
        super().stop()


def listening_socket(host: str, port: int | None) -> socket.socket:
    """A socket bound to the address; port None: PORT or one of the next, 0: any free one.

    Raises
    ------
    ServerError
        If the port is taken or must not be used, or the host is not an address of this machine.
    """
    tried = range(PORT, PORT + PORTS_TRIED) if port is None else (port,)
    reason = ""
    for number in tried:
        try:
            family = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0][0]
        except (OSError, UnicodeError) as error:
            raise ServerError(f"--host: expected an address of this machine, got {host!r} ({error})") from error
        try:
            return socket.create_server((host, number), family=family, dualstack_ipv6=family == socket.AF_INET6)
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise ServerError(f"--host: expected an address of this machine, got {host!r}") from error
            reason = os.strerror(error.errno or 0)
    what = f"{PORT} to {PORT + PORTS_TRIED - 1}" if port is None else str(port)
    hint = "give another --port" if port is None else f"give another --port, or none to take the first free from {PORT}"
    raise ServerError(f"--port: {what} of {host} cannot be used ({reason}); {hint}")


def serve(bound: socket.socket) -> PageServer:
    """Start the server on a bound socket.

    Raises
    ------
    ServerError
        If viser could not be guarded; then nothing is served.
    """
    # viser prints a panel at the start and a line at the end.
    rich.get_console().quiet = True
    host, port = bound.getsockname()[:2]
    with _guarding(bound) as (was_called, connections):
        server = PageServer(host=host, port=port, verbose=False)
    server.connections = connections
    if not was_called():
        server.stop()
        raise ServerError(f"viser {viser.__version__} starts its server in another way than is guarded here")
    return server


def refusal(headers: Mapping[str, str], own_names: frozenset[str]) -> str:
    """Why a request with these headers is refused; empty if it is not.

    ``own_names`` are names of this machine, in lower case, besides localhost and addresses.
    """
    host = headers.get("Host", "")
    found = _HOST.fullmatch(host)
    name = "" if found is None else found["name"].strip("[]").lower()
    if not (name == "localhost" or name in own_names or _address(name)):
        return f"Host {host!r} is no name of this machine"
    origin = headers.get("Origin")
    if origin is not None and origin.partition("://")[2].lower() != host.lower():
        return f"a page of {origin!r} must not talk to this one"
    return ""


def is_local(host: str) -> bool:
    """Whether an address to bind to can only be reached from this machine."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def url(bound: socket.socket) -> str:
    """Where a browser of this machine finds what is served on a bound socket."""
    host, port = bound.getsockname()[:2]
    shown = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host  # noqa: S104
    return f"http://{shown}:{port}"


def own_names() -> frozenset[str]:
    """Names that this machine gives itself, with and without .local."""
    name = socket.gethostname().lower()
    return frozenset({name, name.split(".")[0], f"{name.split('.')[0]}.local"} - {""})


@contextlib.contextmanager
def _guarding(bound: socket.socket) -> Iterator[tuple[Callable[[], bool], weakref.WeakSet[Any]]]:
    """While this lasts, a WebSocket server that is started takes ``bound`` and checks its requests.

    Gives whether one was started, and a set that its connections will be in.
    """
    connections: weakref.WeakSet[Any] = weakref.WeakSet()
    original = websockets.asyncio.server.serve
    called = threading.Event()
    names = own_names()

    class Noted(ServerConnection):
        def connection_made(self, transport: Any) -> None:
            # Browsers also open connections on which they may never ask for anything.
            super().connection_made(transport)
            connections.add(self)

    def guarded(handler: Any, _host: Any, _port: Any, *, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            why = refusal(request.headers, names)
            if why:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {why}.\n")
            response = process_request(connection, request)
            if isinstance(response, Response):
                host = request.headers["Host"]
                response.headers["Content-Security-Policy"] = _POLICY.format(sockets=f"ws://{host} wss://{host}")
                response.headers["X-Content-Type-Options"] = "nosniff"
                response.headers["Referrer-Policy"] = "no-referrer"
            return response

        called.set()
        return original(handler, sock=bound, process_request=process, create_connection=Noted, **options)

    with _starting:
        websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield called.is_set, connections
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[misc]


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The address that is written so; None for a name."""
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
