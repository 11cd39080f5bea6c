"""Tests of shared blobs: ownership of a prefix, and removal beside new references."""

import errno
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from sqlalchemy import text

from sceneprint.errors import StoreLocked, UnusableStore
from sceneprint.store import open_blobs, open_database, open_store
from sceneprint.store.blobs.folder import MARK
from sceneprint.store.blobs.object_client import open_objects

HOLDS = """
import sys, time
from sceneprint.store import open_store
with open_store(sys.argv[1], sys.argv[2]).blobs.locks.block_removals():
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_new_database_gets_its_folder_beside_blobs_elsewhere(tmp_path):
    data, blobs = tmp_path / "data" / "node", tmp_path / "mount" / "blobs"
    store = open_store(f"sqlite:///{data / 'a.db'}", blobs)
    digest = store.blobs.put(b"depth")
    store.close()
    assert data.stat().st_mode & 0o777 == 0o700
    assert [*blobs.rglob(digest)] != []


def test_a_prefix_belongs_to_one_database(store_url, bucket, tmp_path):
    first = open_store(store_url, f"{bucket}/mine")
    digest = first.blobs.put(b"depth")
    first.close()
    again = open_store(store_url, f"{bucket}/mine/")
    assert again.blobs.get(digest) == b"depth"
    again.close()
    other = f"sqlite:///{tmp_path / 'other.db'}"
    with pytest.raises(UnusableStore, match=r"belong to another database.*SCENEPRINT_BLOB_URL"):
        open_store(other, f"{bucket}/mine")
    open_store(other, f"{bucket}/yours").close()
    objects = open_objects(f"{bucket}/mine")
    objects.put(MARK, b"[1]")
    with pytest.raises(UnusableStore, match="belong to another database"):
        open_store(store_url, f"{bucket}/mine")


def test_a_folder_of_a_fleet_belongs_to_one_database(postgres, tmp_path):
    """Hosts mount it, and another database would remove what it does not refer to."""
    first, second = (postgres.create(f"on_a_folder_{i}") for i in range(2))
    with closing(open_store(first, tmp_path)) as store:
        assert (tmp_path / MARK).is_file()
        assert list(store.blobs.digests()) == []
    with pytest.raises(UnusableStore, match=r"belong to another database.*a different prefix"):
        open_store(second, tmp_path)
    with closing(open_database(second)) as database:
        (tmp_path / MARK).unlink()
        open_blobs(tmp_path, database, claim=False).close()
        assert not (tmp_path / MARK).exists()


def test_who_only_looks_marks_nothing(store_url, bucket):
    database = open_database(store_url)
    blobs = open_blobs(bucket, database, claim=False)
    assert list(open_objects(bucket).list("")) == []
    blobs.put(b"depth")  # what writes does
    assert open_objects(bucket).head(MARK) is not None
    blobs.close()
    database.close()


def test_a_store_that_is_away_is_opened_and_claimed_later(
    tmp_path, bucket, monkeypatch, object_server
):
    monkeypatch.setattr("sceneprint.store.blobs.object_client.TRIED_S", 0.1)
    monkeypatch.setattr("sceneprint.store.blobs.object_client.AWAY_S", 0.0)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    store = open_store(f"sqlite:///{tmp_path / 'new' / 'a.db'}", bucket)
    with pytest.raises(UnusableStore, match="cannot be read"):
        store.blobs.put(b"depth")
    with pytest.raises(UnusableStore):
        store.blobs.remove("0" * 64)
    with pytest.raises(UnusableStore):
        store.blobs.check()
    store.close()
    monkeypatch.setenv("AWS_ENDPOINT_URL", object_server.endpoint)
    store = open_store(f"sqlite:///{tmp_path / 'new' / 'a.db'}", bucket)
    store.blobs.put(b"depth")
    store.blobs.check()
    open_objects(bucket).delete(MARK)
    monkeypatch.setattr("sceneprint.store.blobs.object_store.CHECK_S", 0.0)
    with pytest.raises(UnusableStore, match="emptied or replaced"):
        store.blobs.check()
    store.close()


def test_all_processes_share_one_lock(store_url, bucket, until):
    store = open_store(store_url, bucket)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, store_url, bucket], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        with store.blobs.locks.removing() as allowed:
            assert not allowed
        with store.blobs.locks.block_removals():  # others may need them kept as well
            pass
        other.kill()

    def removes():
        with store.blobs.locks.removing() as allowed:
            return allowed

    until(removes)  # the lock of the dead goes when the server sees the end of its connection
    with store.blobs.locks.removing() as allowed, store.blobs.locks.removing() as also:
        assert (allowed, also) == (True, False)
    store.close()


def test_what_was_put_is_held_without_asking_until_something_is_removed(postgres_url, bucket):
    mine, theirs = (open_store(postgres_url, bucket) for _ in range(2))
    objects = open_objects(bucket)
    digest = mine.blobs.put(b"depth")
    objects.delete(f"blobs/{digest[:2]}/{digest}")  # past all locks: nobody can know
    assert mine.blobs.holds(digest)  # not asked
    assert not theirs.blobs.holds(digest)  # checks the store, since another process wrote it
    mine.blobs.put(b"depth")
    with theirs.blobs.locks.removing() as allowed:
        assert allowed
        theirs.blobs.remove(digest)
        assert not mine.blobs.holds(digest)  # while it goes on
    assert not mine.blobs.holds(digest)
    mine.blobs.put(b"depth")
    assert mine.blobs.holds(digest)
    mine.blobs.remove(digest)
    assert not mine.blobs.holds(digest)
    mine.close()
    theirs.close()


def test_a_folder_without_locks_holds_what_it_has(tmp_path, monkeypatch):
    """Nothing is removed there, so there is nothing to wait for."""

    def refuse(*_):
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    store = open_store(f"sqlite:///{tmp_path / 'a.db'}", tmp_path / "blobs")
    digest = store.blobs.put(b"depth")
    with store.blobs.locks.removing() as allowed:
        assert not allowed
    assert store.blobs.holds(digest)
    store.close()


def test_a_folder_waits_for_who_removes(tmp_path, monkeypatch):
    store = open_store(f"sqlite:///{tmp_path / 'a.db'}", tmp_path / "blobs")
    digest = store.blobs.put(b"depth")
    with ThreadPoolExecutor(1) as pool, store.blobs.locks.removing() as allowed:
        assert allowed
        held = pool.submit(store.blobs.holds, digest)
        with pytest.raises(TimeoutError):
            held.result(0.05)
        store.blobs.remove(digest)
    assert held.result() is False
    monkeypatch.setattr("sceneprint.store.blobs.folder.TURN_S", 0.0)
    with store.blobs.locks.removing(), pytest.raises(StoreLocked, match="Try again later"):
        store.blobs.holds(digest)
    store.close()


def test_a_lock_that_was_lost_is_said(postgres_url, bucket):
    store = open_store(postgres_url, bucket)
    kept = store.blobs.locks.block_removals()
    kept.__enter__()
    with store.database.write() as connection:
        connection.execute(
            text(
                "SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory' "
                "AND mode = 'ShareLock' AND database = "
                "(SELECT oid FROM pg_database WHERE datname = current_database())"
            )
        )
    with pytest.raises(UnusableStore, match=r"was lost.*Run the command again"):
        kept.__exit__(None, None, None)
    store.close()
