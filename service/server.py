"""Running the service: one process, a socket, and word when it is ready."""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Callable

import uvicorn

from sceneprint.descriptors import raise_descriptors
from sceneprint.engine.opening import open_engine
from sceneprint.errors import UnusableStore
from sceneprint.settings import Settings
from service.app import create_app
from service.connections import Connection, make_room

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
            f"{settings.host}:{settings.port} cannot be listened on ({error.strerror}). "
            "Choose another --port, 0 for a free one, or stop what holds it."
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
    # uvicorn would make a traceback of what cannot be opened
    with open_engine(settings) as engine:
        read_only = engine.store.database.read_only
    if read_only:
        log.warning(
            "the store is read-only: queries are answered, and nothing is taken or signed",
            extra={"data": str(settings.data_dir)},
        )
    # a thread that computes gives way to the event loop after this long, not after 5 ms
    sys.setswitchinterval(0.001)
    listening = listen(settings)
    host, port = listening.getsockname()[:2]
    url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        log_config=None,  # ours is JSON
        access_log=False,  # `Around` writes one line a request
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
    _Server(config, lambda: ready(url, read_only), lambda: app.state.context.feed.close()).run(
        sockets=[listening]
    )


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
