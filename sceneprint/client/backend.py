"""What a client needs of whoever does the work: the one seam between HTTP and the engine."""

from __future__ import annotations

from typing import Protocol

from pydantic import Field

from sceneprint.client.asking import AskingBackend
from sceneprint.client.associations import AssociationsBackend
from sceneprint.client.ingest import IngestBackend
from sceneprint.client.kept import KeptBackend
from sceneprint.client.keys import KeysBackend
from sceneprint.client.operations import OperationsBackend
from sceneprint.client.outputs import OutputsBackend
from sceneprint.client.reconstructions import ReconstructionsBackend
from sceneprint.client.snapshots import SnapshotsBackend
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
from sceneprint.schemas.base import Told


class Status(Told):
    """How a service is."""

    version: str
    frames: dict[str, int] | None = Field(
        description="How many frames of all maps are in each state; None where the key may not "
        "read all maps."
    )
    jobs: dict[str, int] | None = Field(
        description="How many jobs are in each state that has any; None as `frames`."
    )


class Backend(
    IngestBackend,
    AskingBackend,
    KeptBackend,
    OutputsBackend,
    AssociationsBackend,
    ReconstructionsBackend,
    SnapshotsBackend,
    KeysBackend,
    OperationsBackend,
    Protocol,
):
    """Does what a `Client` asks for; every method may be called from any thread.

    Each raises what the engine raises for it, `Unreachable` and `Refused` besides where a
    network lies between.
    """

    def create_map(self, new: NewMap) -> Map:
        """Make a map, or find that it is there as wanted."""

    def list_maps(self) -> list[Map]:
        """All maps by name."""

    def get_map(self, name: str) -> Map:
        """A map."""

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it."""

    def add_frame(
        self, map_name: str, data: bytes, meta: FrameMeta, wait_s: float, priority: int,
        if_novel: float | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map, waiting for its job at most so long; whether it is new."""

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame."""

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Take a frame out of its map."""

    def get_job(self, job_id: str) -> Job:
        """A job."""

    def list_jobs(self, cursor: str | None, state: JobState | None) -> Page[Job]:
        """A page of all jobs, the newest first."""

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over."""

    def retry_job(self, job_id: str) -> Job:
        """Try again what was given up."""

    def meanwhile(self, pause_s: float) -> None:
        """Let jobs come nearer to their end: do one, or wait for others to."""

    def status(self) -> Status:
        """How the service is."""

    def healthy(self) -> bool:
        """Whether it answers at all."""

    def close(self) -> None:
        """Give back what was opened."""
