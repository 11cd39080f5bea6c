"""The client robots use."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import httpx
from pydantic import Field

from sceneprint_client.administration import AdminMethods
from sceneprint_client.api.base import ApiRecord
from sceneprint_client.errors import MissingDependency
from sceneprint_client.http import DEFAULT_URL, ServiceConnection
from sceneprint_client.map_contents import MapMethods, SurfaceMethods
from sceneprint_client.queries import QueryMethods
from sceneprint_client.uploads import UploadMethods

if TYPE_CHECKING:
    from typing_extensions import Self

#: Silence that the service in this process may keep, seconds: it is not measured.
_EMBEDDED_S = 60.0
#: What the service in this process is called in messages.
_EMBEDDED_URL = "http://embedded"
#: Longest silence that a service may keep and be called healthy, seconds.
_HEALTHY_S = 5.0


class Status(ApiRecord):
    """How a service is."""

    version: str
    frames: dict[str, int] | None = Field(
        description="How many frames of all maps are in each state; None where the key may not "
        "read all maps."
    )
    jobs: dict[str, int] | None = Field(
        description="How many jobs are in each state that has any; None as `frames`."
    )
    read_only: bool = Field(default=False, description="Whether it answers, and takes nothing.")


class Client(MapMethods, SurfaceMethods, UploadMethods, QueryMethods, AdminMethods):
    """Maps, frames and queries of a service; safe to share between threads.

    Brief faults of the network and of a busy service are waited out; uploading twice is safe,
    as the same frame is kept once.

    Parameters
    ----------
    url : of the service
    key : where it asks for one
    timeout_s : longest silence of the service

    Raises
    ------
    Unreachable : the address is none; whether anybody answers there, the first call tells.
    """

    def __init__(
        self, url: str = DEFAULT_URL, key: str | None = None, *, timeout_s: float = 60.0
    ) -> None:
        super().__init__(url, key, timeout_s)

    @classmethod
    def embedded(cls, path: str | Path) -> Self:
        """Return a client without a service: everything runs in this process, on a data folder.

        Frames are signed in this process, while you wait for them (`wait`, or
        `upload` with `wait_s`). Everything is in the folder, whatever SCENEPRINT_DATABASE_URL
        says, and `sceneprint serve --data` may serve it at the same time. Until you close it,
        BLAS and OpenMP use one thread in this process, so that sums have one order.

        Parameters
        ----------
        path : the folder, created if missing

        Raises
        ------
        UnusableStore, NewerSchema : the folder cannot be opened.
        MissingDependency : only the client is installed, not sceneprint.
        """
        if find_spec("sceneprint") is None:
            raise MissingDependency(
                "Client.embedded runs the service in this process, and its package is not "
                "installed. Run: pip install sceneprint"
            )
        # by name: this package depends on nothing of ours, and loads it for those alone who ask
        service = import_module("service.embedded").LocalService(Path(path))
        client = cls.__new__(cls)
        ServiceConnection.__init__(client, _EMBEDDED_URL, None, _EMBEDDED_S, service, service)
        return client

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    def status(self) -> Status:
        """Return the version, and the number of frames and jobs in each state."""
        return self._ask(Status, "GET", "/readyz")

    def healthy(self) -> bool:
        """Return whether the service answers; asks once, with a short timeout."""
        try:
            timeout = min(self._timeout_s, _HEALTHY_S)
            response = self._http.get("/healthz", timeout=timeout)
            return response.status_code == 200 and bool(response.json()["status"] == "ok")
        except (httpx.TransportError, ValueError, KeyError, TypeError):
            return False
