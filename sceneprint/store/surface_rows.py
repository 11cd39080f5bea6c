"""Surfaces of maps: their tiles, the frames that are fused in them, and what is left to do.

Which frame touches which tile is a row each. So a frame that is gone or was edited costs the tiles
it touches, and those are made anew from the other frames that touch them.
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

#: Scale of a tile that is to be given out again.
NO_SCALE = -1
#: Columns of a frame that its share of a surface depends on.
FUSED_COLUMNS = frozenset(("pose", "pose_parent", "session", "captured_at"))


# The surface of a map as a whole.


@dataclass(frozen=True)
class SurfaceRow:
    """A surface; fields as in the table."""

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
        """Whether nothing came, went or was edited since its last job was over."""
        return (
            self.revision == row.revision
            and self.edits == self.pose_edits
            and self.model_id == row.model_id
        )


def find_surface(connection: Connection, map_number: int) -> SurfaceRow | None:
    """The surface of a map; None where none was ever begun."""
    asked = select(surfaces).where(surfaces.c.map_number == map_number)
    row = connection.execute(asked).mappings().first()
    return None if row is None else SurfaceRow(**row)


def add_surface(connection: Connection, row: MapRow) -> SurfaceRow:
    """A surface of no model yet: its first job sets that."""
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


def note_edit(connection: Connection, frame_number: int, map_number: int) -> None:
    """Let the surface learn that a frame was edited, in the transaction that does so."""
    mark_edited(connection, frame_number)
    _count_edit(connection, map_number)


def note_moved(connection: Connection, numbers: Sequence[int], map_number: int) -> None:
    """As `note_edit`, of many frames at once."""
    for some in blocks(numbers):
        own = among(connection, surface_frames.c.frame_number, some)
        connection.execute(update(surface_frames).where(own).values(changed=True))
    _count_edit(connection, map_number)


def _count_edit(connection: Connection, map_number: int) -> None:
    of_map = surfaces.c.map_number == map_number
    counted = update(surfaces).where(of_map).values(pose_edits=surfaces.c.pose_edits + 1)
    connection.execute(counted)


def mark_edited(connection: Connection, frame_number: int) -> None:
    """As `note_edit`, of a frame that takes a revision of its map with it."""
    own = surface_frames.c.frame_number == frame_number
    connection.execute(update(surface_frames).where(own).values(changed=True))


def maps_to_look_at(connection: Connection) -> list[tuple[MapRow, SurfaceRow | None]]:
    """Maps whose surfaces may lack something, or that have none."""
    asked = (
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
    found = []
    for values in connection.execute(asked):
        of_map = dict(zip((c.name for c in maps.c), values, strict=False))
        own = dict(zip((c.name for c in surfaces.c), values[len(maps.c) :], strict=True))
        surface = None if own["map_number"] is None else SurfaceRow(**own)
        found.append((map_row(of_map), surface))  # type: ignore[arg-type]
    return found


def count_unfinished(connection: Connection, surface: SurfaceRow) -> int:
    """How many tiles are to be made anew, or given out again."""
    c = surface_tiles.c
    lacking = c.rebuilt_to.is_not(None) | ((c.level == 0) & (c.scale != surface.scale))
    asked = select(func.count()).where(c.map_number == surface.map_number, lacking)
    return int(connection.execute(asked).scalar_one())


# Frames: those that are fused, that are to be, and that are no more.


@dataclass(frozen=True)
class FusedFrame:
    """A posed frame with all that its share of a surface depends on.

    Parameters
    ----------
    parent, pose : T_parent_sensor, 4 rows of 4, and where it leads
    session, captured_at : as far as is known
    geometry : blob of its artifact
    """

    number: int
    parent: str
    pose: list[list[float]]
    session: str | None
    captured_at: float | None
    geometry: str


def _posed(map_number: int, model_id: str) -> Select[Any]:
    """Numbers of the frames that a surface is made of, in order."""
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


def _fused_no_more(surface: SurfaceRow) -> Select[Any]:
    gone: ColumnElement[bool] = or_(
        surface_frames.c.changed,
        frames.c.state != FrameState.INDEXED,
        frames.c.pose_x.is_(None),
    )
    return (
        select(surface_frames.c.frame_number)
        .join(frames, frames.c.number == surface_frames.c.frame_number)
        .where(surface_frames.c.map_number == surface.map_number, gone)
    )


def count_posed(connection: Connection, row: MapRow) -> int:
    """How many frames of a map a surface would be made of."""
    asked = select(func.count()).select_from(_posed(row.number, row.model_id).subquery())
    return int(connection.execute(asked).scalar_one())


def count_fused(connection: Connection, map_number: int) -> dict[str, int]:
    """How many frames are fused, by parent frame."""
    c = surface_frames.c
    asked = select(c.parent, func.count()).where(c.map_number == map_number).group_by(c.parent)
    return {row[0]: row[1] for row in connection.execute(asked)}


def count_left(connection: Connection, surface: SurfaceRow) -> int:
    """How many frames are to be added, or taken out."""
    parts = (_unfused(surface), _fused_no_more(surface))
    return sum(
        int(connection.execute(select(func.count()).select_from(one.subquery())).scalar_one())
        for one in parts
    )


def frames_to_fuse(
    connection: Connection, surface: SurfaceRow, after: int, limit: int
) -> list[FusedFrame]:
    """The next frames that are not fused yet, from behind a number on."""
    asked = _unfused(surface).where(frames.c.number > after)
    numbers = connection.execute(asked.order_by(frames.c.number).limit(limit)).scalars().all()
    return fused_frames(connection, surface, numbers)


def frames_to_remove(connection: Connection, surface: SurfaceRow, limit: int) -> list[int]:
    """Numbers of fused frames that are gone or were edited."""
    asked = _fused_no_more(surface).order_by(surface_frames.c.frame_number).limit(limit)
    return list(connection.execute(asked).scalars())


def fused_frames(
    connection: Connection, surface: SurfaceRow, numbers: Iterable[int]
) -> list[FusedFrame]:
    """Frames by their numbers, in order; without those that have no pose or no artifact now."""
    c = frames.c
    asked = (
        _posed(surface.map_number, surface.model_id)
        .with_only_columns(
            c.number, c.pose_parent, c.pose, c.session, c.captured_at, signatures.c.geometry
        )
        .order_by(c.number)
    )
    return [FusedFrame(*row) for row in rows_among(connection, asked, c.number, numbers)]


def add_fused(connection: Connection, surface: SurfaceRow, fused: Sequence[FusedFrame]) -> None:
    """Note frames as fused; those that were edited since they were read are noted as such."""
    now = {
        one.number: one for one in fused_frames(connection, surface, [one.number for one in fused])
    }
    rows = [
        {"frame_number": one.number, "map_number": surface.map_number, "parent": one.parent,
         "changed": now.get(one.number) != one}
        for one in fused
    ]  # fmt: skip
    if rows:
        connection.execute(insert(surface_frames), rows)


def taken_range(connection: Connection, surface: SurfaceRow) -> tuple[float, float] | None:
    """The first and the last time at which frames of a surface were taken, fused ones or not."""
    at = frames.c.captured_at
    asked = _posed(surface.map_number, surface.model_id)
    asked = asked.with_only_columns(func.min(at), func.max(at))
    row = connection.execute(asked).one()
    return None if row[0] is None else (row[0], row[1])


def fused_range(connection: Connection, map_number: int) -> tuple[float | None, float | None]:
    """The first and the last time at which the fused frames of a map were taken."""
    at = frames.c.captured_at
    asked = (
        select(func.min(at), func.max(at))
        .join(surface_frames, surface_frames.c.frame_number == frames.c.number)
        .where(surface_frames.c.map_number == map_number)
    )
    first, last = connection.execute(asked).one()
    return first, last


def spread_fused(connection: Connection, map_number: int, parent: str, most: int) -> list[int]:
    """Numbers of fused frames of a parent frame, evenly taken."""
    c = surface_frames.c
    own = (c.map_number == map_number) & (c.parent == parent)
    numbers = connection.execute(select(c.frame_number).where(own).order_by(c.frame_number))
    found = list(numbers.scalars())
    return found[:: max(len(found) // most, 1)]


# Tiles.


@dataclass(frozen=True)
class TileRow:
    """A tile; fields as in the table."""

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
        """Column, row and floor."""
        return self.tile_x, self.tile_y, self.tile_z


def tiles_at(
    connection: Connection, map_number: int, parent: str, level: int, places: Iterable[TilePlace]
) -> dict[TilePlace, TileRow]:
    """Tiles of a parent frame and level by their places; those that are not there are left out."""
    c = surface_tiles.c
    wanted = set(places)
    # those of each floor and row together: no database takes lists of many tuples well
    columns: dict[tuple[int, int], list[int]] = {}
    for x, y, z in sorted(wanted):
        columns.setdefault((y, z), []).append(x)
    found = {}
    for (y, z), xs in columns.items():
        asked = select(surface_tiles).where(
            c.map_number == map_number, c.parent == parent, c.level == level, c.tile_y == y,
            c.tile_z == z, c.tile_x.in_(xs),
        )  # fmt: skip
        for row in connection.execute(asked).mappings():
            tile = TileRow(**row)
            found[tile.place] = tile
    return found


def tile_of_digest(connection: Connection, map_number: int, digest: str) -> TileRow | None:
    """A tile that has been made, by what the outside knows."""
    c = surface_tiles.c
    asked = select(surface_tiles).where(
        c.map_number == map_number, c.digest == digest, c.blob.is_not(None)
    )
    row = connection.execute(asked.limit(1)).mappings().first()
    return None if row is None else TileRow(**row)


def tile_of_number(connection: Connection, number: int) -> TileRow | None:
    """A tile by its number; None where it was removed."""
    asked = select(surface_tiles).where(surface_tiles.c.number == number)
    row = connection.execute(asked).mappings().first()
    return None if row is None else TileRow(**row)


def spoil_tile(connection: Connection, tile: TileRow) -> None:
    """Have a tile made again whose bytes are lost: from its frames, or from finer tiles."""
    own = surface_tiles.c.number == tile.number
    doom(connection, [blob for blob in (tile.blob, tile.draft) if blob])
    if tile.level == 0:
        lost = {"rebuilt_to": 0, "blob": None, "draft": None, "scale": NO_SCALE}
        connection.execute(update(surface_tiles).where(own).values(**lost))
    else:
        connection.execute(delete(surface_tiles).where(own))
        forget_scale(connection, tile.map_number, tile.parent, tile.place, FACTOR**tile.level)
    of_map = surfaces.c.map_number == tile.map_number
    counted = update(surfaces).where(of_map).values(pose_edits=surfaces.c.pose_edits + 1)
    connection.execute(counted)


def list_tiles(
    connection: Connection, map_number: int, parent: str, level: int,
    beyond: TilePlace | None = None, limit: int | None = None,
) -> list[TileRow]:  # fmt: skip
    """Tiles that have been made, by column, row and floor, from behind a place on."""
    c = surface_tiles.c
    place = (c.tile_x, c.tile_y, c.tile_z)
    asked = select(surface_tiles).where(
        c.map_number == map_number, c.parent == parent, c.level == level, c.blob.is_not(None)
    )
    if beyond is not None:
        asked = asked.where(tuple_(*place) > tuple_(*beyond))
    found = connection.execute(asked.order_by(*place).limit(limit)).mappings()
    return [TileRow(**row) for row in found]


@dataclass(frozen=True)
class LevelTotals:
    """Tiles of a parent frame and level together; low and high: (3,) box of their cells."""

    parent: str
    level: int
    tiles: int
    cells: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]


def level_totals(connection: Connection, map_number: int) -> list[LevelTotals]:
    """Sums over the tiles that have been made, by parent frame and level."""
    c = surface_tiles.c
    lows = [func.min(one) for one in (c.low_x, c.low_y, c.low_z)]
    highs = [func.max(one) for one in (c.high_x, c.high_y, c.high_z)]
    asked = (
        select(c.parent, c.level, func.count(), func.sum(c.cells), *lows, *highs)
        .where(c.map_number == map_number, c.blob.is_not(None))
        .group_by(c.parent, c.level)
        .order_by(c.parent, c.level)
    )
    return [
        LevelTotals(row[0], row[1], row[2], int(row[3]), tuple(row[4:7]), tuple(row[7:10]))
        for row in connection.execute(asked)
    ]


def tiles_to_rebuild(connection: Connection, map_number: int, most: int) -> list[TileRow]:
    """Some tiles that are made anew and have come equally far, those nearest to the end first."""
    c = surface_tiles.c
    asked = (
        select(surface_tiles)
        .where(c.map_number == map_number, c.rebuilt_to.is_not(None))
        .order_by(c.rebuilt_to.desc(), c.number)
        .limit(most)
    )
    found = [TileRow(**row) for row in connection.execute(asked).mappings()]
    return [one for one in found if one.rebuilt_to == found[0].rebuilt_to]


def tiles_of_other_scale(connection: Connection, surface: SurfaceRow, most: int) -> list[TileRow]:
    """Some tiles of the finest level that were given out with other times."""
    c = surface_tiles.c
    asked = select(surface_tiles).where(
        c.map_number == surface.map_number, c.level == 0, c.scale != surface.scale,
        c.rebuilt_to.is_(None),
    )  # fmt: skip
    return [
        TileRow(**row)
        for row in connection.execute(asked.order_by(c.number).limit(most)).mappings()
    ]


def forget_scale(
    connection: Connection, map_number: int, parent: str, place: TilePlace, factor: int
) -> None:
    """Have the tiles given out again that lie in one of a coarser level, which is lost.

    Parameters
    ----------
    connection, map_number, parent : see `tiles_at`
    place : of the coarser tile
    factor : how many times as wide it is
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
    """Make or change a tile.

    Returns
    -------
    number : of the tile
    blobs : that it refers to no more
    """
    c = surface_tiles.c
    before = tiles_at(connection, map_number, parent, level, [place]).get(place)
    if before is None:
        x, y, z = place
        blank = dict.fromkeys(("low_x", "low_y", "low_z", "high_x", "high_y", "high_z"), 0.0) | {
            "cells": 0,
            "digest": "",
            "scale": NO_SCALE,
        }
        made = insert(surface_tiles).values(
            map_number=map_number, parent=parent, level=level, tile_x=x, tile_y=y, tile_z=z,
            **(blank | values),
        )  # fmt: skip
        return int(connection.execute(made.returning(c.number)).scalar_one()), []
    connection.execute(update(surface_tiles).where(c.number == before.number).values(**values))
    new = {values.get(name, getattr(before, name)) for name in ("blob", "draft")}
    return before.number, [one for one in (before.blob, before.draft) if one and one not in new]


def remove_tiles(connection: Connection, tiles: Sequence[TileRow]) -> list[str]:
    """Remove tiles, with which frames touch them; returns blobs that they referred to."""
    for some in blocks(one.number for one in tiles):
        own = among(connection, surface_touches.c.tile_number, some)
        connection.execute(delete(surface_touches).where(own))
        connection.execute(
            delete(surface_tiles).where(among(connection, surface_tiles.c.number, some))
        )
    return [blob for one in tiles for blob in (one.blob, one.draft) if blob]


def add_touches(connection: Connection, touches: Iterable[tuple[int, int]]) -> None:
    """Note that frames touch tiles: numbers of tile and frame."""
    rows = [{"tile_number": tile, "frame_number": frame} for tile, frame in sorted(touches)]
    if rows:
        connection.execute(insert(surface_touches), rows)


def frames_touching(
    connection: Connection, tiles: Sequence[int], after: int, limit: int
) -> list[int]:
    """Numbers of frames that touch any of some tiles, in order from behind a number on."""
    c = surface_touches.c
    asked = (
        select(c.frame_number)
        .where(among(connection, c.tile_number, tiles), c.frame_number > after)
        .distinct()
        .order_by(c.frame_number)
        .limit(limit)
    )
    return list(connection.execute(asked).scalars())


def take_out(connection: Connection, numbers: Sequence[int]) -> None:
    """Take frames out: the tiles they touch are to be made anew."""
    c = surface_touches.c
    own = among(connection, c.frame_number, numbers)
    tiles = list(connection.execute(select(c.tile_number).where(own).distinct()).scalars())
    for some in blocks(tiles):
        connection.execute(
            update(surface_tiles)
            .where(among(connection, surface_tiles.c.number, some))
            .values(rebuilt_to=0)
        )
    connection.execute(delete(surface_touches).where(own))
    connection.execute(
        delete(surface_frames).where(among(connection, surface_frames.c.frame_number, numbers))
    )


# All of it removed.

#: Tiles and frames that are removed in one commit.
_AT_ONCE = 50


def remove_some(connection: Connection, map_number: int) -> tuple[list[str], bool]:
    """Remove some tiles and frames of a surface.

    Returns
    -------
    blobs : that are doomed: sweep them when this is committed
    over : whether nothing is left
    """
    c = surface_tiles.c
    asked = select(surface_tiles).where(c.map_number == map_number).limit(_AT_ONCE)
    tiles = [TileRow(**row) for row in connection.execute(asked).mappings()]
    blobs = remove_tiles(connection, tiles)
    doom(connection, blobs)
    if len(tiles) == _AT_ONCE:
        return blobs, False
    own = surface_frames.c.map_number == map_number
    numbers = list(
        connection.execute(
            select(surface_frames.c.frame_number).where(own).limit(10 * _AT_ONCE)
        ).scalars()
    )
    connection.execute(
        delete(surface_frames).where(among(connection, surface_frames.c.frame_number, numbers))
    )
    return blobs, len(numbers) < 10 * _AT_ONCE


# Frames by where they were taken, or what they touch.


@dataclass(frozen=True)
class SightingFrame:
    """A frame as a list of sightings has it; `square`: of its distance from the spot, metres."""

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
    """Frames that touch any of some tiles, the nearest to a spot first.

    Parameters
    ----------
    surface, parent : whose
    places : of tiles of the finest level
    spot : x, y, z, metres
    beyond : square of the distance, and number, of the last frame before
    limit : most frames
    """
    tiles = tiles_at(connection, surface.map_number, parent, 0, places)
    touching = select(surface_touches.c.frame_number).where(
        among(connection, surface_touches.c.tile_number, [one.number for one in tiles.values()])
    )
    return _sightings(
        connection, surface, [frames.c.number.in_(touching), frames.c.pose_parent == parent],
        spot, beyond, limit,
    )  # fmt: skip


def frames_taken_in(
    connection: Connection, surface: SurfaceRow, parent: str, low: Sequence[float],
    high: Sequence[float], beyond: tuple[float, int] | None, limit: int,
) -> list[SightingFrame]:  # fmt: skip
    """Frames taken in a box, the nearest to its middle first; parameters as of `frames_seeing`."""
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
    asked = _posed(surface.map_number, surface.model_id).with_only_columns(
        c.number, c.id, c.name, c.intrinsics, c.cloud, c.robot, c.session, c.captured_at, c.pose,
        signatures.c.geometry, square.label("square"),
    ).where(*conditions)  # fmt: skip
    if beyond is not None:
        asked = asked.where(
            or_(square > beyond[0], and_(square == beyond[0], c.number > beyond[1]))
        )
    found = connection.execute(asked.order_by(square, c.number).limit(limit))
    return [
        SightingFrame(
            row.number, row.id, row.name, row.cloud is not None, row.robot, row.session,
            row.captured_at, row.pose, row.geometry, row.square,
        )
        for row in found
    ]  # fmt: skip


def living_surface(connection: Connection, name: str) -> tuple[MapRow, SurfaceRow | None]:
    """A map and its surface; None where none was begun, or it was deleted. UnknownMap."""
    row = find_map(connection, name)
    surface = find_surface(connection, row.number)
    return row, surface if surface is not None and surface.wanted else None
