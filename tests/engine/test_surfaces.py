"""Tests of map surfaces against a simple fusion after all kinds of changes."""

import io
import shutil
from datetime import UTC, datetime

import numpy as np
import pytest
from PIL import Image
from sqlalchemy import func, select

from sceneprint.engine.maps import map_surface, surface_job
from sceneprint.engine.maps.surface_job import surface_points
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.errors import DamagedBlob, InvalidRequest, NotFound
from sceneprint.geometry.rigid import transform_points
from sceneprint.settings import Settings
from sceneprint.store.events import number_events
from sceneprint.store.frame_queries import numbers_of_runs, path_frames
from sceneprint.store.frames import refers_to, write_frame
from sceneprint.store.maps import find_frame, find_map, geometry_blobs
from sceneprint.store.tables import events, surface_frames, surface_tiles, surface_touches, surfaces
from sceneprint_client.api import JobState
from sceneprint_client.surface_encoding import SurfaceCells, decode_tile
from tests.whole_engine import Engine

BEGIN = datetime(2026, 1, 1, tzinfo=UTC).timestamp()


@pytest.fixture(scope="session")
def surfaced_folder(tmp_path_factory, signed_folder):
    """A data folder whose map `hall` has twelve frames in two rooms, ten seconds apart, in
    sessions a, b and none; and the surface of them.
    """
    folder = tmp_path_factory.mktemp("surfaced") / "data"
    shutil.copytree(signed_folder, folder)
    with Engine(Settings(data_dir=folder)) as engine:
        for i, frame in enumerate(engine.list_frames("hall").items):
            session = ("a", "b", None)[i % 3]
            edit(engine, frame.frame_id, session=session, captured_at=BEGIN + 10.0 * i)
        build(engine)
    return folder


@pytest.fixture
def engine(surfaced_folder, tmp_path, make_engine):
    shutil.copytree(surfaced_folder, tmp_path / "data")
    return make_engine()


def edit(engine, frame_id, **values):
    with engine.store.database.write() as connection:
        row = find_map(connection, "hall")
        write_frame(connection, row, find_frame(connection, row, frame_id), values)


def build(engine):
    result, begun = engine.surfaces.begin("hall")
    assert (result.state, begun) == ("building", True)
    assert engine.work_off()[-1] is JobState.SUCCEEDED


def tiles_of(engine):
    return {
        (parent.parent_frame, level.level, tile.column, tile.row, tile.floor): engine.surfaces.tile(
            "hall", tile.digest
        ).make()
        for parent in engine.surfaces.get("hall").parents
        for level in parent.levels
        for tile in engine.surfaces.tiles("hall", parent.parent_frame, level.level).items
    }


def cells_of(engine, parent, level=0):
    result = next(p for p in engine.surfaces.get("hall").parents if p.parent_frame == parent)
    own = result.levels[level]
    parts = [
        decode_tile(engine.surfaces.tile("hall", tile.digest).make(), tile, own.tile_m)
        for tile in engine.surfaces.tiles("hall", parent, level).items
    ]
    assert sum(len(part.points) for part in parts) == own.cells
    names = ("points", "seen", "sessions", "taken")
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return SurfaceCells(*columns), own.cell_m


def seen(engine):
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        numbers = numbers_of_runs(connection, row.number, None, None)
        stops = path_frames(connection, numbers)
        blobs = geometry_blobs(connection, numbers, row.model_id)
    return stops, blobs


def oracle(engine, cell_m):
    """What each frame saw of each cell: its mean, its session and its time, by parent frame."""
    results = {}
    stops, blobs = seen(engine)
    for number in sorted(stops):
        stop = stops[number]
        if stop.pose is None or stop.parent is None:
            continue
        geometry = engine.store.geometries.read(blobs[number])
        points = transform_points(np.array(stop.pose), surface_points(geometry))
        places = np.floor(points / cell_m).astype(int)
        keys, own, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(own.ravel(), weights=column) for column in points.T], axis=1)
        cells = results.setdefault(stop.parent, {})
        for key, mean in zip(map(tuple, keys.tolist()), sums / counts[:, None], strict=True):
            cells.setdefault(key, []).append((mean, stop))
    return results


def check(engine):
    """The surface is that of the frames that the map has now."""
    result = engine.surfaces.get("hall")
    assert (result.state, result.frames_left, result.error) == ("ready", 0, None)
    expected = oracle(engine, result.parents[0].levels[0].cell_m)
    assert {parent.parent_frame for parent in result.parents} == set(expected)
    start = 0.0 if result.taken_from is None else result.taken_from.timestamp()
    for parent, seen in expected.items():
        actual, cell_m = cells_of(engine, parent)
        keys = [tuple(one) for one in np.floor(actual.points / cell_m + 1e-9).astype(int).tolist()]
        assert len(keys) == len(set(keys))
        assert set(keys) == set(seen)
        np.testing.assert_allclose(actual.seen, [len(seen[key]) for key in keys], rtol=0.03)
        means = np.array([np.mean([mean for mean, _ in seen[key]], axis=0) for key in keys])
        # an eighth of a cell, and what each frame's mean is rounded by
        np.testing.assert_allclose(actual.points, means, atol=cell_m * (1 / 8 + 1 / 100))
        for place, key in enumerate(keys):
            last = max((stop for _, stop in seen[key]), key=lambda one: one.captured_at or 0.0)
            session = actual.sessions[place]
            assert last.session == (None if session < 0 else result.sessions[session])
            if last.captured_at is not None:
                assert actual.taken[place] == (last.captured_at - start) // result.taken_step_s


def test_a_surface_is_that_of_its_frames(engine):
    check(engine)
    result, begun = engine.surfaces.begin("hall")
    assert (result.state, begun, result.frames) == ("ready", False, 12)
    assert sorted(result.sessions) == ["a", "b"]
    assert (result.last_taken - result.first_taken).total_seconds() == 110.0
    number_events(engine.store.database)
    own = select(events.c.data).where(events.c.kind == "surface.updated")
    (data,) = engine.fetch(own).scalars()
    tiles = sum(level.tiles for parent in result.parents for level in parent.levels)
    assert data == {"frames": 12, "tiles": tiles}
    for parent in result.parents:
        assert parent.frames == 6
        assert [level.cell_m for level in parent.levels] == [0.05, 0.2, 0.8]
        assert [level.tile_m for level in parent.levels] == [3.2, 12.8, 51.2]
        actual, _ = cells_of(engine, parent.parent_frame)
        low, high = ([getattr(end, axis) for axis in "xyz"] for end in (parent.low, parent.high))
        assert (actual.points > low).all()
        assert (actual.points < high).all()
        np.testing.assert_allclose(actual.points.min(axis=0), low, atol=0.0125)
        np.testing.assert_allclose(actual.points.max(axis=0), high, atol=0.0125)


def test_coarser_levels_are_those_of_the_finest(engine):
    parent = engine.surfaces.get("hall").parents[0].parent_frame
    fine, _ = cells_of(engine, parent)
    for level in (1, 2):
        actual, cell_m = cells_of(engine, parent, level)
        assert cell_m == pytest.approx(0.05 * 4**level)
        within = {}
        for i, key in enumerate(np.floor(fine.points / cell_m).astype(int).tolist()):
            within.setdefault(tuple(key), []).append(i)
        keys = [tuple(one) for one in np.floor(actual.points / cell_m + 1e-9).astype(int).tolist()]
        assert set(keys) == set(within)
        most = [fine.seen[within[key]].max() for key in keys]
        np.testing.assert_array_equal(actual.seen, most)
        last = [fine.taken[within[key]].max() for key in keys]
        np.testing.assert_array_equal(actual.taken, last)


def test_frames_that_go_and_move_take_their_share_along(engine):
    frames = engine.list_frames("hall").items
    engine.delete_frame("hall", frames[3].frame_id)
    edit(engine, frames[4].frame_id, pose=None, pose_parent=None)
    edit(engine, frames[7].frame_id, session="c")
    T = np.eye(4)
    T[:3, 3] = 5.0, -0.4, 3.0
    edit(engine, frames[2].frame_id, pose=(T @ np.array(frames[2].pose.matrix)).tolist())
    result = engine.surfaces.get("hall")
    assert (result.state, result.frames, result.frames_left) == ("stale", 12, 4)
    build(engine)
    check(engine)
    kept = tiles_of(engine)
    engine.surfaces.remove("hall")
    build(engine)
    again = tiles_of(engine)
    assert kept.keys() == again.keys()  # no empty tile is left, and as if made at once
    for place in kept:
        a, b = (np.frombuffer(one[place], surface_job.CELL) for one in (kept, again))
        for name in ("at", "seen", "taken"):
            np.testing.assert_array_equal(a[name], b[name])


def test_a_surface_whose_frames_are_all_gone_is_none(engine):
    columns = surface_tiles.c.blob, surface_tiles.c.digest
    blobs = [row[0] for row in engine.fetch(select(*columns))]
    assert blobs
    for frame in engine.list_frames("hall").items:
        engine.delete_frame("hall", frame.frame_id)
    build(engine)
    result = engine.surfaces.get("hall")
    assert (result.state, result.frames, result.parents) == ("none", 0, [])
    assert [blob for blob in blobs if engine.store.blobs.holds(blob)] == []
    with pytest.raises(InvalidRequest, match="has no indexed frame with a pose"):
        engine.surfaces.begin("hall")


def test_slices_that_are_lost_are_done_again(engine, monkeypatch):
    before = tiles_of(engine)
    engine.surfaces.remove("hall")
    monkeypatch.setattr(surface_job, "SLICE_S", 0.0)
    engine.surfaces.begin("hall")
    turns = []
    while (lost := engine.claim("w")) is not None:
        engine.put_back(lost)
        job = engine.claim("w")
        outcome = surface_job.SurfaceHandler(engine.store, engine.signers)(job, lambda: True)
        assert all(engine.store.blobs.holds(blob) for blob in outcome.blobs)
        turns.append(engine.run(job))
    assert turns[-1] is JobState.SUCCEEDED
    assert len(turns) > 12
    assert tiles_of(engine) == before


def test_a_lost_tile_is_made_again(engine):
    before = tiles_of(engine)
    parent = engine.surfaces.get("hall").parents[0].parent_frame
    for level in (2, 0):
        tile = engine.surfaces.tiles("hall", parent, level).items[0]
        own = select(surface_tiles.c.blob).where(surface_tiles.c.digest == tile.digest)
        blob = engine.fetch(own).scalar_one()
        engine.settings.data_dir.joinpath("blobs", blob[:2], blob).unlink()
        with pytest.raises(DamagedBlob):
            engine.surfaces.tile("hall", tile.digest).make()
        with pytest.raises(NotFound, match="has no tile"):
            engine.surfaces.tile("hall", tile.digest)
        build(engine)
        assert tiles_of(engine) == before
    check(engine)


def test_a_deleted_map_leaves_nothing(engine):
    with engine.store.database.read() as connection:
        blobs = list(connection.execute(select(surface_tiles.c.blob)).scalars())
        assert all(refers_to(connection, blob) for blob in blobs)
    engine.delete_map("hall")
    with engine.store.database.read() as connection:
        for table in (surfaces, surface_tiles, surface_frames, surface_touches):
            statement = select(func.count()).select_from(table)
            assert connection.execute(statement).scalar_one() == 0
    assert [blob for blob in blobs if engine.store.blobs.holds(blob)] == []


def test_workers_begin_by_themselves_once_frames_have_come(engine, monkeypatch):
    monkeypatch.setattr(map_surface, "LOOK_S", 0.0)
    by_itself = Housekeeping(engine.context)

    def begun():
        return engine.surfaces.get("hall").state == "building"

    first, second, *_ = engine.list_frames("hall").items
    edit(engine, second.frame_id, tags=["x"])
    by_itself.run(), by_itself.run()
    assert not begun()  # a tag is not of the surface
    edit(engine, first.frame_id, session="z")
    by_itself.run()
    assert not begun()  # more may come
    edit(engine, first.frame_id, session="y")
    by_itself.run()
    assert not begun()
    by_itself.run()
    assert begun()
    assert engine.work_off()[-1] is JobState.SUCCEEDED
    engine.surfaces.remove("hall")
    for _ in range(3):
        by_itself.run()
    assert not begun()  # it was deleted


def test_a_spot_is_seen_by_the_frames_that_have_a_point_there(engine):
    parent = engine.surfaces.get("hall").parents[0]
    cells, cell_m = cells_of(engine, parent.parent_frame)
    spot = cells.points[int(np.argmax(cells.seen))].tolist()
    stops, blobs = seen(engine)
    expected = []
    for number, stop in stops.items():
        if stop.parent != parent.parent_frame:
            continue
        pose = np.array(stop.pose)
        points = transform_points(pose, surface_points(engine.store.geometries.read(blobs[number])))
        if np.linalg.norm(points - spot, axis=1).min() <= 2 * cell_m:
            expected.append((float(np.linalg.norm(pose[:3, 3] - spot)), stop.id))
    assert len(expected) > 2
    page = engine.surfaces.sightings("hall", spot, None, parent.parent_frame, None, 2)
    rest = engine.surfaces.sightings("hall", spot, None, parent.parent_frame, page.next_cursor, 99)
    actual = [*page.items, *rest.items]
    assert (len(page.items), rest.next_cursor) == (2, None)
    assert [item.frame_id for item in actual] == [name for _, name in sorted(expected)]
    distances = sorted(one for one, _ in expected)
    np.testing.assert_allclose([item.distance_m for item in actual], distances, rtol=1e-6)
    nowhere = engine.surfaces.sightings("hall", [1e6, 0.0, 0.0], None, parent.parent_frame)
    assert (nowhere.items, nowhere.next_cursor) == ([], None)
    with pytest.raises(InvalidRequest, match=r"The radius is 4 m. Use a radius above 0 and up to"):
        engine.surfaces.sightings("hall", spot, 4.0)


def test_a_plan_shows_what_lies_between_two_heights(engine):
    parent = engine.surfaces.get("hall").parents[0]
    cells, _ = cells_of(engine, parent.parent_frame)
    up = np.array([getattr(parent.up, axis) for axis in "xyz"])
    axes = np.array([parent.x_axis, parent.y_axis])
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), up, atol=1e-9)

    def picture(**more):
        data = engine.surfaces.picture("hall", parent.parent_frame, **more).make()
        return np.asarray(Image.open(io.BytesIO(data)))

    whole = picture()
    assert whole.shape == (parent.plan.height, parent.plan.width, 4)
    assert max(whole.shape) == 1024
    assert max(picture(width=100).shape) == 100
    flat, heights = cells.points @ axes.T, cells.points @ up
    x = ((flat[:, 0] - parent.plan.left) / parent.plan.m_per_pixel).astype(int)
    y = ((parent.plan.top - flat[:, 1]) / parent.plan.m_per_pixel).astype(int)
    assert (whole[y, x, 3] > 0).all()
    assert 0.05 < (whole[..., 3] == 0).mean() < 0.95
    low = heights <= np.median(heights)
    lower = picture(high=float(np.median(heights)))
    assert (lower[y[low], x[low], 3] > 0).all()
    assert (lower[..., 3] > 0).sum() < (whole[..., 3] > 0).sum()
    assert not picture(low=heights.max() + 1)[..., 3].any()
    with pytest.raises(NotFound, match="has no surface in that parent frame"):
        engine.surfaces.picture("hall", "nowhere")
