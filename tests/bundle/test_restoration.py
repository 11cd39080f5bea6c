"""Tests that restored folders and servers have the same rows and answers."""

import hashlib
import json
import os
import pty
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import psycopg
import pytest
from pydantic import SecretStr

from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder, restore_to_server, verify_bundle
from sceneprint.engine.admin.operations import list_keys
from sceneprint.errors import BundleError, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.blobs.object_store import BucketOwner
from sceneprint.store.tables import metadata
from tests.bundle.test_backup import names_in
from tests.whole_engine import Engine

SIGNED = 4
file_only = pytest.mark.sqlite_only("looks at the database as a file of the data folder")
own_servers = pytest.mark.sqlite_only("these have servers of their own")


def fleet_of(folder, url, **other):
    return Settings(data_dir=folder, database_url=SecretStr(url), index_dir=None, **other)


def ask(url, statement):
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as connection:
        return connection.execute(statement).fetchall()


def rows_in(url):
    own = ("secrets", "samples", "schema_range", "scrubs")
    names = [table.name for table in metadata.sorted_tables if table.name not in own]
    return sum(ask(url, f"SELECT count(*) FROM {name}")[0][0] for name in names)


def changed(folder, *statements):
    with closing(sqlite3.connect(folder / "sceneprint.db")) as database:
        for statement in statements:
            database.execute(statement)
        database.commit()


@file_only
def test_what_is_restored_is_what_was_there(
    data, place, tmp_path, content, answers, uploads, settings
):
    new = tmp_path / "new" / "data"
    restored = restore_to_folder(place, new)
    assert names_in(tmp_path / "new") == ["data"]
    assert names_in(new) == ["blobs", "sceneprint.db"]
    original = content(data)
    orphan = hashlib.sha256(b"nothing refers to this").hexdigest()
    del original[f"blobs/{orphan[:2]}/{orphan}"]
    assert content(new) == original
    queries = uploads[:8]
    wanted = answers(settings(data), queries)
    assert {item.status for item in wanted} >= {"found"}
    assert answers(settings(new), queries) == wanted
    with Engine(settings(new)) as engine:  # the frame that waited is signed, and found
        work = engine.claim("w")
        assert engine.run(work) == "succeeded"
        assert engine.get_map("hall").frames == {"deleted": 1, "indexed": 5}
        assert [key.name for key in list_keys(engine.store).items] == ["robot"]
    assert restored.manifest.n_frames == 5


@file_only
@pytest.mark.parametrize(
    ("options", "typed", "kept"),
    [((), None, True), (("--keys", "revoke"), None, False), ((), "y", True), ((), "", False)],
)
def test_keys_of_a_bundle_are_listed_and_kept_or_revoked(
    place, tmp_path, settings, sceneprint, monkeypatch, options, typed, kept
):
    new = tmp_path / "new"
    terminal, stdin = pty.openpty()
    with os.fdopen(terminal, "wb", buffering=0) as keyboard, os.fdopen(stdin) as read:
        if typed is not None:
            keyboard.write(f"{typed}\n".encode())
            monkeypatch.setattr(sys, "stdin", read)
        output = sceneprint("restore", place, "--data", new, *options)
    assert output.stderr == ""
    assert ("Keep these keys?" in output.stdout) == (typed is not None)
    assert ": robot." in output.stdout.splitlines()[-1]
    with Engine(settings(new)) as engine:
        assert [key.name for key in list_keys(engine.store).items] == ["robot"] * kept
    with closing(sqlite3.connect(new / "sceneprint.db")) as database:
        revoked = database.execute("SELECT count(*) FROM events WHERE kind = 'key.revoked'")
        assert revoked.fetchone() == (0 if kept else 1,)


@file_only
def test_what_is_there_stays(place, data, tmp_path, content, sceneprint):
    before = content(data)
    output = sceneprint("restore", place, "--data", data, expect=2)
    assert "data holds blobs, sceneprint.db" in output.stderr
    (tmp_path / "notes").mkdir()
    for name in "dcba":
        (tmp_path / "notes" / name).touch()
    output = sceneprint("restore", place, "--data", tmp_path / "notes", expect=2)
    assert "notes holds a, b, c and 1 more" in output.stderr
    assert names_in(tmp_path) == ["data", "notes"]
    assert content(data) == before


def test_an_empty_folder_is_filled_and_stays_the_same_one(place, tmp_path, content):
    folder, link = tmp_path / "folder", tmp_path / "link"
    folder.mkdir(0o750)
    link.symlink_to(folder)
    before = folder.stat().st_ino
    restore_to_folder(place, link)
    assert link.is_symlink()
    assert (folder.stat().st_ino, folder.stat().st_mode & 0o777) == (before, 0o750)
    assert names_in(folder) == ["blobs", "sceneprint.db"]
    restore_to_folder(place, tmp_path / "new")
    assert content(folder) == content(tmp_path / "new")


@pytest.mark.parametrize("name", ["sceneprint.db", "other"])
def test_somebody_else_is_faster(place, tmp_path, name):
    folder = tmp_path / "new"

    def come(done, total):
        if done > total // 2:
            (folder / name).write_bytes(b"somebody else's")

    if name == "other":  # a file that does no harm
        restore_to_folder(place, folder, progress=come)
        assert names_in(folder) == ["blobs", "other", "sceneprint.db"]
    else:
        with pytest.raises(BundleError, match="cannot be moved into this folder"):
            restore_to_folder(place, folder, progress=come)
    assert (folder / name).read_bytes() == b"somebody else's"


def test_what_a_killed_restore_left_is_used_or_removed(place, tmp_path, content):
    restore_to_folder(place, tmp_path / "sound")
    whole, other = list((tmp_path / "sound" / "blobs").glob("??/*"))[:2]
    work, blobs = tmp_path / "new" / ".restoring", tmp_path / "new" / "blobs"
    work.mkdir(parents=True)
    for blob in (whole, other):
        (blobs / blob.parent.name).mkdir(parents=True, exist_ok=True)
    kept = Path(shutil.copy(whole, blobs / whole.parent.name / whole.name)).stat().st_ino
    changed = blobs / other.parent.name
    (changed / other.name).write_bytes(bytes(other.stat().st_size))
    (changed / ".0123456789ab.part").write_bytes(b"half")
    (work / "sceneprint.db").write_bytes(b"half")
    restore_to_folder(place, tmp_path / "new")
    assert content(tmp_path / "new") == content(tmp_path / "sound")
    assert (blobs / whole.parent.name / whole.name).stat().st_ino == kept
    assert names_in(blobs.parent) == ["blobs", "sceneprint.db"]


def test_a_restore_killed_between_two_names_goes_on(place, tmp_path, content):
    restore_to_folder(place, tmp_path / "sound")
    new = Path(shutil.copytree(tmp_path / "sound", tmp_path / "new"))
    (new / ".restoring").mkdir()
    (new / "sceneprint.db").rename(new / ".restoring" / "sceneprint.db")
    restore_to_folder(place, new)
    assert content(new) == content(tmp_path / "sound")
    assert names_in(new) == ["blobs", "sceneprint.db"]


def test_two_at_once(place, tmp_path):
    inner = []

    def come(_done, _total):
        try:
            restore_to_folder(place, tmp_path / "new")
        except BundleError as error:
            inner.append(error)

    restore_to_folder(place, tmp_path / "new", progress=come)
    assert "another process is restoring to this folder" in str(inner[0])
    assert names_in(tmp_path / "new") == ["blobs", "sceneprint.db"]


#: Restores to a mount with `lost+found`, and to one that is too small.
MOUNTED = """
import os, subprocess, sys
from pathlib import Path
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder
from sceneprint.errors import BundleError, StoreFull
from sceneprint.settings import Settings

place, folder = sys.argv[1], Path(sys.argv[2])
volume, small = folder / "volume", folder / "small"
for mount, size in ((volume, "64m"), (small, "100k")):
    mount.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", mount], check=True)
(volume / "lost+found").mkdir()
restore_to_folder(place, volume)
print(sorted(os.listdir(volume)))
for attempt in (
    lambda: restore_to_folder(place, small),
    lambda: take_backup(Settings(data_dir=volume, database_url=None), str(small / "place")),
):
    try:
        attempt()
    except (BundleError, StoreFull) as error:
        print(error)
"""


@file_only
def test_a_mount_is_filled_and_never_moved(place, tmp_path):
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode != 0:
        pytest.skip("this machine lets nobody mount anything")
    done = subprocess.run(
        ["unshare", "-rm", sys.executable, "-c", MOUNTED, place, str(tmp_path)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second, third = done.stdout.splitlines()
    assert first == "['blobs', 'lost+found', 'sceneprint.db']"
    assert "small: the bundle needs" in second
    assert "The store is full" in third


@own_servers
def test_there_and_back(place, data, uploads, postgres_url, tmp_path, content, answers, settings):
    fleet = fleet_of(tmp_path / "fleet", postgres_url)
    first = restore_to_server(place, fleet)
    assert first.manifest.frames["indexed"] == SIGNED
    queries = uploads[SIGNED - 1 : SIGNED + 2]
    before = answers(settings(data), queries)
    assert all(answer.matches for answer in before)
    back = take_backup(fleet, str(tmp_path / "back"))
    assert back.manifest.parts == first.manifest.parts  # of PostgreSQL they are the same bytes
    assert answers(fleet, queries) == before
    restore_to_folder(str(tmp_path / "back"), tmp_path / "home")
    restore_to_folder(place, tmp_path / "straight")
    actual = content(tmp_path / "home")
    assert actual == content(tmp_path / "straight")
    assert "sqlite_sequence" in actual[""]
    assert "secrets" in actual[""]


@own_servers
def test_no_number_is_given_out_twice(data, postgres_url, tmp_path, rows, settings):
    newest = "(SELECT max(number) FROM events)"
    [(highest,)] = rows(data, f"SELECT {newest}")
    changed(data, f"DELETE FROM events WHERE number = {newest}")
    take_backup(settings(data), str(tmp_path / "place"))
    restore_to_server(str(tmp_path / "place"), fleet_of(tmp_path / "fleet", postgres_url))
    statement = "SELECT nextval(pg_get_serial_sequence('{}', 'number'))"
    assert ask(postgres_url, statement.format("events")) == [(highest + 1,)]
    assert ask(postgres_url, statement.format("samples")) == [(1,)]  # none was ever given out
    restore_to_folder(str(tmp_path / "place"), tmp_path / "home")
    values = rows(tmp_path / "home", "SELECT seq FROM sqlite_sequence WHERE name = 'events'")
    assert values == [(highest,)]


@own_servers
def test_a_server_that_is_used_stays(place, postgres, postgres_url, tmp_path):
    with Engine(fleet_of(tmp_path / "used", postgres_url)) as engine:
        engine.create_key("robot")
        before = rows_in(postgres_url)
        with pytest.raises(BundleError, match="has rows in its table"):
            restore_to_server(place, fleet_of(tmp_path / "new", postgres_url))
        assert rows_in(postgres_url) == before > 0
    empty = postgres.create("in_use")
    with (
        Engine(fleet_of(tmp_path / "service", empty)),
        pytest.raises(BundleError, match="is in use by "),
    ):
        restore_to_server(place, fleet_of(tmp_path / "new", empty))
    (tmp_path / "embedded").mkdir()
    (tmp_path / "embedded" / "sceneprint.db").touch()
    with pytest.raises(BundleError, match="the database of another store"):
        restore_to_server(place, fleet_of(tmp_path / "embedded", empty))
    assert not (tmp_path / "new").exists()
    assert rows_in(empty) == 0


@own_servers
def test_what_postgresql_cannot_hold_is_not_restored(data, postgres, tmp_path, settings):
    url = postgres.create("choosy")
    changed(data, "UPDATE frames SET robot = printf('%.*c', 129, 'r')")
    take_backup(settings(data), str(tmp_path / "place"))
    with pytest.raises(BundleError, match=r"a row of table frames .*character varying"):
        restore_to_server(str(tmp_path / "place"), fleet_of(tmp_path / "fleet", url))
    assert rows_in(url) == 0


@own_servers
def test_commands_with_a_server(place, postgres, tmp_path, sceneprint, monkeypatch):
    url, data = postgres.create("commands"), tmp_path / "data"
    secret = url.replace("postgres@", "postgres:hidden@")
    for one in (secret, f"{url}?password=hidden", "hidden"):
        output = sceneprint("restore", place, "--data", data, "--database", one, expect=2)
        assert output.stderr.startswith("sceneprint restore: --database")
        assert "hidden" not in output.stderr
    again = ("restore", place, "--data", data, "--database", url)
    shown = url.replace("+psycopg", "")
    assert f"is restored to {shown}: 1 maps" in sceneprint(*again).stdout
    assert "does not overwrite" in sceneprint(*again, expect=2).stderr
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", secret)
    out = tmp_path / "out"
    assert "1 maps, 5 frames" in sceneprint("snapshot", "--data", data, "--to", out).stdout
    assert "is complete" in sceneprint("restore", "--verify-only", out).stdout


@own_servers
def test_blobs_and_bundles_in_an_object_store(place, postgres_url, bucket, tmp_path):
    fleet = fleet_of(tmp_path / "node", postgres_url, blob_url=SecretStr(f"{bucket}/one"))
    with Engine(fleet):  # it marks the prefix with a name that the database then loses
        pass
    restored = restore_to_server(place, fleet)
    assert not (tmp_path / "node" / "blobs").exists()
    with Engine(fleet) as engine:
        blobs = {*engine.store.blobs.digests()}
        engine.store.blobs.remove(first := min(blobs))
    assert len(blobs) == restored.manifest.blobs
    backup = take_backup(fleet, f"{bucket}/bundles", keep=1)
    assert [(blob.digest, blob.why) for blob in backup.lost] == [(first, "missing")]
    assert take_backup(fleet, f"{bucket}/bundles", keep=1).written == 0
    assert verify_bundle(f"{bucket}/bundles").lost == backup.lost
    restore_to_folder(f"{bucket}/bundles", tmp_path / "home")
    assert len([*(tmp_path / "home" / "blobs").glob("*/*")]) == len(blobs) - 1


@own_servers
def test_a_prefix_is_not_shared_with_the_store_that_was_copied(place, postgres, bucket, tmp_path):
    """They have the same name, and each would remove what only the other refers to."""
    marks = open_objects(bucket)
    first, second = (
        fleet_of(tmp_path / name, postgres.create(name), blob_url=SecretStr(bucket))
        for name in ("first", "second")
    )
    restore_to_server(place, first)
    mark = json.loads(marks.get("sceneprint.json"))
    assert mark.keys() == {"kind", "store"}
    with pytest.raises(UnusableStore, match="belong to the store of the snapshot"):
        restore_to_server(place, second)
    assert rows_in(second.database) == 0
    marks.put("sceneprint.json", json.dumps(mark | {"restoring": True}).encode())
    restore_to_server(place, second)  # as after one that was killed half way
    assert rows_in(second.database) == rows_in(first.database)
    assert json.loads(marks.get("sceneprint.json")) == mark
    with pytest.raises(UnusableStore, match="belong to another database"):
        BucketOwner(marks).begin("0" * 32, "1" * 32)
