"""The engine in this process, as a backend of the client."""

from __future__ import annotations

import itertools
import os
import time
from pathlib import Path

from sceneprint import __version__
from sceneprint.client.asking import EmbeddedAsking
from sceneprint.client.associations import EmbeddedAssociations
from sceneprint.client.backend import Status
from sceneprint.client.ingest import EmbeddedIngest
from sceneprint.client.kept import EmbeddedKept
from sceneprint.client.keys import EmbeddedKeys
from sceneprint.client.operations import EmbeddedOperations
from sceneprint.client.outputs import EmbeddedOutputs
from sceneprint.client.reconstructions import EmbeddedReconstructions
from sceneprint.client.snapshots import EmbeddedSnapshots
from sceneprint.engine import Engine
from sceneprint.errors import SceneprintError
from sceneprint.maintenance.shelf import LONGEST_S, SNAPSHOT, snapshot_handler
from sceneprint.schemas import (
    Added,
    Frame,
    FrameMeta,
    Job,
    JobState,
    Map,
    NewMap,
    Page,
)
from sceneprint.settings import Settings

#: Jobs after which it is looked whether an index has fallen behind.
_UPKEEP = 256


class Embedded(
    EmbeddedIngest,
    EmbeddedAsking,
    EmbeddedKept,
    EmbeddedOutputs,
    EmbeddedAssociations,
    EmbeddedReconstructions,
    EmbeddedSnapshots,
    EmbeddedKeys,
    EmbeddedOperations,
):
    """The engine on a data folder.

    Parameters
    ----------
    path : the folder, made where missing

    Raises
    ------
    UnusableStore, NewerSchema : it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        # a folder was named, so nothing goes elsewhere, whatever the environment says
        settings = Settings(data_dir=path.absolute(), database_url=None, index_dir=None)
        self._engine = Engine(settings)
        self._engine.tasks.register(SNAPSHOT, snapshot_handler(settings), LONGEST_S)
        self._name = f"embedded-{os.getpid()}"
        self._done = itertools.count(1)

    def create_map(self, new: NewMap) -> Map:
        """Make a map, or find that it is there as wanted."""
        return self._engine.create_map(new)[0]

    def list_maps(self) -> list[Map]:
        """All maps by name."""
        return self._engine.list_maps().items

    def get_map(self, name: str) -> Map:
        """A map."""
        return self._engine.get_map(name)

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it."""
        self._engine.delete_map(name)

    def add_frame(
        self, map_name: str, data: bytes, meta: FrameMeta, wait_s: float, priority: int,
        if_novel: float | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map; nobody but who waits would sign it."""
        del wait_s
        return self._engine.add_frame(map_name, data, meta, priority, if_novel)

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame."""
        return self._engine.get_frame(map_name, frame_id)

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Take a frame out of its map."""
        self._engine.delete_frame(map_name, frame_id)

    def get_job(self, job_id: str) -> Job:
        """A job."""
        return self._engine.get_job(job_id)

    def list_jobs(self, cursor: str | None, state: JobState | None) -> Page[Job]:
        """A page of all jobs, the newest first."""
        return self._engine.list_jobs(state, cursor)

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over."""
        return self._engine.cancel_job(job_id)

    def retry_job(self, job_id: str) -> Job:
        """Try again what was given up."""
        return self._engine.retry_job(job_id)[0]

    def meanwhile(self, pause_s: float) -> None:
        """Do a job, or wait where there is none to do."""
        work = self._engine.claim(self._name)
        if work is None:
            time.sleep(pause_s)
            return
        try:
            self._engine.run(work)
        except BaseException:  # such as Ctrl-C: another need not wait for the lease to run out
            self._engine.put_back(work)
            raise
        if next(self._done) % _UPKEEP == 0:
            self._engine.publish_due()

    def status(self) -> Status:
        """How the store is."""
        frames, jobs = self._engine.counts()
        return Status(version=__version__, frames=frames, jobs=jobs)

    def healthy(self) -> bool:
        """Whether the database answers."""
        try:
            self._engine.counts()
        except SceneprintError:
            return False
        return True

    def close(self) -> None:
        """Close the database."""
        self._engine.close()
