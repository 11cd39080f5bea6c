"""Reconstructions: surfaces fused from the accepted matches of an answer.

StoredAnswer, NewReconstruction  --begin_for-->  job  --fused, in a worker-->  mesh.ply, Coverage
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

Source = Literal["upload", "geometry"]
Strength = Literal["strong", "weak"]


@dataclass(frozen=True, eq=False)
class JobView:
    """A frame to fuse, as stored in a job.

    Parameters
    ----------
    rank, strength : rank and strength of the match; None for the query itself
    transform : (4, 4) T_query_match
    """

    map: str
    frame_id: str
    rank: int | None
    strength: Strength | None
    transform: list[list[float]]


def fused(
    store: Store, views: Sequence[JobView], query: Geometry | None, own: JobView | None,
    request: NewReconstruction, model_id: str, parent_frame: str, as_of: float,
) -> tuple[Coverage, bytes]:  # fmt: skip
    """Fuse the matches of an answer and the query frame.

    Parameters
    ----------
    views : one or more matches in the order of the ranking
    query : geometry of the query; None if it is not stored
    own : view of the query if it is a stored frame, else None
    model_id : model of the geometries to use instead of lost uploads
    parent_frame : name of the sensor frame of the query
    as_of : time of the answer, seconds since 1970

    Returns
    -------
    coverage : figures of the surface and its views
    ply : surface or cloud in the sensor frame of the query, coloured by view

    Raises
    ------
    MissingDependency : If Open3D cannot be loaded.
    UselessFrame : If no match can be fused, or the fused depth has no surface.
    InvalidRequest : If the voxels are so small that memory does not suffice.
    """
    open3d("A reconstruction")
    p = FusionParameters(voxel_m=request.voxel_m)
    frames, parts, left_out = list[DepthFrame](), list[FusedView](), list[LeftOut]()
    # a cloud cannot be fused; compute only the share of it that the matches explain
    if query is not None and request.include_query and isinstance(query.surface.camera, Intrinsics):
        frame, source = _own(store, query, own, model_id, as_of)
        frames.append(prepare_view(frame, p))
        parts.append(_fused_view(None, frames[-1], source))
    for view in views:
        try:
            frame, source = _read(store, view, model_id, as_of)
        except (NotFound, FrameError, DamagedBlob, UnreadableGeometry) as error:
            left_out.append(LeftOut(frame_id=view.frame_id, map=view.map, reason=str(error)))
            continue
        frames.append(prepare_view(frame, p))
        parts.append(_fused_view(view, frames[-1], source))
    others = [frame for frame, part in zip(frames, parts, strict=True) if part.frame_id is not None]
    if not others:
        raise UselessFrame(
            f"None of the {len(views)} matches can be fused: {left_out[0].reason} Use another "
            "answer."
        )
    mesh, voxel = fuse(frames, p)
    first = first_views(mesh, frames, BAND * voxel)
    added = added_areas(mesh, first, len(frames)).tolist()
    volume, _ = observed_volume(frames)
    as_mesh = request.output == "mesh"
    query_points = (
        None if query is None else query.surface.points[query.surface.valid].astype(np.float64)
    )
    coverage = Coverage(
        views=[
            part.model_copy(update={"added_m2": a}) for part, a in zip(parts, added, strict=True)
        ],
        left_out=left_out,
        area_m2=float(sum(added)),
        observed_volume_m3=volume,
        query_explained=0.0 if query_points is None else share_seen(query_points, others),
        voxel_m=voxel,
        points=len(mesh.points),
        triangles=len(mesh.triangles) if as_mesh else 0,
    )
    # the axes of the sensor of a cloud are unknown
    axes = ": x right, y down, z forward" if parent_frame.endswith(".optical") else ""
    comment = f"frame {parent_frame}{axes}, metres"
    colours = PALETTE[first % len(PALETTE)]
    ply = write_ply(
        mesh.points, mesh.normals, colours, mesh.triangles if as_mesh else None,
        comments=(comment,),
    )  # fmt: skip
    return coverage, ply


def _own(
    store: Store, query: Geometry, own: JobView | None, model_id: str, as_of: float
) -> tuple[DepthFrame, Source]:
    """Return the depth image of the query at the finest stored resolution, and its source."""
    if own is not None:
        with suppress(NotFound, FrameError, DamagedBlob, UnreadableGeometry):
            frame, source = _read(store, own, model_id, as_of)
            return replace(frame, name="query"), source
    return double_resolution(_frame(query, "query", np.eye(4))), "geometry"


def _read(store: Store, view: JobView, model_id: str, as_of: float) -> tuple[DepthFrame, Source]:
    """Return the depth image of a match and its source: the upload or, if lost, the geometry.

    Raises
    ------
    NotFound : If the map or the frame was deleted.
    DamagedBlob, UnreadableGeometry : If both upload and geometry are lost or damaged.
    FrameError : If the frame is empty or not a depth image.
    """
    with store.database.read() as connection:
        row = find_map(connection, view.map)
        frame = living(row, find_frame(connection, row, view.frame_id))
        if frame.received_at > as_of:
            raise UnknownFrame(
                f"Frame {frame.id} of map {row.name!r} was deleted and replaced by a new frame."
            )
        blob = geometry_blobs(connection, [frame.number], model_id).get(frame.number)
    if frame.kind == "cloud":
        raise _no_image(view.frame_id)
    T = np.array(view.transform)
    try:
        upload = read_stored(store.blobs.get(frame.blob), frame, store.decoders)
        assert isinstance(upload, DepthFrame)
        return DepthFrame(upload.depth, upload.intrinsics, view.frame_id, T), "upload"
    except DamagedBlob:
        if blob is None:
            raise
        return double_resolution(
            _frame(read_geometry(store.blobs.get(blob)), view.frame_id, T)
        ), "geometry"


def _frame(geometry: Geometry, name: str, T: Floats) -> DepthFrame:
    """Return the depth image of a geometry with the pose `T` (4, 4)."""
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
    names = ("frame_id", "map", "rank", "strength")
    own: dict[str, Any] = {name: getattr(view, name, None) for name in names}
    samples = int(np.count_nonzero(frame.depth))
    return FusedView(**own, source=source, samples=samples, added_m2=0.0)


#: Names of the files of a job: geometry of the query (until the end of the job), and surface.
QUERY, MESH = "query.geometry", "mesh.ply"
MEDIA_TYPE = "application/ply"
#: Transform of the query to itself.
_STILL = np.eye(4).tolist()


class Reconstructions(Products[NewReconstruction, Reconstruction]):
    """Reconstructions of answers."""

    kind = "reconstruct"
    record = Reconstruction

    def begin_for(self, stored: StoredAnswer, request: NewReconstruction) -> Reconstruction:
        """Queue and return a reconstruction. It copies the data of the answer, which may expire.

        Parameters
        ----------
        request : selection of matches, and options of the surface

        Raises
        ------
        InvalidRequest : If the answer has no accepted match, or the request names other frames.
        UnknownMap : If the map no longer exists.
        """
        chosen = _matches_to_fuse(stored.answer.matches, request)
        views, own = [_view(match) for match in chosen], stored.answer.frame
        names = sorted({*(view.map for view in views), *([] if own is None else [own.map])})
        data = {
            "query_id": stored.answer.query_id,
            "maps": names,
            "parent_frame": chosen[0].transform.child_frame if chosen[0].transform else "",
            "model_id": stored.model_id,
            "asked_at": stored.at,
            "request": request.model_dump(mode="json"),
            "views": [asdict(view) for view in views],
            "own": None
            if own is None
            else asdict(JobView(own.map, own.frame_id, None, None, _STILL)),
        }
        # a job of several maps belongs to no map, since readers of one map may not read the others
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
                collect_deleted_blobs(self._store, [file.blob for file in files])
                raise
            return self.get(None, job.job_id)

    def fields(self, job: JobRow) -> dict[str, Any]:
        """Return the record fields that depend on the request of a job."""
        data = job.data or {}
        return {name: data[name] for name in ("request", "query_id", "maps", "parent_frame")}

    def shows_deleted(self, connection: Connection, job: JobRow) -> bool:
        """Return whether a frame of a job was deleted permanently."""
        return not _is_current(connection, job)

    def run_slice(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Fuse all views in one slice of a few seconds; return its results."""
        del is_over
        data = task.data
        request = NewReconstruction.model_validate(data["request"])
        views = [JobView(**view) for view in data["views"]]
        own = None if data["own"] is None else JobView(**data["own"])
        coverage, ply = fused(
            self._store, views, self._query_of(task), own, request, data["model_id"],
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
        """Return the geometry of the query; None if it is damaged or not stored."""
        with self._store.database.read() as connection:
            file = queue.files_of(connection, task.job.number).get(QUERY)
        if file is not None:
            with suppress(DamagedBlob, UnreadableGeometry):
                return read_geometry(self._store.blobs.get(file.blob))
        return None


def _matches_to_fuse(matches: Sequence[Match], request: NewReconstruction) -> list[Match]:
    """Return the matches to fuse, by rank; raise InvalidRequest if there are none."""
    accepted = [m for m in matches if m.validation.status == "accepted" and m.transform is not None]
    if not accepted:
        raise InvalidRequest(
            "The answer has no accepted match, so there is nothing to fuse. Use an answer with "
            "the status `found`."
        )
    if request.frames is not None:
        frame_ids = {match.frame_id for match in accepted}
        missing = [frame for frame in request.frames if frame not in frame_ids]
        if missing:
            raise InvalidRequest(
                f"Frame {missing[0]!r:.80} is not an accepted match of the answer. Choose from "
                f"{', '.join(sorted(frame_ids))}, or omit `frames`.",
                (("frames", "not an accepted match"),),
            )
        accepted = [match for match in accepted if match.frame_id in request.frames]
    if request.strength == "strong":
        accepted = [match for match in accepted if match.validation.strength == "strong"]
        if not accepted:
            raise InvalidRequest(
                "No accepted match has the strength `strong`. Use `strength` = `any`.",
                (("strength", "excludes all matches"),),
            )
    return sorted(accepted, key=lambda match: match.rank)[: MOST_VIEWS - 1]


def _view(match: Match) -> JobView:
    if match.transform is None:
        raise ValueError(f"match {match.frame_id} has no transform")
    T = inverse(np.array(match.transform.matrix))
    return JobView(match.map, match.frame_id, match.rank, match.validation.strength, T.tolist())


def _is_current(connection: Connection, job: JobRow) -> bool:
    """Return whether all frames of a job exist or can be restored."""
    data = job.data or {}
    views = [*data["views"], *([] if data["own"] is None else [data["own"]])]
    places = {(view["map"], view["frame_id"]) for view in views}
    statement = (
        select(maps.c.name, frames.c.id)
        .join(maps, maps.c.number == frames.c.map_number)
        .where(
            maps.c.name.in_({name for name, _ in places}),
            frames.c.id.in_({frame_id for _, frame_id in places}),
            frames.c.received_at <= data["asked_at"],
            not_purged(),
        )
    )
    return places <= {(row.name, row.id) for row in connection.execute(statement)}
