"""Reconstructions: the accepted matches of an answer, fused to a surface by a worker.

Kept, NewReconstruction  --begin-->  job
job  --(in a worker) _fuse-->  mesh.ply, picture.png, Coverage
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict

import numpy as np
from sqlalchemy import Connection

from sceneprint.artifacts import read_geometry
from sceneprint.engine.fusing import View, fused
from sceneprint.engine.kept import Kept
from sceneprint.engine.shown import Standing
from sceneprint.engine.slices import Outcome, Swept, Task
from sceneprint.engine.sweeping import sweep_deleted
from sceneprint.engine.tasks import Tasks
from sceneprint.engine.wire import when
from sceneprint.errors import (
    DamagedBlob,
    InvalidRequest,
    NotIndexed,
    UnknownJob,
    UnreadableGeometry,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.schemas import JobState, Match
from sceneprint.schemas.reconstructions import (
    MOST_VIEWS,
    Coverage,
    NewReconstruction,
    Reconstruction,
    ReconstructionFile,
)
from sceneprint.store import Store
from sceneprint.store.associations import remove_job
from sceneprint.store.listing import find_job, unknown_job
from sceneprint.store.parts import JobFile, files_of, jobs_with_files
from sceneprint.store.records import JobRow
from sceneprint.types import Geometry

KIND = "reconstruct"
#: Files of such a job: what the query saw, until it is fused; and what is made.
QUERY, MESH, PICTURE = "query.geometry", "mesh.ply", "picture.png"
MEDIA_TYPES = {MESH: "application/ply", PICTURE: "image/png"}
#: The query itself is where it is.
_STILL = np.eye(4).tolist()


class Reconstructions:
    """Begins reconstructions, does them, and hands out what they made.

    Parameters
    ----------
    store, tasks : of the engine
    """

    def __init__(self, store: Store, tasks: Tasks) -> None:
        self._store, self._tasks = store, tasks
        tasks.register(KIND, self._fuse)

    def begin(self, kept: Kept, wanted: NewReconstruction) -> Reconstruction:
        """Queue a reconstruction. All that it needs of the answer is copied: that may expire.

        Parameters
        ----------
        kept : the answer
        wanted : which of its views, and to what

        Raises
        ------
        InvalidRequest : the answer has no accepted match, or not the ones that are named.
        UnknownMap : the map is gone.
        """
        chosen = _chosen(kept.answer.matches, wanted)
        views, own = [_view(match) for match in chosen], kept.answer.frame
        maps = sorted({*(view.map for view in views), *([] if own is None else [own.map])})
        data = {
            "query_id": kept.answer.query_id,
            "maps": maps,
            "parent_frame": chosen[0].transform.child_frame if chosen[0].transform else "",
            "model_id": kept.model_id,
            "asked_at": kept.at,
            "request": wanted.model_dump(mode="json"),
            "views": [asdict(view) for view in views],
            "own": None if own is None else asdict(View(own.map, own.frame_id, None, None, _STILL)),
        }
        # of several maps: the job's own page would tell who may read one of them of the others
        of = maps[0] if len(maps) == 1 else None
        self._store.database.require_writable()
        while True:
            files = []
            if kept.geometry is not None:
                blob = self._store.blobs.put(kept.geometry)
                files = [JobFile(QUERY, blob, len(kept.geometry), "application/octet-stream")]
            try:
                job = self._tasks.begin(KIND, of, data, files=files)
            except Swept:
                continue
            except BaseException:
                sweep_deleted(self._store, [one.blob for one in files])
                raise
            return self.find(job.job_id)

    def find(self, job_id: str) -> Reconstruction:
        """A reconstruction; UnknownJob where there is none."""
        with self._store.database.read() as connection:
            job = _find(connection, job_id)
            return _tell(job, files_of(connection, job.number))

    def file(self, job_id: str, name: str) -> JobFile:
        """A file that a reconstruction made.

        Raises
        ------
        UnknownJob : there is no such reconstruction.
        NotIndexed : it has not made it.
        """
        with self._store.database.read() as connection:
            job = _find(connection, job_id)
            found = files_of(connection, job.number).get(name)
        if found is None or name not in MEDIA_TYPES:
            why = f": {job.error}" if job.error else "."
            raise NotIndexed(
                f"Reconstruction {job_id} is {job.state}, and {name} is made at its end{why}"
            )
        return found

    def delete(self, job_id: str) -> None:
        """Remove a reconstruction, whatever has become of it; UnknownJob where there is none."""
        with self._store.database.write() as connection:
            blobs = remove_job(connection, _find(connection, job_id))
        sweep_deleted(self._store, blobs)

    def forget(self, standing: Standing) -> int:
        """Remove those of which any view was deleted since: they show it; returns how many."""
        with self._store.database.read() as connection:
            found = jobs_with_files(connection, KIND)
        gone = [job for job in found if not _stands(job, standing)]
        for job in gone:
            with suppress(UnknownJob):  # somebody else has
                self.delete(job.id)
        return len(gone)

    def _fuse(self, task: Task, until: float) -> Outcome:
        """Do it, in one slice: at most 32 views of bounded size take seconds."""
        del until
        data = task.data
        wanted = NewReconstruction.model_validate(data["request"])
        views = [View(**view) for view in data["views"]]
        own = None if data["own"] is None else View(**data["own"])
        result = fused(
            self._store, views, self._query_of(task), own, wanted, data["model_id"],
            data["parent_frame"], data["asked_at"],
        )  # fmt: skip
        files = [
            JobFile(name, self._store.blobs.put(content), len(content), MEDIA_TYPES[name])
            for name, content in ((MESH, result.ply), (PICTURE, result.png))
        ]
        return Outcome(
            over=True,
            progress={"done": len(views), "total": len(views)},
            files=files,
            result=result.coverage.model_dump(mode="json"),
            drop=(QUERY,),
        )

    def _query_of(self, task: Task) -> Geometry | None:
        """What the query saw; a reconstruction does without it where it is damaged."""
        with self._store.database.read() as connection:
            found = files_of(connection, task.claim.job.number).get(QUERY)
        if found is not None:
            with suppress(DamagedBlob, UnreadableGeometry):
                return read_geometry(self._store.blobs.get(found.blob))
        return None


def _chosen(matches: Sequence[Match], wanted: NewReconstruction) -> list[Match]:
    """The matches to fuse, in the order of the ranking."""
    accepted = [m for m in matches if m.validation.status == "accepted" and m.transform is not None]
    if not accepted:
        raise InvalidRequest(
            "The answer has no accepted match, so there is nothing that could be fused. "
            "Reconstruct from an answer whose status is `found`."
        )
    if wanted.frames is not None:
        known = {match.frame_id for match in accepted}
        missing = [frame for frame in wanted.frames if frame not in known]
        if missing:
            raise InvalidRequest(
                f"Frame {missing[0]!r:.80} is no accepted match of the answer. Name some of "
                f"{', '.join(sorted(known))}, or leave `frames` out.",
                (("frames", "names what is no accepted match"),),
            )
        accepted = [match for match in accepted if match.frame_id in wanted.frames]
    if wanted.strength == "strong":
        accepted = [match for match in accepted if match.validation.strength == "strong"]
        if not accepted:
            raise InvalidRequest(
                "None of the matches is accepted with strength `strong`. Give `any`.",
                (("strength", "leaves no match"),),
            )
    return sorted(accepted, key=lambda match: match.rank)[: MOST_VIEWS - 1]


def _view(match: Match) -> View:
    if match.transform is None:
        raise ValueError(f"match {match.frame_id} has no transform")
    T = inverse(np.array(match.transform.matrix))
    return View(match.map, match.frame_id, match.rank, match.validation.strength, T.tolist())


def _stands(job: JobRow, standing: Standing) -> bool:
    data = job.data or {}
    views = [*data["views"], *([] if data["own"] is None else [data["own"]])]
    return all(standing.frame(one["map"], one["frame_id"], data["asked_at"]) for one in views)


def _find(connection: Connection, job_id: str) -> JobRow:
    job = find_job(connection, job_id)
    if job.kind != KIND:
        raise unknown_job(job_id)
    return job


def _tell(job: JobRow, files: dict[str, JobFile]) -> Reconstruction:
    data, done = job.data or {}, job.state == JobState.SUCCEEDED
    made = [files[name] for name in MEDIA_TYPES if name in files]
    return Reconstruction(
        job_id=job.id,
        query_id=data["query_id"],
        maps=data["maps"],
        state=job.state,
        error=job.error,
        created_at=when(job.created_at),
        finished_at=when(job.finished_at),
        request=NewReconstruction.model_validate(data["request"]),
        parent_frame=data["parent_frame"],
        coverage=Coverage.model_validate(job.result) if done else None,
        files=[ReconstructionFile.model_validate(asdict(one)) for one in made],
    )
