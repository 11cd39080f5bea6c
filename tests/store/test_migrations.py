"""Databases of earlier versions, brought to the present schema with what is in them."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from benchmarks.fleet.postgres import Server
from sceneprint.store import open_database
from sceneprint.store.database import reach_database, schema_range_of
from sceneprint.store.deletion import doomed_blobs
from sceneprint.store.events import last_event
from sceneprint.store.frame_queries import frame_ups
from sceneprint.store.frames import write_frame, write_map
from sceneprint.store.keys import list_keys
from sceneprint.store.maps import MapUsage, add_frame, counted_usage, find_map, frame_of, use_of
from sceneprint.store.query_records import WantedRecords, list_records
from sceneprint.store.queue import enqueue, find_job
from sceneprint.store.tables import frame_tags
from sceneprint_client.api import FrameState

#: What version 0001 stored of three frames: with tags and pose, with neither, with a tag twice.
POSE = [[1.0, 0.0, 0.0, 1.5], [0.0, 1.0, 0.0, -2.5], [0.0, 0.0, 1.0, 3.25], [0.0, 0.0, 0.0, 1.0]]
FRAMES = [(["door", "lit"], POSE), ([], None), (["door", "door"], None)]


@pytest.fixture
def old(tmp_path: Path, bring_to: Callable[[str, str], None]) -> Path:
    """A database as migration 0001 left it."""
    path = tmp_path / "truth.db"
    bring_to(f"sqlite:///{path}", "0001")
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("INSERT INTO models VALUES ('m', 'compact', x'00', 1.0)")
        connection.execute(
            "INSERT INTO maps (number, name, model_id, revision, created_at) "
            "VALUES (1, 'hall', 'm', 0, 1.0)"
        )
        for number, (tags, pose) in enumerate(FRAMES, 1):
            connection.execute(
                "INSERT INTO frames (number, id, map_number, state, blob, bytes, intrinsics, "
                "depth_scale, depth_along_ray, tags, pose, received_at) "
                "VALUES (?, ?, 1, 'received', 'b', 1, '{}', 1000, 0, ?, ?, 1.0)",
                (number, f"f{number}", json.dumps(tags), pose and json.dumps(pose)),
            )
            connection.execute(
                "INSERT INTO jobs (number, id, kind, frame_number, state, priority, attempts, "
                "failures, token, run_after, created_at) "
                "VALUES (?, ?, 'sign', ?, 'queued', 0, 0, 0, 0, 1.0, 1.0)",
                (10 + number, f"j{number}", number),
            )
        connection.execute("INSERT INTO keys VALUES ('k', 'fleet', 'd', '[\"admin\"]', 1.0)")
        # numbers that were given out to what has been removed since
        connection.execute("UPDATE sqlite_sequence SET seq = 70 WHERE name = 'frames'")
        connection.execute("UPDATE sqlite_sequence SET seq = 80 WHERE name = 'jobs'")
    return path


def test_what_is_searched_for_is_filled_in_from_what_was_stored(old: Path) -> None:
    database = open_database(f"sqlite:///{old}")
    with database.read() as connection:
        tags = connection.execute(frame_tags.select().order_by(*frame_tags.c)).all()
        rows = [frame_of(connection, number) for number in (1, 2, 3)]
    database.close()
    assert tags == [(1, "door"), (1, "lit"), (3, "door")]
    assert [(row.pose_x, row.pose_y, row.pose_z) for row in rows] \
        == [(1.5, -2.5, 3.25), (None, None, None), (None, None, None)]  # fmt: skip
    assert rows[0].pose == POSE
    assert {row.state for row in rows} == {FrameState.RECEIVED}
    assert {row.novelty for row in rows} == {None}


def test_jobs_keys_and_numbers_go_on_where_they_were(old: Path) -> None:
    database = open_database(f"sqlite:///{old}")
    with database.write() as connection:
        found = [find_job(connection, f"j{number}") for number in (1, 2, 3)]
        assert [(job.number, job.frame, job.map_number) for job in found] \
            == [(11, 1, 1), (12, 2, 1), (13, 3, 1)]  # fmt: skip
        assert [(key.name, key.grants, key.expires_at) for key in list_keys(connection)] \
            == [("fleet", {"*": "admin"}, None)]  # fmt: skip
        assert enqueue(connection, "sign", 2).number == 81
        connection.execute(text("UPDATE frames SET state = 'deleted' WHERE number = 3"))
        values = {
            "blob": "b", "bytes": 1, "intrinsics": {}, "depth_scale": 1.0, "tags": [],
            "depth_along_ray": False, "pose": None,
        }  # fmt: skip
        assert add_frame(connection, 1, values).number == 71
        checked = connection.execute(text("PRAGMA foreign_keys")).scalar()
    assert checked == 1
    database.close()


def test_frames_of_before_there_were_clouds_are_depth_images(
    old: Path, bring_to: Callable[[str, str], None]
) -> None:
    bring_to(f"sqlite:///{old}", "0003")
    database = open_database(f"sqlite:///{old}")
    with database.write() as connection:
        rows = [frame_of(connection, number) for number in (1, 2, 3)]
        assert [(row.tags, row.pose) for row in rows] == FRAMES
        assert {(row.kind, row.cloud) for row in rows} == {("depth", None)}
        seen = {"viewpoint": None, "units_per_metre": 1000.0, "points": 12, "note": None}
        values = {
            "blob": "b", "bytes": 1, "intrinsics": None, "depth_scale": 1.0, "tags": [],
            "depth_along_ray": False, "pose": None, "cloud": seen,
        }  # fmt: skip
        added = add_frame(connection, 1, values)
        assert (added.kind, added.cloud, added.intrinsics) == ("cloud", seen, None)
    database.close()


def test_what_a_map_held_before_there_were_quotas_is_counted(
    old: Path, bring_to: Callable[[str, str], None]
) -> None:
    bring_to(f"sqlite:///{old}", "0006")
    states = ("indexed", "deleted", "redundant")
    with closing(sqlite3.connect(old)) as connection, connection:
        for number, state in enumerate(states, 1):
            connection.execute(
                "UPDATE frames SET state = ?, bytes = ?, blob = ? WHERE number = ?",
                (state, 10**number, f"blob-{number}", number),
            )
        connection.execute("INSERT INTO events (at, kind, map, data) VALUES (1, 'x', 'gone', '{}')")
        connection.execute("INSERT INTO events (at, kind, map, data) VALUES (1, 'y', 'hall', '{}')")
        connection.execute("INSERT INTO events (at, kind, map, data) VALUES (1, 'z', 'gone', '{}')")
    database = open_database(f"sqlite:///{old}")
    with database.read() as connection:
        assert use_of(connection, 1) == counted_usage(connection, 1) == MapUsage(1, 10)
        assert doomed_blobs(connection, 10) == ["blob-2"]
        assert (last_event(connection, "gone"), last_event(connection, "never")) == (3, 0)
    database.close()


def test_what_is_there_before_there_was_gravity_knows_no_up(
    old: Path, bring_to: Callable[[str, str], None]
) -> None:
    bring_to(f"sqlite:///{old}", "0008")
    database = open_database(f"sqlite:///{old}")
    with database.write() as connection:
        rows = [frame_of(connection, number) for number in (1, 2, 3)]
        assert [(row.pose, row.up) for row in rows] == [(pose, None) for _, pose in FRAMES]
        assert find_map(connection, "hall").up is None
        assert [(one.number, one.up, one.map_up) for one in frame_ups(connection, (1, 2, 3))] \
            == [(1, None, None)]  # fmt: skip
        up = [0.0, 0.6, 0.8]
        assert write_frame(connection, find_map(connection, "hall"), rows[1], {"up": up}).up == up
        assert write_map(connection, find_map(connection, "hall"), {"up": up}).up == up
        assert [(one.number, one.up, one.map_up) for one in frame_ups(connection, (1, 2, 3))] \
            == [(1, None, up), (2, up, up)]  # fmt: skip
    database.close()


def test_codes_of_before_there_were_vectors_go(
    postgres: Server, bring_to: Callable[[str, str], None]
) -> None:
    url = postgres.create("coded")
    bring_to(url, "0007")
    for statement in (
        "CREATE TABLE code_fits (number bigint PRIMARY KEY)",
        "CREATE TABLE code_maps (fit_number bigint REFERENCES code_fits (number))",
        "CREATE TABLE codes_12 (frame_number bigint PRIMARY KEY)",
        "CREATE TABLE codes_of_ours (n bigint)",  # nobody's but whose it is
    ):
        postgres.execute(statement, "coded")
    open_database(url).close()
    left = postgres.execute("SELECT relname FROM pg_class WHERE relname ~ '^code.*'", "coded")
    assert left == [("codes_of_ours",)]
    postgres.drop("coded")


def test_frames_of_before_there_were_names_have_none(
    old: Path, bring_to: Callable[[str, str], None]
) -> None:
    bring_to(f"sqlite:///{old}", "0009")
    database = open_database(f"sqlite:///{old}")
    with database.write() as connection:
        row, map_row = frame_of(connection, 1), find_map(connection, "hall")
        assert (row.name, row.sequence, row.tags, row.pose) == (None, None, *FRAMES[0])
        named = write_frame(connection, map_row, row, {"name": "a/1.png", "sequence": 2**53 - 1})
        assert (named.name, named.sequence) == ("a/1.png", 2**53 - 1)
    with closing(sqlite3.connect(old)) as connection:
        indexes = dict(
            connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'index'")
        )
    assert "captured_at, sequence, pose_parent" in indexes["ix_frames_searched"]
    assert "map_number, name, state" in indexes["ix_frames_named"]
    database.close()


#: As a process of the schema before writes a record.
RECORD = (
    "INSERT INTO query_records (id, at, map_number, status, reason, alternatives, milliseconds, "
    "kept) VALUES (:id, 1.0, 1, 'found', '', 0, 1.0, {})"
)


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_processes_of_before_there_were_offline_queries_go_on(
    kind: str, tmp_path: Path, postgres: Server, bring_to: Callable[[str, str], None]
) -> None:
    url = f"sqlite:///{tmp_path}/truth.db" if kind == "sqlite" else postgres.create("offline")
    bring_to(url, "0018")
    record = text(RECORD.format("0" if kind == "sqlite" else "false"))
    with closing(reach_database(url)) as former, former.write() as connection:
        connection.execute(text("INSERT INTO models VALUES ('m', 'depth', '', 1.0)"))
        connection.execute(
            text(
                "INSERT INTO maps (number, name, model_id, revision, created_at) "
                "VALUES (1, 'hall', 'm', 0, 0.5)"
            )
        )
        connection.execute(record, {"id": "a"})
    with closing(open_database(url)) as database:
        with database.write() as connection:
            connection.execute(record, {"id": "a"})  # and nothing keeps it from that
            connection.execute(record, {"id": "b"})
            allowed = schema_range_of(connection)
            assert allowed is not None
            assert allowed.allows("0018")
            found = list_records(connection, WantedRecords(), None, 9)
        assert [(one.id, one.offline) for one in found] == [
            ("b", False), ("a", False), ("a", False)
        ]  # fmt: skip
        late = text("UPDATE query_records SET offline = (1 = 1) WHERE id = :id")
        with database.write() as connection:
            connection.execute(late, {"id": "b"})
        with pytest.raises(IntegrityError), database.write() as connection:
            connection.execute(late, {"id": "a"})  # a robot's record is there once
    if kind == "postgresql":
        postgres.drop("offline")
