"""Surfaces of maps: tiles, frames that observed a spot, plans, and jobs that build surfaces."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.maps.map_frames import Output
from sceneprint.engine.maps.map_plans import PlanFrame, plan_frame, surface_picture
from sceneprint.engine.maps.surface_job import SURFACE, scale_of, surface_points, tile_cells
from sceneprint.engine.products.product import BACKGROUND
from sceneprint.engine.serializers import copy_fields, tag_of, vector, when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import (
    DamagedBlob,
    InvalidRequest,
    NotFound,
    SceneprintError,
    UnreadableGeometry,
)
from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.cells import FACTOR, TilePlace
from sceneprint.geometry.rigid import transform_points
from sceneprint.store import Store, queue
from sceneprint.store import surface_rows as stored
from sceneprint.store.audit_log import record_change
from sceneprint.store.maps import find_map, map_of_number
from sceneprint.store.opaque_ids import invalid_cursor
from sceneprint.store.surface_rows import LevelTotals, SightingFrame, SurfaceRow, TileRow
from sceneprint.store.tables import JobRow, MapRow
from sceneprint.store.wakeup import Wakeup
from sceneprint.types import Floats
from sceneprint_client.api import JobState, Page
from sceneprint_client.api.surface import (
    PLAN_WIDTH,
    MapSurface,
    SurfaceLevel,
    SurfaceParent,
    SurfacePlan,
    SurfaceSighting,
    SurfaceState,
    SurfaceTile,
)
from sceneprint_client.surface_encoding import CELL, SIDE, cell_points

log = logging.getLogger(__name__)

#: Maximum number of cells to draw in a plan; with more, the plan uses a coarser level.
_DRAWN_CELLS = 1_500_000
#: Default and maximum radius of the search around a spot, in cell widths.
_NEAR, _NEAREST = 2.0, float(SIDE)
#: Maximum number of geometries to read for a page of sightings, and number of frames to list at
#: once.
_OPENED, _AT_ONCE = 150, 25
#: Largest absolute coordinate in a request, metres.
FARTHEST_M = 1e9
#: Maximum duration of a call that removes a surface, seconds.
_CALL_S = 10.0


class MapSurfaces:
    """Surfaces of all maps."""

    def __init__(self, store: Store, bell: Wakeup) -> None:
        self._store, self._bell = store, bell

    def get(self, map_name: str) -> MapSurface:
        """Return the surface of a map; raise UnknownMap if the map does not exist."""
        with self._store.database.read() as connection:
            row, surface = stored.living_surface(connection, map_name)
            return _surface_record(connection, row, surface)

    def begin(self, map_name: str) -> tuple[MapSurface, bool]:
        """Queue a job that builds or updates the surface of a map, unless it is up to date.

        Returns
        -------
        surface : record of the surface
        pending : whether a job is pending

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the map has no frames with poses.
        """
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            surface = stored.find_surface(connection, row.number)
            if surface is None:
                surface = stored.add_surface(connection, row)
            elif not surface.wanted:
                stored.write_surface(connection, row.number, wanted=True, model_id="")
                surface = stored.find_surface(connection, row.number) or surface
            pending, blobs = begin_job(connection, row, surface)
            if pending:
                record_change(connection, "surface.requested", map_name)
            record = _surface_record(connection, row, stored.find_surface(connection, row.number))
            if not pending and not record.frames:
                raise InvalidRequest(
                    f"Map {row.name!r} has no indexed frame with a pose, so it has no surface. "
                    "Send `pose` with uploads, or edit frames with PATCH."
                )
        collect_deleted_blobs(self._store, blobs)
        if pending:
            self._bell.ring()
        return record, pending

    def remove(self, map_name: str) -> None:
        """Remove the surface of a map, which is built again only by `begin`.

        Rows that remain after _CALL_S seconds are removed by workers. Raise UnknownMap if the map
        does not exist.
        """
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            surface = stored.find_surface(connection, row.number)
            if surface is None:
                surface = stored.add_surface(connection, row)
            job = _job_of(connection, surface)
            blobs = [] if job is None else queue.remove_job(connection, job)
            stored.write_surface(connection, row.number, wanted=False, job_number=None)
            record_change(connection, "surface.removed", map_name)
        collect_deleted_blobs(self._store, blobs)
        until = time.monotonic() + _CALL_S
        while not remove_block(self._store, row) and time.monotonic() < until:
            pass

    def tiles(
        self, map_name: str, parent: str | None = None, level: int = 0,
        cursor: str | None = None, limit: int = 1000,
    ) -> Page[SurfaceTile]:  # fmt: skip
        """Return a page of tiles, sorted by column, row and floor; empty if there is no surface.

        Parameters
        ----------
        parent : parent frame of the poses; None selects the parent frame with the most frames
        level : level of detail; 0 is the finest

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the service did not issue the cursor.
        """
        beyond = _place_of(cursor)
        with self._store.database.read() as connection:
            row, surface = stored.living_surface(connection, map_name)
            name = _parent_name(surface, parent)
            rows: list[TileRow] = []
            if surface is not None and name is not None:
                rows = stored.list_tiles(connection, row.number, name, level, beyond, limit + 1)
        more = "~".join(map(str, rows[limit - 1].place)) if len(rows) > limit else None
        items = [
            SurfaceTile(
                column=record.tile_x, row=record.tile_y, floor=record.tile_z, cells=record.cells,
                bytes=record.cells * CELL.itemsize, digest=record.digest,
            )
            for record in rows[:limit]
        ]  # fmt: skip
        return Page[SurfaceTile](items=items, next_cursor=more)

    def tile(self, map_name: str, digest: str) -> Output[bytes]:
        """Return the cells of a tile as bytes.

        If the bytes are lost, `Output.make` raises DamagedBlob, and a worker rebuilds the tile.

        Raises
        ------
        UnknownMap, NotFound : If the map does not exist, or has no tile with this digest.
        """
        with self._store.database.read() as connection:
            row, surface = stored.living_surface(connection, map_name)
            stored_tile = None
            if surface is not None:
                stored_tile = stored.tile_of_digest(connection, row.number, digest)
        if surface is None or stored_tile is None:
            raise _unknown_tile(row, digest)
        scale = scale_of(surface)

        def make() -> bytes:
            try:
                return tile_cells(self._store, stored_tile, scale).tobytes()
            except DamagedBlob:
                self._rebuild_tile(row, stored_tile)
                raise

        return Output(digest, make)

    def sightings(
        self, map_name: str, spot: Sequence[float], radius: float | None = None,
        parent: str | None = None, cursor: str | None = None, limit: int = 20,
    ) -> Page[SurfaceSighting]:  # fmt: skip
        """Return a page of the frames that observed a spot, nearest viewpoint first.

        A page may have fewer than `limit` frames, since a call checks a limited number of frames.

        Parameters
        ----------
        spot : x, y, z in the parent frame, metres
        radius : a frame must have a point within this distance of the spot, metres; default: two
            cell widths
        parent : parent frame; None selects the parent frame with the most frames

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the service did not issue the cursor, or the radius is not positive or
            exceeds 64 cell widths.
        """
        beyond = self._store.seals.moment("frame", cursor)
        with self._store.database.read() as connection:
            _, surface = stored.living_surface(connection, map_name)
        name = _parent_name(surface, parent)
        if surface is None or name is None or not surface.cell_m:
            return Page[SurfaceSighting](items=[])
        within = _NEAR * surface.cell_m if radius is None else radius
        if not 0 < within <= _NEAREST * surface.cell_m:
            raise InvalidRequest(
                f"The radius is {within:g} m. Use a radius above 0 and up to "
                f"{_NEAREST * surface.cell_m:g} m.",
                (("radius", "out of range"),),
            )
        places = _tiles_around(spot, within, surface.cell_m * SIDE)
        hits: list[SightingFrame] = []
        count = 0
        while len(hits) < limit and count < _OPENED:
            with self._store.database.read() as connection:
                block = stored.frames_seeing(
                    connection, surface, name, places, spot, beyond, _AT_ONCE
                )
            for row in block:
                beyond = row.square, row.number
                count += 1
                if self._saw(row, spot, within):
                    hits.append(row)
                if len(hits) == limit:
                    break
            if len(block) < _AT_ONCE and len(hits) < limit:
                beyond = None
                break
        more = None if beyond is None else self._moment(beyond)
        items = [_sighting(hit, name, math.sqrt(hit.square)) for hit in hits]
        return Page[SurfaceSighting](items=items, next_cursor=more)

    def frames_in(
        self, map_name: str, low: Sequence[float], high: Sequence[float],
        parent: str | None = None, cursor: str | None = None, limit: int = 20,
    ) -> Page[SurfaceSighting]:  # fmt: skip
        """Return a page of the frames with viewpoints in a box, sorted by distance from its centre.

        Parameters
        ----------
        low, high : minimum and maximum x, y, z, metres
        """
        beyond = self._store.seals.moment("frame", cursor)
        ends = np.sort([low, high], axis=0).tolist()
        with self._store.database.read() as connection:
            _, surface = stored.living_surface(connection, map_name)
            name = _parent_name(surface, parent)
            if surface is None or name is None:
                return Page[SurfaceSighting](items=[])
            rows = stored.frames_captured_in(
                connection, surface, name, ends[0], ends[1], beyond, limit + 1
            )
        last = rows[limit - 1] if len(rows) > limit else None
        more = None if last is None else self._moment((last.square, last.number))
        items = [_sighting(row, name, None) for row in rows[:limit]]
        return Page[SurfaceSighting](items=items, next_cursor=more)

    def picture(
        self, map_name: str, parent: str | None = None, width: int = PLAN_WIDTH,
        low: float | None = None, high: float | None = None,
    ) -> Output[bytes]:  # fmt: skip
        """Draw a surface from above as a PNG with a transparent background.

        Parameters
        ----------
        parent : parent frame; None selects the parent frame with the most frames
        width : length of the longer side, pixels
        low, high : minimum and maximum height along the up vector, metres; None for no limit

        Raises
        ------
        UnknownMap : If the map does not exist.
        NotFound : If the map has no surface in the parent frame.
        """
        with self._store.database.read() as connection:
            row, surface = stored.living_surface(connection, map_name)
            name = _parent_name(surface, parent)
            record = None
            if surface is not None:
                record = next((p for p in surface.parents if p["parent_frame"] == name), None)
            totals = [
                total
                for total in stored.level_totals(connection, row.number)
                if total.parent == name
            ]
        if surface is None or record is None or not totals:
            raise NotFound(
                f"Map {row.name!r} has no surface in that parent frame. Start a build with "
                f"POST /v1/maps/{row.name}/surface; GET /v1/maps/{row.name}/surface lists the "
                "parent frames."
            )
        axes = np.array(record["axes"])
        plan = plan_frame(axes, totals[0].low, totals[0].high, surface.cell_m, width)
        level = _drawn_level(surface, totals, plan)

        def make() -> bytes:
            with self._store.database.read() as connection:
                tiles = stored.list_tiles(connection, row.number, totals[0].parent, level)
            points = (self._points(surface, tile) for tile in tiles)
            return surface_picture(plan, axes, points, surface.cell_m * FACTOR**level, (low, high))

        tag = tag_of("surface-plan", row.number, surface.updated_at, record["axes"], width, low,
                     high, name)  # fmt: skip
        return Output(tag, make)

    def _points(self, surface: SurfaceRow, tile: TileRow) -> Floats:
        """Return the points (N, 3) of a tile, metres; empty if the tile is lost or was replaced."""
        try:
            cells = tile_cells(self._store, tile, scale_of(surface))
        except DamagedBlob:
            return np.zeros((0, 3))
        return cell_points(cells, tile.place, surface.cell_m * FACTOR**tile.level * SIDE)

    def _saw(self, frame: SightingFrame, spot: Sequence[float], within: float) -> bool:
        try:
            geometry = read_geometry(self._store.blobs.get(frame.geometry))
        except (DamagedBlob, UnreadableGeometry):
            return False
        apart = transform_points(np.array(frame.pose), surface_points(geometry)) - np.array(spot)
        return bool(((apart * apart).sum(axis=1) <= within * within).any())

    def _rebuild_tile(self, row: MapRow, tile: TileRow) -> None:
        """Schedule a lost tile to be rebuilt; raise NotFound if the tile was replaced meanwhile."""
        with self._store.database.write() as connection:
            now = stored.tile_of_number(connection, tile.number)
            if now is None or now.blob != tile.blob:
                raise _unknown_tile(row, tile.digest)
            stored.schedule_rebuild(connection, now)

    def _moment(self, last: tuple[float, int]) -> str | None:
        return self._store.seals.next_moment("frame", [last, last], 1)


def begin_job(connection: Connection, row: MapRow, surface: SurfaceRow) -> tuple[bool, list[str]]:
    """Queue a job for an outdated surface, unless a job is pending; remove the former job.

    If no frame must be added or removed, record that the surface is up to date instead.

    Returns
    -------
    pending : whether a job is pending now
    blobs : blobs of the former job, to collect after the commit
    """
    job = _job_of(connection, surface)
    if job is not None and not job.state.over:
        return True, []
    if surface.is_current(row):
        return False, []
    is_done = not (
        stored.count_unprocessed(connection, surface)
        or stored.count_unfinished(connection, surface)
    )
    if surface.model_id == row.model_id and is_done:
        stored.write_surface(
            connection, row.number, revision=row.revision, edits=surface.pose_edits
        )
        return False, []
    if surface.model_id != row.model_id and not stored.count_posed(connection, row):
        fused = stored.count_fused(connection, row.number)
        if not fused:
            stored.write_surface(
                connection, row.number, model_id=row.model_id, cell_m=0.0,
                revision=row.revision, edits=surface.pose_edits,
            )  # fmt: skip
            return False, []
    blobs = [] if job is None else queue.remove_job(connection, job)
    data = {"revision": row.revision, "edits": surface.pose_edits}
    new = queue.enqueue(connection, SURFACE, None, BACKGROUND, map_number=row.number, data=data)
    stored.write_surface(connection, row.number, job_number=new.number)
    return True, blobs


def remove_block(store: Store, row: MapRow) -> bool:
    """Remove a block of the rows of a deleted surface; return whether no rows remain."""
    with store.database.write(map_number=row.number) as connection:
        surface = stored.find_surface(connection, row.number)
        if surface is None or surface.wanted:
            return True
        blobs, over = stored.remove_block(connection, row.number)
        if over:
            stored.write_surface(
                connection, row.number, model_id="", parents=[], sessions=[], updated_at=None
            )
    collect_deleted_blobs(store, blobs)
    return over


#: Seconds between checks of all maps, and maximum delay of a job while new frames arrive.
LOOK_S, LONGEST_S = 5.0, 60.0
#: Time of the first unhandled change of a map without such changes.
_DONE = math.inf
#: Maximum number of surface rows to insert in one check.
_ROWS_AT_ONCE = 100


class SurfaceUpkeep:
    """Scheduler of jobs for outdated surfaces; several processes may run it at the same time.

    Parameters
    ----------
    auto : whether new frames start jobs; deleted frames always do
    """

    def __init__(self, store: Store, bell: Wakeup, *, auto: bool) -> None:
        self._store, self._bell, self._auto = store, bell, auto
        self._next = 0.0
        # for each map: revision and number of edits, and time of the first unhandled change
        self._seen: dict[int, tuple[tuple[int, int], float]] = {}

    def run(self) -> None:
        """Check all maps, at most every LOOK_S seconds; log errors instead of raising them."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + LOOK_S
        try:
            with self._store.database.read() as connection:
                pairs = stored.maps_to_update(connection)
            if self._auto:
                self._add_rows([row for row, surface in pairs if surface is None])
            changes_before = self._seen
            self._seen = {}
            for row, surface in pairs:
                if surface is None:
                    continue
                if not surface.wanted:
                    if surface.model_id:
                        remove_block(self._store, row)
                    continue
                self._begin_after_changes(row, surface, changes_before.get(row.number))
        except SceneprintError as error:
            log.warning("check of surfaces failed", extra={"error": str(error)})

    def _begin_after_changes(
        self, row: MapRow, surface: SurfaceRow, last_change: tuple[tuple[int, int], float] | None
    ) -> None:
        """Start a job once no new frames arrive, at the latest LONGEST_S after the first change.

        A job that failed with the same frames is not repeated.
        """
        at = row.revision, surface.pose_edits
        changed = last_change is None or last_change[0] != at
        since = (
            time.monotonic()
            if last_change is None or (changed and last_change[1] == _DONE)
            else last_change[1]
        )
        self._seen[row.number] = at, since
        if since == _DONE or (changed and time.monotonic() - since < LONGEST_S):
            return
        self._seen[row.number] = at, _DONE
        with self._store.database.read() as connection:  # usually none is due: avoid a write lock
            job = _job_of(connection, surface)
            if (
                job is not None
                and job.state.over
                and job.state != JobState.SUCCEEDED
                and job.data == {"revision": row.revision, "edits": surface.pose_edits}
            ):
                return  # the user has to retry a job that failed with the same frames
            if not self._auto and not stored.frames_to_remove(connection, surface, 1):
                return
        with self._store.database.write(map_number=row.number) as connection:
            row = map_of_number(connection, row.number)
            now = stored.find_surface(connection, row.number)
            if now is None or not now.wanted:
                return
            pending, blobs = begin_job(connection, row, now)
        collect_deleted_blobs(self._store, blobs)
        if pending:
            self._bell.ring()

    def _add_rows(self, rows: Sequence[MapRow]) -> None:
        if not rows:
            return
        with self._store.database.write() as connection:
            for row in rows[:_ROWS_AT_ONCE]:
                with suppress(SceneprintError):
                    number = map_of_number(connection, row.number).number
                    if stored.find_surface(connection, number) is None:
                        stored.add_surface(connection, row)


def _job_of(connection: Connection, surface: SurfaceRow) -> JobRow | None:
    if surface.job_number is None:
        return None
    return queue.job_of_number(connection, surface.job_number)


def _surface_record(connection: Connection, row: MapRow, surface: SurfaceRow | None) -> MapSurface:
    """Return the API record of a surface; None stands for a map without a surface."""
    if surface is None:
        return MapSurface(
            map=row.name, state="none", job_id=None, error=None, frames=0,
            frames_left=stored.count_posed(connection, row), updated_at=None, sessions=[],
            first_taken=None, last_taken=None, taken_from=None, taken_step_s=1.0, parents=[],
        )  # fmt: skip
    job = _job_of(connection, surface)
    is_building = job is not None and not job.state.over
    frames = sum(stored.count_fused(connection, row.number).values())
    frames_left = 0
    if is_building and job is not None and job.progress and job.progress.get("total"):
        frames_left = job.progress["total"] - job.progress.get("done", 0)
    elif not surface.is_current(row):
        of_model = surface.model_id == row.model_id
        frames_left = (
            stored.count_unprocessed(connection, surface)
            if of_model
            else stored.count_posed(connection, row)
        )
    state: SurfaceState = "stale" if frames_left else "ready"
    if is_building:
        state = "building"
    elif not frames:
        state = "none"
    totals = stored.level_totals(connection, row.number)
    failed = job is not None and job.state.over and job.state != JobState.SUCCEEDED
    return MapSurface(
        map=row.name, state=state, job_id=None if job is None else job.id,
        error=job.error if job is not None and failed else None,
        frames=frames, frames_left=frames_left, updated_at=when(surface.updated_at),
        sessions=surface.sessions, first_taken=when(surface.first_taken),
        last_taken=when(surface.last_taken), taken_from=when(surface.taken_from),
        taken_step_s=surface.taken_step_s,
        parents=[
            _parent_record(surface, parent, own)
            for parent in surface.parents
            if (own := [level for level in totals if level.parent == parent["parent_frame"]])
        ],
    )  # fmt: skip


def _parent_record(
    surface: SurfaceRow, parent: dict[str, Any], totals: Sequence[LevelTotals]
) -> SurfaceParent:
    finest = totals[0]
    plan = plan_frame(np.array(parent["axes"]), finest.low, finest.high, surface.cell_m, PLAN_WIDTH)
    return SurfaceParent(
        parent_frame=parent["parent_frame"], frames=parent["frames"], up=vector(parent["up"]),
        up_from=parent["up_from"], x_axis=parent["axes"][0], y_axis=parent["axes"][1],
        low=vector(finest.low), high=vector(finest.high),
        levels=[
            SurfaceLevel(
                level=level.level, cell_m=surface.cell_m * FACTOR**level.level,
                tile_m=surface.cell_m * FACTOR**level.level * SIDE, tiles=level.tiles,
                cells=level.cells, bytes=level.cells * CELL.itemsize,
            )
            for level in totals
        ],
        plan=copy_fields(SurfacePlan, plan),
    )  # fmt: skip


def _unknown_tile(row: MapRow, digest: str) -> NotFound:
    return NotFound(
        f"Map {row.name!r} has no tile {digest!r:.80}. It may have changed or been removed. List "
        f"the tiles with GET /v1/maps/{row.name}/surface/tiles."
    )


def _sighting(frame: SightingFrame, parent: str, distance: float | None) -> SurfaceSighting:
    return SurfaceSighting(
        frame_id=frame.id, name=frame.name, kind="cloud" if frame.is_cloud else "depth",
        robot=frame.robot, session=frame.session, captured_at=when(frame.captured_at),
        parent_frame=parent, position=vector(frame.pose[i][3] for i in range(3)),
        distance_m=distance,
    )  # fmt: skip


def _parent_name(surface: SurfaceRow | None, parent: str | None) -> str | None:
    """Return the requested parent frame, or the parent frame with the most frames."""
    if parent is not None or surface is None:
        return parent
    return surface.parents[0]["parent_frame"] if surface.parents else None


def _place_of(cursor: str | None) -> TilePlace | None:
    if cursor is None:
        return None
    try:
        x, y, z = (int(part) for part in cursor.split("~"))
    except ValueError:
        raise invalid_cursor(cursor) from None
    if max(abs(x), abs(y), abs(z)) >= 2**62:
        raise invalid_cursor(cursor)
    return x, y, z


def _tiles_around(spot: Sequence[float], within: float, tile_m: float) -> list[TilePlace]:
    """Return the places of all tiles that a ball with the radius `within` may intersect."""
    low = [math.floor((at - within) / tile_m) for at in spot]
    high = [math.floor((at + within) / tile_m) for at in spot]
    x, y, z = (range(a, b + 1) for a, b in zip(low, high, strict=True))
    return [(i, j, k) for i in x for j in y for k in z]


def _drawn_level(surface: SurfaceRow, totals: Sequence[LevelTotals], plan: PlanFrame) -> int:
    """Return the coarsest level with cells up to a pixel wide, or a coarser one with few cells."""
    fine = [level for level in totals if surface.cell_m * FACTOR**level.level <= plan.m_per_pixel]
    first = fine[-1].level if fine else 0
    few = [level.level for level in totals if level.level >= first and level.cells <= _DRAWN_CELLS]
    return few[0] if few else totals[-1].level
