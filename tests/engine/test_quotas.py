"""Tests that quotas are exact for concurrent uploads and all changes of frames."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
from sqlalchemy import select

from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.errors import InvalidRequest, MapExists, QuotaExceeded
from sceneprint.store import frames as stored
from sceneprint.store import maps
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import MapUsage, counted_usage, find_map, map_usage
from sceneprint.store.tables import frames
from sceneprint_client.api import FrameState, NewMap
from tests.engine.conftest import packed_again, used


def limit(engine, **limits):
    edit_map(engine.store, "hall", limits)


def test_a_map_takes_what_its_quota_allows(empty, uploads):
    a, b, c, d, *_ = uploads
    limit(empty, quota_frames=2)
    first, _ = empty.add(a)
    empty.add(b)
    assert used(empty) == MapUsage(2, len(a.data) + len(b.data))
    with pytest.raises(QuotaExceeded, match=r"has 2 frames, and its quota is 2.*PATCH /v1/maps"):
        empty.add(c)
    blobs = set(empty.store.blobs.digests())
    assert len(blobs) == 2  # nothing is left of what was not taken
    again, new = empty.add(a)  # no new frame
    assert (again.frame_id, new) == (first.frame_id, False)
    empty.delete_frame("hall", first.frame_id)
    assert used(empty) == MapUsage(1, len(a.data) + len(b.data))  # it can be restored
    assert empty.tombstones.purge(everything=True) == 1
    assert used(empty) == MapUsage(1, len(b.data))
    batch = [Upload(shot.data, shot.meta) for shot in (b, c, d)]
    outcomes, _ = empty.uploads.add_all("hall", batch)
    assert [outcome.new for outcome in outcomes] == [False, True, False]
    assert isinstance(outcomes[2].error, QuotaExceeded)
    assert used(empty) == MapUsage(2, len(b.data) + len(c.data))
    limit(empty, quota_frames=None)
    empty.add(d)


def test_bytes_are_those_of_uploads(empty, uploads):
    a, b, *_ = uploads
    limit(empty, quota_bytes=len(a.data) + len(b.data) - 1)
    empty.add(a)
    with pytest.raises(QuotaExceeded, match=f"has {len(a.data)} bytes of uploads, and its quota"):
        empty.add(b)
    limit(empty, quota_bytes=len(a.data) + len(b.data))
    empty.add(b)
    limit(empty, quota_bytes=1)  # what is there stays
    assert used(empty) == MapUsage(2, len(a.data) + len(b.data))


def test_a_quota_holds_to_the_frame_whoever_sends_at_once(empty, make_engine, uploads):
    limit(empty, quota_frames=7)
    engines, taken = [empty, make_engine()], []

    def send(part):
        for i, upload in enumerate(uploads):
            if i % 4 == part:
                continue  # each frame is sent three times
            with suppress(QuotaExceeded):
                taken.append(engines[part % 2].add(upload)[1])

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(send, range(4)))
    assert sum(taken) == used(empty).frames == 7


def test_every_change_of_a_frame_is_counted(empty, uploads):
    rng, data = np.random.default_rng(3), uploads[0]
    empty.add(data)
    with empty.store.database.write() as connection:
        row = find_map(connection, "hall")
        [template] = connection.execute(select(frames)).mappings()
        names = set(frames.c.keys()) - {
            "number", "id", "map_number", "state", "received_at", "pose_x", "pose_y", "pose_z",
        }  # fmt: skip
        values = {name: template[name] for name in names}
        states = set()
        for step in range(150):
            size, kind = int(rng.integers(1, 1000)), rng.integers(6)
            ordered = select(frames.c.number).order_by(frames.c.number)  # ids are random
            numbers = connection.execute(ordered).scalars().all()
            one = maps.frame_of(connection, int(rng.choice(numbers)))
            if kind <= 1:
                content = {"content_id": f"{step:064d}", "bytes": size}
                maps.add_frame(connection, row.number, values | content)
            elif kind == 2:
                stored.set_state(connection, one.number, FrameState.REDUNDANT)
            elif kind == 3 and one.state == FrameState.REDUNDANT:
                stored.reset_frame(connection, one.number, {"bytes": size})
            elif kind == 4:
                stored.renew_upload(connection, one.number, "ab" * 32, size, None)
            elif kind == 5 and one.state != FrameState.DELETED:
                stored.delete_frame(connection, row, one)
            states.add((int(kind), str(one.state)))
            assert map_usage(connection, row.number) == counted_usage(connection, row.number), step
    assert {(2, "deleted"), (2, "redundant"), (3, "redundant"), (5, "redundant")} <= states


def test_what_had_no_room_is_taken_when_it_is_sent_again(empty, uploads):
    a, b, *_ = uploads
    once = IdempotentRequest("robot", "key", "f" * 64)
    limit(empty, quota_frames=0)
    for _ in range(2):
        with pytest.raises(QuotaExceeded):
            empty.uploads.add("hall", Upload(a.data, a.meta), once)
    limit(empty, quota_frames=1)
    batch = [Upload(shot.data, shot.meta) for shot in (a, b)]
    other = IdempotentRequest("robot", "other", "e" * 64)
    (first, second), again = empty.uploads.add_all("hall", batch, other)
    assert (first.new, second.added, again) == (True, None, False)
    limit(empty, quota_frames=2)
    (first, second), again = empty.uploads.add_all("hall", batch, other)
    assert (first.new, second.new, again) == (False, True, False)
    outcomes, again = empty.uploads.add_all("hall", batch, other)
    assert (again, [outcome.error for outcome in outcomes]) == (True, [None, None])


def test_a_map_made_anew_has_the_quota_of_the_one_before(empty):
    limit(empty, quota_frames=3, retention_days=2.0)
    empty.delete_map("hall")
    row, _ = empty.create_map(NewMap(name="hall", model="depth"))
    assert (row.quota_frames, row.quota_bytes, row.retention_days) == (3, None, None)
    assert empty.create_map(NewMap(name="hall", model="depth"))[1] is False
    assert empty.create_map(NewMap(name="hall", model="depth", quota_frames=3))[1] is False
    with pytest.raises(MapExists, match="its title, model, limits or up vector differ"):
        empty.create_map(NewMap(name="hall", model="depth", quota_frames=4))
    empty.delete_map("hall")
    row, _ = empty.create_map(NewMap(name="hall", model="depth", quota_frames=None))
    assert row.quota_frames is None


def test_limits_are_looked_at_before_they_are_set(empty):
    before = empty.get_map("hall").etag
    for bad in ({"quota_frames": -1}, {"quota_bytes": 1.5}, {"retention_days": 0},
                {"retention_days": float("nan")}, {"quota_frames": 2**60}):  # fmt: skip
        with pytest.raises(InvalidRequest):
            edit_map(empty.store, "hall", bad)
    assert empty.get_map("hall").etag == before
    result = edit_map(empty.store, "hall", {"quota_frames": 0, "quota_bytes": 10})
    assert (result.quota_frames, result.quota_bytes, result.retention_days) == (0, 10, None)
    assert result.etag != before
    assert edit_map(empty.store, "hall", {"quota_frames": None}).quota_bytes == 10


def test_a_failed_frame_that_comes_larger_needs_room_too(empty, uploads):
    one = uploads[0]
    added, _ = empty.add(one)
    with empty.store.database.write() as connection:
        row = find_map(connection, "hall")
        number = maps.find_frame(connection, row, added.frame_id).number
        stored.set_state(connection, number, FrameState.FAILED, "it broke down")
    loose = packed_again(one.data)
    limit(empty, quota_frames=1, quota_bytes=len(loose) - 1)
    with pytest.raises(QuotaExceeded, match=f"{len(loose) - len(one.data)} more bytes"):
        empty.add_frame("hall", loose, one.meta)
    assert used(empty) == MapUsage(1, len(one.data))
    again, new = empty.add(one)  # as it was: no more room than before
    assert (again.frame_id, new, used(empty)) == (added.frame_id, True, MapUsage(1, len(one.data)))
