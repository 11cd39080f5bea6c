"""Tests of coverage of a map: equal rooms, duplicates, changes, and plans."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select

from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.engine.maps.map_plans import (
    QueriedPosition,
    coverage_plans,
    localisability,
    plan_changes,
)
from sceneprint.engine.products.map_coverage import frames_to_query
from sceneprint.engine.search.up_vectors import PlanAxes
from sceneprint.errors import InvalidRequest, NotIndexed, UnknownJob
from sceneprint.settings import Settings
from sceneprint.store.frame_queries import path_frames
from sceneprint.store.maps import find_map
from sceneprint.store.tables import job_items
from sceneprint.types import Floats
from sceneprint_client.api import JobState, NewMap
from sceneprint_client.api.coverage import CoverageCell, CoveragePlan, NewMapCoverage
from tests.whole_engine import Engine

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
#: How far the room that equals the first one is from it, metres.
APART_M = 10.0


#: Options of the two jobs that `rooms` has done.
WHOLE = {"not_within_s": 0.0, "cell_m": 0.5}
LATER_DAY = {"session": "a", "other_sessions": True}


@dataclass(frozen=True)
class Rooms:
    """A data folder, where the frames of its map `hall` were taken, and two coverage jobs."""

    folder: Path
    positions: list[Floats]
    parents: tuple[str, str]
    whole: str
    later_day: str


@pytest.fixture(scope="session")
def rooms(tmp_path_factory, uploads, make_upload, room_views):
    """A map `hall`: five frames of a room in session a, five of a room equal to it in session b,
    and four of another room in session c, a second apart. The first two share a parent frame.

    Map `pair` holds two frames of one session that differ by a millimetre of noise.
    """
    folder = tmp_path_factory.mktemp("rooms") / "data"
    path = room_views(21, 0, 12, along_path=True)
    positions = []
    with Engine(Settings(data_dir=folder)) as engine:
        for name in ("hall", "pair"):
            engine.create_map(NewMap(name=name, model="depth"))

        def add(name, frame, room, session):
            second = 5 * len(positions) if name == "pair" else len(positions)
            upload = make_upload(
                frame, room, session=session, robot="ann",
                captured_at=BEGIN + timedelta(seconds=second),
            )  # fmt: skip
            engine.add(upload, name)
            positions.append(frame.pose[:3, 3])

        rng, frame = np.random.default_rng(5), path.frames[0]
        noise = rng.choice((-0.001, 0.001), frame.depth.shape) * (frame.depth > 0)
        for depth in (frame.depth, frame.depth + noise):
            add("pair", replace(frame, depth=depth.astype(np.float32)), path.name, "a")
        positions.clear()
        shift = np.eye(4)
        shift[0, 3] = APART_M
        for i, frame in enumerate(path.frames[:10]):
            pose = (np.eye(4), shift)[i % 2] @ frame.pose
            add("hall", replace(frame, pose=pose), path.name, "ab"[i % 2])
        for upload in uploads[6:10]:
            add("hall", replace(upload.frame, pose=upload.pose), upload.room, "c")
        assert set(engine.work_off()) == {JobState.SUCCEEDED}
        done = [measured(engine, **request).job_id for request in (WHOLE, LATER_DAY)]
    return Rooms(folder, positions, (path.name, uploads[6].room), *done)


@pytest.fixture
def engine(rooms, tmp_path, make_engine):
    shutil.copytree(rooms.folder, tmp_path / "data")
    return make_engine()


def measured(engine, map_name="hall", **body):
    begun = engine.coverage.begin(map_name, NewMapCoverage.model_validate(body))
    assert begun.state is JobState.QUEUED
    assert engine.work_off()[-1] is JobState.SUCCEEDED
    return engine.coverage.get(map_name, begun.job_id)


def frames_of(engine, record):
    return engine.coverage.frames(record.map, record.job_id).items


def test_equal_rooms_are_ambiguous_and_linked(engine, rooms):
    record = engine.coverage.get("hall", rooms.whole)
    assert record.state is JobState.SUCCEEDED
    result = record.result
    assert (result.frames, result.skipped, result.map_frames) == (14, 0, 14)
    assert (result.found, result.ambiguous, result.wrong, result.not_found) == (4, 10, 0, 0)
    assert (result.unchecked, result.revision, result.last_revision) == (0, 14, 14)
    frames = frames_of(engine, record)
    places = [(p.x, p.y, p.z) for frame in frames if (p := frame.position) is not None]
    np.testing.assert_allclose(sorted(places), sorted(map(tuple, rooms.positions)))
    parents = Counter(frame.parent_frame for frame in frames)
    assert parents == {rooms.parents[0]: 10, rooms.parents[1]: 4}
    assert [frame.number for frame in frames] == list(range(14))
    sessions = {frame.frame_id: frame.session for frame in frames}
    for frame in frames:
        others = {sessions[look_alike] for look_alike in frame.look_alikes}
        if frame.session == "c":  # the room that nothing equals
            assert (frame.outcome, others) == ("found", set())
            assert frame.error_m < 0.05
        else:
            assert (frame.outcome, frame.error_m) == ("ambiguous", None)
            assert others == {"b" if frame.session == "a" else "a"}
    event, *_ = engine.events.page(engine.events.wanted("hall", ["coverage.measured"])).items
    assert event.data == result.model_dump(mode="json")


def test_an_answer_in_another_parent_frame_is_not_checked(engine, rooms):
    mine = [frame for frame in engine.list_frames("hall").items if frame.session == "c"]
    edit_frame(engine.store, "hall", mine[0].frame_id, {"pose": {"parent_frame": "elsewhere"}})
    result = measured(engine, session="c", not_within_s=0.0)
    assert (result.result.frames, result.result.found, result.result.unchecked) == (4, 3, 1)
    of_parent = {plan.parent_frame: plan.cells for plan in result.plans}
    assert sum(one.found for one in of_parent[rooms.parents[1]]) == 3
    assert sum(one.unchecked for one in of_parent["elsewhere"]) == 1


def test_only_another_session_of_an_equal_room_gives_wrong_poses(engine, rooms):
    result = engine.coverage.get("hall", rooms.later_day)
    assert (result.result.frames, result.result.wrong) == (5, 5)
    frames = frames_of(engine, result)
    by_id = {frame.frame_id: frame for frame in engine.list_frames("hall").items}
    for frame in frames:
        assert frame.error_m == pytest.approx(APART_M, abs=0.1)
        assert frame.error_deg < 2
        (other,) = frame.look_alikes
        assert by_id[other].session == "b"
    wrong = engine.coverage.frames("hall", result.job_id, outcome="wrong", limit=3)
    assert wrong.items == frames[:3]
    rest = engine.coverage.frames("hall", result.job_id, wrong.next_cursor, outcome="wrong")
    assert rest.items == frames[3:]
    assert engine.coverage.frames("hall", result.job_id, outcome="found").items == []
    wide = measured(engine, **LATER_DAY, every=5, tolerance_m=APART_M + 1)
    assert (wide.result.frames, wide.result.found) == (1, 1)


def test_a_duplicate_is_left_out_with_the_frames_around_it(engine):
    near = measured(engine, "pair", not_within_s=0.0)
    assert (near.result.frames, near.result.found) == (2, 2)
    for left_out in ({"not_within_s": 4.9}, {"not_within_s": 5.1}, {"other_sessions": True}):
        result = measured(engine, "pair", **left_out)
        kept = left_out == {"not_within_s": 4.9}
        assert (result.result.found, result.result.not_found) == ((2, 0) if kept else (0, 2))
        if not kept:
            assert {frame.cause for frame in frames_of(engine, result)} == {"no_frames"}


def test_every_nth_frame_and_at_most_so_many(engine):
    frames = [(frame.session, frame.frame_id) for frame in engine.list_frames("hall").items]
    order = [frame_id for _, frame_id in sorted(frames, key=lambda one: one[0] or "")]

    def chosen(**body):
        with engine.store.database.read() as connection:
            row = find_map(connection, "hall")
            numbers = frames_to_query(connection, row, NewMapCoverage.model_validate(body))
            stops = path_frames(connection, numbers)
        return [stops[number].id for number in numbers]

    assert chosen() == order
    assert chosen(every=5) == order[::5]
    assert chosen(session="b", robot="ann") == order[5:10]
    assert chosen(most=4) == [order[i] for i in (0, 3, 7, 10)]
    assert chosen(every=2, most=100) == order[::2]


def test_cells_that_became_better_are_told(engine, rooms):
    how = WHOLE | {"session": "a"}
    before = measured(engine, **how)
    for frame in engine.list_frames("hall").items:
        if frame.session == "b":
            engine.delete_frame("hall", frame.frame_id)
    after = measured(engine, **how)
    result = engine.coverage.changes("hall", after.job_id, before.job_id)
    assert (result.result_before, result.result_after) == (before.result, after.result)
    assert (result.result_before.ambiguous, result.result_after.found) == (5, 5)
    cells = {(int(x // 0.5), int(y // 0.5)) for x, y, _ in rooms.positions[:10:2]}
    assert result.trends == dict.fromkeys(result.trends, 0) | {"better": len(cells)}
    items = list(engine.fetch(select(job_items.c.data)).scalars())
    frames = [item for item in items if "frame" in item]
    assert len(frames) > 20
    written = json.dumps(frames)  # a deleted frame leaves no position behind
    assert not [x for x, *_ in rooms.positions if f"{x:.6f}"[:8] in written]
    # frames that were deleted since are in no list and are no look-alikes
    whole = frames_of(engine, engine.coverage.get("hall", rooms.whole))
    assert {frame.session for frame in whole} == {"a", "c"}
    assert not any(frame.look_alikes for frame in whole)
    with pytest.raises(InvalidRequest, match="differ in session"):
        engine.coverage.changes("hall", rooms.whole, before.job_id)


def test_what_cannot_be_measured_is_refused(engine):
    with pytest.raises(InvalidRequest, match="no indexed frame of session 'z'"):
        engine.coverage.begin("hall", NewMapCoverage(session="z"))
    with pytest.raises(ValueError, match="already excludes the whole session"):
        NewMapCoverage(other_sessions=True, not_within_s=3.0)
    queued = engine.coverage.begin("hall", NewMapCoverage(every=6))
    with pytest.raises(NotIndexed, match="is queued"):
        engine.coverage.changes("hall", queued.job_id, queued.job_id)
    with pytest.raises(UnknownJob, match="no coverage"):
        engine.coverage.get("pair", queued.job_id)


LEVEL = PlanAxes(np.eye(3)[:2], "map")


def cell(column, row, frames=0, **counts):
    fields = {"found": 0, "wrong": 0, "ambiguous": 0, "not_found": 0} | counts
    return CoverageCell(column=column, row=row, frames=frames, **fields)


def plan(*cells, parent="map"):
    return CoveragePlan(
        parent_frame=parent, x_axis=[1, 0, 0], y_axis=[0, 1, 0], up_from="map", cells=list(cells)
    )


def queried(*args):
    return [QueriedPosition(np.array([x, y, 7.0]), outcome) for x, y, outcome in args]


def test_frames_are_counted_by_cell():
    taken = {"map": np.array([[0.1, 0.1, 0.0], [0.9, 0.2, 9.0], [-0.1, 0.1, 0.0], [5.0, 5.0, 0.0]])}
    positions = {
        "map": queried((0.1, 0.1, "found"), (0.9, 0.2, "wrong"), (-0.1, 0.1, "ambiguous")),
        "odom": queried((3.5, -0.5, "not_found")),
    }
    plans, cell_m = coverage_plans(positions, taken, {"map": LEVEL, "odom": LEVEL}, 1.0)
    assert cell_m == 1.0
    assert [plan.parent_frame for plan in plans] == ["map", "odom"]
    assert plans[0].cells == [
        cell(-1, 0, 1, ambiguous=1), cell(0, 0, 2, found=1, wrong=1), cell(5, 5, 1)
    ]  # fmt: skip
    assert plans[1].cells == [cell(3, -1, 0, not_found=1)]  # its frame was deleted meanwhile
    assert coverage_plans({}, taken, {}, None)[0] == []


def test_two_results_are_compared_cell_by_cell():
    before = [
        plan(
            cell(0, 0, 9, found=1, not_found=1), cell(1, 0, 9, found=2), cell(2, 0, 9, ambiguous=3),
            cell(3, 0, 9, found=2, wrong=1), cell(4, 0, 9, found=1), cell(5, 0, 9),
            cell(0, 1, 9, not_found=2),
        ),
        plan(cell(0, 0, 1, found=1), parent="gone"),
    ]  # fmt: skip
    after = [
        plan(
            cell(0, 0, 12, found=3, not_found=1),  # 1/2 of 2, now 3/4 of 4
            cell(1, 0, 9, found=1, ambiguous=1),  # all of 2, now half
            cell(2, 0, 9, not_found=3),  # not found is no better than ambiguous
            cell(3, 0, 9, found=1, not_found=2),  # (2 - 1) / 3 as (1 - 0) / 3
            cell(5, 0, 9, found=1),  # not queried before
            cell(6, 0, 9),  # queried in neither
            cell(0, 1, 9, wrong=1, not_found=1),  # wrong is worse than not found
        )
    ]  # fmt: skip
    result, gone = plan_changes(before, after)
    trends = {(cell.column, cell.row): cell.trend for cell in result.cells}
    assert trends == {
        (0, 0): "better", (1, 0): "worse", (2, 0): "same", (3, 0): "same", (4, 0): "gone",
        (5, 0): "new", (0, 1): "worse",
    }  # fmt: skip
    assert [(c.column, c.row) for c in result.cells] == list(trends)  # by row, then by column
    assert (result.cells[0].before, result.cells[0].after) == (
        before[0].cells[0],
        after[0].cells[0],
    )
    assert result.cells[4].after is None
    assert (gone.parent_frame, [cell.trend for cell in gone.cells]) == ("gone", ["gone"])
    assert localisability(before[0].cells[3]) == pytest.approx(1 / 3)
    assert localisability(cell(0, 0, 3, found=1, wrong=0, not_found=1, unchecked=1)) == 0.5
