"""Reconstructions: the accepted matches of an answer, fused to a surface by a worker.

StoredAnswer, NewReconstruction  --begin-->  job
job  --_fuse, in a worker-->  mesh.ply, Coverage
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from sqlalchemy import Connection, select

from sceneprint.engine.ingest.frame_decoder import read_stored
from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult, Swept, queue_task
from sceneprint.engine.maps.map_frames import living
from sceneprint.engine.products.product import Products
from sceneprint.engine.results.query_entry import StoredAnswer
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import (
    DamagedBlob,
    FrameError,
    InvalidRequest,
    NotFound,
    UnknownFrame,
    UnreadableGeometry,
    UselessFrame,
)
from sceneprint.formats.artifact import read_geometry
from sceneprint.formats.export import write_ply
from sceneprint.fusion import (
    BAND,
    PALETTE,
    FusionParameters,
    fuse,
    open3d,
    prepare_view,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.surface.coverage import (
    added_areas,
    first_views,
    observed_volume,
    share_seen,
)
from sceneprint.geometry.surface.depth_image import double_resolution
from sceneprint.store import Store, queue
from sceneprint.store.frames import not_purged
from sceneprint.store.maps import find_frame, find_map, geometry_blobs
from sceneprint.store.tables import JobRow, frames, maps
from sceneprint.types import DepthFrame, Floats, Geometry, Intrinsics
from sceneprint_client.api import Match
from sceneprint_client.api.surface import (
    MOST_VIEWS,
    Coverage,
    FusedView,
    LeftOut,
    NewReconstruction,
    Reconstruction,
)

# Views of an answer fused: their depth out of the store, the surface, its figures, its files.
#
# data of a job, geometry of the query  --fused-->  coverage, PLY

Source = Literal["upload", "geometry"]
Strength = Literal["strong", "weak"]


@dataclass(frozen=True, eq=False)
class JobView:
    """A match that is to be fused, as it stands in a job's data.

    Parameters
    ----------
    rank, strength : of the answer; None of the query itself
    transform : (4, 4) T_query_match
    """

    map: str
    frame_id: str
    rank: int | None
    strength: Strength | None
    transform: list[list[float]]


def fused(
    store: Store, views: Sequence[JobView], query: Geometry | None, own: JobView | None,
    wanted: NewReconstruction, model_id: str, parent_frame: str, asked_at: float,
) -> tuple[Coverage, bytes]:  # fmt: skip
    """Fuse the matches of an answer, and what the query saw.

    Parameters
    ----------
    store : with the matches' uploads and artifacts
    views : at least one, in the order of the ranking
    query : its own geometry; None where it is not known
    own : the query, where it is a stored frame
    model_id : whose artifacts stand in for uploads that are lost
    parent_frame : what the query's camera frame is called
    asked_at : when the answer was given, seconds since 1970

    Returns
    -------
    coverage : what became of the views
    ply : surface or cloud, in the query's camera frame, coloured by view

    Raises
    ------
    MissingDependency : Open3D cannot be loaded.
    UselessFrame : no match is left, or their depth makes no surface.
    InvalidRequest : voxels too small for memory.
    """
    # before all the reading: where it is missing, that is what is to be told
    open3d("A reconstruction")
    p = FusionParameters(voxel_m=wanted.voxel_m)
    frames, told, left_out = list[DepthFrame](), list[FusedView](), list[LeftOut]()
    # points of a cloud have no image that voxels could be carved with: it is explained, not fused
    if query is not None and wanted.include_query and isinstance(query.surface.camera, Intrinsics):
        frame, source = _own(store, query, own, model_id, asked_at)
        frames.append(prepare_view(frame, p))
        told.append(_fused_view(None, frames[-1], source))
    for view in views:
        try:
            frame, source = _read(store, view, model_id, asked_at)
        except (NotFound, FrameError, DamagedBlob, UnreadableGeometry) as error:
            left_out.append(LeftOut(frame_id=view.frame_id, map=view.map, reason=str(error)))
            continue
        frames.append(prepare_view(frame, p))
        told.append(_fused_view(view, frames[-1], source))
    others = [frame for frame, one in zip(frames, told, strict=True) if one.frame_id is not None]
    if not others:
        raise UselessFrame(
            f"None of the {len(views)} matches can be fused: {left_out[0].reason} Use another "
            "answer."
        )
    mesh, voxel = fuse(frames, p)
    first = first_views(mesh, frames, BAND * voxel)
    added = added_areas(mesh, first, len(frames)).tolist()
    volume, _ = observed_volume(frames)
    as_mesh = wanted.output == "mesh"
    seen = None if query is None else query.surface.points[query.surface.valid].astype(np.float64)
    coverage = Coverage(
        views=[one.model_copy(update={"added_m2": a}) for one, a in zip(told, added, strict=True)],
        left_out=left_out,
        area_m2=float(sum(added)),
        observed_volume_m3=volume,
        query_explained=0.0 if seen is None else share_seen(seen, others),
        voxel_m=voxel,
        points=len(mesh.points),
        triangles=len(mesh.triangles) if as_mesh else 0,
    )
    # a cloud keeps the axes of its sensor, whichever they are
    axes = ": x right, y down, z forward" if parent_frame.endswith(".optical") else ""
    comment = f"frame {parent_frame}{axes}, metres"
    colours = PALETTE[first % len(PALETTE)]
    ply = write_ply(
        mesh.points, mesh.normals, colours, mesh.triangles if as_mesh else None,
        comments=(comment,),
    )  # fmt: skip
    return coverage, ply


def _own(
    store: Store, query: Geometry, own: JobView | None, model_id: str, asked_at: float
) -> tuple[DepthFrame, Source]:
    """What the query saw, as fine as it is kept."""
    if own is not None:
        with suppress(NotFound, FrameError, DamagedBlob, UnreadableGeometry):
            frame, source = _read(store, own, model_id, asked_at)
            return replace(frame, name="query"), source
    return double_resolution(_frame(query, "query", np.eye(4))), "geometry"


def _read(store: Store, view: JobView, model_id: str, asked_at: float) -> tuple[DepthFrame, Source]:
    """Return a match's depth as it was sent; if that is lost, as validation compares it. Raise
    NotFound if map or frame is gone, DamagedBlob or UnreadableGeometry if both are lost, and
    FrameError if it is empty.
    """
    with store.database.read() as connection:
        row = find_map(connection, view.map)
        frame = living(row, find_frame(connection, row, view.frame_id))
        if frame.received_at > asked_at:
            raise UnknownFrame(
                f"Frame {frame.id} of map {row.name!r} was deleted, and a new frame has its id."
            )
        blob = geometry_blobs(connection, [frame.number], model_id).get(frame.number)
    if frame.kind == "cloud":  # before five million points are unpacked, if they can be here
        raise _no_image(view.frame_id)
    T = np.array(view.transform)
    try:
        found = read_stored(store.blobs.get(frame.blob), frame, store.decoders)
        assert isinstance(found, DepthFrame)
        return DepthFrame(found.depth, found.intrinsics, view.frame_id, T), "upload"
    except DamagedBlob:
        if blob is None:
            raise
        return double_resolution(
            _frame(read_geometry(store.blobs.get(blob)), view.frame_id, T)
        ), "geometry"


def _frame(geometry: Geometry, name: str, T: Floats) -> DepthFrame:
    """The depth that an artifact keeps, with a pose."""
    surface = geometry.surface
    if not isinstance(surface.camera, Intrinsics):
        raise _no_image(name)
    depth = np.where(surface.valid, surface.points[..., 2], np.float32(0))
    return DepthFrame(np.ascontiguousarray(depth, np.float32), surface.camera, name, T)


def _no_image(name: str) -> UselessFrame:
    return UselessFrame(
        f"{name} is a point cloud, but reconstruction fuses only depth images. Use overlay.ply "
        "to view its points with the others."
    )


def _fused_view(view: JobView | None, frame: DepthFrame, source: Source) -> FusedView:
    samples = int(np.count_nonzero(frame.depth))
    return FusedView(
        frame_id=None if view is None else view.frame_id,
        map=None if view is None else view.map,
        rank=None if view is None else view.rank,
        strength=None if view is None else view.strength,
        source=source,
        samples=samples,
        added_m2=0.0,
    )


#: Files of such a job: what the query saw, until it is fused; and the surface.
QUERY, MESH = "query.geometry", "mesh.ply"
MEDIA_TYPE = "application/ply"
#: The query itself is where it is.
_STILL = np.eye(4).tolist()


class Reconstructions(Products[NewReconstruction, Reconstruction]):
    """Reconstructions of answers."""

    kind = "reconstruct"
    record = Reconstruction

    def begin_for(self, stored: StoredAnswer, wanted: NewReconstruction) -> Reconstruction:
        """Queue a reconstruction. All that it needs of the answer is copied: that may expire.

        Parameters
        ----------
        wanted : which of its views, and to what

        Raises
        ------
        InvalidRequest : the answer has no accepted match, or not the ones that are named.
        UnknownMap : the map is gone.
        """
        chosen = _matches_to_fuse(stored.answer.matches, wanted)
        views, own = [_view(match) for match in chosen], stored.answer.frame
        names = sorted({*(view.map for view in views), *([] if own is None else [own.map])})
        data = {
            "query_id": stored.answer.query_id,
            "maps": names,
            "parent_frame": chosen[0].transform.child_frame if chosen[0].transform else "",
            "model_id": stored.model_id,
            "asked_at": stored.at,
            "request": wanted.model_dump(mode="json"),
            "views": [asdict(view) for view in views],
            "own": None
            if own is None
            else asdict(JobView(own.map, own.frame_id, None, None, _STILL)),
        }
        # of several maps: the job's own page would tell who may read one of them of the others
        of = names[0] if len(names) == 1 else None
        self._store.database.require_writable()
        while True:
            files = []
            if (data_of_query := stored.geometry) is not None:
                blob, size = self._store.blobs.put(data_of_query), len(data_of_query)
                files = [queue.JobFile(QUERY, blob, size, "application/octet-stream")]
            try:
                bell = self._context.bell
                job, _ = queue_task(self._store, bell, self.kind, of, data, files=files)
            except Swept:
                continue
            except BaseException:
                collect_deleted_blobs(self._store, [one.blob for one in files])
                raise
            return self.get(None, job.job_id)

    def fields(self, job: JobRow) -> dict[str, Any]:
        """Return the fields of a record that the request of a job fills."""
        data = job.data or {}
        return {name: data[name] for name in ("request", "query_id", "maps", "parent_frame")}

    def shows_deleted(self, connection: Connection, job: JobRow) -> bool:
        """Return whether a view of a job was deleted, and cannot be restored."""
        return not _is_current(connection, job)

    def run_slice(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Fuse the views, in one slice: at most 32 views of bounded size take seconds."""
        del is_over
        data = task.data
        wanted = NewReconstruction.model_validate(data["request"])
        views = [JobView(**view) for view in data["views"]]
        own = None if data["own"] is None else JobView(**data["own"])
        coverage, ply = fused(
            self._store, views, self._query_of(task), own, wanted, data["model_id"],
            data["parent_frame"], data["asked_at"],
        )  # fmt: skip
        files = [queue.JobFile(MESH, self._store.blobs.put(ply), len(ply), MEDIA_TYPE)]
        return SliceResult(
            over=True,
            progress={"done": len(views), "total": len(views)},
            files=files,
            result=coverage.model_dump(mode="json"),
            drop=(QUERY,),
        )

    def _query_of(self, task: LongJob) -> Geometry | None:
        """What the query saw; a reconstruction does without it where it is damaged."""
        with self._store.database.read() as connection:
            found = queue.files_of(connection, task.job.number).get(QUERY)
        if found is not None:
            with suppress(DamagedBlob, UnreadableGeometry):
                return read_geometry(self._store.blobs.get(found.blob))
        return None


def _matches_to_fuse(matches: Sequence[Match], wanted: NewReconstruction) -> list[Match]:
    """The matches to fuse, in the order of the ranking."""
    accepted = [m for m in matches if m.validation.status == "accepted" and m.transform is not None]
    if not accepted:
        raise InvalidRequest(
            "The answer has no accepted match, so there is nothing to fuse. Use an answer with "
            "the status `found`."
        )
    if wanted.frames is not None:
        known = {match.frame_id for match in accepted}
        missing = [frame for frame in wanted.frames if frame not in known]
        if missing:
            raise InvalidRequest(
                f"Frame {missing[0]!r:.80} is not an accepted match of the answer. Choose from "
                f"{', '.join(sorted(known))}, or leave `frames` out.",
                (("frames", "not an accepted match"),),
            )
        accepted = [match for match in accepted if match.frame_id in wanted.frames]
    if wanted.strength == "strong":
        accepted = [match for match in accepted if match.validation.strength == "strong"]
        if not accepted:
            raise InvalidRequest(
                "No match is accepted with strength `strong`. Use `any`.",
                (("strength", "leaves no match"),),
            )
    return sorted(accepted, key=lambda match: match.rank)[: MOST_VIEWS - 1]


def _view(match: Match) -> JobView:
    if match.transform is None:
        raise ValueError(f"match {match.frame_id} has no transform")
    T = inverse(np.array(match.transform.matrix))
    return JobView(match.map, match.frame_id, match.rank, match.validation.strength, T.tolist())


def _is_current(connection: Connection, job: JobRow) -> bool:
    """Return whether all views of a job exist, or can be restored."""
    data = job.data or {}
    views = [*data["views"], *([] if data["own"] is None else [data["own"]])]
    places = {(one["map"], one["frame_id"]) for one in views}
    there = (
        select(maps.c.name, frames.c.id)
        .join(maps, maps.c.number == frames.c.map_number)
        .where(
            maps.c.name.in_({name for name, _ in places}),
            frames.c.id.in_({frame_id for _, frame_id in places}),
            frames.c.received_at <= data["asked_at"],
            not_purged(),
        )
    )
    return places <= {(row.name, row.id) for row in connection.execute(there)}
