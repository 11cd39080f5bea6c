"""Tests of `sceneprint doctor` on machines with and without problems."""

import re
import sqlite3

import pytest
from pydantic import SecretStr

from benchmarks.waiting import until
from sceneprint import __version__
from sceneprint.cli import doctor
from sceneprint.cli.checks import queue_check, service_checks, worker_check
from sceneprint.cli.doctor import object_stores
from sceneprint.formats.dataset import find_sequences
from sceneprint.settings import Settings
from sceneprint_client import Client

#: What is said of a service.
SERVICE = [
    "service", "ready", "service clock", "store", "scrub", "service disk", "workers",
    "queue", "models",
]  # fmt: skip


def verdicts(text):
    lines = text.splitlines()[:-1]
    return {line[7:23].strip(): line[:5].strip() for line in lines}


@pytest.fixture(scope="module")
def working(service_url):
    """The service, whose worker has begun: that is a while after it answers."""
    with Client(service_url) as client:
        until(lambda: client.stats(minutes=1).workers)
    return service_url


@pytest.mark.sqlite_only("this server is told not to wait for its disk")
def test_a_sound_machine(sceneprint, data_folder, working):
    done = sceneprint("doctor", "--data", data_folder)
    found = verdicts(done.stdout)
    assert list(found) == [
        "python", "sqlite", "kernels", "table depth", "table lidar", "table paper", "data folder",
        "disk", "database", "decoders", "open3d", *SERVICE,
    ]  # fmt: skip
    for needed in ("python", "sqlite", "data folder", "database", "service", "workers"):
        assert found[needed] == "ok"
    assert set(found.values()) <= {"ok", "note"}
    for pattern in (
        rf"{working} answers, version {re.escape(__version__)}", "1 worker runs, ",
        "accepts uploads and answers queries", r"clock differs from this machine's by 0\.\d s",
    ):  # fmt: skip
        assert re.search(pattern, done.stdout), pattern
    assert "the default of --data" not in done.stdout
    assert done.stdout.splitlines()[-1] == "no problems found"


def test_a_key_that_may_not_see_all(sceneprint, service_url, monkeypatch):
    def findings(key):
        with Client(service_url, key) as client:
            client._http.headers["X-Forwarded-For"] = "192.0.2.7"  # as behind a proxy
            return list(service_checks(client, service_url))

    with Client(service_url) as client:
        few = client.create_key("doctor-few", {"nowhere": "read"}).secret
    none, few_found, wrong = findings(None), findings(few), findings("sp_wrong")
    assert [finding.subject for finding in none] == ["service", "ready", "workers"]
    assert "requires a key; pass one with --key" in none[-1].text
    assert [finding.subject for finding in few_found] == ["service", "ready", "workers", "models"]
    assert "only to a key for all maps" in few_found[-2].text
    assert few_found[-1].text == "no maps yet"
    assert [place.verdict for place in wrong] == ["WRONG"]


@pytest.mark.sqlite_only("a file that is damaged")
def test_what_is_wrong_says_what_to_do(sceneprint, tmp_path):
    (tmp_path / "sceneprint.db").write_bytes(b"not a database " * 100)
    done = sceneprint("doctor", "--data", tmp_path, "--url", "http://127.0.0.1:1", expect=2)
    found = verdicts(done.stdout)
    assert [what for what, verdict in found.items() if verdict == "WRONG"] == [
        "database",
        "service",
    ]
    assert "file is not a database" in done.stdout
    assert "no service responds at http://127.0.0.1:1" in done.stdout
    assert done.stdout.splitlines()[-1] == "2 problems found"
    done = sceneprint("doctor", "--data", "/proc/none", expect=2)
    assert verdicts(done.stdout)["data folder"] == "WRONG"


def found_in(settings):
    return {finding.subject: finding for finding in doctor.machine(settings)}


@pytest.mark.sqlite_only("what is in its file")
def test_databases_of_other_versions(tmp_path):
    Client.embedded(tmp_path).close()
    settings = Settings(data_dir=tmp_path, database_url=None)
    path = tmp_path / "sceneprint.db"
    assert found_in(settings)["database"].verdict == "ok"
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    connection.close()
    finding = found_in(settings)["database"]
    assert (finding.verdict, "which this version can still use" in finding.text) == ("note", True)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE schema_range SET least_revision = '9999'")
    connection.close()
    before = path.read_bytes()
    finding = found_in(settings)["database"]
    assert (finding.verdict, "schema 9999: it was written by a later version" in finding.text) == (
        "WRONG",
        True,
    )
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("url", "verdict", "said"),
    [
        ("sqlite:////{tmp}/x.db", "ok", "none yet; the first use creates {tmp}/x.db"),
        ("sqlite:////{tmp}/none/x.db", "WRONG", "the folder of {tmp}/none/x.db does not exist"),
        ("sqlite://", "WRONG", "is an in-memory database"),
        ("postgresql://me:p@ss:hidden@host/db", "WRONG", "the port is not a number"),
        ("nonsense", "WRONG", "not an SQLAlchemy URL"),
        ("postgresql://me:hidden@127.0.0.1:1/maps", "WRONG", "postgresql://me@127.0.0.1:1/maps: "),
        ("mysql://me:hidden@host/maps", "WRONG", "'mysql' is not a supported database"),
    ],
)
def test_addresses_of_databases(sceneprint, tmp_path, monkeypatch, url, verdict, said):
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", url.format(tmp=str(tmp_path).lstrip("/")
        if url.startswith("sqlite:////") else tmp_path))  # fmt: skip
    done = sceneprint("doctor", "--data", tmp_path, expect=2 if verdict == "WRONG" else 0)
    (line,) = [line for line in done.stdout.splitlines() if line[7:].startswith("database ")]
    assert line.startswith(verdict)
    assert said.format(tmp=tmp_path) in line
    assert "hidden" not in done.stdout + done.stderr  # half of a password
    last = "1 problem found" if verdict == "WRONG" else "no problems found"
    assert done.stdout.splitlines()[-1] == last
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def waiting(tmp_path_factory, rooms):
    with Client.embedded(tmp_path_factory.mktemp("waiting") / "data") as client:
        client.create_map("m")
        client.upload("m", find_sequences(rooms)[0].frames[0])
        yield client


def test_workers_that_are_missing(waiting):
    stats = waiting.stats(minutes=1)
    assert (stats.workers, stats.waiting) == ([], 1)
    result = worker_check(stats, read_only=False)
    assert result.verdict == "note"
    assert "wait if the service has just started" in result.text
    assert re.fullmatch(r"1 job waiting, 0 running, the oldest for \d+ s", queue_check(stats).text)
    late = stats.model_copy(
        update={"oldest_waiting_s": {"sign": 100.0}, "jobs": {"queued": 1, "dead": 2}}
    )
    result = worker_check(late, read_only=False)
    assert result.verdict == "WRONG"
    assert "not signed. Start workers with `sceneprint work`, and read their log" in result.text
    assert worker_check(late, read_only=True).verdict == "ok"  # there is nothing for them to do
    queue = queue_check(late)
    assert queue.verdict == "note"
    assert "the oldest for 100 s; 2 failed in every attempt: `sceneprint jobs" in queue.text


# Servers and object stores.


def test_object_stores(bucket, tmp_path, monkeypatch):
    settings = Settings(
        data_dir=tmp_path, database_url=None, blob_url=SecretStr(f"{bucket}/blobs"),
        index_url=f"file://{tmp_path}/kept",
    )  # fmt: skip
    blobs, indexes = object_stores(settings)
    assert (blobs.verdict, indexes.verdict) == ("ok", "ok")
    assert blobs.text.startswith(f"{bucket}/blobs: written, read and deleted in ")
    assert "AWS_... in the environment" in blobs.text
    assert not any(path.is_file() for path in tmp_path.rglob("*"))
    lost = Settings(data_dir=tmp_path, database_url=None, index_url=f"{bucket}-none")
    [result] = object_stores(lost)
    assert (result.verdict, result.subject) == ("WRONG", "indexes")
