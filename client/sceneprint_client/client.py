"""Clients of a service: methods of Client block, methods of AsyncClient are coroutines."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
from pydantic import Field

from sceneprint_client.administration import AdminMethods
from sceneprint_client.api.base import ApiRecord
from sceneprint_client.calls import Blocking, Call, settled
from sceneprint_client.errors import MissingDependency
from sceneprint_client.http import DEFAULT_URL, ServiceConnection
from sceneprint_client.map_contents import MapMethods, SurfaceMethods
from sceneprint_client.queries import QueryMethods
from sceneprint_client.uploads import UploadMethods

if TYPE_CHECKING:
    from typing_extensions import Self

#: Timeout of requests to a service in this process, seconds.
_EMBEDDED_S = 60.0
#: URL that error messages show for a service in this process.
_EMBEDDED_URL = "http://embedded"
#: Timeout of a health check, seconds.
_HEALTHY_S = 5.0


class Status(ApiRecord):
    """State of a service."""

    version: str
    frames: dict[str, int] | None = Field(
        description="Number of frames in each state, over all maps; None if the key may not "
        "read all maps."
    )
    jobs: dict[str, int] | None = Field(
        description="Number of jobs in each state; None if the key cannot read all maps."
    )
    read_only: bool = Field(default=False, description="Whether the service rejects all changes.")


class ServiceMethods(MapMethods, SurfaceMethods, UploadMethods, QueryMethods, AdminMethods):
    """Methods of both clients."""

    def __init__(
        self, url: str = DEFAULT_URL, key: str | None = None, *, timeout_s: float = 60.0
    ) -> None:
        super().__init__(url, key, timeout_s)

    @Call
    async def status(self) -> Status:
        """Return the version, and the number of frames and jobs in each state."""
        return await self._call(Status, "GET", "/readyz")

    @Call
    async def healthy(self) -> bool:
        """Return whether the service answers a health check within 5 seconds."""
        try:
            timeout = min(self._timeout_s, _HEALTHY_S)
            response = await settled(self._http.get("/healthz", timeout=timeout))
            return response.status_code == 200 and bool(response.json()["status"] == "ok")
        except (httpx.TransportError, ValueError, KeyError, TypeError):
            return False


class AsyncClient(ServiceMethods):
    """Asynchronous client with the methods of Client, as coroutines or asynchronous iterators.

    Use it in one event loop, with `async with`. A cancelled call closes its connection and is not
    repeated; the service may have executed it. Files are read in threads.

    Parameters
    ----------
    url, key, timeout_s : see Client

    Raises
    ------
    Unreachable : If the URL is invalid. The first request shows whether a service answers.
    """

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class Client(ServiceMethods, Blocking):
    """Blocking client of a service; safe to share between threads.

    Requests are repeated after brief failures and while the service is busy. Repeating an upload
    is safe, since a map stores the same frame only once.

    Parameters
    ----------
    url : address of the service
    key : API key; None if the service requires no key
    timeout_s : maximum time without data from the service, seconds

    Raises
    ------
    Unreachable : If the URL is invalid. The first request shows whether a service answers.
    """

    @classmethod
    def embedded(cls, path: str | Path) -> Self:
        """Return a client that runs the whole service in this process, on a data folder.

        Frames are signed in this process while you wait for them (`wait`, or `upload` with
        `wait_s`). All data is in the folder, and SCENEPRINT_DATABASE_URL has no effect.
        `sceneprint serve --data` may use the folder at the same time. Until you close the client,
        BLAS and OpenMP use one thread, which makes floating-point sums reproducible.

        Parameters
        ----------
        path : data folder, created if missing

        Raises
        ------
        UnusableStore, NewerSchema : If the folder cannot be opened.
        MissingDependency : If only the client is installed, not sceneprint.
        """
        try:  # the package of the service is not a dependency of the client
            module = import_module("service.embedded")
        except ImportError as cause:
            raise MissingDependency(
                "Client.embedded runs the service in this process, and its package is not "
                f"installed ({cause}). In a clone, run: pip install ."
            ) from cause
        service = module.LocalService(Path(path))
        client = cls.__new__(cls)
        ServiceConnection.__init__(client, _EMBEDDED_URL, None, _EMBEDDED_S, service, service)
        return client

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
