"""Running the service: one process, a socket, and word when it is ready."""

from __future__ import annotations

import asyncio
import fcntl
import gc
import logging
import resource
import signal
import socket
import struct
import sys
import termios
import time
import uuid
from collections.abc import Callable
from typing import TYPE_CHECKING

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from sceneprint.atomic_files import warn_if_public
from sceneprint.errors import UnusableStore
from sceneprint.process_limits import raise_descriptors
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.startup_retry import open_patiently
from service.startup import Front

if TYPE_CHECKING:
    from fastapi import FastAPI

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
        if len(self.connections) > room():
            others = [one for one in self.connections if isinstance(one, Connection)]
            waiting = [one for one in others if one is not self and one.idle]
            if waiting:
                min(waiting, key=lambda one: one.silent_since).transport.abort()
        self._time_head()

    def data_received(self, data: bytes) -> None:
        """Read on."""
        super().data_received(data)
        self._time_head()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.silent_since = time.monotonic()
        super().on_response_complete()

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
        if self.transport.get_write_buffer_size() == 0:
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
        if self._unread() > self._unread_before - READING_BYTES:
            self.transport.abort()
        else:
            self._time_reading()

    def _unread(self) -> int:
        """Bytes of answers that the other side has not taken yet: ours, and the kernel's."""
        known = self.transport.get_extra_info("socket")
        try:
            (kernel,) = struct.unpack("i", fcntl.ioctl(known, termios.TIOCOUTQ, bytes(4)))
        except (OSError, TypeError):  # closed meanwhile
            kernel = 0
        return self.transport.get_write_buffer_size() + int(kernel)


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

#: Seconds after which a thread that computes lets another go on: the event loop waits for each of
#: a dozen in turn, and answers nobody meanwhile.
SWITCH_S = 0.0005
#: Seconds that requests in flight may take after the signal to stop.
GRACE_S = 20


def listen(settings: Settings) -> socket.socket:
    """A socket on the address of the settings.

    Raises
    ------
    UnusableStore : the address is not of this machine, or taken.
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
    settings : see Settings
    ready : called once it answers, with its address, and whether its store is read-only

    Raises
    ------
    UnusableStore, NewerSchema : the store cannot be opened, or the address not listened on.
    """
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
    url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
    app = Front(settings, lambda: _load(settings), lambda: server.handle_exit(signal.SIGTERM, None))
    config = uvicorn.Config(
        app,
        log_config=None,  # ours is JSON
        access_log=False,  # `RequestMiddleware` writes one line a request
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        timeout_keep_alive=30,
        http=Connection,  # which has the limits that uvicorn lacks
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


def _load(settings: Settings) -> FastAPI:
    """The application; all that is imported stays, and need not be looked through ever again."""
    from service.app import create_app

    app = create_app(settings)
    gc.freeze()
    gc.enable()
    return app


def _close_feed(front: Front) -> None:
    if front.app is not None:
        front.app.state.context.feed.close()


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
