"""Snapshots of an embedded store put into a fleet's, and back: the same rows, the same answers."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import psycopg
import pytest
from pydantic import SecretStr
from sqlalchemy import insert

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine import Engine
from sceneprint.errors import DamagedSnapshot, SnapshotError, UnusableStore
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.maintenance.snapshot.database_copy import copy_server
from sceneprint.maintenance.snapshot.postgres_restore import restore_to_fleet
from sceneprint.maintenance.snapshot.restoration import restore_snapshot
from sceneprint.settings import Settings
from sceneprint.store import open_database
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import BucketOwner
from sceneprint.store.events import record_event
from sceneprint.store.tables import keys, metadata
from sceneprint_client.api import Query

pytestmark = pytest.mark.sqlite_only("these have servers of their own")

SIGNED = 4


def fleet_of(folder: Path, url: str, **other: object) -> Settings:
    return Settings(data_dir=folder, database_url=SecretStr(url), index_dir=None, **other)


def answers_of(settings: Settings, asked: list) -> list:
    """What the map `hall` answers, but for what no two answers share."""
    free = {"query_id": "", "milliseconds": {}}
    with Engine(settings) as engine:
        found = [engine.queries.upload(["hall"], x.data, x.meta, Query(exact=True)) for x in asked]
        return [one.model_copy(update=free) for one in found]


def inserted(sql: str) -> list[str]:
    """Rows of a dump; constraints within a table are in the order of whoever made it."""
    return [line for line in sql.splitlines() if line.startswith("INSERT")]


def ask(url: str, asked: str) -> list[tuple]:
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as connection:
        return connection.execute(asked).fetchall()


def rows_in(url: str) -> int:
    """Rows that are not there of themselves."""
    own = ("secrets", "samples", "schema_range", "scrubs")
    names = [one.name for one in metadata.sorted_tables if one.name not in own]
    return sum(ask(url, f"SELECT count(*) FROM {name}")[0][0] for name in names)


def changed(folder: Path, *statements: str | tuple[str, tuple]) -> None:
    """Change a data folder's database past all that would refuse it."""
    with closing(sqlite3.connect(folder / "sceneprint.db")) as database:
        for one in statements:
            database.execute(*((one,) if isinstance(one, str) else one))
        database.commit()


def test_there_and_back(archive, data, uploads, postgres_url, tmp_path, content, settings):
    fleet = fleet_of(tmp_path / "fleet", postgres_url)
    told = restore_to_fleet(archive, fleet)
    assert told.manifest.frames["indexed"] == SIGNED
    asked = uploads[SIGNED - 1 : SIGNED + 2]
    before = answers_of(settings(data), asked)
    assert all(one.matches for one in before)
    back = take_snapshot(fleet, tmp_path / "back.tar")
    assert answers_of(fleet, asked) == before
    assert back.manifest.frames == told.manifest.frames
    restore_snapshot(tmp_path / "back.tar", tmp_path / "home")
    restore_snapshot(archive, tmp_path / "straight")
    wanted, found = content(tmp_path / "straight"), content(tmp_path / "home")
    sql = inserted(found.pop(""))
    assert sql == inserted(wanted.pop(""))
    assert any("sqlite_sequence" in line for line in sql)
    assert any("secrets" in line for line in sql)
    assert found == wanted


def test_no_number_is_given_out_twice(data, postgres_url, tmp_path, rows, settings):
    newest = "(SELECT max(number) FROM events)"
    [(highest,)] = rows(data, f"SELECT {newest}")
    changed(data, f"DELETE FROM events WHERE number = {newest}")
    take_snapshot(settings(data), tmp_path / "a.tar")
    restore_to_fleet(tmp_path / "a.tar", fleet_of(tmp_path / "fleet", postgres_url))
    asked = "SELECT nextval(pg_get_serial_sequence('{}', 'number'))"
    assert ask(postgres_url, asked.format("events")) == [(highest + 1,)]
    assert ask(postgres_url, asked.format("samples")) == [(1,)]  # none was ever given out


def test_what_is_there_stays(archive, postgres, postgres_url, tmp_path):
    with Engine(fleet_of(tmp_path / "used", postgres_url)) as engine:
        engine.create_key("robot")
        before = rows_in(postgres_url)
        with pytest.raises(SnapshotError, match="has rows in its table"):
            restore_to_fleet(archive, fleet_of(tmp_path / "new", postgres_url))
        assert rows_in(postgres_url) == before > 0
    empty = postgres.create("in_use")
    with (
        Engine(fleet_of(tmp_path / "service", empty)),
        pytest.raises(SnapshotError, match="is in use: "),
    ):
        restore_to_fleet(archive, fleet_of(tmp_path / "new", empty))
    (tmp_path / "embedded").mkdir()
    (tmp_path / "embedded" / "sceneprint.db").touch()
    with pytest.raises(SnapshotError, match="the database of another store"):
        restore_to_fleet(archive, fleet_of(tmp_path / "embedded", empty))
    assert not (tmp_path / "new").exists()
    assert rows_in(empty) == 0


def test_a_damaged_archive_leaves_nothing(archive, postgres, tmp_path):
    """Also where the damage is in its last blob."""
    bad, url = tmp_path / "bad.tar", postgres.create("untouched")
    data = bytearray(archive.read_bytes())
    data[-4000] ^= 1
    bad.write_bytes(data)
    with pytest.raises(DamagedSnapshot):
        restore_to_fleet(bad, fleet_of(tmp_path / "fleet", url))
    assert ask(url, "SELECT count(*) FROM pg_tables WHERE schemaname = 'public'") == [(0,)]
    assert not (tmp_path / "fleet" / "blobs").exists()


def test_what_postgresql_cannot_hold_is_not_restored(data, postgres, tmp_path, settings):
    url = postgres.create("choosy")
    changed(data, "UPDATE frames SET robot = printf('%.*c', 129, 'r')")
    take_snapshot(settings(data), tmp_path / "a.tar")
    with pytest.raises(SnapshotError, match=r"a row of table frames .*character varying"):
        restore_to_fleet(tmp_path / "a.tar", fleet_of(tmp_path / "fleet", url))
    assert ask(url, "SELECT count(*) FROM frames") == [(0,)]


RESTORE = "import sys; from sceneprint.cli import main; sys.exit(main(sys.argv[1:]))"


def test_killed_half_way_it_can_be_restored_again(archive, postgres_url, tmp_path):
    fleet = fleet_of(tmp_path / "fleet", postgres_url)
    said = {"SCENEPRINT_DATABASE_URL": postgres_url}
    with psycopg.connect(postgres_url.replace("+psycopg", "")) as holder:
        holder.execute("LOCK TABLE signatures IN SHARE MODE")  # what is written waits for it
        process = subprocess.Popen(
            [sys.executable, "-c", RESTORE, "restore", str(archive), "--data", fleet.data_dir],
            env=os.environ | said,
        )
        waits = "SELECT count(*) FROM pg_locks WHERE NOT granted AND locktype = 'relation'"
        until = time.monotonic() + PATIENCE_S
        while holder.execute(waits).fetchone() == (0,) and time.monotonic() < until:
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert rows_in(postgres_url) == 0
    while ask(
        postgres_url,
        "SELECT 1 FROM pg_stat_activity WHERE application_name = 'sceneprint'"
        " AND datname = current_database()",
    ):  # the server has not seen yet that it is gone
        time.sleep(0.05)
    told = restore_to_fleet(archive, fleet)
    assert rows_in(postgres_url) > 0
    assert [one for one in fsck(fleet) if one.left] == []
    assert told.manifest.blobs.count == len([*(fleet.data_dir / "blobs").glob("*/*")])
    assert not [*fleet.data_dir.glob(".restoring-*")]


def test_the_copy_is_one_state(postgres_url, tmp_path):
    """What is committed while it is made is not in it, whatever table is next."""
    database, late = open_database(postgres_url), open_database(postgres_url)

    def key(name: str) -> dict[str, object]:
        return {"id": name, "name": name, "digest": name, "grants": {}, "created_at": 0.0}

    with closing(database), closing(late):
        with late.write() as connection:
            connection.execute(insert(keys), [key("early")])
        told: list[int] = []

        def written(done: int) -> None:
            if not told:
                with late.write() as connection:
                    connection.execute(insert(keys), [key("late")])
            told.append(done)

        copy_server(database, tmp_path / "copy.db", written)
    assert len(told) == len(metadata.sorted_tables)
    with closing(sqlite3.connect(tmp_path / "copy.db")) as copy:
        assert copy.execute("SELECT id, grants FROM keys").fetchall() == [("early", "{}")]
    assert ask(postgres_url, "SELECT id FROM keys ORDER BY id") == [("early",), ("late",)]


def test_events_that_were_pending_have_numbers_in_the_copy(postgres_url, tmp_path):
    with closing(open_database(postgres_url)) as database:
        with database.write() as connection:
            record_event(connection, "map.created", "hall")
        for frame in ("a", "b"):
            with database.write(map_number=1) as connection:
                record_event(connection, "frame.received", "hall", frame)
        copy_server(database, tmp_path / "copy.db", lambda _: None)
    assert ask(postgres_url, "SELECT count(*) FROM pending_events") == [(2,)]  # nobody numbered
    with closing(sqlite3.connect(tmp_path / "copy.db")) as copy:
        found = copy.execute("SELECT number, kind, frame_id FROM events ORDER BY number").fetchall()
        assert copy.execute("SELECT count(*) FROM pending_events").fetchall() == [(0,)]
    assert found == [
        (1, "map.created", None), (2, "frame.received", "a"), (3, "frame.received", "b"),
    ]  # fmt: skip


def test_commands(archive, postgres, tmp_path, sceneprint, monkeypatch):
    url, data = postgres.create("commands"), tmp_path / "data"
    secret = url.replace("postgres@", "postgres:hidden@")
    for one in (secret, f"{url}?password=hidden", "hidden"):
        said = sceneprint("restore", archive, "--data", data, "--database", one, expect=2)
        assert said.stderr.startswith("sceneprint restore: --database: ")
        assert "hidden" not in said.stderr
    again = ("restore", archive, "--data", data, "--database", url)
    shown = url.replace("+psycopg", "")
    assert f"is restored to {shown}: 1 maps" in sceneprint(*again).stdout
    assert "nothing is overwritten" in sceneprint(*again, expect=2).stderr
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", secret)
    out = tmp_path / "a.tar"
    assert "1 maps, 5 frames" in sceneprint("snapshot", "--data", data, "--out", out).stdout
    assert "is complete" in sceneprint("restore", "--verify-only", out).stdout


def test_blobs_in_an_object_store(archive, postgres_url, bucket, tmp_path):
    fleet = fleet_of(tmp_path / "node", postgres_url, blob_url=SecretStr(f"{bucket}/one"))
    with Engine(fleet):  # it marks the prefix with a name that the database then loses
        pass
    restored = restore_to_fleet(archive, fleet)
    assert not (tmp_path / "node" / "blobs").exists()
    with Engine(fleet) as engine:
        blobs = {*engine.store.blobs.digests()}
        engine.store.blobs.remove(first := min(blobs))
    assert len(blobs) == restored.manifest.blobs.count
    taken = take_snapshot(fleet, tmp_path / "a.tar")
    assert [(one.digest, one.why) for one in taken.damaged] == [(first, "missing")]
    restore_snapshot(tmp_path / "a.tar", tmp_path / "home")
    assert len([*(tmp_path / "home" / "blobs").glob("*/*")]) == len(blobs) - 1


def test_a_prefix_is_not_shared_with_the_store_that_was_copied(archive, postgres, bucket, tmp_path):
    """They have the same name, and each would remove what only the other refers to."""
    marks = open_objects(bucket)
    first, second = (
        fleet_of(tmp_path / name, postgres.create(name), blob_url=SecretStr(bucket))
        for name in ("first", "second")
    )
    restore_to_fleet(archive, first)
    mark = json.loads(marks.get("sceneprint.json"))
    assert mark.keys() == {"kind", "store"}
    with pytest.raises(UnusableStore, match="of the store that the snapshot was taken of"):
        restore_to_fleet(archive, second)
    assert rows_in(second.database) == 0
    marks.put("sceneprint.json", json.dumps(mark | {"restoring": True}).encode())
    restore_to_fleet(archive, second)  # as after one that was killed half way
    assert rows_in(second.database) == rows_in(first.database)
    assert json.loads(marks.get("sceneprint.json")) == mark
    with pytest.raises(UnusableStore, match="of another database"):
        BucketOwner(marks).begin("0" * 32, "1" * 32)


def test_an_archive_that_is_another_when_it_is_read_again(
    archive, postgres_url, tmp_path, settings
):
    """No row refers to a blob that the second reading has not brought."""
    with Engine(settings(tmp_path / "other")) as engine:
        engine.create_key("robot")
    take_snapshot(settings(tmp_path / "other"), tmp_path / "other.tar")
    path = Path(shutil.copy(archive, tmp_path / "a.tar"))

    def progress(done: int, total: int) -> None:
        if (tmp_path / "other.tar").exists():  # while it is verified
            (tmp_path / "other.tar").replace(path)

    with pytest.raises(DamagedSnapshot, match="was changed while it was restored"):
        restore_to_fleet(path, fleet_of(tmp_path / "fleet", postgres_url), progress)
    assert rows_in(postgres_url) == 0
