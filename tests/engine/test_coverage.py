"""Coverage of a map through the engine: equal rooms, duplicates, slices that are lost, changes."""

from __future__ import annotations

import io
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from sqlalchemy import select

from sceneprint.engine import Engine
from sceneprint.engine.jobs.lifecycle import Work, cancel
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.engine.maps.coverage_job import CoverageHandler
from sceneprint.engine.maps.coverage_picture import COLOURS
from sceneprint.errors import InvalidRequest, NotIndexed, UnknownJob, UnknownMap
from sceneprint.settings import Settings
from sceneprint.store.tables import events, job_items, jobs
from sceneprint_client.api import JobState, NewMap
from sceneprint_client.api.coverage import CoverageFrame, MapCoverage, NewMapCoverage

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
WorkOff = Callable[[Engine], list[JobState | None]]
#: How far the room that equals the first one is from it, metres.
APART_M = 10.0


@pytest.fixture(scope="session")
def rooms_folder(
    tmp_path_factory: pytest.TempPathFactory, uploads: Any, make_upload: Callable[..., Any],
    work_off: WorkOff,
) -> Path:  # fmt: skip
    """A map `hall`: six frames of a room in session a, of a room equal to it in session b, and of
    another room in session c, a second apart. The first two share a parent frame.

    The equal room's frames are the first one's with a millimetre of noise. Map `pair` holds two
    frames that differ by as much, in one session.
    """
    folder = tmp_path_factory.mktemp("rooms") / "data"
    rng = np.random.default_rng(5)

    def add(engine: Engine, name: str, frame: Any, room: str, session: str, second: int) -> None:
        depth = np.where(
            frame.depth > 0, frame.depth + rng.choice((-0.001, 0.001), frame.depth.shape), 0
        )
        made = make_upload(
            replace(frame, depth=depth.astype(np.float32)), room, session=session, robot="ann",
            captured_at=BEGIN + timedelta(seconds=second),
        )  # fmt: skip
        engine.add_frame(name, made.data, made.meta)

    with Engine(Settings(data_dir=folder)) as engine:
        for name in ("hall", "pair"):
            engine.create_map(NewMap(name=name, model="depth"))
        for i, one in enumerate(uploads):
            frame = replace(one.frame, pose=one.pose)
            add(engine, "hall", frame, one.room, "a" if i < 6 else "c", i)
        shift = np.eye(4)
        shift[0, 3] = APART_M
        for i, one in enumerate(uploads[:6]):
            frame = replace(one.frame, pose=shift @ one.pose)
            add(engine, "hall", frame, one.room, "b", 20 + i)
        for second in (0, 5):
            one = uploads[0]
            add(engine, "pair", replace(one.frame, pose=one.pose), one.room, "a", second)
        assert set(work_off(engine)) == {JobState.SUCCEEDED}
    return folder


@pytest.fixture
def engine(rooms_folder: Path, tmp_path: Path, make_engine: Callable[..., Engine]) -> Engine:
    shutil.copytree(rooms_folder, tmp_path / "data")
    return make_engine()


def measured(
    engine: Engine, work_off: WorkOff, map_name: str = "hall", **asked: Any
) -> MapCoverage:
    begun = engine.coverage.begin(map_name, NewMapCoverage.model_validate(asked))
    assert begun.state is JobState.QUEUED
    assert work_off(engine)[-1] is JobState.SUCCEEDED
    return engine.coverage.get(map_name, begun.coverage_id)


def frames_of(engine: Engine, told: MapCoverage) -> list[CoverageFrame]:
    return engine.coverage.frames(told.map, told.coverage_id).items


def test_equal_rooms_are_ambiguous_and_linked(
    engine: Engine, work_off: WorkOff, uploads: Any
) -> None:
    told = measured(engine, work_off, not_within_s=0.0, cell_m=0.5)
    result = told.result
    assert result is not None
    assert (result.frames, result.skipped, result.map_frames) == (18, 0, 18)
    assert (result.found, result.ambiguous, result.wrong, result.not_found) == (6, 12, 0, 0)
    assert result.unchecked == 0
    assert result.revision == result.last_revision == 18
    frames = frames_of(engine, told)
    assert [frame.number for frame in frames] == list(range(18))
    sessions = {frame.frame_id: frame.session for frame in frames}
    for frame in frames:
        others = {sessions[one] for one in frame.look_alikes}
        if frame.session == "c":  # the room that nothing equals
            assert (frame.outcome, others) == ("found", set())
            assert frame.error_m is not None
            assert frame.error_m < 0.05
        else:
            assert (frame.outcome, frame.error_m) == ("ambiguous", None)
            assert others == {"b" if frame.session == "a" else "a"}
    # the plan's cells by hand: positions of both rooms
    plans = told.plans
    assert plans is not None
    assert [plan.parent_frame for plan in plans] == [uploads[0].room, uploads[6].room]
    assert {plan.up_from for plan in plans} == {"cameras"}
    positions = [np.array(one.pose)[:3, 3] for one in uploads]
    expected = Counter[tuple[int, int]]()
    for x, y, _ in positions[:6]:
        expected[int(x // 0.5), int(y // 0.5)] += 1
        expected[int((x + APART_M) // 0.5), int(y // 0.5)] += 1
    cells = {(cell.column, cell.row): cell for cell in plans[0].cells}
    assert {place: cell.frames for place, cell in cells.items()} == expected
    assert {place: cell.ambiguous for place, cell in cells.items()} == expected
    assert (plans[0].x_axis, plans[0].y_axis) == ([1, 0, 0], [0, 1, 0])  # z is up in these rooms
    with engine.store.database.read() as connection:
        kind = events.c.kind == "coverage.measured"
        data = connection.execute(select(events.c.data).where(kind)).scalar_one()
    assert data == result.model_dump(mode="json")


def test_only_another_session_of_an_equal_room_gives_wrong_poses(
    engine: Engine, work_off: WorkOff
) -> None:
    told = measured(engine, work_off, session="a", other_sessions=True)
    assert told.result is not None
    assert (told.result.frames, told.result.wrong) == (6, 6)
    frames = frames_of(engine, told)
    by_id = {one.frame_id: one for one in engine.list_frames("hall").items}
    for frame in frames:
        assert frame.error_m == pytest.approx(APART_M, abs=0.1)
        assert frame.error_deg is not None
        assert frame.error_deg < 2
        (other,) = frame.look_alikes
        assert by_id[other].session == "b"
    wrong = engine.coverage.frames("hall", told.coverage_id, outcome="wrong", limit=4)
    assert wrong.items == frames[:4]
    rest = engine.coverage.frames("hall", told.coverage_id, wrong.next_cursor, outcome="wrong")
    assert rest.items == frames[4:]
    assert engine.coverage.frames("hall", told.coverage_id, outcome="found").items == []
    wide = measured(engine, work_off, session="a", other_sessions=True, tolerance_m=APART_M + 1)
    assert wide.result is not None
    assert wide.result.found == 6


def test_a_duplicate_is_left_out_with_the_frames_around_it(
    engine: Engine, work_off: WorkOff
) -> None:
    """Two frames of one place, five seconds apart: each finds the other, unless it is left out."""
    near = measured(engine, work_off, "pair", not_within_s=0.0)
    assert near.result is not None
    assert (near.result.frames, near.result.found) == (2, 2)
    for left_out in ({"not_within_s": 4.9}, {"not_within_s": 5.1}, {"other_sessions": True}):
        told = measured(engine, work_off, "pair", **left_out)
        assert told.result is not None
        kept = left_out == {"not_within_s": 4.9}
        assert (told.result.found, told.result.not_found) == ((2, 0) if kept else (0, 2))
        if not kept:
            assert {frame.cause for frame in frames_of(engine, told)} == {"no_frames"}


def test_every_nth_frame_and_at_most_so_many(engine: Engine, work_off: WorkOff) -> None:
    order = [one.frame_id for one in sorted(
        engine.list_frames("hall").items, key=lambda one: (one.session, one.captured_at)
    )]  # fmt: skip
    told = measured(engine, work_off, every=7)
    assert [frame.frame_id for frame in frames_of(engine, told)] == order[::7]
    few = measured(engine, work_off, most=4)
    assert [frame.frame_id for frame in frames_of(engine, few)] == [order[i] for i in (0, 4, 9, 13)]
    assert few.progress is not None
    assert (few.progress.done, few.progress.total) == (4, 4)


def stored(engine: Engine, coverage_id: str) -> list[Any]:
    with engine.store.database.read() as connection:
        own = select(jobs.c.number).where(jobs.c.id == coverage_id).scalar_subquery()
        asked = select(job_items.c.data).where(job_items.c.job_number == own)
        return list(connection.execute(asked.order_by(job_items.c.number)).scalars())


def test_a_slice_that_was_lost_is_done_again_with_the_same_result(
    engine: Engine, work_off: WorkOff, due_now: Callable[[Engine], None]
) -> None:
    asked = {"session": "c", "not_within_s": 1.5}
    whole = measured(engine, work_off, **asked)
    begun = engine.coverage.begin("hall", NewMapCoverage.model_validate(asked))
    handler = CoverageHandler(engine.store, engine.signers, engine.queries)
    slices = 0
    while True:  # a frame a slice, and each is lost once
        lost = engine.claim("dies")
        assert isinstance(lost, LongJob)
        first = handler(lost, 0.0)
        due_now(engine)
        again = engine.claim("lives")
        assert isinstance(again, LongJob)
        assert engine.tasks.run(lost, 60.0, 60.0) is None  # its lease is another's
        second = handler(again, 0.0)
        assert asdict(first) == asdict(second)
        engine.tasks._keep(again, second)
        slices += 1
        told = engine.coverage.get("hall", begun.coverage_id)
        if told.state.over:
            break
        assert told.progress is not None
        assert told.progress.done == slices
        assert len(frames_of(engine, told)) == slices  # told while more are queried
    assert slices == 7  # the last concludes
    assert (told.result, told.plans) == (whole.result, whole.plans)
    assert stored(engine, told.coverage_id) == stored(engine, whole.coverage_id)


def test_an_upload_goes_before_the_next_slice(
    engine: Engine, work_off: WorkOff, uploads: Any
) -> None:
    engine.coverage.begin("hall", NewMapCoverage(session="c"))
    handler = CoverageHandler(engine.store, engine.signers, engine.queries)
    task = engine.claim("w")
    assert isinstance(task, LongJob)
    engine.tasks._keep(task, handler(task, 0.0))
    engine.add_frame("pair", uploads[9].data, uploads[9].meta, -10)  # of the least priority
    frame = engine.claim("w")
    assert isinstance(frame, Work)
    engine.run(frame)
    assert isinstance(engine.claim("w"), LongJob)


def test_cells_that_became_better_are_told(engine: Engine, work_off: WorkOff) -> None:
    how = {"not_within_s": 0.0, "cell_m": 0.5}
    before = measured(engine, work_off, **how)
    for frame in engine.list_frames("hall").items:
        if frame.session == "b":
            engine.delete_frame("hall", frame.frame_id)
    after = measured(engine, work_off, **how)
    told = engine.coverage.changes("hall", after.coverage_id, before.coverage_id)
    assert (told.result_before, told.result_after) == (before.result, after.result)
    assert told.result_after.found == 12
    assert told.result_after.revision == told.result_before.revision + 6
    trends = {
        (plan.parent_frame, cell.column, cell.row): cell.trend
        for plan in told.plans
        for cell in plan.cells
    }
    assert before.plans is not None
    rooms = [plan.parent_frame for plan in before.plans]
    for (parent, column, _), trend in trends.items():
        twin = column * 0.5 > APART_M / 2
        assert trend == ("same" if parent == rooms[1] else "gone" if twin else "better")
    assert told.trends == dict.fromkeys(told.trends, 0) | Counter(trends.values())
    backwards = engine.coverage.changes("hall", before.coverage_id, after.coverage_id)
    assert backwards.trends["worse"] == told.trends["better"] > 0
    assert backwards.trends["new"] == told.trends["gone"] > 0
    # frames that were deleted since are in no list and on no plan
    assert {frame.session for frame in frames_of(engine, before)} == {"a", "c"}
    assert all(not frame.look_alikes for frame in frames_of(engine, before))
    other = measured(engine, work_off, **(how | {"every": 2}))
    wider = measured(engine, work_off, **(how | {"cell_m": 1.0}))
    for second, why in ((other, "every"), (wider, "cells are 0.5 m and 1 m")):
        with pytest.raises(InvalidRequest, match=why):
            engine.coverage.changes("hall", second.coverage_id, before.coverage_id)


def test_the_plan_is_drawn_in_the_colours_of_its_cells(engine: Engine, work_off: WorkOff) -> None:
    told = measured(engine, work_off, not_within_s=0.0, cell_m=0.5)
    assert told.plans is not None
    output = engine.coverage.picture("hall", told.coverage_id)
    pixels = np.asarray(Image.open(io.BytesIO(output.make())).convert("RGB"))
    assert pixels.shape[1] == 1400
    colours = {tuple(one) for one in pixels.reshape(-1, 3).tolist()}
    assert COLOURS["ambiguous"] in colours
    legend = pixels[-84:].reshape(-1, 3).tolist()
    assert [name for name, colour in COLOURS.items() if list(colour) in legend] == list(COLOURS)
    other = engine.coverage.picture("hall", told.coverage_id, told.plans[1].parent_frame)
    assert other.tag != output.tag
    engine.delete_frame("hall", frames_of(engine, told)[0].frame_id)
    assert engine.coverage.picture("hall", told.coverage_id).tag != output.tag
    with pytest.raises(InvalidRequest, match="no plan of parent frame 'x'"):
        engine.coverage.picture("hall", told.coverage_id, "x")


def test_what_cannot_be_measured_is_refused(engine: Engine, work_off: WorkOff) -> None:
    with pytest.raises(UnknownMap):
        engine.coverage.begin("none", NewMapCoverage())
    with pytest.raises(InvalidRequest, match="no indexed frame of session 'z'"):
        engine.coverage.begin("hall", NewMapCoverage(session="z"))
    with pytest.raises(ValueError, match="leaves out the whole session already"):
        NewMapCoverage(other_sessions=True, not_within_s=3.0)
    queued = engine.coverage.begin("hall", NewMapCoverage(every=6))
    for ask in (engine.coverage.picture, lambda *of: engine.coverage.changes(*of, of[1])):
        with pytest.raises(NotIndexed, match="is queued"):
            ask("hall", queued.coverage_id)
    with pytest.raises(UnknownJob, match="no coverage"):
        engine.coverage.get("pair", queued.coverage_id)
    cancel(engine.store, queued.coverage_id)
    assert engine.coverage.get("hall", queued.coverage_id).state is JobState.CANCELLED
    assert work_off(engine) == []
    listed = engine.coverage.list_all("hall").items
    assert [one.coverage_id for one in listed] == [queued.coverage_id]
    engine.coverage.remove("hall", queued.coverage_id)
    assert engine.coverage.list_all("hall").items == []


def test_frames_that_went_meanwhile_are_skipped(
    engine: Engine, work_off: WorkOff, due_now: Callable[[Engine], None]
) -> None:
    begun = engine.coverage.begin("hall", NewMapCoverage(session="c", not_within_s=0.0))
    task = engine.claim("w")
    assert isinstance(task, LongJob)
    handler = CoverageHandler(engine.store, engine.signers, engine.queries)
    engine.tasks._keep(task, handler(task, 0.0))
    last = [one for one in engine.list_frames("hall").items if one.session == "c"][-1]
    engine.delete_frame("hall", last.frame_id)
    due_now(engine)
    work_off(engine)
    told = engine.coverage.get("hall", begun.coverage_id)
    assert told.result is not None
    assert (told.result.frames, told.result.skipped, told.result.found) == (5, 1, 5)
    assert told.result.last_revision == told.result.revision + 1
