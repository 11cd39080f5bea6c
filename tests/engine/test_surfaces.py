"""Surfaces of maps through the engine: as an oracle would fuse, whatever comes, goes and moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sceneprint.engine import Engine
from sceneprint.engine.maps.surface_job import surface_points
from sceneprint.geometry.pose.rigid import moved
from sceneprint.store.frame_queries import numbers_of_runs, stops_of
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import geometry_blobs
from sceneprint_client.api import JobState
from sceneprint_client.surface_tiles import SurfaceCells, decode_tile

WorkOff = Callable[[Engine], list[JobState | None]]


def cells_of(engine: Engine, level: int = 0, name: str = "hall") -> dict[str, SurfaceCells]:
    """All cells of a level by parent frame, in one order."""
    found = {}
    for parent in engine.surfaces.get(name).parents:
        tile_m = parent.levels[level].tile_m
        parts = [
            decode_tile(engine.surfaces.tile(name, tile.digest).make(), tile, tile_m)
            for tile in engine.surfaces.tiles(name, parent.parent_frame, level).items
        ]
        points = np.concatenate([one.points for one in parts])
        order = np.lexsort(np.floor(points / (tile_m / 64) + 1e-9).T)
        found[parent.parent_frame] = SurfaceCells(
            points[order],
            *(np.concatenate([getattr(one, what) for one in parts])[order]
              for what in ("seen", "sessions", "taken")),
        )  # fmt: skip
    return found


def oracle(engine: Engine, cell_m: float, name: str = "hall") -> dict[str, dict[Any, Any]]:
    """Cells of each parent frame, one point after the other: means of each frame, by cell."""
    found: dict[str, dict[Any, Any]] = {}
    with engine.store.database.read() as connection:
        row = find_map(connection, name)
        numbers = numbers_of_runs(connection, row.number, None, None)
        stops, blobs = (
            stops_of(connection, numbers),
            geometry_blobs(connection, numbers, row.model_id),
        )
    for number in sorted(stops):
        stop = stops[number]
        if stop.pose is None or stop.parent is None:
            continue
        points = moved(
            np.array(stop.pose), surface_points(engine.store.geometries.read(blobs[number]))
        )
        own: dict[Any, list[Any]] = {}
        for point in points:
            own.setdefault(tuple(np.floor(point / cell_m).astype(int).tolist()), []).append(point)
        for key, some in own.items():
            means = found.setdefault(stop.parent, {}).setdefault(key, [])
            means.append(np.mean(some, axis=0))
    return found


def check(engine: Engine) -> None:
    """The surface is that of the frames that the map has now."""
    told = engine.surfaces.get("hall")
    assert (told.state, told.frames_left, told.error) == ("ready", 0, None)
    cell_m = told.parents[0].levels[0].cell_m
    expected, cells = oracle(engine, cell_m), cells_of(engine)
    assert cells.keys() == expected.keys()
    for parent, found in cells.items():
        keys = [tuple(one) for one in np.floor(found.points / cell_m + 1e-9).astype(int).tolist()]
        assert len(keys) == len(set(keys))
        assert set(keys) == set(expected[parent])
        views = np.array([len(expected[parent][key]) for key in keys])
        np.testing.assert_allclose(found.seen, views, rtol=0.03)
        means = np.array([np.mean(expected[parent][key], axis=0) for key in keys])
        # a quarter of a cell, and what each frame's mean is rounded by
        np.testing.assert_allclose(found.points, means, atol=cell_m * (1 / 8 + 1 / 100))


def test_a_surface_is_that_of_its_frames(full: Engine, work_off: WorkOff) -> None:
    assert full.surfaces.get("hall").state == "none"
    told, begun = full.surfaces.begin("hall")
    assert (told.state, begun) == ("building", True)
    assert work_off(full)[-1] is JobState.SUCCEEDED
    check(full)
    told, begun = full.surfaces.begin("hall")
    assert (told.state, begun, told.frames) == ("ready", False, 12)
