"""Running the service: one process, a socket, and word when it is ready."""

from __future__ import annotations

import asyncio
import fcntl
import gc
import logging
import resource
import signal
import socket
import ssl
import struct
import sys
import termios
import time
import uuid
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

# Connections: none is kept by who neither speaks nor listens.
#
# uvicorn lets the head of a request take any time, waits for ever for an answer to be read, and
# counts silent connections like busy ones: a few callers could shut all others out.

#: Seconds in which the head of a request must be whole, counted from its first byte, or from when
#: the connection was made.
HEAD_S = 10.0
#: Seconds between two looks at whether an answer is being read, and the fewest bytes between them.
READING_S, READING_BYTES = 30.0, 30 << 10
#: Connections of all callers; beyond, the one that has been silent for longest is closed.
MOST_CONNECTIONS = 1000
#: Files that are open beside them: the database, uploads, blobs, indexes.
OTHER_FILES = 256


class Connection(H11Protocol):
    """A connection that is closed where the caller keeps us waiting.

    How long an answer takes to be made is not its concern.
    """

    _head: asyncio.TimerHandle | None = None
    _reading: asyncio.TimerHandle | None = None
    _unread_before = 0
    silent_since = 0.0
    #: What carries the TLS of this connection, where it has any.
    wire: asyncio.Transport | None = None

    @property
    def silent(self) -> bool:
        """Whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def idle(self) -> bool:
        """Whether it is silent, and not being closed already."""
        return self.silent and not self.transport.is_closing()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin; where there is no room, the connection that was silent for longest makes some."""
        super().connection_made(transport)
        self.silent_since = time.monotonic()
        close_oldest(self.connections, self)
        self._time_head()

    def data_received(self, data: bytes) -> None:
        """Read on."""
        super().data_received(data)
        self._time_head()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.silent_since = time.monotonic()
        super().on_response_complete()
        # TLS says nothing of what waits below it, and waits for the other side to agree to its end
        if self.wire is not None and (self._unread() > 0 or self.transport.is_closing()):
            self._time_reading()

    def shutdown(self) -> None:
        """Stop, as the service does: what is in flight ends, what is idle is closed."""
        if self.wire is not None and self.idle:
            self.loop.call_later(FAREWELL_S, self.transport.abort)
        super().shutdown()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        for timer in (self._head, self._reading):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """So much of an answer waits to be read that no more is written until some is."""
        super().pause_writing()
        self._time_reading()

    def resume_writing(self) -> None:
        """Enough was read."""
        if self._reading is not None:
            self._reading.cancel()
            self._reading = None
        super().resume_writing()

    def timeout_keep_alive_handler(self) -> None:
        """Close what was not used again; an answer that is still being read has its time."""
        carried = 0 if self.wire is None else self.wire.get_write_buffer_size()
        if self.transport.get_write_buffer_size() + carried == 0:
            self.transport.abort()
        elif self._reading is None:
            self._time_reading()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP in the form of all refusals."""
        from service.problems import problem

        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):
            self.transport.abort()  # in the middle of an answer
            return
        request_id = uuid.uuid4().hex
        detail = f"{msg} Its head is not HTTP/1.1, or longer than 16 KiB. Check the sender."
        told = problem(request_id, "BadRequest", 400, detail)
        headers = [*told.raw_headers, (b"x-request-id", request_id.encode())]
        headers += [(b"connection", b"close"), (b"cache-control", b"no-store")]
        for event in (
            h11.Response(status_code=400, headers=headers, reason=b"Bad Request"),
            h11.Data(data=bytes(told.body)),
            h11.EndOfMessage(),
        ):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()
        if self.wire is not None:
            self._time_reading()

    def _time_head(self) -> None:
        """Have the next head timed while none is being answered; each byte is not a new start."""
        if not self.silent:
            if self._head is not None:
                self._head.cancel()
                self._head = None
        elif self._head is None:
            self._head = self.loop.call_later(HEAD_S, self.transport.abort)

    def _time_reading(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
        self._unread_before = self._unread()
        self._reading = self.loop.call_later(READING_S, self._look)

    def _look(self) -> None:
        """Whether some of the answer was read since the last look."""
        self._reading = None
        if not (self.silent or self.flow.write_paused):
            return  # it was read, and the next request came
        unread, silent_s = self._unread(), time.monotonic() - self.silent_since
        if unread == 0 and not self.transport.is_closing() and silent_s < self.timeout_keep_alive:
            return  # all of it was read, and `timeout_keep_alive_handler` is still to come
        if unread > self._unread_before - READING_BYTES:
            self.transport.abort()
        else:
            self._time_reading()

    def _unread(self) -> int:
        """Bytes of answers that the other side has not taken yet: ours, and the kernel's."""
        carried = 0 if self.wire is None else self.wire.get_write_buffer_size()
        known = self.transport.get_extra_info("socket")
        try:
            (kernel,) = struct.unpack("i", fcntl.ioctl(known, termios.TIOCOUTQ, bytes(4)))
        except (OSError, TypeError):  # closed meanwhile
            kernel = 0
        return self.transport.get_write_buffer_size() + carried + int(kernel)


def close_oldest(connections: Iterable[object], new: object) -> None:
    """Where there is no room for a new connection, close the one that was silent for longest."""
    known = [one for one in connections if isinstance(one, Connection | Handshake)]
    if len(known) <= room():
        return
    waiting = [one for one in known if one is not new and one.idle]
    if waiting:
        min(waiting, key=lambda one: one.silent_since).transport.abort()


# TLS. asyncio would make a connection of ours only after the handshake: until then nobody would
# count it, and it could take a minute.

#: Seconds that the other side may take to agree to the end of an idle connection.
FAREWELL_S = 2.0
#: asyncio would end a connection that is being closed while its last answer is still being read:
#: `Connection` looks itself whether it is.
NEVER_S = 86_400.0
#: Bytes of an answer that wait to be encrypted before no more are written, as without TLS.
UNENCRYPTED_BYTES = 64 << 10


def tls_context(settings: Settings) -> ssl.SSLContext | None:
    """Return the TLS context of the service, or None for plain HTTP; raise InvalidRequest if
    certificate or key cannot be read, or do not match.
    """
    if settings.tls_cert is None or settings.tls_key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION  # it costs us more than whoever asks for it
    context.set_alpn_protocols(["http/1.1"])
    try:
        # an encrypted key would be asked for on the terminal
        context.load_cert_chain(settings.tls_cert, settings.tls_key, password=lambda: "")
    except (OSError, ValueError) as error:  # SSLError is an OSError
        reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        raise InvalidRequest(
            f"The certificate {settings.tls_cert} and the key {settings.tls_key} cannot be used "
            f"({reason}). Set SCENEPRINT_TLS_CERT to a PEM file with the certificate and its "
            "chain, and SCENEPRINT_TLS_KEY to one with its key, not encrypted."
        ) from error
    return context


class Handshake(asyncio.Protocol):
    """A connection whose TLS is not agreed on yet, counted and timed like any other.

    Parameters
    ----------
    context : see `tls_context`
    server_state : of uvicorn, which has all connections
    more : what uvicorn makes connections with
    """

    transport: asyncio.Transport
    silent_since = 0.0

    def __init__(self, context: ssl.SSLContext, *, server_state: ServerState, **more: Any) -> None:
        self._context, self._state, self._more = context, server_state, more
        self._connections: set[Any] = server_state.connections
        self._early = bytearray()  # what came between the end of the handshake and our hearing it
        self._lost = False

    @property
    def idle(self) -> bool:
        """Whether it is not being closed already."""
        return not self.transport.is_closing()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin."""
        self.transport, self.silent_since = transport, time.monotonic()
        transport.pause_reading()  # start_tls reads on
        self._connections.add(self)
        close_oldest(self._connections, self)
        self._task = asyncio.get_running_loop().create_task(self._agree())

    def data_received(self, data: bytes) -> None:
        """Keep what the connection will read."""
        self._early += data

    def connection_lost(self, _exc: Exception | None) -> None:
        """End."""
        self._lost = True
        self._connections.discard(self)

    def shutdown(self) -> None:
        """Stop, as the service does."""
        self.transport.abort()

    async def _agree(self) -> None:
        """Agree on TLS, and hand over to a connection."""
        try:
            secured = await asyncio.get_running_loop().start_tls(
                self.transport, self, self._context, server_side=True,
                ssl_handshake_timeout=HEAD_S, ssl_shutdown_timeout=NEVER_S,
            )  # fmt: skip
        except OSError:  # no TLS, none of ours, too slow, or gone
            self.transport.abort()
            return
        finally:
            self._connections.discard(self)
        if secured is None or self._lost:
            self.transport.abort()
            return
        secured.set_write_buffer_limits(high=UNENCRYPTED_BYTES)
        connection = Connection(server_state=self._state, **self._more)
        connection.wire = self.transport
        secured.set_protocol(connection)
        connection.connection_made(secured)
        if self._early:
            connection.data_received(bytes(self._early))


def room() -> int:
    """Connections that may be open at once."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return min(MOST_CONNECTIONS, max(soft - OTHER_FILES, 16))


def make_room() -> None:
    """Let this process have as many files open as all connections need, if it may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_CONNECTIONS + OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most), hard))


log = logging.getLogger(__name__)

#: Seconds after which a thread that computes lets another go on. The event loop waits for each of
#: a dozen in turn, and answers nobody meanwhile; a query, which leaves the interpreter a hundred
#: times, waits each time that it comes back.
SWITCH_S = 0.0001
#: Seconds that requests in flight may take after the signal to stop.
GRACE_S = 20


def listen(settings: Settings) -> socket.socket:
    """Open a socket on the address of the settings; raise UnusableStore if the address is taken or
    not of this machine.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # the protocol named, or asyncio leaves Nagle on and every answer waits 40 ms for an ACK
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((settings.host, settings.port))
    except OSError as error:
        listening.close()
        raise UnusableStore(
            f"{settings.host}:{settings.port} is not available ({error.strerror}). Choose "
            "another --port, 0 for a free one, or stop the process that uses it."
        ) from error
    return listening


def run(settings: Settings, ready: Callable[[str, bool], None]) -> None:
    """Serve until SIGINT or SIGTERM.

    Parameters
    ----------
    ready : called once it answers, with its address, and whether its store is read-only

    Raises
    ------
    InvalidRequest : there is no certificate where the settings name one.
    UnusableStore, NewerSchema : the store cannot be opened, or the address not listened on.
    """
    context = tls_context(settings)
    listening = listen(settings)  # first: where it is refused, no data folder is made
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
        log_config=None,  # ours is JSON
        access_log=False,  # `RequestMiddleware` writes one line a request
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        timeout_keep_alive=30,
        # which has the limits that uvicorn lacks
        http=Connection if context is None else secured(context),
        ws="none",
        h11_max_incomplete_event_size=16 << 10,
        proxy_headers=False,  # uvicorn would believe X-Forwarded-For of whoever is on this machine
    )
    raise_descriptors()
    sys.setswitchinterval(SWITCH_S)
    make_room()
    server = _Server(config, lambda: ready(url, read_only), lambda: _close_feed(app))
    try:
        server.run(sockets=[listening])
    except KeyboardInterrupt:  # uvicorn raises the signal again by which `Front` stopped it
        if app.error is None:
            raise
    finally:
        gc.enable()
    if app.error is not None:
        raise app.error


def _require_store(settings: Settings) -> bool:
    """See that the store can be opened, before anything is answered; whether it is read-only.

    The application opens it once more: uvicorn would make a traceback of what cannot be opened.
    """
    store = open_patiently(lambda: open_store(settings.database, settings.served_blobs))
    try:
        return store.database.read_only
    finally:
        store.close()


def secured(context: ssl.SSLContext) -> type[asyncio.Protocol]:
    """What uvicorn makes of a connection, where it speaks TLS."""
    return cast("type[asyncio.Protocol]", partial(Handshake, context))


def _load(settings: Settings) -> FastAPI:
    """The application; all that is imported stays, and need not be looked through ever again."""
    from service.app import create_app

    app = create_app(settings)
    gc.freeze()
    gc.enable()
    return app


def _close_feed(front: Front) -> None:
    if front.app is not None:
        front.app.state.service.feed.close()


class _Server(uvicorn.Server):
    """A server that says when it has started, and when it is about to stop."""

    def __init__(
        self, config: uvicorn.Config, started: Callable[[], None], stopping: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._started, self._stopping = started, stopping

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and say so."""
        await super().startup(sockets)
        if self.started:
            self._started()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop; streams of events would else be waited for like any other answer."""
        self._stopping()
        await super().shutdown(sockets)
