"""Rows of surfaces: tiles, fused frames and pending work.

Rows link each frame to the tiles that it overlaps. When a frame is deleted or edited, these tiles
are rebuilt from their other frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import (
    ColumnElement,
    Connection,
    Select,
    and_,
    delete,
    func,
    insert,
    null,
    or_,
    select,
    tuple_,
    update,
)

from sceneprint.geometry.cells import FACTOR, TilePlace
from sceneprint.store.deletion import doom
from sceneprint.store.maps import find_map
from sceneprint.store.tables import (
    MapRow,
    among,
    blocks,
    count_rows,
    frames,
    map_row,
    maps,
    rows_among,
    signatures,
    surface_frames,
    surface_tiles,
    surface_touches,
    surfaces,
)
from sceneprint_client.api import FrameState

#: Value of `scale` for a tile that must be published again.
NO_SCALE = -1
#: Columns of a frame that affect its contribution to a surface.
FUSED_COLUMNS = frozenset(("pose", "pose_parent", "session", "captured_at"))


@dataclass(frozen=True)
class SurfaceRow:
    """A row of the table `surfaces`."""

    map_number: int
    model_id: str
    cell_m: float
    wanted: bool
    job_number: int | None
    revision: int
    edits: int
    pose_edits: int
    scale: int
    taken_from: float | None
    taken_step_s: float
    first_taken: float | None
    last_taken: float | None
    sessions: list[str]
    parents: list[dict[str, Any]]
    updated_at: float | None

    def is_current(self, row: MapRow) -> bool:
        """Return whether the surface includes all changes of its map."""
        return (
            self.revision == row.revision
            and self.edits == self.pose_edits
            and self.model_id == row.model_id
        )


def find_surface(connection: Connection, map_number: int) -> SurfaceRow | None:
    """Return the surface of a map; None if no build was ever started."""
    statement = select(surfaces).where(surfaces.c.map_number == map_number)
    row = connection.execute(statement).mappings().first()
    return None if row is None else SurfaceRow(**row)


def add_surface(connection: Connection, row: MapRow) -> SurfaceRow:
    """Insert a surface, and return its row; the first job sets its model."""
    new = SurfaceRow(
        map_number=row.number, model_id="", cell_m=0.0, wanted=True, job_number=None,
        revision=-1, edits=0, pose_edits=0, scale=0, taken_from=None, taken_step_s=1.0,
        first_taken=None,
        last_taken=None, sessions=[], parents=[], updated_at=None,
    )  # fmt: skip
    connection.execute(insert(surfaces).values(**vars(new)))
    return new


def write_surface(connection: Connection, map_number: int, **values: object) -> None:
    """Change columns of a surface."""
    own = surfaces.c.map_number == map_number
    connection.execute(update(surfaces).where(own).values(**values))


def note_edit(connection: Connection, numbers: Sequence[int], map_number: int) -> None:
    """Mark fused frames as edited, and count the edit, in the transaction of the edit."""
    mark_edited(connection, numbers)
    write_surface(connection, map_number, pose_edits=surfaces.c.pose_edits + 1)


def mark_edited(connection: Connection, numbers: Sequence[int]) -> None:
    """Mark fused frames as edited without counting the edit; their map has a new revision."""
    for block in blocks(numbers):
        own = among(connection, surface_frames.c.frame_number, block)
        connection.execute(update(surface_frames).where(own).values(changed=True))


def maps_to_update(connection: Connection) -> list[tuple[MapRow, SurfaceRow | None]]:
    """Return the maps without a surface, and those whose surface may be outdated."""
    statement = (
        select(maps, surfaces)
        .join(surfaces, surfaces.c.map_number == maps.c.number, isouter=True)
        .where(
            surfaces.c.map_number.is_(None)
            | (surfaces.c.revision != maps.c.revision)
            | (surfaces.c.edits != surfaces.c.pose_edits)
            | (surfaces.c.model_id != maps.c.model_id)
        )
        .order_by(maps.c.number)
    )
    pairs = []
    for values in connection.execute(statement):
        row = dict(zip((c.name for c in maps.c), values, strict=False))
        own = dict(zip((c.name for c in surfaces.c), values[len(maps.c) :], strict=True))
        surface = None if own["map_number"] is None else SurfaceRow(**own)
        pairs.append((map_row(row), surface))  # type: ignore[arg-type]
    return pairs


def count_unfinished(connection: Connection, surface: SurfaceRow) -> int:
    """Count the tiles to rebuild or to publish again."""
    c = surface_tiles.c
    lacking = c.rebuilt_to.is_not(None) | ((c.level == 0) & (c.scale != surface.scale))
    return count_rows(connection, c.map_number == surface.map_number, lacking)


# Frames to fuse, fused frames, and frames to remove.


@dataclass(frozen=True)
class FusedFrame:
    """A frame with the values that affect its contribution to a surface.

    Parameters
    ----------
    parent, pose : parent frame, and T_parent_sensor (4, 4)
    session, captured_at : run and capture time; None if unknown
    geometry : digest of the geometry artifact
    """

    number: int
    parent: str
    pose: list[list[float]]
    session: str | None
    captured_at: float | None
    geometry: str


def _posed(map_number: int, model_id: str) -> Select[Any]:
    """Return the query of the numbers of all frames that belong in a surface."""
    c = frames.c
    return (
        select(c.number)
        .join(signatures, signatures.c.frame_number == c.number)
        .where(
            c.map_number == map_number, c.state == FrameState.INDEXED, c.pose_x.is_not(None),
            signatures.c.model_id == model_id,
        )
    )  # fmt: skip


def _unfused(surface: SurfaceRow) -> Select[Any]:
    fused = select(surface_frames.c.frame_number).where(
        surface_frames.c.frame_number == frames.c.number
    )
    return _posed(surface.map_number, surface.model_id).where(~fused.exists())


def _outdated(surface: SurfaceRow) -> Select[Any]:
    is_outdated: ColumnElement[bool] = or_(
        surface_frames.c.changed,
        frames.c.state != FrameState.INDEXED,
        frames.c.pose_x.is_(None),
    )
    return (
        select(surface_frames.c.frame_number)
        .join(frames, frames.c.number == surface_frames.c.frame_number)
        .where(surface_frames.c.map_number == surface.map_number, is_outdated)
    )


def count_posed(connection: Connection, row: MapRow) -> int:
    """Count the frames of a map that belong in a surface."""
    return _count(connection, _posed(row.number, row.model_id))


def _count(connection: Connection, statement: Select[Any]) -> int:
    return connection.execute(select(func.count()).select_from(statement.subquery())).scalar_one()


def count_fused(connection: Connection, map_number: int) -> dict[str, int]:
    """Count the fused frames of a map by parent frame."""
    c = surface_frames.c
    counts = select(c.parent, func.count()).where(c.map_number == map_number).group_by(c.parent)
    return {row[0]: row[1] for row in connection.execute(counts)}


def count_unprocessed(connection: Connection, surface: SurfaceRow) -> int:
    """Count the frames to fuse or to remove."""
    return _count(connection, _unfused(surface)) + _count(connection, _outdated(surface))


def frames_to_fuse(
    connection: Connection, surface: SurfaceRow, after: int, limit: int
) -> list[FusedFrame]:
    """Return up to `limit` frames to fuse after frame number `after`."""
    unfused = _unfused(surface).where(frames.c.number > after)
    numbers = connection.execute(unfused.order_by(frames.c.number).limit(limit)).scalars().all()
    return fused_frames(connection, surface, numbers)


def frames_to_remove(connection: Connection, surface: SurfaceRow, limit: int) -> list[int]:
    """Return the numbers of up to `limit` fused frames that were deleted or edited."""
    outdated = _outdated(surface).order_by(surface_frames.c.frame_number).limit(limit)
    return list(connection.execute(outdated).scalars())


def fused_frames(
    connection: Connection, surface: SurfaceRow, numbers: Iterable[int]
) -> list[FusedFrame]:
    """Return the frames with these numbers, ascending, except frames without pose or artifact."""
    c = frames.c
    statement = (
        _posed(surface.map_number, surface.model_id)
        .with_only_columns(
            c.number, c.pose_parent, c.pose, c.session, c.captured_at, signatures.c.geometry
        )
        .order_by(c.number)
    )
    return [FusedFrame(*row) for row in rows_among(connection, statement, c.number, numbers)]


def add_fused(connection: Connection, surface: SurfaceRow, fused: Sequence[FusedFrame]) -> None:
    """Record frames as fused; mark those as edited that have changed since they were read."""
    now = {
        frame.number: frame
        for frame in fused_frames(connection, surface, [f.number for f in fused])
    }
    rows = [
        {"frame_number": frame.number, "map_number": surface.map_number, "parent": frame.parent,
         "changed": now.get(frame.number) != frame}
        for frame in fused
    ]  # fmt: skip
    if rows:
        connection.execute(insert(surface_frames), rows)


def capture_range(connection: Connection, surface: SurfaceRow) -> tuple[float, float] | None:
    """Return the first and last capture time of all frames that belong in a surface."""
    at, posed = frames.c.captured_at, _posed(surface.map_number, surface.model_id)
    first, last = connection.execute(posed.with_only_columns(func.min(at), func.max(at))).one()
    return None if first is None else (first, last)


def fused_range(connection: Connection, map_number: int) -> tuple[float | None, float | None]:
    """Return the first and last capture time of the fused frames of a map."""
    at = frames.c.captured_at
    statement = (
        select(func.min(at), func.max(at))
        .join(surface_frames, surface_frames.c.frame_number == frames.c.number)
        .where(surface_frames.c.map_number == map_number)
    )
    first, last = connection.execute(statement).one()
    return first, last


def sample_fused(connection: Connection, map_number: int, parent: str, most: int) -> list[int]:
    """Return the numbers of up to `most` evenly spaced fused frames in a parent frame."""
    c = surface_frames.c
    own = (c.map_number == map_number) & (c.parent == parent)
    statement = select(c.frame_number).where(own).order_by(c.frame_number)
    numbers = list(connection.execute(statement).scalars())
    return numbers[:: max(-(-len(numbers) // most), 1)]


@dataclass(frozen=True)
class TileRow:
    """A row of the table `surface_tiles`."""

    number: int
    map_number: int
    parent: str
    level: int
    tile_x: int
    tile_y: int
    tile_z: int
    cells: int
    blob: str | None
    digest: str
    scale: int
    rebuilt_to: int | None
    draft: str | None
    low_x: float
    low_y: float
    low_z: float
    high_x: float
    high_y: float
    high_z: float

    @property
    def place(self) -> TilePlace:
        """Column, row and floor of the tile."""
        return self.tile_x, self.tile_y, self.tile_z


def tiles_at(
    connection: Connection, map_number: int, parent: str, level: int, places: Iterable[TilePlace]
) -> dict[TilePlace, TileRow]:
    """Return the existing tiles at `places` of a parent frame and level, by place."""
    c = surface_tiles.c
    # one statement per row and floor is faster than a list of many tuples
    columns: dict[tuple[int, int], list[int]] = {}
    for x, y, z in sorted(set(places)):
        columns.setdefault((y, z), []).append(x)
    tiles: dict[TilePlace, TileRow] = {}
    for (y, z), xs in columns.items():
        statement = select(surface_tiles).where(
            c.map_number == map_number, c.parent == parent, c.level == level, c.tile_y == y,
            c.tile_z == z, c.tile_x.in_(xs),
        )  # fmt: skip
        tiles |= {tile.place: tile for tile in _tiles(connection, statement)}
    return tiles


def _tiles(connection: Connection, statement: Select[Any]) -> list[TileRow]:
    return [TileRow(**row) for row in connection.execute(statement).mappings()]


def tile_of_digest(connection: Connection, map_number: int, digest: str) -> TileRow | None:
    """Return a published tile by digest; None if it does not exist."""
    c = surface_tiles.c
    own = c.map_number == map_number, c.digest == digest, c.blob.is_not(None)
    return next(iter(_tiles(connection, select(surface_tiles).where(*own).limit(1))), None)


def tile_of_number(connection: Connection, number: int) -> TileRow | None:
    """Return a tile by number; None if it was removed."""
    own = surface_tiles.c.number == number
    return next(iter(_tiles(connection, select(surface_tiles).where(own))), None)


def schedule_rebuild(connection: Connection, tile: TileRow) -> None:
    """Doom the blobs of a lost tile, and schedule its rebuild from frames or from finer tiles."""
    own = surface_tiles.c.number == tile.number
    doom(connection, [blob for blob in (tile.blob, tile.draft) if blob])
    if tile.level == 0:
        lost = {"rebuilt_to": 0, "blob": None, "draft": None, "scale": NO_SCALE}
        connection.execute(update(surface_tiles).where(own).values(**lost))
    else:
        connection.execute(delete(surface_tiles).where(own))
        forget_scale(connection, tile.map_number, tile.parent, tile.place, FACTOR**tile.level)
    note_edit(connection, [], tile.map_number)


def list_tiles(
    connection: Connection, map_number: int, parent: str, level: int,
    beyond: TilePlace | None = None, limit: int | None = None,
) -> list[TileRow]:  # fmt: skip
    """Return up to `limit` published tiles after a place, sorted by column, row and floor."""
    c = surface_tiles.c
    place = (c.tile_x, c.tile_y, c.tile_z)
    statement = select(surface_tiles).where(
        c.map_number == map_number, c.parent == parent, c.level == level, c.blob.is_not(None)
    )
    if beyond is not None:
        statement = statement.where(tuple_(*place) > tuple_(*beyond))
    return _tiles(connection, statement.order_by(*place).limit(limit))


@dataclass(frozen=True)
class LevelTotals:
    """Totals of the tiles of a parent frame and level; `low` and `high` (3,) bound the cells."""

    parent: str
    level: int
    tiles: int
    cells: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]


def level_totals(connection: Connection, map_number: int) -> list[LevelTotals]:
    """Return the totals of the published tiles by parent frame and level."""
    c = surface_tiles.c
    lows = [func.min(column) for column in (c.low_x, c.low_y, c.low_z)]
    highs = [func.max(column) for column in (c.high_x, c.high_y, c.high_z)]
    statement = (
        select(c.parent, c.level, func.count(), func.sum(c.cells), *lows, *highs)
        .where(c.map_number == map_number, c.blob.is_not(None))
        .group_by(c.parent, c.level)
        .order_by(c.parent, c.level)
    )
    return [
        LevelTotals(row[0], row[1], row[2], int(row[3]), tuple(row[4:7]), tuple(row[7:10]))
        for row in connection.execute(statement)
    ]


def tiles_to_rebuild(connection: Connection, map_number: int, most: int) -> list[TileRow]:
    """Return up to `most` tiles to rebuild, only those with the most advanced rebuild."""
    c = surface_tiles.c
    own = c.map_number == map_number, c.rebuilt_to.is_not(None)
    statement = select(surface_tiles).where(*own).order_by(c.rebuilt_to.desc(), c.number)
    tiles = _tiles(connection, statement.limit(most))
    return [tile for tile in tiles if tile.rebuilt_to == tiles[0].rebuilt_to]


def tiles_of_other_scale(connection: Connection, surface: SurfaceRow, most: int) -> list[TileRow]:
    """Return up to `most` tiles of the finest level with an outdated time scale."""
    c = surface_tiles.c
    statement = select(surface_tiles).where(
        c.map_number == surface.map_number, c.level == 0, c.scale != surface.scale,
        c.rebuilt_to.is_(None),
    )  # fmt: skip
    return _tiles(connection, statement.order_by(c.number).limit(most))


def forget_scale(
    connection: Connection, map_number: int, parent: str, place: TilePlace, factor: int
) -> None:
    """Schedule the finest tiles within a lost coarser tile to be published again.

    Parameters
    ----------
    connection, map_number, parent : see `tiles_at`
    factor : width of the coarser tile, in widths of the finest tiles
    """
    c = surface_tiles.c
    within = [
        column.between(at * factor, (at + 1) * factor - 1)
        for column, at in zip((c.tile_x, c.tile_y, c.tile_z), place, strict=True)
    ]
    own = (c.map_number == map_number) & (c.parent == parent) & (c.level == 0)
    connection.execute(update(surface_tiles).where(own, *within).values(scale=NO_SCALE))


def write_tile(
    connection: Connection, map_number: int, parent: str, level: int, place: TilePlace,
    values: dict[str, Any],
) -> tuple[int, list[str]]:  # fmt: skip
    """Insert or change a tile.

    Returns
    -------
    number : number of the tile
    blobs : blobs that the tile no longer refers to
    """
    c = surface_tiles.c
    before = tiles_at(connection, map_number, parent, level, [place]).get(place)
    if before is None:
        x, y, z = place
        blank: dict[str, Any] = {"cells": 0, "digest": "", "scale": NO_SCALE}
        blank |= dict.fromkeys(("low_x", "low_y", "low_z", "high_x", "high_y", "high_z"), 0.0)
        new = insert(surface_tiles).values(
            map_number=map_number, parent=parent, level=level, tile_x=x, tile_y=y, tile_z=z,
            **(blank | values),
        )  # fmt: skip
        return int(connection.execute(new.returning(c.number)).scalar_one()), []
    connection.execute(update(surface_tiles).where(c.number == before.number).values(**values))
    current = {values.get(name, getattr(before, name)) for name in ("blob", "draft")}
    return before.number, [b for b in (before.blob, before.draft) if b and b not in current]


def remove_tiles(connection: Connection, tiles: Sequence[TileRow]) -> list[str]:
    """Remove tiles and their links to frames; return the blobs of the tiles."""
    for block in blocks(tile.number for tile in tiles):
        touches = among(connection, surface_touches.c.tile_number, block)
        connection.execute(delete(surface_touches).where(touches))
        own = among(connection, surface_tiles.c.number, block)
        connection.execute(delete(surface_tiles).where(own))
    return [blob for tile in tiles for blob in (tile.blob, tile.draft) if blob]


def add_touches(connection: Connection, touches: Iterable[tuple[int, int]]) -> None:
    """Insert links between tiles and frames: pairs of tile number and frame number."""
    rows = [{"tile_number": tile, "frame_number": frame} for tile, frame in sorted(touches)]
    if rows:
        connection.execute(insert(surface_touches), rows)


def frames_touching(
    connection: Connection, tiles: Sequence[int], after: int, limit: int
) -> list[int]:
    """Return the numbers of up to `limit` frames after `after` that overlap any of the tiles."""
    c = surface_touches.c
    statement = (
        select(c.frame_number)
        .where(among(connection, c.tile_number, tiles), c.frame_number > after)
        .distinct()
        .order_by(c.frame_number)
        .limit(limit)
    )
    return list(connection.execute(statement).scalars())


def remove_fused(connection: Connection, numbers: Sequence[int]) -> None:
    """Remove fused frames, and schedule the tiles that they overlap to be rebuilt."""
    c = surface_touches.c
    own = among(connection, c.frame_number, numbers)
    tiles = list(connection.execute(select(c.tile_number).where(own).distinct()).scalars())
    for block in blocks(tiles):
        touched = among(connection, surface_tiles.c.number, block)
        connection.execute(update(surface_tiles).where(touched).values(rebuilt_to=0))
    connection.execute(delete(surface_touches).where(own))
    fused = among(connection, surface_frames.c.frame_number, numbers)
    connection.execute(delete(surface_frames).where(fused))


#: Number of tiles to remove in one commit; ten times as many frames are removed.
_AT_ONCE = 50


def remove_block(connection: Connection, map_number: int) -> tuple[list[str], bool]:
    """Remove a block of tiles and frames of a surface.

    Returns
    -------
    blobs : doomed blobs, to be collected after the commit
    over : whether all tiles and frames are removed
    """
    c = surface_tiles.c
    own = c.map_number == map_number
    tiles = _tiles(connection, select(surface_tiles).where(own).limit(_AT_ONCE))
    blobs = remove_tiles(connection, tiles)
    doom(connection, blobs)
    if len(tiles) == _AT_ONCE:
        return blobs, False
    f = surface_frames.c
    statement = select(f.frame_number).where(f.map_number == map_number).limit(10 * _AT_ONCE)
    numbers = list(connection.execute(statement).scalars())
    fused = among(connection, f.frame_number, numbers)
    connection.execute(delete(surface_frames).where(fused))
    return blobs, len(numbers) < 10 * _AT_ONCE


# Frames by position, or by the tiles that they overlap.


@dataclass(frozen=True)
class SightingFrame:
    """A frame near a spot; `square` is the squared distance of its viewpoint, square metres."""

    number: int
    id: str
    name: str | None
    is_cloud: bool
    robot: str | None
    session: str | None
    captured_at: float | None
    pose: list[list[float]]
    geometry: str
    square: float


def frames_seeing(
    connection: Connection, surface: SurfaceRow, parent: str, places: Iterable[TilePlace],
    spot: Sequence[float], beyond: tuple[float, int] | None, limit: int,
) -> list[SightingFrame]:  # fmt: skip
    """Return frames that overlap a tile at one of `places`, sorted by distance from a spot.

    Parameters
    ----------
    places : places of tiles of the finest level
    spot : x, y, z of the spot, metres
    beyond : squared distance and number of the last frame of the previous page
    limit : maximum number of frames
    """
    tiles = tiles_at(connection, surface.map_number, parent, 0, places)
    touching = select(surface_touches.c.frame_number).where(
        among(connection, surface_touches.c.tile_number, [tile.number for tile in tiles.values()])
    )
    return _sightings(
        connection, surface, [frames.c.number.in_(touching), frames.c.pose_parent == parent],
        spot, beyond, limit,
    )  # fmt: skip


def frames_captured_in(
    connection: Connection, surface: SurfaceRow, parent: str, low: Sequence[float],
    high: Sequence[float], beyond: tuple[float, int] | None, limit: int,
) -> list[SightingFrame]:  # fmt: skip
    """Return frames captured in a box, sorted by distance from its centre; see `frames_seeing`."""
    sides = [
        getattr(frames.c, f"pose_{axis}").between(a, b)
        for axis, a, b in zip("xyz", low, high, strict=True)
    ]
    middle = ((np.array(low) + np.array(high)) / 2).tolist()
    conditions = [frames.c.pose_parent == parent, *sides]
    return _sightings(connection, surface, conditions, middle, beyond, limit)


def _sightings(
    connection: Connection, surface: SurfaceRow, conditions: Sequence[ColumnElement[bool]],
    spot: Sequence[float], beyond: tuple[float, int] | None, limit: int,
) -> list[SightingFrame]:  # fmt: skip
    c = frames.c
    apart = [getattr(c, f"pose_{axis}") - at for axis, at in zip("xyz", spot, strict=True)]
    square = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]
    statement = _posed(surface.map_number, surface.model_id).with_only_columns(
        c.number, c.id, c.name, c.cloud.is_not(null()), c.robot, c.session, c.captured_at, c.pose,
        signatures.c.geometry, square,
    ).where(*conditions)  # fmt: skip
    if beyond is not None:
        statement = statement.where(
            or_(square > beyond[0], and_(square == beyond[0], c.number > beyond[1]))
        )
    rows = connection.execute(statement.order_by(square, c.number).limit(limit))
    return [SightingFrame(*row) for row in rows]


def living_surface(connection: Connection, name: str) -> tuple[MapRow, SurfaceRow | None]:
    """Return a map and its surface; None for a surface that does not exist or was deleted.

    Raises
    ------
    UnknownMap : If the map does not exist.
    """
    row = find_map(connection, name)
    surface = find_surface(connection, row.number)
    return row, surface if surface is not None and surface.wanted else None
