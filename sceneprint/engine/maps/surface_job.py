"""Jobs that build and update the surface of a map in slices.

    new frames                -->  fused into the tiles that they overlap
    deleted or moved frames   -->  their tiles rebuilt from the remaining frames

Each slice processes some frames, and stores tiles and progress in one commit. Tiles therefore
always consist of the frames that are recorded as fused, and an interrupted job continues after its
last slice.
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

#: Kind of the jobs, and kind of the event that a finished job records.
SURFACE, UPDATED = "surface", "surface.updated"
#: Seconds for which a slice fuses frames; writing the tiles takes about as long.
SLICE_S = 1.5
#: Number of levels of a surface, and width of its finest cells in voxels of the model.
LEVELS, VOXELS = 3, 2.5
#: Maximum number of parent frames in a record, and of sessions that cells distinguish.
MOST_PARENTS, MOST_SESSIONS = 20, 10_000
#: Number of frames to read at once, and to remove in one slice.
_FRAMES, _REMOVED = 256, 500
#: Maximum number of changed tiles, and of processed cells, in a slice.
_TILES, _CELLS = 96, 1_500_000


def cell_width(voxel_m: float) -> float:
    """Return the finest cell width for a model with voxels of the width `voxel_m`, metres."""
    return float(np.clip(VOXELS * voxel_m, 1e-3, 100.0))


def surface_points(geometry: Geometry) -> Floats:
    """Return all points (N, 3) of a geometry in the sensor frame, metres."""
    points = geometry.surface.points[geometry.surface.valid]
    if geometry.surface.spread is not None:
        spread = geometry.surface.spread
        points = np.concatenate([points, spread.points[spread.valid]])
    return points.astype(np.float64)


def tile_cells(store: Store, tile: TileRow, scale: TimeScale | None) -> Cells:
    """Return the cells of a tile, with times on `scale`; raise DamagedBlob if the tile is lost."""
    data = store.blobs.get(tile.blob or "")
    if tile.level:
        return np.frombuffer(data, CELL)
    return encode_cells(np.frombuffer(data, CELL_SUM), scale)


def scale_of(surface: SurfaceRow) -> TimeScale | None:
    """Return the time scale of the tiles of a surface; None if no frame has a capture time."""
    if surface.taken_from is None:
        return None
    return TimeScale(surface.taken_from, surface.taken_step_s)


#: Parent frame and place of a tile.
_Key = tuple[str, TilePlace]


@dataclass
class _Slice:
    """Changes to tiles in a slice.

    Parameters
    ----------
    tiles : columns of changed tiles by parent frame, level and place; None for empty tiles
    damaged : damaged tiles of the finest level, to be rebuilt from frames
    unread : damaged tiles of coarser levels, to be rebuilt from the finest level
    blobs : new blobs that `tiles` refers to
    """

    tiles: dict[tuple[str, int, TilePlace], dict[str, Any] | None] = field(default_factory=dict)
    damaged: list[_Key] = field(default_factory=list)
    unread: list[tuple[str, int, TilePlace]] = field(default_factory=list)
    blobs: list[str] = field(default_factory=list)

    def store(self, connection: Connection, map_number: int) -> tuple[dict[_Key, int], list[str]]:
        """Write the changed tiles, and remove the rows of empty tiles.

        Mark damaged tiles for rebuilding, and doom blobs that are no longer referenced.

        Returns
        -------
        numbers : row numbers of the finest tiles
        unused : doomed blobs, to collect after the commit
        """
        numbers: dict[_Key, int] = {}
        unused: list[str] = []
        for (parent, level, place), values in self.tiles.items():
            if values is None:
                empty = stored.tiles_at(connection, map_number, parent, level, [place])
                unused += stored.remove_tiles(connection, list(empty.values()))
                continue
            number, blobs = stored.write_tile(connection, map_number, parent, level, place, values)
            unused += blobs
            if level == 0:
                numbers[parent, place] = number
        for parent, place in self.damaged:
            number, blobs = stored.write_tile(
                connection, map_number, parent, 0, place,
                {"rebuilt_to": 0, "scale": stored.NO_SCALE},
            )  # fmt: skip
            unused += blobs
            numbers[parent, place] = number
        for parent, level, place in self.unread:
            stored.forget_scale(connection, map_number, parent, place, FACTOR**level)
        doom(connection, unused)
        return numbers, unused


class SurfaceHandler:
    """Handler of jobs that update surfaces."""

    def __init__(self, store: Store, signers: Signers) -> None:
        self._store, self._signers = store, signers

    def __call__(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Add or remove frames, rebuild tiles, or conclude the job; return the slice's results."""
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
                progress["total"] = stored.count_unprocessed(connection, surface)
        if not progress["checked"]:  # remove frames first, so that each tile is rebuilt only once
            return self._remove_frames(surface, progress)
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
            return SliceResult(False, progress | {"after": 0})  # start over for edited frames
        return self._conclude(row, surface, progress)

    def _reset(self, row: MapRow, surface: SurfaceRow, task: LongJob) -> SliceResult:
        """Return a slice that removes a block of tiles of a former model, or resets the surface."""
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

    def _remove_frames(self, surface: SurfaceRow, progress: dict[str, Any]) -> SliceResult:
        """Return a slice that removes deleted and edited frames, and marks tiles to be rebuilt."""
        with self._store.database.read() as connection:
            numbers = stored.frames_to_remove(connection, surface, _REMOVED)
        if not numbers:
            return SliceResult(False, progress | {"checked": True})

        def write(connection: Connection) -> Collection[str]:
            stored.remove_fused(connection, numbers)
            return ()

        progress["done"] += len(numbers)
        return SliceResult(False, _with_total(progress), write=write)

    def _rebuild(
        self, surface: SurfaceRow, progress: dict[str, Any], tiles: Sequence[TileRow],
        is_over: IsOver,
    ) -> SliceResult:  # fmt: skip
        """Rebuild tiles from the frames that overlap them, while time allows; return the slice."""
        tiles = _leading_tiles(tiles)
        last = tiles[0].rebuilt_to or 0
        sums: dict[_Key, list[CellSums]] = {}
        for tile in tiles:
            sums[tile.parent, tile.place] = [np.zeros(0, CELL_SUM)]
            if last and tile.draft is not None:
                try:
                    data = self._store.blobs.get(tile.draft)
                except DamagedBlob:
                    return _restart(surface, progress, [(tile.parent, tile.place)])
                sums[tile.parent, tile.place] = [np.frombuffer(data, CELL_SUM)]
        numbers, over = [tile.number for tile in tiles], False
        sessions = _Sessions(surface.sessions)
        while not over:
            with self._store.database.read() as connection:
                touching = stored.frames_touching(connection, numbers, last, _FRAMES)
                frames = stored.fused_frames(connection, surface, touching)
            over = len(touching) < _FRAMES
            for frame in frames:
                for key, cells in self._cells(surface, frame, sessions).items():
                    if key in sums:
                        sums[key].append(cells)
                last = frame.number
                if is_over():
                    over = over and frame is frames[-1]
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
        """Encode tiles again, with the current time scale of the surface."""
        done = _Slice()
        self._publish(surface, self._sums_of(_leading_tiles(tiles), done), done)
        return self._result(surface, progress, done, _Sessions(surface.sessions))

    def _add(
        self, row: MapRow, surface: SurfaceRow, progress: dict[str, Any],
        new: Sequence[FusedFrame], is_over: IsOver,
    ) -> SliceResult:  # fmt: skip
        """Fuse frames into the tiles that they overlap, while time allows; return the slice."""
        times = [frame.captured_at for frame in new if frame.captured_at is not None]
        scale = scale_of(surface)
        if times and (scale is None or not scale.holds(min(times), max(times))):
            return self._change_scale(surface, progress)
        sessions = _Sessions(surface.sessions)
        parts: dict[_Key, list[CellSums]] = {}
        touches: list[tuple[_Key, int]] = []
        added: list[FusedFrame] = []
        cell_count = 0
        for frame in new:
            for key, cells in self._cells(surface, frame, sessions).items():
                parts.setdefault(key, []).append(cells)
                touches.append((key, frame.number))
                cell_count += len(cells)
            added.append(frame)
            if is_over() or cell_count > _CELLS or len(parts) > _TILES:
                break
        done = _Slice()
        with self._store.database.read() as connection:
            before = _tiles_of(connection, surface, parts)
        for key, sums in self._sums_of(before, done).items():
            parts[key].append(sums)
        for key in done.damaged:
            del parts[key]  # the damaged tile is rebuilt from all its frames
        changed = {key: fuse_cells(own) for key, own in parts.items()}
        self._publish(surface, changed, done)
        progress["after"] = added[-1].number
        progress["done"] += len(added)
        return self._result(surface, progress, done, sessions, _Addition(row, added, touches))

    def _change_scale(self, surface: SurfaceRow, progress: dict[str, Any]) -> SliceResult:
        """Return a slice that extends the time scale of a surface to all its frames."""

        def write(connection: Connection) -> Collection[str]:
            times = stored.capture_range(connection, surface)
            if times is not None:
                scale = time_scale(*times)
                stored.write_surface(
                    connection, surface.map_number, scale=surface.scale + 1,
                    taken_from=scale.start, taken_step_s=scale.step_s,
                )  # fmt: skip
            return ()

        return SliceResult(False, progress, write=write)

    def _conclude(self, row: MapRow, surface: SurfaceRow, progress: dict[str, Any]) -> SliceResult:
        """Return the last slice, or a slice that continues the job if frames have changed."""
        with self._store.database.read() as connection:
            row = current_map(connection, row)
            now = stored.find_surface(connection, row.number)
            if (
                now is None
                or stored.count_unprocessed(connection, surface)
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
        result = {"frames": frames, "tiles": sum(level.tiles for level in totals)}
        return SliceResult(True, progress, result=result, event=UPDATED, write=write)

    def _cells(
        self, surface: SurfaceRow, frame: FusedFrame, sessions: _Sessions
    ) -> dict[_Key, CellSums]:
        """Return the cells of a frame by tile; empty if its geometry is lost or damaged."""
        try:
            geometry = read_geometry(self._store.blobs.get(frame.geometry))
        except (DamagedBlob, UnreadableGeometry):
            return {}
        points = transform_points(np.array(frame.pose), surface_points(geometry))
        stamp = ViewStamp(frame.number, frame.captured_at, sessions.index(frame.session))
        tiles = view_cells(points, surface.cell_m, stamp)
        return {(frame.parent, place): cells for place, cells in tiles.items()}

    def _sums_of(self, tiles: Iterable[TileRow], done: _Slice) -> dict[_Key, CellSums]:
        """Return the cell sums of tiles; add damaged tiles to `done.damaged`."""
        sums: dict[_Key, CellSums] = {}
        for tile in tiles:
            key = tile.parent, tile.place
            if tile.blob is None or tile.rebuilt_to is not None:
                done.damaged.append(key)
                continue
            try:
                sums[key] = np.frombuffer(self._store.blobs.get(tile.blob), CELL_SUM)
            except DamagedBlob:
                done.damaged.append(key)
        return sums

    def _publish(self, surface: SurfaceRow, changed: Mapping[_Key, CellSums], done: _Slice) -> None:
        """Store changed tiles of the finest level in `done`, and update the coarser levels."""
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
        """Store changed tiles of a coarser level in `done`; return them coarsened, by tile."""
        groups: dict[_Key, dict[TilePlace, Cells]] = {}
        for (parent, place), cells in parts.items():
            x, y, z = (value // FACTOR for value in place)
            groups.setdefault((parent, (x, y, z)), {})[place] = cells
        with self._store.database.read() as connection:
            before = {
                (tile.parent, tile.place): tile
                for tile in _tiles_of(connection, surface, groups, level)
            }
        above: dict[_Key, Cells] = {}
        for key, changed in groups.items():
            parent, place = key
            cells_before = self._coarse_cells(before.get(key), done)
            for part in changed:
                cells_before = remove_tile(cells_before, part)
            cells = merge_cells(cells_before, np.concatenate(list(changed.values())))
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
            numbers, unused = done.store(connection, surface.map_number)
            values: dict[str, Any] = {"updated_at": time.time()}
            if addition is not None:
                stored.add_fused(connection, surface, addition.frames)
                stored.add_touches(
                    connection, ((numbers[key], number) for key, number in addition.touches)
                )
                values["parents"] = parent_records(
                    connection, addition.row,
                    {parent["parent_frame"]: parent for parent in surface.parents},
                )  # fmt: skip
            if sessions.names != surface.sessions:
                values["sessions"] = sessions.names
            stored.write_surface(connection, surface.map_number, **values)
            return unused

        return SliceResult(False, _with_total(progress), write=write, blobs=done.blobs)


@dataclass(frozen=True)
class _Addition:
    """Frames that a slice adds to a surface, and the tiles that they overlap."""

    row: MapRow
    frames: list[FusedFrame]
    touches: list[tuple[_Key, int]]


class _Sessions:
    """Session names by the index that cells store; `index` appends new names."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._index = {name: i for i, name in enumerate(names)}

    def index(self, name: str | None) -> int:
        """Return the index of a session; NO_SESSION without a name, or if MOST_SESSIONS exist."""
        if name is None or (name not in self._index and len(self.names) >= MOST_SESSIONS):
            return NO_SESSION
        if name not in self._index:
            self._index[name] = len(self.names)
            self.names.append(name)
        return self._index[name]


def parent_records(
    connection: Connection, row: MapRow, earlier: Mapping[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return the records of the parent frames of a surface, sorted by number of frames.

    Parameters
    ----------
    earlier : earlier records by name; their axes and up vectors are reused
    """
    counts = stored.count_fused(connection, row.number)
    names = sorted(counts, key=lambda name: (-counts[name], name))[:MOST_PARENTS]
    records = []
    for name in names:
        record = earlier.get(name)
        if record is None:
            some = stored.sample_fused(connection, row.number, name, 200)
            view = parent_axes(connection, row, some)
            record = {
                "parent_frame": name, "axes": view.axes.tolist(), "up_from": view.up_from,
                "up": np.cross(view.axes[0], view.axes[1]).tolist(),
            }  # fmt: skip
        records.append(record | {"frames": counts[name]})
    return records


def _with_total(progress: dict[str, Any]) -> dict[str, Any]:
    """Return the progress with a total that includes frames added during the job."""
    return progress | {"total": max(progress["total"], progress["done"])}


def _restart(surface: SurfaceRow, progress: dict[str, Any], keys: Sequence[_Key]) -> SliceResult:
    """Return the result of a slice that schedules tiles to be rebuilt."""
    done = _Slice(damaged=list(keys))

    def write(connection: Connection) -> Collection[str]:
        return done.store(connection, surface.map_number)[1]

    return SliceResult(False, progress, write=write)


def _leading_tiles(tiles: Sequence[TileRow]) -> list[TileRow]:
    """Return the first tiles that have at most _CELLS cells in total, but at least one tile."""
    room = np.cumsum([tile.cells for tile in tiles]) <= _CELLS
    return list(tiles[: max(int(room.sum()), 1)])


def _tiles_of(
    connection: Connection, surface: SurfaceRow, keys: Iterable[_Key], level: int = 0
) -> list[TileRow]:
    """Return the tiles of a level that exist at the places `keys`."""
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
    """Return the columns of a tile that depend on its cells."""
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
