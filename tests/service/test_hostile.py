"""Tests of a service on a faulty machine, which still answers and loses no data."""

import os
import resource
import shutil
import signal
import sqlite3
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from sceneprint.settings import Settings
from sceneprint.store.postgres.connection import allow
from sceneprint_client.api import FrameMeta, NewMap
from tests.whole_engine import Engine

BIN = Path(sys.executable).parent
#: Largest file that a process may write from now on, where no disk can be mounted: less than the
#: log of the database or a frame, more than our own logs.
NARROW = 1 << 17


def pending(server):
    return dict(server.client.get("/readyz").json()["jobs"])


def limit_files(server, size):
    """Limit the files of the service's processes; no privilege is needed for that."""
    for pid in (server.process.pid, *server.workers):
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def tree(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.thorough
@pytest.mark.sqlite_only("the disk of uploads is that of the database")
def test_a_full_disk_takes_nothing_and_costs_nothing(
    begin, make_map, shots, small_shots, refused, until, tmp_path
):
    server = begin(folder=tmp_path / "data", job_lease_s=3)
    path = make_map(server, "hall")
    first = server.index(path, shots[0])
    (worker,) = server.workers
    os.kill(worker, signal.SIGSTOP)
    waiting = server.client.post(f"{path}/frames", **shots[1].form())
    assert waiting.status_code == 202
    before = server.client.get("/readyz").json()
    limit_files(server, NARROW)
    blobs = tree(server.folder / "blobs")
    for shot in (shots[2], small_shots[0]):  # too large for a blob; for the database alone
        answer = server.client.post(f"{path}/frames", **shot.form())
        refused(answer, 503, "unusable-store", "nothing was stored")
        assert answer.headers["retry-after"] == "1"
    assert tree(server.folder / "blobs") == blobs  # no blob without a row, no part
    assert server.client.get("/readyz").json() == before
    response = server.client.post(f"{path}/queries", json={"frame_id": first})
    assert response.status_code == 200
    query = server.client.post(f"{path}/queries", **shots[0].form())
    assert (query.status_code, query.json()["status"]) == (200, "found")
    os.kill(worker, signal.SIGCONT)
    until(lambda: len(server.log("store unreachable")) >= 2)
    assert server.client.get("/healthz").status_code == 200
    job = server.client.get(f"/v1/jobs/{waiting.json()['job_id']}").json()
    assert job["state"] in ("queued", "running")
    assert tree(server.folder / "blobs") == blobs
    limit_files(server, resource.RLIM_INFINITY)
    until(lambda: pending(server) == {"succeeded": 2})  # of itself
    assert server.workers == [worker]
    server.index(path, shots[2])
    copy = tmp_path / "copy.db"  # SQLite would look for the path in our own namespace
    for end in ("", "-wal"):
        shutil.copy(server.folder / f"sceneprint.db{end}", f"{copy}{end}")
    with closing(sqlite3.connect(copy)) as database:
        assert database.execute("SELECT max(failures) FROM jobs").fetchone() == (0,)
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)


@pytest.fixture(scope="module")
def busy(begin, make_map, small_shots):
    """A service with three indexed frames, that works on one thing at a time and lets few wait."""
    server = begin(concurrent_requests=1, queued_requests=2)
    path = make_map(server, "hall")
    for shot in small_shots[:3]:
        server.index(path, shot)
    return server


@pytest.mark.thorough
def test_another_process_that_keeps_writing_stops_uploads_alone(busy, small_shots, refused, until):
    path = "/v1/maps/hall"

    def upload(i):
        return busy.client.post(f"{path}/frames", **small_shots[i].form())

    with (
        Engine(Settings(data_dir=busy.folder, database_url=None)) as other,
        other.store.database.write() as writing,
    ):
        allow(writing, 0)
        with ThreadPoolExecutor(4) as pool:
            sent = [pool.submit(upload, i) for i in (8, 9, 10, 11)]
            until(lambda: any(future.done() for future in sent))
            query = busy.client.post(f"{path}/queries", **small_shots[0].form())
            assert (query.status_code, query.json()["status"]) == (200, "found")
            for address in ("/healthz", "/readyz", "/metrics", path, f"{path}/frames"):
                assert busy.client.get(address).status_code == 200
            answers = [future.result() for future in sent]
            for answer in answers:
                assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")
            kinds = [answer.json()["type"].rpartition("/")[2] for answer in answers]
            assert kinds == ["store-locked"] * 4
        refused(upload(11), 503, "store-locked", "nothing was stored")
        deleted = busy.client.delete(f"{path}/frames/none")
        refused(deleted, 503, "store-locked")
    assert busy.client.get("/readyz").json()["frames"] == {"indexed": 3}
    assert [upload(i).status_code for i in (8, 9, 10)] == [202, 202, 202]
    until(lambda: busy.client.get("/readyz").json()["frames"] == {"indexed": 6})
    assert busy.log("worker died") == []


#: Permissions hold for root as well: PR_CAPBSET_DROP, CAP_DAC_OVERRIDE.
HELD = """
import ctypes, os, sys
assert os.getuid() or ctypes.CDLL(None).prctl(24, 1, 0, 0, 0) == 0
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.fixture(scope="module")
def stored(small_shots, tmp_path_factory):
    """A data folder of four indexed frames, closed."""
    folder = tmp_path_factory.mktemp("stored") / "data"
    with Engine(Settings(data_dir=folder, database_url=None)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        for shot in small_shots[:4]:
            meta = FrameMeta.model_validate({"intrinsics": shot.camera})
            engine.add_frame("hall", shot.png, meta)
        while (work := engine.claim("w")) is not None:
            engine.run(work)
    return folder


@pytest.fixture
def sealed(stored):
    """The words before a command that may read the folder and not write it."""
    sceneprint = str(BIN / "sceneprint")
    for path in (stored, *stored.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    start = (sys.executable, "-c", HELD, sceneprint)
    yield lambda name, *port: (
        *start, name, "--data", str(stored), *(("--port", *port) if port else ())
    )  # fmt: skip
    for path in (stored, *stored.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.thorough
@pytest.mark.sqlite_only("a database in a folder that may be read alone")
def test_a_read_only_folder_is_served_as_it_is(sealed, stored, begin, small_shots, refused):
    before = contents(stored)
    server = begin(command=sealed("serve", "0"), workers=1)
    path = "/v1/maps/hall"
    ready = server.client.get("/readyz").json()
    assert (ready["status"], ready["read_only"], ready["frames"]) == ("ready", True, {"indexed": 4})
    said = "the store is read-only: queries work, but nothing is stored or signed"
    assert len(server.log(said)) == 1
    query = server.client.post(f"{path}/queries", **small_shots[1].form())
    assert (query.status_code, query.json()["status"]) == (200, "found")
    frames = server.client.get(f"{path}/frames").json()["items"]
    assert len(frames) == 4
    for answer in (
        server.client.post(f"{path}/frames", **small_shots[9].form()),
        server.client.delete(f"{path}/frames/{frames[0]['frame_id']}"),
        server.client.post("/v1/maps", json={"name": "other"}),
    ):
        refused(answer, 503, "read-only-store", "Make the data folder writable")
        assert answer.headers["retry-after"] == "60"
    again = server.client.post(f"{path}/frames", **small_shots[0].form())
    assert (again.status_code, again.json()["state"]) == (200, "indexed")  # nothing to be done
    assert server.workers == []
    assert server.end(signal.SIGTERM) == 0
    assert contents(stored) == before
