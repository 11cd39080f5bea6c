"""Views of an answer fused: their depth out of the store, the surface, its figures, its files.

data of a job, geometry of the query  --fused-->  Fused
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sceneprint.artifacts import read_geometry
from sceneprint.clouds import write_ply
from sceneprint.engine.frames import read_stored
from sceneprint.engine.indexed import living
from sceneprint.errors import (
    DamagedBlob,
    FrameError,
    NotFound,
    UnknownFrame,
    UnreadableGeometry,
    UselessFrame,
)
from sceneprint.fusion import BAND, FusionParameters, fuse, within
from sceneprint.geometry.coverage import (
    added_areas,
    observed_volume,
    of_views,
    share_seen,
)
from sceneprint.geometry.enlarging import doubled
from sceneprint.libraries import open3d
from sceneprint.rendering import PALETTE, reconstruction_picture
from sceneprint.schemas.reconstructions import Coverage, FusedView, LeftOut, NewReconstruction
from sceneprint.store import Store
from sceneprint.store.frames import find_frame
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import geometry_blobs
from sceneprint.types import Floats, Frame, Geometry, Intrinsics

Source = Literal["upload", "geometry"]
Strength = Literal["strong", "weak"]


@dataclass(frozen=True, eq=False)
class View:
    """A match that is to be fused, as it stands in a job's data.

    Parameters
    ----------
    map, frame_id : of the match
    rank, strength : of the answer; None of the query itself
    transform : (4, 4) T_query_match
    """

    map: str
    frame_id: str
    rank: int | None
    strength: Strength | None
    transform: list[list[float]]


@dataclass(frozen=True, eq=False)
class Fused:
    """What became of the views.

    Parameters
    ----------
    coverage : see Coverage
    ply : surface or cloud, in the query's camera frame, coloured by view
    png : its picture
    """

    coverage: Coverage
    ply: bytes
    png: bytes


def fused(
    store: Store, views: Sequence[View], query: Geometry | None, own: View | None,
    wanted: NewReconstruction, model_id: str, parent_frame: str, asked_at: float,
) -> Fused:  # fmt: skip
    """Fuse the matches of an answer, and what the query saw.

    Parameters
    ----------
    store : with the matches' uploads and artifacts
    views : at least one, in the order of the ranking
    query : its own geometry; None where it is not known
    own : the query, where it is a stored frame
    wanted : see NewReconstruction
    model_id : whose artifacts stand in for uploads that are lost
    parent_frame : what the query's camera frame is called
    asked_at : when the answer was given, seconds since 1970

    Raises
    ------
    MissingDependency : Open3D cannot be loaded.
    UselessFrame : no match is left, or their depth makes no surface.
    InvalidRequest : voxels too small for memory.
    """
    # before all the reading: where it is missing, that is what is to be told
    open3d("A reconstruction")
    p = FusionParameters(voxel_m=wanted.voxel_m)
    frames, told, left_out = list[Frame](), list[FusedView](), list[LeftOut]()
    # points of a cloud have no image that voxels could be carved with: it is explained, not fused
    if query is not None and wanted.include_query and isinstance(query.surface.camera, Intrinsics):
        frame, source = _own(store, query, own, model_id, asked_at)
        frames.append(within(frame, p))
        told.append(_told(None, frames[-1], source))
    for view in views:
        try:
            frame, source = _read(store, view, model_id, asked_at)
        except (NotFound, FrameError, DamagedBlob, UnreadableGeometry) as error:
            left_out.append(LeftOut(frame_id=view.frame_id, map=view.map, reason=str(error)))
            continue
        frames.append(within(frame, p))
        told.append(_told(view, frames[-1], source))
    others = [frame for frame, one in zip(frames, told, strict=True) if one.frame_id is not None]
    if not others:
        raise UselessFrame(
            f"None of the {len(views)} matches can be fused: {left_out[0].reason} Reconstruct from "
            "another answer."
        )
    mesh, voxel = fuse(frames, p)
    first = of_views(mesh, frames, BAND * voxel)
    added = added_areas(mesh, first, len(frames)).tolist()
    volume, _ = observed_volume(frames)
    as_mesh = wanted.output == "mesh"
    coverage = Coverage(
        views=[one.model_copy(update={"added_m2": a}) for one, a in zip(told, added, strict=True)],
        left_out=left_out,
        area_m2=float(sum(added)),
        observed_volume_m3=volume,
        query_explained=0.0 if query is None else share_seen(_points(query), others),
        voxel_m=voxel,
        points=len(mesh.points),
        triangles=len(mesh.triangles) if as_mesh else 0,
    )
    # a cloud keeps the axes of its sensor, whichever they are
    axes = ": x right, y down, z ahead" if parent_frame.endswith(".optical") else ""
    comment = f"frame {parent_frame}{axes}, metres"
    colours = PALETTE[first % len(PALETTE)]
    ply = write_ply(
        mesh.points, mesh.normals, colours, mesh.triangles if as_mesh else None,
        comments=(comment,),
    )  # fmt: skip
    named = f"{len(frames)} views, {coverage.area_m2:.1f} m², {volume:.1f} m³ observed"
    explained = f"{coverage.query_explained:.0%} of the query explained"
    title = named if query is None else f"{named}; {explained}"
    return Fused(coverage, ply, reconstruction_picture(mesh, first, frames, added, title))


def _own(
    store: Store, query: Geometry, own: View | None, model_id: str, asked_at: float
) -> tuple[Frame, Source]:
    """What the query saw, as fine as it is kept."""
    if own is not None:
        with suppress(NotFound, FrameError, DamagedBlob, UnreadableGeometry):
            frame, source = _read(store, own, model_id, asked_at)
            return replace(frame, name="query"), source
    return doubled(_frame(query, "query", np.eye(4))), "geometry"


def _read(store: Store, view: View, model_id: str, asked_at: float) -> tuple[Frame, Source]:
    """A match's depth as it was sent; where that is lost, as validation compares it.

    Raises
    ------
    NotFound : its map or it is gone, whether or not another has its name.
    DamagedBlob, UnreadableGeometry : both are lost.
    FrameError : there is nothing in it.
    """
    with store.database.read() as connection:
        row = find_map(connection, view.map)
        frame = living(row, find_frame(connection, row, view.frame_id))
        if frame.received_at > asked_at:
            raise UnknownFrame(
                f"Frame {frame.id} of map {row.name!r} was deleted, and another has its id since."
            )
        blob = geometry_blobs(connection, [frame.number], model_id).get(frame.number)
    if frame.kind == "cloud":  # before five million points are unpacked, if they can be here
        raise _no_image(view.frame_id)
    T = np.array(view.transform)
    try:
        found = read_stored(store.blobs.get(frame.blob), frame)
        assert isinstance(found, Frame)
        return Frame(found.depth, found.intrinsics, view.frame_id, T), "upload"
    except DamagedBlob:
        if blob is None:
            raise
        return doubled(_frame(read_geometry(store.blobs.get(blob)), view.frame_id, T)), "geometry"


def _frame(geometry: Geometry, name: str, T: Floats) -> Frame:
    """The depth that an artifact keeps, with a pose."""
    surface = geometry.surface
    if not isinstance(surface.camera, Intrinsics):
        raise _no_image(name)
    depth = np.where(surface.valid, surface.points[..., 2], np.float32(0))
    return Frame(np.ascontiguousarray(depth, np.float32), surface.camera, name, T)


def _no_image(name: str) -> UselessFrame:
    return UselessFrame(
        f"{name} is a point cloud, and reconstructions fuse depth images alone. Lay its points "
        "over the others with overlay.ply."
    )


def _points(geometry: Geometry) -> Floats:
    return geometry.surface.points[geometry.surface.valid].astype(np.float64)


def _told(view: View | None, frame: Frame, source: Source) -> FusedView:
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
