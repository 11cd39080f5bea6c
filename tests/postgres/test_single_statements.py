"""Tests that single statements on PostgreSQL have the effect of several statements."""

import numpy as np
import pytest
from sqlalchemy import insert, select, update

from sceneprint.store import queue
from sceneprint.store.events import record_event
from sceneprint.store.maps import add_frame, add_map, map_of_number, store_model
from sceneprint.store.new_frames import NewFrame, receive_frames
from sceneprint.store.parent_joins import ParentJoin, join_parent
from sceneprint.store.signatures import StoredSignature, index_claimed_frame, index_frame
from sceneprint.store.tables import (
    frame_row,
    frame_tags,
    frames,
    jobs,
    maps,
    pending_events,
    signatures,
    surface_frames,
)
from sceneprint_client.api import JobState
from tests.store.frame_rows import frame_values

MODEL, OTHER = "ab" * 32, "cd" * 32
MADE = StoredSignature(MODEL, b"signature", "e" * 64, [3, 2], [5, 4])
#: Columns that differ between any two frames that are otherwise alike.
CHANCE = {
    "number", "id", "frame_number", "map_number", "frame_id", "job_id", "name", "map",
    "received_at", "run_after", "created_at", "at", "indexed_at", "finished_at",
    "started_at", "token", "turn",
}  # fmt: skip
POSE = [[1.0, 0.0, 0.0, 2.5], [0.0, 1.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
VALUES = frame_values(
    "c" * 64, bytes=70, novelty=None, robot="cart \U0001f916 \"'\\", session="monday",
    intrinsics={"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 1.5},
    captured_at=12.5, tags=["wet", "dark", "wet"], pose_parent="odom", pose=POSE, base_frame=None,
    base=None, up=[0.0, -1.0, 0.0], sequence=2**40, cloud=None,
)  # fmt: skip


@pytest.fixture
def pair(server_store):
    """Two maps that are alike: one for each way."""
    with server_store.database.write() as connection:
        for model in (MODEL, OTHER):
            store_model(connection, model, "toy", model.encode())
        return [add_map(connection, name, None, MODEL) for name in ("single", "parts")]


def received(store, row, *, at_once):
    with store.database.write(map_number=row.number) as connection:
        if at_once:
            assert len(receive_frames(connection, [NewFrame(row, VALUES, 3)])) == 1
            return
        frame = add_frame(connection, row.number, VALUES)
        job = queue.enqueue(connection, "sign", frame.number, 3)
        record_event(connection, "frame.received", row.name, frame.id, job.id)


def claimed(store, row):
    with store.database.write() as connection:
        held = queue.claim(connection, "worker", 60.0)
    assert held.map_number == row.number
    return held


def indexed(store, row, job, signature=MADE, *, at_once):
    with store.database.write(map_number=row.number) as connection:
        query = select(frames).where(frames.c.number == job.frame_number)
        frame = frame_row(connection.execute(query).mappings().one())
        if at_once:
            return index_claimed_frame(connection, job, frame, row.name, signature)
        queue.finish(connection, job, JobState.SUCCEEDED)
        index_frame(connection, frame, signature)
        record_event(connection, "frame.indexed", row.name, frame.id, job.id)
        return True


def rows(store, row):
    """All that a map has, but for what is chance."""
    with store.database.read() as connection:
        own = list(
            connection.execute(select(frames.c.number).where(frames.c.map_number == row.number))
            .scalars()
        )  # fmt: skip
        of_frames = {table.name: table.c.frame_number.in_(own)
                     for table in (frame_tags, signatures, surface_frames)}  # fmt: skip
        which = {
            maps.name: maps.c.number == row.number,
            frames.name: frames.c.map_number == row.number,
            jobs.name: jobs.c.map_number == row.number,
            pending_events.name: pending_events.c.map == row.name,
            **of_frames,
        }
        return {name: _told(connection, maps.metadata.tables[name], of)
                for name, of in which.items()}  # fmt: skip


def _told(connection, table, of):
    result = connection.execute(select(table).where(of).order_by(*table.primary_key)).mappings()
    return [{name: item[name] for name in item if name not in CHANCE} for item in result]


def test_a_frame_is_received_as_by_its_parts(server_store, pair):
    for row, at_once in zip(pair, (True, False), strict=True):
        received(server_store, row, at_once=at_once)
    single, parts = (rows(server_store, row) for row in pair)
    assert single == parts
    assert [tag["tag"] for tag in single["frame_tags"]] == ["dark", "wet"]
    assert single["frames"][0]["pose_x"] == 2.5
    assert single["jobs"][0] | {"priority": 3, "state": "queued"} == single["jobs"][0]
    assert (single["maps"][0]["used_frames"], single["maps"][0]["used_bytes"]) == (1, 70)


def test_a_frame_of_a_joined_parent_frame_is_indexed_in_the_root(server_store, pair):
    row, T = pair[0], np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about z
    received(server_store, row, at_once=True)
    job = claimed(server_store, row)
    with server_store.database.write(map_number=row.number) as connection:
        assert join_parent(connection, row.number, ParentJoin("odom", "hall", T), "0" * 32)
        # as a frame that came in the very moment of the join
        sent = {"pose_parent": "odom", "pose": POSE, "sent_parent": None, "sent_pose": None}
        connection.execute(update(frames).values(**sent, pose_x=0, pose_y=0, pose_z=0))
    assert not indexed(server_store, row, job, at_once=True)
    assert indexed(server_store, row, job, at_once=False)
    [stored] = rows(server_store, row)["frames"]
    assert (stored["pose_parent"], stored["sent_parent"]) == ("hall", "odom")
    assert [stored[f"pose_{axis}"] for axis in "xyz"] == [-2.5, 1.0, 0.5]
    assert (stored["pose"], stored["sent_pose"]) == ((T @ np.array(POSE)).tolist(), POSE)


@pytest.mark.parametrize("fused", [False, True])
def test_a_frame_is_indexed_as_by_its_parts(server_store, pair, fused):
    held = []
    for row in pair:
        received(server_store, row, at_once=True)
        held.append(job := claimed(server_store, row))
        if fused:
            with server_store.database.write() as connection:
                there = {"frame_number": job.frame_number, "map_number": row.number}
                connection.execute(
                    insert(surface_frames).values(**there, parent="odom", changed=False)
                )
                of = {"frame_number": job.frame_number, "model_id": MODEL}
                old = {"vector": b"old", "checksum": 1, "geometry": "0" * 64}
                counts = {"n_patches": [1], "n_pairs": [1]}
                connection.execute(insert(signatures).values(**of, **old, **counts))
    for row, job, at_once in zip(pair, held, (True, False), strict=True):
        assert indexed(server_store, row, job, at_once=at_once)
    single, parts = (rows(server_store, row) for row in pair)
    assert single == parts
    assert single["frames"][0]["state"] == "indexed"
    assert single["frames"][0]["revision"] == single["maps"][0]["revision"]
    assert [signature["vector"] for signature in single["signatures"]] == [b"signature"]
    assert [frame["changed"] for frame in single["surface_frames"]] == [True] * fused
    assert [e["kind"] for e in single["pending_events"]] == ["frame.received", "frame.indexed"]


def _lost(connection, job):
    connection.execute(update(jobs).where(jobs.c.number == job.number).values(token=job.token + 1))


def _cancelled(connection, job):
    connection.execute(update(jobs).where(jobs.c.number == job.number).values(state="cancelled"))


def _switching(connection, job):
    of = maps.c.number == job.map_number
    connection.execute(update(maps).where(of).values(next_model_id=OTHER))


def _switched(connection, job):
    connection.execute(update(maps).where(maps.c.number == job.map_number).values(model_id=OTHER))


@pytest.mark.parametrize("happened", [_lost, _cancelled, _switching, _switched])
def test_a_job_that_is_lost_or_of_another_model_indexes_nothing(server_store, pair, happened):
    row = pair[0]
    received(server_store, row, at_once=True)
    job = claimed(server_store, row)
    with server_store.database.write() as connection:
        happened(connection, job)
    before = rows(server_store, row)
    assert not indexed(server_store, row, job, at_once=True)
    assert rows(server_store, row) == before


def test_revisions_of_a_map_follow_each_other(server_store, pair):
    row = pair[0]
    with server_store.database.write(map_number=row.number) as connection:
        for i in range(3):
            values = {**VALUES, "content_id": f"{i}" * 64}
            assert receive_frames(connection, [NewFrame(row, values)])
    for _ in range(3):
        assert indexed(server_store, row, claimed(server_store, row), at_once=True)
    assert [frame["revision"] for frame in rows(server_store, row)["frames"]] == [1, 2, 3]
    with server_store.database.read() as connection:
        assert map_of_number(connection, row.number).revision == 3
