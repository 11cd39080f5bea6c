"""Tests of the content of a bundle, and of the cost of the next one."""

import hashlib
import json
import os
import re
import sqlite3
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from pydantic import SecretStr
from sqlalchemy import insert

from sceneprint.bundle import backup
from sceneprint.bundle import place as place_module
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.place import BundlePlace
from sceneprint.bundle.restoration import restore_to_folder, verify_bundle
from sceneprint.bundle.rows import cut_rows
from sceneprint.errors import BundleError
from sceneprint.settings import Settings
from sceneprint.store import open_database
from sceneprint.store.events import record_event
from sceneprint.store.tables import keys
from tests.whole_engine import Engine

file_only = pytest.mark.sqlite_only("looks at the database as a file of the data folder")


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def parts_in(folder):
    return {path.name: path.read_bytes() for path in folder.glob("parts/??/*")}


def lines_of(data):
    return [json.loads(line) for line in zlib.decompress(data).split(b"\n")]


@file_only
def test_what_is_in_a_bundle(master, place, rows):
    assert names_in(Path(place)) == [".lock", "bundles", "parts", "place.json"]
    (name,) = names_in(Path(place) / "bundles")
    manifest = json.loads((Path(place) / "bundles" / name).read_bytes())
    held = parts_in(Path(place))
    assert all(hashlib.sha256(data).hexdigest() == digest for digest, data in held.items())
    parts = manifest.pop("parts")
    assert {part["digest"]: part["bytes"] for part in parts}.items() <= {
        digest: len(data) for digest, data in held.items()
    }.items()
    of = {part["kind"]: part for part in parts}
    head, *frames = lines_of(held[of["rows/frames"]["digest"]])
    assert of["rows/frames"]["rows"] == len(frames) == 6
    columns = ", ".join(f'"{one}"' for one in head)
    assert [tuple(frame) for frame in frames] == [
        tuple(bool(x) if n == "depth_along_ray" else x for n, x in zip(head, row, strict=True))
        for row in rows(master, f"SELECT {columns} FROM frames ORDER BY number")
    ]
    head, *listed = lines_of(held[of["blobs"]["digest"]])
    uploads = rows(master, "SELECT blob FROM frames WHERE state != 'deleted'")
    artifacts = rows(master, "SELECT geometry FROM signatures")
    assert (len(uploads), len(artifacts)) == (5, 4)
    wanted = sorted(digest for (digest,) in uploads + artifacts)
    assert listed == [[item, len(held[item]), None] for item in wanted]
    begun = datetime.fromisoformat(manifest.pop("created_at"))
    assert f"{begun:%Y%m%dT%H%M%S-%f}Z.json" == name
    assert 0 <= (datetime.now(UTC) - begun).total_seconds() < 3600
    assert re.fullmatch("[0-9a-f]{64}", manifest.pop("sha256"))
    ((revision,),) = rows(master, "SELECT version_num FROM alembic_version")
    assert manifest.pop("sceneprint")
    numbers = manifest.pop("numbers")
    assert (numbers["frames"], numbers["jobs"], numbers["samples"]) == (6, 6, 0)
    assert manifest == {
        "format": "sceneprint-bundle", "version": 1, "schema_revision": revision, "maps": 1,
        "frames": {"deleted": 1, "indexed": 4, "received": 1}, "signatures": 4, "blobs": 9,
        "lost": 0, "blob_bytes": sum(len(held[item]) for item in wanted),
    }  # fmt: skip


def test_parts_end_where_their_rows_say():
    rows = [(i, "x" * 50) for i in range(20_000)]
    before = list(cut_rows(rows, [0]))
    assert [row for part, _ in before for row in part] == rows
    ends = [i for i in range(20_000) if zlib.crc32(str(i).encode()) % 1024 == 0]
    assert [part[-1][0] for part, _ in before] == [*ends, 19_999]
    assert len(ends) > 10
    rows.insert(10_000, (-1, "y"))
    after = list(cut_rows(rows, [0]))
    changed = {source for _, source in after} - {source for _, source in before}
    assert len(changed) == 1
    large = list(cut_rows([("key", "x" * (100 << 10))] * 200, [0]))
    assert [len(part) for part, _ in large] == [96, 96, 8]  # of 8 MiB and what is over


@pytest.mark.parametrize(
    ("row", "other"),
    [
        ((1, "ab", "c"), (1, "a", "bc")),
        ((1, "2"), (1, 2)),
        ((1, 2), (1, 2.0)),
        ((1, "a"), (1, b"a")),
        ((1, None), (1, "None")),
        ((1, 0.1 + 0.2), (1, 0.3)),
    ],
)  # fmt: skip
def test_other_rows_have_another_digest(row, other):
    ((_, source),) = cut_rows([row, (5,)], [0])
    ((_, same),) = cut_rows([(*row,), (5,)], [0])
    ((_, changed),) = cut_rows([other, (5,)], [0])
    assert source == same != changed


@file_only
def test_a_part_that_is_gone_or_cut_is_written_again(data, tmp_path, settings):
    folder = tmp_path / "place"
    first = take_backup(settings(data), str(folder))
    held = parts_in(folder)
    for part, left in zip(first.manifest.parts[:2], (None, b"x"), strict=True):
        path = folder / "parts" / part.digest[:2] / part.digest
        path.unlink() if left is None else path.write_bytes(left)
    again = take_backup(settings(data), str(folder))
    assert again.written == sum(part.bytes for part in first.manifest.parts[:2])
    assert parts_in(folder) == held
    assert verify_bundle(str(folder), first.manifest.name).lost == ()


@file_only
def test_parts_of_another_version_or_of_a_damaged_bundle_are_read_again(
    data, tmp_path, settings, monkeypatch
):
    folder = tmp_path / "place"
    for change in ("version", "damage"):
        backup = take_backup(settings(data), str(folder))
        path = folder / "bundles" / f"{backup.manifest.name}.json"
        of_first = {
            "digest": backup.manifest.parts[0].digest,
            "bytes": backup.manifest.parts[0].bytes,
        }
        parts = tuple(part.model_copy(update=of_first) for part in backup.manifest.parts)
        wrong = backup.manifest.model_copy(update={"parts": parts})
        if change == "version":
            wrong = wrong.model_copy(update={"sceneprint": "0.0.1"})
        BundlePlace.open(str(folder)).publish(wrong)
        if change == "damage":
            path.write_bytes(path.read_bytes().replace(b'"maps": 1', b'"maps": 2'))
        take_backup(settings(data), str(folder))
        assert verify_bundle(str(folder)).manifest.blobs == 9


@file_only
def test_another_bundle_costs_what_is_new(data, tmp_path, settings, uploads):
    folder = tmp_path / "place"
    first = take_backup(settings(data), str(folder))
    held = parts_in(folder)
    assert first.written == sum(map(len, held.values()))
    again = take_backup(settings(data), str(folder))
    assert again.written == 0
    assert parts_in(folder) == held
    with Engine(settings(data)) as engine:
        engine.add_frame("hall", uploads[9].data, uploads[9].meta)
    third = take_backup(settings(data), str(folder))
    new = set(parts_in(folder)) - set(held)
    tables = {part.kind for part in third.manifest.parts if part.digest in new}
    changed = ("events", "frame_tags", "frames", "jobs", "maps")
    assert tables == {"blobs", *(f"rows/{table}" for table in changed)}
    assert len(new) == len(tables) + 1  # and the upload
    assert first.manifest.name < again.manifest.name < third.manifest.name
    assert BundlePlace.open(str(folder)).names()[-1] == first.manifest.name
    restore_to_folder(str(folder), tmp_path / "first", first.manifest.name)
    restore_to_folder(str(folder), tmp_path / "third")
    for name, count in (("first", 5), ("third", 6)):
        with Engine(settings(tmp_path / name)) as engine:
            assert len(engine.list_frames("hall").items) == count


@file_only
def test_old_bundles_go_with_their_parts(data, tmp_path, settings):
    folder = tmp_path / "place"
    gone = take_backup(settings(data), str(folder))
    with Engine(settings(data)) as engine:
        engine.delete_map("hall")
    second = take_backup(settings(data), str(folder), keep=1)
    assert names_in(folder / "bundles") == [f"{second.manifest.name}.json"]
    assert len(parts_in(folder)) > 9
    for path in folder.glob("parts/??/*"):
        os.utime(path, (0, time.time() - place_module.GRACE_S - 1))
    (folder / "parts" / "ab").mkdir(exist_ok=True)
    (folder / "parts" / "ab" / "half#1").touch()
    os.utime(folder / "parts" / "ab" / "half#1", (0, 0))
    third = take_backup(settings(data), str(folder), keep=2)
    assert len(names_in(folder / "bundles")) == 2
    needed = {part.digest for part in (*second.manifest.parts, *third.manifest.parts)}
    assert set(parts_in(folder)) == needed
    with pytest.raises(BundleError, match="holds no bundle"):
        verify_bundle(str(folder), gone.manifest.name)
    assert verify_bundle(str(folder)).manifest.maps == 0


@file_only
def test_the_commands(master, tmp_path, sceneprint, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = sceneprint("snapshot", "--data", master, "--to", "place")
    held = r"1 maps, 5 frames, 9 blobs, \d\.\d MB"
    actual = re.fullmatch(
        rf"place: bundle (\S+), {held}, (\S+) MB of it new, in \S+ s\n", output.stdout
    )
    assert float(actual[2]) > 0
    assert output.stderr == ""
    assert ", 0.0 MB of it new," in sceneprint("snapshot", "--data", master, "--to", "place").stdout
    output = sceneprint("restore", "place", "--list").stdout.splitlines()
    assert [line.partition(" ")[0] for line in output] == BundlePlace.open("place").names()
    output = sceneprint("restore", "--verify-only", "place", "--bundle", actual[1])
    assert re.fullmatch(rf"place: bundle {actual[1]} is complete: {held} in \S+ s\n", output.stdout)
    output = sceneprint("restore", "place", "--data", "new")
    assert re.search(rf" is restored to new: {held} in ", output.stdout)
    assert names_in(tmp_path) == ["new", "place"]
    sceneprint("snapshot", "--data", master, "--to", "place", "--keep", "1")
    assert len(names_in(Path("place/bundles"))) == 1


@file_only
def test_it_is_in_nobodys_way(data, tmp_path, settings):
    with closing(sqlite3.connect(data / "sceneprint.db", isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE maps SET title = 'half done'")
        backup = take_backup(settings(data), str(tmp_path / "place"))
        writer.execute("COMMIT")
    assert backup.lost == ()
    restore_to_folder(str(tmp_path / "place"), tmp_path / "new")
    with closing(sqlite3.connect(tmp_path / "new" / "sceneprint.db")) as new:
        assert new.execute("SELECT title FROM maps").fetchall() == [(None,)]


@file_only
@pytest.mark.parametrize("large", [backup.LARGE, 20])
def test_damaged_blobs_are_left_out_and_named(
    large, data, tmp_path, sceneprint, rows, settings, monkeypatch
):
    monkeypatch.setattr(backup, "LARGE", large)
    (first, second) = rows(data, "SELECT id, blob FROM frames WHERE state = 'indexed' LIMIT 2")
    ((artifact,),) = rows(
        data, "SELECT geometry FROM signatures JOIN frames ON number = frame_number"
        f" WHERE id = '{second[0]}'"
    )  # fmt: skip
    path = data / "blobs" / first[1][:2] / first[1]
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    (data / "blobs" / artifact[:2] / artifact).unlink()
    folder = tmp_path / "place"
    output = sceneprint("snapshot", "--data", data, "--to", folder, expect=1)
    why = sorted([(first[1], "damaged"), (artifact, "missing")])
    lines = [f"missing: blob {digest[:12]}, {why}" for digest, why in why]
    assert output.stderr.splitlines()[:-1] == lines
    assert not {digest for digest, _ in why} & set(parts_in(folder))
    assert (
        sceneprint("restore", "--verify-only", folder, expect=1).stderr.splitlines()[:-1] == lines
    )
    output = sceneprint("restore", folder, "--data", tmp_path / "new", expect=1)
    assert output.stderr.splitlines()[:-1] == lines
    with Engine(settings(tmp_path / "new")) as engine:
        assert len(engine.list_frames("hall").items) == 5
        assert len(list(engine.store.blobs.digests())) == 7


@file_only
def test_what_cannot_be_taken(data, tmp_path, sceneprint, monkeypatch):
    folder = tmp_path / "place"

    def refused(text, data=data, to=folder):
        assert text in sceneprint("snapshot", "--data", data, "--to", to, expect=2).stderr
        assert not (folder / "bundles").exists() or names_in(folder / "bundles") == []

    refused("the database does not exist", tmp_path / "typo")
    refused("is not the URL of an object store", to="s3://")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").touch()
    refused("holds a.txt", to=tmp_path / "notes")
    assert names_in(tmp_path / "notes") == ["a.txt"]
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", "postgresql://u:secret@127.0.0.1:1/maps")
    output = sceneprint("snapshot", "--data", data, "--to", folder, expect=2)
    assert "postgresql://u@127.0.0.1:1/maps: connection failed" in output.stderr
    assert "secret" not in output.stderr
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", f"sqlite:///{tmp_path}/other.db")
    output = sceneprint("restore", folder, "--data", tmp_path / "new", expect=2)
    assert "SCENEPRINT_DATABASE_URL is set" in output.stderr
    monkeypatch.delenv("SCENEPRINT_DATABASE_URL")
    with closing(sqlite3.connect(data / "sceneprint.db")) as database:
        database.execute("PRAGMA foreign_keys = OFF")
        database.execute("DELETE FROM maps")
        database.commit()
    refused("refers to a missing row of maps")


def test_a_place_is_one_stores_and_one_writers(master, data, tmp_path, settings):
    folder, inner = str(tmp_path / "place"), list[Exception]()

    def come(_done, _total):
        try:
            take_backup(settings(data), folder)
        except BundleError as error:
            inner.append(error)

    take_backup(settings(master), folder, come)
    assert "another process is writing" in str(inner[0])
    with Engine(settings(tmp_path / "other")):
        pass
    with pytest.raises(BundleError, match="the bundles of another store"):
        take_backup(settings(tmp_path / "other"), folder)


@pytest.mark.sqlite_only("has a server of its own")
def test_it_is_one_state(postgres_url, tmp_path):
    database, late = open_database(postgres_url), open_database(postgres_url)

    def key(name):
        return {"id": name, "name": name, "digest": name, "grants": {}, "created_at": 0.0}

    fleet = Settings(
        data_dir=tmp_path / "fleet", database_url=SecretStr(postgres_url), index_dir=None
    )
    with closing(database), closing(late), Engine(fleet):
        (tmp_path / "fleet" / "blobs").mkdir(parents=True)  # as the first upload does
        with late.write() as connection:
            connection.execute(insert(keys), [key("early")])
            record_event(connection, "map.created", "hall")
        for frame in ("a", "b"):
            with late.write(map_number=1) as connection:
                record_event(connection, "frame.received", "hall", frame)
        done = []

        def go_on(count, _total):
            if not done:
                with late.write() as connection:
                    connection.execute(insert(keys), [key("late")])
            done.append(count)

        take_backup(fleet, str(tmp_path / "place"), go_on)
    restore_to_folder(str(tmp_path / "place"), tmp_path / "copy")
    with closing(sqlite3.connect(tmp_path / "copy" / "sceneprint.db")) as copy:
        assert copy.execute("SELECT id, grants FROM keys").fetchall() == [("early", "{}")]
        actual = copy.execute("SELECT kind, frame_id FROM events ORDER BY number").fetchall()
        assert copy.execute("SELECT count(*) FROM pending_events").fetchall() == [(0,)]
    assert actual[-3:] == [
        ("map.created", None), ("frame.received", "a"), ("frame.received", "b"),
    ]  # fmt: skip


@file_only
def test_what_is_deleted_meanwhile_is_in_it(data, tmp_path, settings, rows):
    with Engine(settings(data)) as engine:
        before = set(engine.store.blobs.digests())
        frames = [frame.frame_id for frame in engine.list_frames("hall").items]

        def delete(_done, _total):
            while frames:
                engine.delete_frame("hall", frames.pop())

        backup = take_backup(settings(data), str(tmp_path / "place"), delete)
        assert frames == []
        assert backup.lost == ()
        assert backup.manifest.blobs == 9
        assert set(engine.store.blobs.digests()) == before
        assert verify_bundle(str(tmp_path / "place")).lost == ()
        assert rows(data, "SELECT DISTINCT state FROM frames") == [("deleted",)]


def test_a_sweep_under_way_is_waited_for(data, tmp_path, settings):
    with ThreadPoolExecutor(1) as pool, Engine(settings(data)) as engine:
        (frame, *_) = [frame.frame_id for frame in engine.list_frames("hall").items]
        with engine.store.blobs.locks.removing() as allowed:
            assert allowed
            with engine.store.blobs.locks.removing() as second:
                assert not second
            taking = pool.submit(take_backup, settings(data), str(tmp_path / "place"))
            while not (tmp_path / "place").exists():
                time.sleep(0.01)
            time.sleep(0.3)
            assert list((tmp_path / "place").glob("parts/??")) == []
            assert not taking.done()
            engine.delete_frame("hall", frame)
        backup = taking.result()
    assert backup.lost == ()
    assert backup.manifest.frames == {"deleted": 2, "indexed": 3, "received": 1}
    assert backup.manifest.blobs == 7
