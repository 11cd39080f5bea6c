"""The HTTP server: socket, TLS, and connections with time limits that uvicorn lacks."""

from __future__ import annotations

import asyncio
import fcntl
import gc
import logging
import math
import resource
import signal
import socket
import ssl
import struct
import sys
import termios
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from sceneprint.atomic_files import warn_if_public
from sceneprint.errors import InvalidRequest, UnusableStore
from sceneprint.process import raise_descriptors
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.database_errors import open_patiently
from service.startup import Front

if TYPE_CHECKING:
    from fastapi import FastAPI
    from uvicorn.server import ServerState

# Connections, closed if the client neither sends nor reads.
#
# uvicorn has no time limits for the head of a request and for reading a response. Proxies enforce
# stricter limits; these protect the connections and the memory of a service without a proxy.

#: Seconds between checks, and minimum number of bytes that a client must read in this time.
READING_S, READING_BYTES = 30.0, 30 << 10
#: Time limits for a connection without a complete request, and for a TLS handshake, seconds.
SILENT_S, HANDSHAKE_S = 60.0, 10.0
#: Maximum number of connections; beyond it, the connection that has been silent for longest is
#: closed.
MOST_CONNECTIONS = 1000
#: Number of file descriptors for other purposes, such as database, uploads, blobs and indexes.
OTHER_FILES = 256


class Connection(H11Protocol):
    """A connection that is closed if the client is too slow. The time to compute a response does
    not count.
    """

    _checking: asyncio.TimerHandle | None = None
    _unread_before = math.inf
    silent_since = 0.0
    #: Transport below TLS; None for plain HTTP.
    wire: asyncio.Transport | None = None

    @property
    def silent(self) -> bool:
        """Return whether no request is in progress."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def idle(self) -> bool:
        """Return whether the connection is silent and not closing."""
        return self.silent and not self.transport.is_closing()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the connection; see `close_oldest`."""
        super().connection_made(transport)
        self.silent_since = time.monotonic()
        close_oldest(self.connections, self)
        self._checking = self.loop.call_later(READING_S, self._check)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.silent_since = time.monotonic()
        super().on_response_complete()

    def resume_writing(self) -> None:
        """Record that the client has read enough of its response."""
        super().resume_writing()
        self._unread_before = math.inf

    def send_400_response(self, msg: str) -> None:
        """Refuse a request that is not HTTP; abort the connection if its response has begun."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self.transport.abort()

    def shutdown(self) -> None:
        """Finish the response in progress, or close an idle connection."""
        if self.idle and self._unread() == 0:
            self.transport.abort()  # `close` would wait for the close message of TLS
        super().shutdown()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the checks."""
        if self._checking is not None:
            self._checking.cancel()
        super().connection_lost(exc)

    def _check(self) -> None:
        """Abort the connection if the client is silent, or reads too little of its response."""
        unread = self._unread()
        if unread == 0:
            is_over = self.silent and time.monotonic() - self.silent_since > SILENT_S
        else:
            is_slow = unread > self._unread_before - READING_BYTES
            is_over = is_slow and (self.silent or self.flow.write_paused)
        if is_over:
            self.transport.abort()
            return
        self._unread_before = unread or math.inf
        self._checking = self.loop.call_later(READING_S, self._check)

    def _unread(self) -> int:
        """Return the number of unread bytes in the buffers of the process and of the kernel."""
        carried = 0 if self.wire is None else self.wire.get_write_buffer_size()
        handle = self.transport.get_extra_info("socket")
        try:
            (kernel,) = struct.unpack("i", fcntl.ioctl(handle, termios.TIOCOUTQ, bytes(4)))
        except (OSError, TypeError):  # the socket is closed
            kernel = 0
        return self.transport.get_write_buffer_size() + carried + int(kernel)


def close_oldest(connections: Iterable[object], new: object) -> None:
    """Beyond the limit, close the connection that has been silent for longest, except `new`."""
    all_ours = [each for each in connections if isinstance(each, Connection | Handshake)]
    if len(all_ours) <= connection_limit():
        return
    waiting = [connection for connection in all_ours if connection is not new and connection.idle]
    if waiting:
        min(waiting, key=lambda connection: connection.silent_since).transport.abort()


# TLS. asyncio creates a connection only after the handshake, which may take a minute, so handshakes
# would not count as connections.

#: TLS shutdown timeout of asyncio. It must not end a connection whose client still reads a
#: response, for which `Connection` has a time limit.
NEVER_S = 86_400.0


def tls_context(settings: Settings) -> ssl.SSLContext | None:
    """Return the TLS context of the service; None for plain HTTP. Raise InvalidRequest if the
    certificate or the key cannot be read, or they do not match.
    """
    if settings.tls_cert is None or settings.tls_key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION  # it costs the server more than the client
    context.set_alpn_protocols(["http/1.1"])
    try:
        # Without a password function, OpenSSL would prompt for the password of an encrypted key.
        context.load_cert_chain(settings.tls_cert, settings.tls_key, password=lambda: "")
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        raise InvalidRequest(
            f"The certificate {settings.tls_cert} and the key {settings.tls_key} cannot be used "
            f"({reason}). Set SCENEPRINT_TLS_CERT to a PEM file with the certificate and its "
            "chain, and SCENEPRINT_TLS_KEY to a PEM file with its unencrypted key."
        ) from error
    return context


class Handshake(asyncio.Protocol):
    """A connection during the TLS handshake, to which the limits of connections apply.

    Parameters
    ----------
    context : see `tls_context`
    server_state : state of uvicorn, which contains the set of all connections
    more : further arguments of uvicorn for the connection
    """

    transport: asyncio.Transport
    silent_since = 0.0

    def __init__(self, context: ssl.SSLContext, *, server_state: ServerState, **more: Any) -> None:
        self._context, self._state, self._more = context, server_state, more
        self._connections: set[Any] = server_state.connections
        self._early = bytearray()  # data that arrived before the end of `start_tls`
        self._lost = False

    @property
    def idle(self) -> bool:
        """Return whether the connection is not closing."""
        return not self.transport.is_closing()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the handshake."""
        self.transport, self.silent_since = transport, time.monotonic()
        transport.pause_reading()  # start_tls resumes reading
        self._connections.add(self)
        close_oldest(self._connections, self)
        self._task = asyncio.get_running_loop().create_task(self._agree())

    def data_received(self, data: bytes) -> None:
        """Buffer data for the connection."""
        self._early += data

    def connection_lost(self, _exc: Exception | None) -> None:
        """Mark the connection as lost."""
        self._lost = True
        self._connections.discard(self)

    def shutdown(self) -> None:
        """Abort the handshake."""
        self.transport.abort()

    async def _agree(self) -> None:
        """Perform the handshake, and pass the transport to a connection."""
        try:
            secured = await asyncio.get_running_loop().start_tls(
                self.transport, self, self._context, server_side=True,
                ssl_handshake_timeout=HANDSHAKE_S, ssl_shutdown_timeout=NEVER_S,
            )  # fmt: skip
        except OSError:  # no TLS, no common protocol, timeout or disconnect
            self.transport.abort()
            return
        finally:
            self._connections.discard(self)
        if secured is None or self._lost:
            self.transport.abort()
            return
        connection = Connection(server_state=self._state, **self._more)
        connection.wire = self.transport
        secured.set_protocol(connection)
        connection.connection_made(secured)
        if self._early:
            connection.data_received(bytes(self._early))


def connection_limit() -> int:
    """Return the maximum number of open connections."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return min(MOST_CONNECTIONS, max(soft - OTHER_FILES, 16))


log = logging.getLogger(__name__)

#: Seconds after which a computing thread releases the interpreter lock. With the default, the event
#: loop would wait too long for a dozen threads, and so would a query, which acquires the lock a
#: hundred times.
SWITCH_S = 0.0001
#: Grace period for requests in progress after the signal to stop, seconds.
GRACE_S = 20


def listen(settings: Settings) -> socket.socket:
    """Return a socket that listens on the configured address. Raise UnusableStore if the address is
    in use or does not belong to this machine.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # asyncio disables Nagle's algorithm, a delay of 40 ms, only if the protocol is specified.
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((settings.host, settings.port))
    except OSError as error:
        listening.close()
        raise UnusableStore(
            f"{settings.host}:{settings.port} is not available ({error.strerror}). Choose "
            "another --port (0 selects a free port), or stop the process that uses this port."
        ) from error
    return listening


def run(settings: Settings, ready: Callable[[str, bool], None]) -> None:
    """Serve until SIGINT or SIGTERM.

    Parameters
    ----------
    ready : function to call at the start, with the address and whether the store is read-only

    Raises
    ------
    InvalidRequest : If the certificate or the key cannot be used.
    UnusableStore, NewerSchema : If the store cannot be opened or the address is not available.
    """
    context = tls_context(settings)
    listening = listen(settings)  # listen before a data folder is created
    try:
        read_only = _require_store(settings)
    except BaseException:
        listening.close()
        raise
    warn_if_public(settings.data_dir)
    if read_only:
        log.warning(
            "the store is read-only: queries work, but nothing is stored or signed",
            extra={"data": str(settings.data_dir)},
        )
    host, port = listening.getsockname()[:2]
    scheme = "http" if context is None else "https"
    url = f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
    app = Front(settings, lambda: _load(settings), lambda: server.handle_exit(signal.SIGTERM, None))
    config = uvicorn.Config(
        app,
        log_config=None,  # our logs are JSON
        access_log=False,  # `RequestMiddleware` logs requests
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        timeout_keep_alive=30,
        http=Connection if context is None else cast(Any, partial(Handshake, context)),
        ws="none",
        h11_max_incomplete_event_size=16 << 10,
        proxy_headers=False,  # uvicorn would trust X-Forwarded-For from any local process
    )
    raise_descriptors()
    sys.setswitchinterval(SWITCH_S)
    server = _Server(config, app, lambda: ready(url, read_only))
    try:
        server.run(sockets=[listening])
    except KeyboardInterrupt:  # uvicorn raises the signal of `Front` again
        if app.error is None:
            raise
    finally:
        gc.enable()
    if app.error is not None:
        raise app.error


def _require_store(settings: Settings) -> bool:
    """Return whether the store is read-only; raise an error if it cannot be opened.

    When the application opens the store later, uvicorn would print a traceback for an error.
    """
    store = open_patiently(lambda: open_store(settings.database, settings.served_blobs))
    try:
        return store.database.read_only
    finally:
        store.close()


def _load(settings: Settings) -> FastAPI:
    """Import and return the application; exclude imported objects from garbage collection."""
    from service.app import create_app

    app = create_app(settings)
    gc.freeze()
    gc.enable()
    return app


class _Server(uvicorn.Server):
    """A server that calls `started`, and closes event streams at its shutdown."""

    def __init__(self, config: uvicorn.Config, front: Front, started: Callable[[], None]) -> None:
        super().__init__(config)
        self._front, self._started = front, started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and call `started`."""
        await super().startup(sockets)
        if self.started:
            self._started()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close event streams, which would otherwise delay the shutdown, and stop."""
        if self._front.app is not None:
            self._front.app.state.service.feed.close()
        await super().shutdown(sockets)
