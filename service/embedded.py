"""The service in this process, for `sceneprint_client.Client.embedded`: no port, no other process.

httpx.Request  --LocalService-->  the application in a thread of its own  -->  httpx.Response
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

#: Jobs after which it is looked whether an index has fallen behind.
_UPKEEP = 256
#: Seconds between two looks whether the program is about to end without closing its client.
_LOOK_S = 0.5
#: What one process has of itself: no more than its memory bounds.
_MOST_WAITING, _LONGEST_WAIT_S, _MOST_BYTES, _MOST_STREAMS = 10_000, 3600.0, 2 << 30, 10_000


def embedded_settings(path: Path) -> Settings:
    """The settings of a service that one process has for itself.

    A folder was named, so nothing goes elsewhere, whatever the environment says; nobody else
    asks, so no key is needed and nobody is sent away. Frames are the program's own, so they are
    decoded here: no other process is started.
    """
    settings = Settings(
        data_dir=path.absolute(), database_url=None, index_dir=None,
        host="127.0.0.1", require_keys=False, cors_origins=(), tenant_requests_per_s=0,
        queued_requests=_MOST_WAITING, queue_timeout_s=_LONGEST_WAIT_S,
        max_event_streams=_MOST_STREAMS, decoders=0,
    )  # fmt: skip
    # more than may be set: that is what a decoder takes
    return settings.model_copy(update={"max_upload_bytes": _MOST_BYTES})


class LocalService(httpx.BaseTransport):
    """The application on a data folder, as a transport of httpx; may be called from any thread.

    It ends with the program where nobody closes it.

    Parameters
    ----------
    path : the folder, made where missing

    Raises
    ------
    UnusableStore, NewerSchema : it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        settings = embedded_settings(path)
        self._app = create_app(settings, warm=False)
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._exchanges: dict[asyncio.Task[None], LocalExchange] = {}
        self._name = f"embedded-{os.getpid()}"
        self._jobs = itertools.count(1)
        # this thread computes as well as those of the service: sums have one order everywhere
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
        """Ask the application; the response streams."""
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
            raise httpx.RemoteProtocolError("this client was closed meanwhile", request=request)
        return httpx.Response(start["status"], headers=start["headers"], stream=exchange)

    def work(self, pause_s: float) -> None:
        """Do a job, or wait so long where there is none to do."""
        claimed = self._runner.claim(self._name)
        if claimed is None:
            time.sleep(pause_s)
            return
        try:
            self._runner.run(claimed)
        except BaseException:  # such as Ctrl-C: another need not wait for the lease to run out
            self._runner.put_back(claimed)
            raise
        if next(self._jobs) % _UPKEEP == 0:
            self._housekeeping.run()

    def close(self) -> None:
        """End all requests, and give back what was opened."""
        with suppress(RuntimeError):  # it has ended already
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
    """What the application tells the thread that asked."""

    WANTS_BODY = auto()
    START = auto()
    PART = auto()
    END = auto()


class LocalExchange(httpx.SyncByteStream):
    """One request and its response: the application on one side, who asks on the other.

    Each side waits for the other, so that neither holds more than one part of a body.

    Parameters
    ----------
    body : of the request; read in the thread that asks
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, body: Iterator[bytes]) -> None:
        self._loop, self._body = loop, body
        self._steps: SimpleQueue[tuple[_Step, Any]] = SimpleQueue()
        self._parts: asyncio.Queue[bytes | None] = asyncio.Queue()  # None: the body's end
        self._taken, self._gone = asyncio.Event(), asyncio.Event()
        self._whole = False

    # in the loop of the application

    async def receive(self) -> Message:
        """The next part of the request's body; after the last, that nobody listens any more."""
        if not (self._whole or self._gone.is_set()):
            self._steps.put((_Step.WANTS_BODY, None))
            part = await self._parts.get()
            if not self._gone.is_set():
                self._whole = part is None
                return {"type": "http.request", "body": part or b"", "more_body": not self._whole}
        await self._gone.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Message) -> None:
        """A part of the response; waits until it is taken."""
        if self._gone.is_set():
            return
        if message["type"] == "http.response.start":
            self._steps.put((_Step.START, message))
            return
        if message.get("body"):
            self._taken.clear()
            self._steps.put((_Step.PART, bytes(message["body"])))
            await self._taken.wait()
        if not message.get("more_body", False):
            self.end()

    def end(self) -> None:
        """There is no more."""
        self._steps.put((_Step.END, None))

    def leave(self) -> None:
        """Nobody listens any more."""
        self._gone.set()
        self._taken.set()
        self._parts.put_nowait(None)

    # in the thread that asks

    def start(self) -> Message | None:
        """Status and headers of the response; None where there is none."""
        step, message = self._next()
        return message if step is _Step.START else None

    def __iter__(self) -> Iterator[bytes]:
        while True:
            step, part = self._next()
            if step is _Step.END:
                return
            self._call(self._taken.set)
            yield part

    def close(self) -> None:
        """Listen no more."""
        self._call(self.leave)

    def _next(self) -> tuple[_Step, Any]:
        while True:
            step, value = self._steps.get()
            if step is not _Step.WANTS_BODY:
                return step, value
            self._call(self._parts.put_nowait, next((part for part in self._body if part), None))

    def _call(self, do: Callable[..., object], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop has ended, and nobody waits in it
            self._loop.call_soon_threadsafe(do, *arguments)


def _scope_of(request: httpx.Request) -> Scope:
    """What an ASGI application is told of a request."""
    headers = [(b"host", b"localhost")]  # whatever the client calls it
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
