"""A long job in hand, and what a slice of it comes to."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from sceneprint.errors import StoreError
from sceneprint.store.parts import JobFile
from sceneprint.store.queue import Claim
from sceneprint.store.records import MapRow


class Swept(StoreError):
    """A deletion removed a file between its making and the commit that would have referred to it;
    nothing was stored."""


@dataclass(frozen=True, eq=False)
class Task:
    """A long job in hand.

    Parameters
    ----------
    claim : on the job
    map : that it is about; None where it is of none
    """

    claim: Claim
    map: MapRow | None

    @property
    def data(self) -> dict[str, Any]:
        """What was asked for."""
        return self.claim.job.data or {}

    @property
    def progress(self) -> dict[str, Any]:
        """How far the slices before have come: of the last `Outcome`; empty before the first."""
        return self.claim.job.progress or {}

    @property
    def of_map(self) -> MapRow:
        """The map, of a kind of job that always has one."""
        if self.map is None:
            raise ValueError(f"job {self.claim.job.id} is of no map")
        return self.map


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a slice came to.

    Parameters
    ----------
    over : whether the job is done
    progress : `done` and `total` for people, and whatever the next slice needs to go on
    items : found in this slice
    files : made in this slice, blobs that are there
    result : in short, at the end
    drop : names of files of the job that are of no use any more
    event : kind of the event that tells of the end, such as association.found; its data is `result`
    """

    over: bool
    progress: dict[str, Any]
    items: list[dict[str, Any]] = field(default_factory=list)
    files: list[JobFile] = field(default_factory=list)
    result: dict[str, Any] | None = None
    drop: Collection[str] = ()
    event: str | None = None


#: Does a slice of a job until the time of `time.monotonic` that is given; may be done again.
Handler = Callable[[Task, float], Outcome]
