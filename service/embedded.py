"""The service inside a Python process, without a port, for `sceneprint_client.Client.embedded`.

httpx.Request  --LocalService-->  the application in its own thread  -->  httpx.Response
"""

from __future__ import annotations

import asyncio
import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from enum import Enum, auto
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import httpx
from starlette.types import Message, Scope
from threadpoolctl import threadpool_limits

from sceneprint.engine.context import Context
from sceneprint.engine.jobs.job_runner import JobRunner
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.settings import Settings
from service.app import create_app

#: Number of jobs after which housekeeping runs.
_UPKEEP = 256
#: Interval of checks whether the main thread has ended without closing the client, seconds.
_LOOK_S = 0.5
#: Limits of an embedded service; only memory limits its own process.
_MOST_WAITING, _LONGEST_WAIT_S, _MOST_BYTES, _MOST_STREAMS = 10_000, 3600.0, 2 << 30, 10_000


def embedded_settings(path: Path) -> Settings:
    """Return the settings of a service for one process.

    All data goes to the folder, whatever the environment says. No key is needed and nothing is
    limited, because the process is the only caller. Frames come from the process itself, so they
    are decoded in it, without another process.
    """
    settings = Settings(
        data_dir=path.absolute(), database_url=None, index_dir=None,
        host="127.0.0.1", require_keys=False, cors_origins=(), tenant_requests_per_s=0,
        queued_requests=_MOST_WAITING, queue_timeout_s=_LONGEST_WAIT_S,
        max_event_streams=_MOST_STREAMS, decoders=0,
    )  # fmt: skip
    # This exceeds the maximum of the setting; it is the limit of the decoders.
    return settings.model_copy(update={"max_upload_bytes": _MOST_BYTES})


class LocalService(httpx.BaseTransport):
    """The application on a data folder, as a transport of httpx. It is thread-safe, and stops with
    the program if nobody closes it.

    Parameters
    ----------
    path : data folder, created if missing

    Raises
    ------
    UnusableStore, NewerSchema : If the store cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        settings = embedded_settings(path)
        self._app = create_app(settings, warm=False)
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._exchanges: dict[asyncio.Task[None], LocalExchange] = {}
        self._name = f"embedded-{os.getpid()}"
        self._jobs = itertools.count(1)
        # The calling thread also computes; one BLAS thread keeps the order of sums the same.
        self._limits = threadpool_limits(1)
        opened: Future[Context] = Future()
        self._thread = threading.Thread(target=self._serve, args=(opened,), name=self._name)
        self._thread.start()
        try:
            context = opened.result()
            self._runner, self._housekeeping = JobRunner(context), Housekeeping(context)
        except BaseException:
            self.close()
            raise

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request to the application, and return a streaming response."""
        exchange = LocalExchange(self._loop, iter(request.stream))  # type: ignore[arg-type]
        answering = self._answer(_scope_of(request), exchange)
        try:
            asyncio.run_coroutine_threadsafe(answering, self._loop)
        except RuntimeError as error:  # the loop is closed
            answering.close()
            raise httpx.ConnectError("this client is closed", request=request) from error
        try:
            start = exchange.start()
        except BaseException:
            exchange.close()
            raise
        if start is None:
            raise httpx.RemoteProtocolError(
                "this client was closed in the meantime", request=request
            )
        return httpx.Response(start["status"], headers=start["headers"], stream=exchange)

    def work(self, pause_s: float) -> None:
        """Run one job, or wait for `pause_s` seconds if there is none."""
        claimed = self._runner.claim(self._name)
        if claimed is None:
            time.sleep(pause_s)
            return
        try:
            self._runner.run(claimed)
        except BaseException:  # such as Ctrl-C: other workers need not wait until the lease expires
            self._runner.put_back(claimed)
            raise
        if next(self._jobs) % _UPKEEP == 0:
            self._housekeeping.run()

    def close(self) -> None:
        """End all requests and release all resources."""
        with suppress(RuntimeError):  # the loop has already stopped
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()
        self._limits.restore_original_limits()

    def _serve(self, opened: Future[Context]) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._live(opened))

    async def _live(self, opened: Future[Context]) -> None:
        try:
            async with self._app.router.lifespan_context(self._app):
                opened.set_result(self._app.state.service.context)
                while not self._stop.is_set() and threading.main_thread().is_alive():
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._stop.wait(), _LOOK_S)
                for exchange in self._exchanges.values():
                    exchange.leave()
                if self._exchanges:
                    await asyncio.wait(self._exchanges)
        except BaseException as error:
            if opened.done():
                raise
            opened.set_exception(error)

    async def _answer(self, scope: Scope, exchange: LocalExchange) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._exchanges[task] = exchange
        try:
            await self._app(scope, exchange.receive, exchange.send)
        except Exception:
            pass
        finally:
            exchange.end()
            del self._exchanges[task]


class _Step(Enum):
    """Messages from the application to the calling thread."""

    WANTS_BODY = auto()
    START = auto()
    PART = auto()
    END = auto()


class LocalExchange(httpx.SyncByteStream):
    """One request and its response, between the application and the calling thread.

    Each side waits for the other, so neither holds more than one part of a body.

    Parameters
    ----------
    loop : event loop of the application
    body : body of the request, read in the calling thread
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, body: Iterator[bytes]) -> None:
        self._loop, self._body = loop, body
        self._steps: SimpleQueue[tuple[_Step, Any]] = SimpleQueue()
        self._parts: asyncio.Queue[bytes | None] = asyncio.Queue()  # None: the body's end
        self._consumed, self._gone = asyncio.Event(), asyncio.Event()
        self._whole = False

    # Methods for the event loop of the application.

    async def receive(self) -> Message:
        """Return the next part of the request's body; after the last, wait for the disconnect."""
        if not (self._whole or self._gone.is_set()):
            self._steps.put((_Step.WANTS_BODY, None))
            part = await self._parts.get()
            if not self._gone.is_set():
                self._whole = part is None
                return {"type": "http.request", "body": part or b"", "more_body": not self._whole}
        await self._gone.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Message) -> None:
        """Pass a part of the response to the caller, and wait until the caller has read it."""
        if self._gone.is_set():
            return
        if message["type"] == "http.response.start":
            self._steps.put((_Step.START, message))
            return
        if message.get("body"):
            self._consumed.clear()
            self._steps.put((_Step.PART, bytes(message["body"])))
            await self._consumed.wait()
        if not message.get("more_body", False):
            self.end()

    def end(self) -> None:
        """Mark the end of the response."""
        self._steps.put((_Step.END, None))

    def leave(self) -> None:
        """Disconnect the caller."""
        self._gone.set()
        self._consumed.set()
        self._parts.put_nowait(None)

    # Methods for the calling thread.

    def start(self) -> Message | None:
        """Return the status and headers of the response; None if there is no response."""
        step, message = self._next()
        return message if step is _Step.START else None

    def __iter__(self) -> Iterator[bytes]:
        while True:
            step, part = self._next()
            if step is _Step.END:
                return
            self._call(self._consumed.set)
            yield part

    def close(self) -> None:
        """Stop reading the response."""
        self._call(self.leave)

    def _next(self) -> tuple[_Step, Any]:
        while True:
            step, value = self._steps.get()
            if step is not _Step.WANTS_BODY:
                return step, value
            self._call(self._parts.put_nowait, next((part for part in self._body if part), None))

    def _call(self, do: Callable[..., object], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop has stopped
            self._loop.call_soon_threadsafe(do, *arguments)


def _scope_of(request: httpx.Request) -> Scope:
    """Return the ASGI scope of a request."""
    headers = [(b"host", b"localhost")]  # in place of the host name that the client uses
    headers += [
        (name.lower(), value) for name, value in request.headers.raw if name.lower() != b"host"
    ]
    return {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "method": request.method,
        "scheme": "http",
        "path": request.url.path,
        "raw_path": request.url.raw_path.partition(b"?")[0],
        "query_string": request.url.query,
        "root_path": "",
        "headers": headers,
        "client": ("127.0.0.1", 0),
        "server": ("localhost", 80),
    }
