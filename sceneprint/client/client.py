"""The client robots use."""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType

from sceneprint.client.asking import Asking
from sceneprint.client.associations import Associations
from sceneprint.client.backend import Backend, Status
from sceneprint.client.frames import checked, sendable
from sceneprint.client.ingest import Ingest
from sceneprint.client.jobs import Jobs
from sceneprint.client.kept import Kept
from sceneprint.client.keys import Keys
from sceneprint.client.operations import Operations
from sceneprint.client.outputs import Outputs
from sceneprint.client.reconstructions import Reconstructions
from sceneprint.client.snapshots import Snapshots
from sceneprint.client.waiting import settle
from sceneprint.datasets import FrameReference
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import (
    Added,
    Frame,
    FrameMeta,
    Map,
    NewMap,
)
from sceneprint.schemas.frames import MOST_PRIORITY
from sceneprint.schemas.novelty import novelty_of

DEFAULT_URL = "http://127.0.0.1:8008"


class Client(
    Jobs,
    Ingest,
    Asking,
    Kept,
    Outputs,
    Associations,
    Reconstructions,
    Snapshots,
    Keys,
    Operations,
):
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
        from sceneprint.client.remote import Remote

        self._backend: Backend = Remote(url, key, timeout_s)

    @classmethod
    def embedded(cls, path: str | Path) -> Client:
        """A client that needs no service: the engine in this process, on a data folder.

        Frames are signed in this process too, while somebody waits for them (`wait`, or
        `upload` with `wait_s`). All is kept in the folder, whatever SCENEPRINT_DATABASE_URL
        says, and `sceneprint serve --data` may serve it at the same time. Until it is closed,
        BLAS and OpenMP run one thread in this process: sums then have one order.

        Parameters
        ----------
        path : the folder, made where missing

        Raises
        ------
        UnusableStore, NewerSchema : it cannot be opened.
        """
        from sceneprint.client.embedded import Embedded

        client = cls.__new__(cls)
        client._backend = Embedded(Path(path))
        return client

    def close(self) -> None:
        """Give back what was opened."""
        self._backend.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    # maps

    def create_map(
        self, name: str, title: str | None = None, model: str = "depth", **limits: float | None
    ) -> Map:
        """Make a map, or find that it is there as wanted.

        Parameters
        ----------
        name, title, model : of the map
        limits : `quota_frames` and `quota_bytes`, which are the operator's to set, and
            `retention_days`; see NewMap

        Raises
        ------
        InvalidRequest : the name is no slug, or there is no such model or limit.
        MapExists : there is one of that name with another title or model, or other limits.
        Forbidden : a quota is given, and the key has not `admin` for `*`.
        """
        return self._backend.create_map(
            checked(NewMap, "The map", name=name, title=title, model=model, **limits)
        )

    def maps(self) -> list[Map]:
        """All maps by name."""
        return self._backend.list_maps()

    def map(self, name: str) -> Map:
        """A map; UnknownMap where there is none."""
        return self._backend.get_map(name)

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it, for good; UnknownMap where there is none."""
        self._backend.delete_map(name)

    # frames

    def upload(
        self, map_name: str, frame: bytes | Path | FrameReference, meta: FrameMeta | None = None,
        *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None,
    ) -> Added:  # fmt: skip
        """Take a frame into a map; it is safe when this returns, and signed soon after.

        Parameters
        ----------
        map_name : of the map
        frame : content of a PNG or NPY file, the file, or a frame of `find_sequences`
        meta : what is known of it; default: what `meta_of` finds
        wait_s : seconds to wait until it is signed; default: none
        priority : from -10 to 10; frames of a greater one are signed first
        if_novel : keep it only if the map lacks the place: if its nearest frame is farther than
            this share of the distance of unrelated frames, or than 0.3 of it where just True;
            else the frame ends `redundant`, and `reason` says which frame is near

        Returns
        -------
        added : its state tells whether it is signed yet

        Raises
        ------
        UnknownMap : no such map.
        FrameError, DatasetError : the frame cannot be read, or its camera or pose is none.
        FrameConflict : the map has the same content with other metadata.
        InvalidRequest : a priority or `if_novel` out of its range.
        """
        until = time.monotonic() + (wait_s or 0.0)
        added, _ = self.add(
            map_name, frame, meta, wait_s=wait_s, priority=priority, if_novel=if_novel
        )
        return settle(self._backend, map_name, added, until)

    def add(
        self, map_name: str, frame: bytes | Path | FrameReference, meta: FrameMeta | None = None,
        *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """As `upload`, with a flag: False where the map had the frame already.

        The wait may end early; `upload` goes on to the end of it.
        """
        if abs(priority) > MOST_PRIORITY:
            raise InvalidRequest(
                f"The priority is {priority}. Give one from {-MOST_PRIORITY} to {MOST_PRIORITY}.",
                (("priority", "out of its range"),),
            )
        novelty = novelty_of(if_novel)
        data, known = sendable(frame, meta, with_pose=True)
        return self._backend.add_frame(map_name, data, known, wait_s or 0.0, priority, novelty)

    def frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame; UnknownMap or UnknownFrame where there is none."""
        return self._backend.get_frame(map_name, frame_id)

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Take a frame out of its map; UnknownMap or UnknownFrame where there is none."""
        self._backend.delete_frame(map_name, frame_id)

    # the service

    def status(self) -> Status:
        """Version, and how many frames and jobs are in each state."""
        return self._backend.status()

    def healthy(self) -> bool:
        """Whether it answers; asked once, without patience."""
        return self._backend.healthy()
