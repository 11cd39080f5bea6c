"""The surface of a map, made and kept up to date: a job in slices.

    frames that came              -->  added to the tiles they touch
    frames that went or moved     -->  their tiles made anew from the other frames that touch them

Each slice does one of these for some frames, and stores the tiles with what it did in one commit.
So a tile is at any time that of the frames that are noted as fused, and a job that is lost goes on
where its last slice ended.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult, ends_within
from sceneprint.engine.search.up_vectors import parent_axes
from sceneprint.engine.serializers import tag_of
from sceneprint.engine.signers import Signers
from sceneprint.errors import DamagedBlob, UnreadableGeometry
from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.cells import (
    CELL_SUM,
    FACTOR,
    Cells,
    CellSums,
    TilePlace,
    TimeScale,
    ViewStamp,
    coarsen_cells,
    encode_cells,
    fuse_cells,
    merge_cells,
    remove_tile,
    time_scale,
    view_cells,
)
from sceneprint.geometry.rigid import transform_points
from sceneprint.store import Store
from sceneprint.store import surface_rows as stored
from sceneprint.store.deletion import doom
from sceneprint.store.maps import current_map
from sceneprint.store.surface_rows import FusedFrame, SurfaceRow, TileRow
from sceneprint.store.tables import MapRow
from sceneprint.types import Floats, Geometry
from sceneprint_client.surface_encoding import CELL, NO_SESSION, SIDE, STEPS

#: Kind of the jobs, and of the event that tells of their end.
SURFACE, UPDATED = "surface", "surface.updated"
#: Seconds that a slice fuses frames; writing its tiles takes about as long.
SLICE_S = 1.5
#: Levels of a surface, and the width of the finest cells in voxels of the map's model.
LEVELS, VOXELS = 3, 2.5
#: Parent frames that are told of: those of most frames. Sessions that cells tell apart.
MOST_PARENTS, MOST_SESSIONS = 20, 10_000
#: Frames looked up at once; frames taken out in one slice.
_FRAMES, _TAKEN_OUT = 256, 500
#: What a slice holds at most: tiles that are changed, and cells of frames or tiles.
_TILES, _CELLS = 96, 1_500_000


def cell_width(voxel_m: float) -> float:
    """Width of the finest cells for a model of such voxels, metres."""
    return float(np.clip(VOXELS * voxel_m, 1e-3, 100.0))


def surface_points(geometry: Geometry) -> Floats:
    """(N, 3) all points that a frame's artifact has, in its sensor's axes."""
    found = geometry.surface.points[geometry.surface.valid]
    if geometry.surface.spread is not None:
        spread = geometry.surface.spread
        found = np.concatenate([found, spread.points[spread.valid]])
    return found.astype(np.float64)


def tile_cells(store: Store, tile: TileRow, scale: TimeScale | None) -> Cells:
    """Return a tile as clients receive it, its sums encoded at the finest level; raise DamagedBlob
    if it is lost or damaged.
    """
    data = store.blobs.get(tile.blob or "")
    if tile.level:
        return np.frombuffer(data, CELL)
    return encode_cells(np.frombuffer(data, CELL_SUM), scale)


def scale_of(surface: SurfaceRow) -> TimeScale | None:
    """How the tiles of a surface tell times; None where no frame had one."""
    if surface.taken_from is None:
        return None
    return TimeScale(surface.taken_from, surface.taken_step_s)


#: Parent frame, and place, of a tile.
_Key = tuple[str, TilePlace]


@dataclass
class _Slice:
    """What a slice is about to store.

    Parameters
    ----------
    tiles : columns of tiles by parent frame, level and place; None of those that are empty now
    damaged : tiles of the finest level that must be made anew
    unread : of coarser levels, which must be made anew from the finest
    blobs : that are there, and that `tiles` refers to
    """

    tiles: dict[tuple[str, int, TilePlace], dict[str, Any] | None] = field(default_factory=dict)
    damaged: list[_Key] = field(default_factory=list)
    unread: list[tuple[str, int, TilePlace]] = field(default_factory=list)
    blobs: list[str] = field(default_factory=list)

    def store(self, connection: Connection, map_number: int) -> tuple[dict[_Key, int], list[str]]:
        """Write the tiles; numbers of those of the finest level, and blobs of no use any more."""
        numbers: dict[_Key, int] = {}
        left: list[str] = []
        for (parent, level, place), values in self.tiles.items():
            if values is None:
                gone = stored.tiles_at(connection, map_number, parent, level, [place])
                left += stored.remove_tiles(connection, list(gone.values()))
                continue
            number, blobs = stored.write_tile(connection, map_number, parent, level, place, values)
            left += blobs
            if level == 0:
                numbers[parent, place] = number
        for parent, place in self.damaged:
            number, blobs = stored.write_tile(
                connection, map_number, parent, 0, place,
                {"rebuilt_to": 0, "scale": stored.NO_SCALE},
            )  # fmt: skip
            left += blobs
            numbers[parent, place] = number
        for parent, level, place in self.unread:
            stored.forget_scale(connection, map_number, parent, place, FACTOR**level)
        doom(connection, left)
        return numbers, left


class SurfaceHandler:
    """Does the jobs."""

    def __init__(self, store: Store, signers: Signers) -> None:
        self._store, self._signers = store, signers

    def __call__(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """A slice: some frames added or taken out, some tiles made anew, or the conclusion."""
        is_over = ends_within(is_over, SLICE_S)
        with self._store.database.read() as connection:
            row = current_map(connection, task.of_map)
            surface = stored.find_surface(connection, row.number)
        if surface is None or not surface.wanted:
            return SliceResult(True, dict(task.progress))
        if surface.model_id != row.model_id or not surface.cell_m:
            return self._reset(row, surface, task)
        progress = dict(task.progress)
        if progress.get("total") is None:
            progress |= {"done": 0, "after": 0, "checked": False}
            with self._store.database.read() as connection:
                progress["total"] = stored.count_left(connection, surface)
        if not progress["checked"]:  # all of them first: tiles are made anew once
            return self._take_out(surface, progress)
        with self._store.database.read() as connection:
            rebuilt = stored.tiles_to_rebuild(connection, row.number, _TILES)
        if rebuilt:
            return self._rebuild(surface, progress, rebuilt, is_over)
        with self._store.database.read() as connection:
            rescaled = stored.tiles_of_other_scale(connection, surface, _TILES)
        if rescaled:
            return self._rescale(surface, progress, rescaled)
        with self._store.database.read() as connection:
            new = stored.frames_to_fuse(connection, surface, progress["after"], _FRAMES)
        if new:
            return self._add(row, surface, progress, new, is_over)
        if progress["after"]:
            return SliceResult(False, progress | {"after": 0})  # of lower numbers, edited since
        return self._conclude(row, surface, progress)

    # kinds of slices

    def _reset(self, row: MapRow, surface: SurfaceRow, task: LongJob) -> SliceResult:
        """Remove what was made with another model, some at a time, and begin."""
        cell_m = cell_width(self._signers(row.model_id).model.parameters.cloud.voxel_size)

        def write(connection: Connection) -> Collection[str]:
            blobs, over = stored.remove_block(connection, row.number)
            if over:
                stored.write_surface(
                    connection, row.number, model_id=row.model_id, cell_m=cell_m, revision=-1,
                    scale=surface.scale + 1, taken_from=None, first_taken=None, last_taken=None,
                    sessions=[], parents=[], updated_at=time.time(),
                )  # fmt: skip
            return blobs

        return SliceResult(False, dict(task.progress), write=write)

    def _take_out(self, surface: SurfaceRow, progress: dict[str, Any]) -> SliceResult:
        """Frames that are gone or were edited: the tiles they touch are made anew next."""
        with self._store.database.read() as connection:
            numbers = stored.frames_to_remove(connection, surface, _TAKEN_OUT)
        if not numbers:
            return SliceResult(False, progress | {"checked": True})

        def write(connection: Connection) -> Collection[str]:
            stored.remove_fused(connection, numbers)
            return ()

        progress["done"] += len(numbers)
        return SliceResult(False, _told(progress), write=write)

    def _rebuild(
        self, surface: SurfaceRow, progress: dict[str, Any], tiles: Sequence[TileRow],
        is_over: IsOver,
    ) -> SliceResult:  # fmt: skip
        """Make tiles anew from the frames that touch them, as far as the time goes."""
        tiles = _first_cells(tiles)
        last = tiles[0].rebuilt_to or 0
        sums: dict[_Key, list[CellSums]] = {}
        for tile in tiles:
            sums[tile.parent, tile.place] = [np.zeros(0, CELL_SUM)]
            if last and tile.draft is not None:
                try:
                    data = self._store.blobs.get(tile.draft)
                except DamagedBlob:
                    return _again(surface, progress, [(tile.parent, tile.place)])
                sums[tile.parent, tile.place] = [np.frombuffer(data, CELL_SUM)]
        numbers, over = [one.number for one in tiles], False
        sessions = _Sessions(surface.sessions)
        while not over:
            with self._store.database.read() as connection:
                touching = stored.frames_touching(connection, numbers, last, _FRAMES)
                found = stored.fused_frames(connection, surface, touching)
            over = len(touching) < _FRAMES
            for one in found:
                for key, cells in self._cells(surface, one, sessions).items():
                    if key in sums:
                        sums[key].append(cells)
                last = one.number
                if is_over():
                    over = over and one is found[-1]
                    break
            else:
                last = touching[-1] if touching else last
            for key, parts in sums.items():
                sums[key] = [fuse_cells(parts)]
            if is_over():
                break
        done = _Slice()
        if over:
            self._publish(surface, {key: parts[0] for key, parts in sums.items()}, done)
        else:
            for (parent, place), (rows,) in sums.items():
                done.blobs.append(draft := self._store.blobs.put(rows.tobytes()))
                done.tiles[parent, 0, place] = {"rebuilt_to": last, "draft": draft}
        return self._result(surface, progress, done, sessions)

    def _rescale(
        self, surface: SurfaceRow, progress: dict[str, Any], tiles: Sequence[TileRow]
    ) -> SliceResult:
        """Give out tiles again with times as the surface tells them now."""
        done = _Slice()
        self._publish(surface, self._sums_of(_first_cells(tiles), done), done)
        return self._result(surface, progress, done, _Sessions(surface.sessions))

    def _add(
        self, row: MapRow, surface: SurfaceRow, progress: dict[str, Any],
        new: Sequence[FusedFrame], is_over: IsOver,
    ) -> SliceResult:  # fmt: skip
        """Fuse frames into the tiles they touch, as far as the time goes."""
        times = [one.captured_at for one in new if one.captured_at is not None]
        scale = scale_of(surface)
        if times and (scale is None or not scale.holds(min(times), max(times))):
            return self._change_scale(surface, progress)
        sessions = _Sessions(surface.sessions)
        parts: dict[_Key, list[CellSums]] = {}
        touches: list[tuple[_Key, int]] = []
        added: list[FusedFrame] = []
        held = 0
        for one in new:
            for key, cells in self._cells(surface, one, sessions).items():
                parts.setdefault(key, []).append(cells)
                touches.append((key, one.number))
                held += len(cells)
            added.append(one)
            if is_over() or held > _CELLS or len(parts) > _TILES:
                break
        done = _Slice()
        with self._store.database.read() as connection:
            before = _tiles_of(connection, surface, parts)
        for key, sums in self._sums_of(before, done).items():
            parts[key].append(sums)
        for key in done.damaged:
            del parts[key]  # made anew from all that touch it
        changed = {key: fuse_cells(own) for key, own in parts.items()}
        self._publish(surface, changed, done)
        progress["after"] = added[-1].number
        progress["done"] += len(added)
        return self._result(surface, progress, done, sessions, _Addition(row, added, touches))

    def _change_scale(self, surface: SurfaceRow, progress: dict[str, Any]) -> SliceResult:
        """Tell times otherwise: a frame was taken before or after those that can be told."""

        def write(connection: Connection) -> Collection[str]:
            times = stored.taken_range(connection, surface)
            if times is not None:
                scale = time_scale(*times)
                stored.write_surface(
                    connection, surface.map_number, scale=surface.scale + 1,
                    taken_from=scale.start, taken_step_s=scale.step_s,
                )  # fmt: skip
            return ()

        return SliceResult(False, progress, write=write)

    def _conclude(self, row: MapRow, surface: SurfaceRow, progress: dict[str, Any]) -> SliceResult:
        """The end, where nothing came, went or was edited meanwhile; else once more."""
        with self._store.database.read() as connection:
            row = current_map(connection, row)
            now = stored.find_surface(connection, row.number)
            if (
                now is None
                or stored.count_left(connection, surface)
                or stored.count_unfinished(connection, surface)
            ):
                return SliceResult(False, progress | {"total": None})
            parents = parent_records(connection, row, {})
            totals = stored.level_totals(connection, row.number)
            first, last = stored.fused_range(connection, row.number)
            frames = sum(stored.count_fused(connection, row.number).values())

        def write(connection: Connection) -> Collection[str]:
            stored.write_surface(
                connection, row.number, revision=row.revision, edits=now.pose_edits,
                parents=parents, first_taken=first, last_taken=last,
            )  # fmt: skip
            return ()

        progress["done"] = progress["total"]
        result = {"frames": frames, "tiles": sum(one.tiles for one in totals)}
        return SliceResult(True, progress, result=result, event=UPDATED, write=write)

    # what they share

    def _cells(
        self, surface: SurfaceRow, frame: FusedFrame, sessions: _Sessions
    ) -> dict[_Key, CellSums]:
        """What a frame saw, by tile; nothing of one whose artifact is lost or damaged."""
        try:
            geometry = read_geometry(self._store.blobs.get(frame.geometry))
        except (DamagedBlob, UnreadableGeometry):
            return {}
        points = transform_points(np.array(frame.pose), surface_points(geometry))
        stamp = ViewStamp(frame.number, frame.captured_at, sessions.index(frame.session))
        found = view_cells(points, surface.cell_m, stamp)
        return {(frame.parent, place): cells for place, cells in found.items()}

    def _sums_of(self, tiles: Iterable[TileRow], done: _Slice) -> dict[_Key, CellSums]:
        """Sums of tiles; those that are damaged are noted."""
        found: dict[_Key, CellSums] = {}
        for tile in tiles:
            key = tile.parent, tile.place
            if tile.blob is None or tile.rebuilt_to is not None:
                done.damaged.append(key)
                continue
            try:
                found[key] = np.frombuffer(self._store.blobs.get(tile.blob), CELL_SUM)
            except DamagedBlob:
                done.damaged.append(key)
        return found

    def _publish(self, surface: SurfaceRow, changed: Mapping[_Key, CellSums], done: _Slice) -> None:
        """Put tiles of the finest level, and what of the coarser ones changes with them."""
        scale = scale_of(surface)
        parts: dict[_Key, Cells] = {}
        for (parent, place), rows in changed.items():
            cells = encode_cells(rows, scale)
            parts[parent, place] = coarsen_cells({place: cells})
            values: dict[str, Any] | None = None
            if len(rows):
                done.blobs.append(blob := self._store.blobs.put(rows.tobytes()))
                values = _columns(surface, 0, place, cells) | {
                    "blob": blob, "rebuilt_to": None, "draft": None,
                    "digest": tag_of(blob, surface.taken_from, surface.taken_step_s),
                }  # fmt: skip
            done.tiles[parent, 0, place] = values
        for level in range(1, LEVELS):
            parts = self._publish_coarser(surface, level, parts, done)

    def _publish_coarser(
        self, surface: SurfaceRow, level: int, parts: Mapping[_Key, Cells], done: _Slice
    ) -> dict[_Key, Cells]:
        """Put tiles of a level of which parts changed; returns what changes of the next level."""
        groups: dict[_Key, dict[TilePlace, Cells]] = {}
        for (parent, place), cells in parts.items():
            x, y, z = (one // FACTOR for one in place)
            groups.setdefault((parent, (x, y, z)), {})[place] = cells
        with self._store.database.read() as connection:
            before = {
                (one.parent, one.place): one
                for one in _tiles_of(connection, surface, groups, level)
            }
        above: dict[_Key, Cells] = {}
        for key, changed in groups.items():
            parent, place = key
            kept = self._coarse_cells(before.get(key), done)
            for part in changed:
                kept = remove_tile(kept, part)
            cells = merge_cells(kept, np.concatenate(list(changed.values())))
            above[key] = coarsen_cells({place: cells})
            done.tiles[parent, level, place] = None
            if len(cells):
                done.blobs.append(blob := self._store.blobs.put(cells.tobytes()))
                done.tiles[parent, level, place] = _columns(surface, level, place, cells) | {
                    "blob": blob, "digest": blob
                }  # fmt: skip
        return above

    def _coarse_cells(self, tile: TileRow | None, done: _Slice) -> Cells:
        if tile is not None and tile.blob is not None:
            try:
                return np.frombuffer(self._store.blobs.get(tile.blob), CELL)
            except DamagedBlob:
                done.unread.append((tile.parent, tile.level, tile.place))
        return np.zeros(0, CELL)

    def _result(
        self, surface: SurfaceRow, progress: dict[str, Any], done: _Slice, sessions: _Sessions,
        addition: _Addition | None = None,
    ) -> SliceResult:  # fmt: skip
        def write(connection: Connection) -> Collection[str]:
            numbers, left = done.store(connection, surface.map_number)
            values: dict[str, Any] = {"updated_at": time.time()}
            if addition is not None:
                stored.add_fused(connection, surface, addition.frames)
                stored.add_touches(
                    connection, ((numbers[key], number) for key, number in addition.touches)
                )
                values["parents"] = parent_records(
                    connection, addition.row,
                    {one["parent_frame"]: one for one in surface.parents},
                )  # fmt: skip
            if sessions.names != surface.sessions:
                values["sessions"] = sessions.names
            stored.write_surface(connection, surface.map_number, **values)
            return left

        return SliceResult(False, _told(progress), write=write, blobs=done.blobs)


@dataclass(frozen=True)
class _Addition:
    """Frames that a slice added to a map's surface, and the tiles that each touches."""

    row: MapRow
    frames: list[FusedFrame]
    touches: list[tuple[_Key, int]]


class _Sessions:
    """Names of sessions by the index that cells have of them; new ones come last."""

    def __init__(self, known: Sequence[str]) -> None:
        self.names = list(known)
        self._index = {name: i for i, name in enumerate(known)}

    def index(self, name: str | None) -> int:
        """The index of a session; NO_SESSION without one, and of those beyond MOST_SESSIONS."""
        if name is None or (name not in self._index and len(self.names) >= MOST_SESSIONS):
            return NO_SESSION
        if name not in self._index:
            self._index[name] = len(self.names)
            self.names.append(name)
        return self._index[name]


def parent_records(
    connection: Connection, row: MapRow, known: Mapping[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return the parent frames of a surface by their number of frames, with their up. Those that
    are `known` keep up and axes.
    """
    counts = stored.count_fused(connection, row.number)
    names = sorted(counts, key=lambda name: (-counts[name], name))[:MOST_PARENTS]
    found = []
    for name in names:
        told = known.get(name)
        if told is None:
            some = stored.spread_fused(connection, row.number, name, 200)
            seen = parent_axes(connection, row, some)
            told = {
                "parent_frame": name, "axes": seen.axes.tolist(), "up_from": seen.up_from,
                "up": np.cross(seen.axes[0], seen.axes[1]).tolist(),
            }  # fmt: skip
        found.append(told | {"frames": counts[name]})
    return found


def _told(progress: dict[str, Any]) -> dict[str, Any]:
    """Progress; more may have come than was counted at first."""
    return progress | {"total": max(progress["total"], progress["done"])}


def _again(surface: SurfaceRow, progress: dict[str, Any], keys: Sequence[_Key]) -> SliceResult:
    """Make tiles anew from the first frame on."""
    done = _Slice(damaged=list(keys))

    def write(connection: Connection) -> Collection[str]:
        return done.store(connection, surface.map_number)[1]

    return SliceResult(False, progress, write=write)


def _first_cells(tiles: Sequence[TileRow]) -> list[TileRow]:
    """As many of some tiles as there is room for, and at least one."""
    room = np.cumsum([one.cells for one in tiles]) <= _CELLS
    return list(tiles[: max(int(room.sum()), 1)])


def _tiles_of(
    connection: Connection, surface: SurfaceRow, keys: Iterable[_Key], level: int = 0
) -> list[TileRow]:
    """Those of some tiles that are there."""
    places: dict[str, list[TilePlace]] = {}
    for parent, place in keys:
        places.setdefault(parent, []).append(place)
    return [
        tile
        for parent, some in places.items()
        for tile in stored.tiles_at(
            connection, surface.map_number, parent, level, some
        ).values()
    ]  # fmt: skip


def _columns(surface: SurfaceRow, level: int, place: TilePlace, cells: Cells) -> dict[str, Any]:
    """Columns of a tile that tell of its cells."""
    tile_m = surface.cell_m * FACTOR**level * SIDE
    at = cells["at"].astype(np.int64)
    low = (np.array(place) + at.min(axis=0) / STEPS) * tile_m
    high = (np.array(place) + (at.max(axis=0) + 1) / STEPS) * tile_m
    box = {
        f"{name}_{axis}": float(end[i])
        for name, end in (("low", low), ("high", high))
        for i, axis in enumerate("xyz")
    }
    return {"cells": len(cells), "scale": surface.scale, **box}
