"""The service inside a Python process, without a port, for `sceneprint_client.Client.embedded`.

httpx.Request  --LocalService-->  a socket in a private folder  -->  the application in its thread
"""

from __future__ import annotations

import itertools
import os
import socket
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

import httpx
import uvicorn
from threadpoolctl import threadpool_limits

from sceneprint.engine.context import Context
from sceneprint.engine.jobs.job_runner import JobRunner
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.settings import Settings
from service.app import create_app

#: Number of jobs after which housekeeping runs.
_UPKEEP = 256
#: Limits of an embedded service, which are never reached in practice.
_MOST_WAITING, _LONGEST_WAIT_S, _MOST_BYTES, _MOST_STREAMS = 10_000, 3600.0, 2 << 30, 10_000
#: Seconds after which an idle connection is closed, and seconds for requests in progress at the
#: end.
_KEEP_ALIVE_S, _GRACE_S = 86_400, 5


def embedded_settings(path: Path) -> Settings:
    """Return the settings of a service embedded in a process.

    All data is in the folder, regardless of the environment. The process is the only caller, so
    keys and limits are disabled, and frames are decoded without confined processes.
    """
    settings = Settings(
        data_dir=path.absolute(), database_url=None, index_dir=None,
        host="127.0.0.1", require_keys=False, cors_origins=(), tenant_requests_per_s=0,
        queued_requests=_MOST_WAITING, queue_timeout_s=_LONGEST_WAIT_S,
        max_event_streams=_MOST_STREAMS, decoders=0,
    )  # fmt: skip
    # The limit of the decoders exceeds the maximum of the setting.
    return settings.model_copy(update={"max_upload_bytes": _MOST_BYTES})


class LocalService(httpx.BaseTransport):
    """The application on a data folder, as an httpx transport. It is thread-safe, and stops at the
    latest with the program.

    Parameters
    ----------
    path : data folder, created if missing

    Raises
    ------
    UnusableStore, NewerSchema : If the store cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._name, self._jobs = f"embedded-{os.getpid()}", itertools.count(1)
        # Socket paths are limited to 103 bytes on macOS, and to 107 on Linux.
        parent = gettempdir() if len(os.fsencode(gettempdir())) <= 76 else "/tmp"
        self._folder = TemporaryDirectory("", "sceneprint-", parent)  # only this user may enter it
        address = str(Path(self._folder.name, "socket"))
        self._transport = httpx.HTTPTransport(uds=address, limits=httpx.Limits())
        self._server = _Server(embedded_settings(path), address)
        # The calling thread also computes; with one BLAS thread, the order of sums is reproducible.
        self._limits = threadpool_limits(1)
        self._thread = threading.Thread(target=self._server.run, name=self._name)
        self._thread.start()
        try:
            context = self._server.opened.result()
            self._runner, self._housekeeping = JobRunner(context), Housekeeping(context)
        except BaseException:
            self.close()
            raise

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request to the application, and return a streaming response."""
        request.headers["Host"] = "localhost"  # replace the host name in the URL of the client
        request.extensions = {}  # no timeouts, because this process computes the response
        return self._transport.handle_request(request)

    def work(self, pause_s: float) -> None:
        """Run one job, or wait for `pause_s` seconds if there is none."""
        claimed = self._runner.claim(self._name)
        if claimed is None:
            time.sleep(pause_s)
            return
        try:
            self._runner.run(claimed)
        except BaseException:  # return the job, so that it need not wait for the end of the lease
            self._runner.put_back(claimed)
            raise
        if next(self._jobs) % _UPKEEP == 0:
            self._housekeeping.run()

    def close(self) -> None:
        """End all requests and release all resources."""
        self._server.should_exit = True
        self._thread.join()
        self._transport.close()
        self._limits.restore_original_limits()
        self._folder.cleanup()


class _Server(uvicorn.Server):
    """A server that ends with the program; `opened` contains its context or its error."""

    def __init__(self, settings: Settings, address: str) -> None:
        self._app, self.opened = create_app(settings, warm=False), Future[Context]()
        super().__init__(
            uvicorn.Config(
                self._app, uds=address, http="h11", ws="none", lifespan="off", log_config=None,
                access_log=False, h11_max_incomplete_event_size=1 << 20,
                timeout_keep_alive=_KEEP_ALIVE_S, timeout_graceful_shutdown=_GRACE_S,
            )
        )  # fmt: skip

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until `should_exit` is true."""
        try:
            async with self._app.router.lifespan_context(self._app):
                await super().serve(sockets)
        except BaseException as error:
            if self.opened.done():
                raise
            self.opened.set_exception(error)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and set `opened`."""
        await super().startup(sockets)
        self.opened.set_result(self._app.state.service.context)

    async def on_tick(self, counter: int) -> bool:
        """Return whether to stop; True if the main thread ended without closing the client."""
        return await super().on_tick(counter) or not threading.main_thread().is_alive()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close event streams, which would otherwise delay the shutdown, and stop."""
        self._app.state.service.feed.close()
        await super().shutdown(sockets)
