"""Tests of `sceneprint doctor` on machines with and without problems."""

import re
import shutil
import sqlite3

import pytest
from pydantic import SecretStr

from benchmarks.waiting import until
from sceneprint import __version__
from sceneprint.cli import checks, doctor
from sceneprint.cli.checks import (
    clock_check,
    model_check,
    queue_check,
    ready_check,
    service_checks,
    version_check,
    worker_check,
)
from sceneprint.cli.output import waiting_reason
from sceneprint.cli.preparation import prepare_presets
from sceneprint.engine import compilation
from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.signature import pair_features
from sceneprint.settings import Settings
from sceneprint_client import Client, Status
from sceneprint_client.api.admin import WorkerSeen

#: What is said of a service.
SERVICE = [
    "service", "ready", "service clock", "store", "scrub", "service disk", "workers",
    "queue", "models",
]  # fmt: skip


def verdicts(text):
    """The first word of each line by its subject."""
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
    assert f"{working} answers, version {__version__}" in done.stdout
    assert "the default of --data" not in done.stdout
    assert done.stdout.splitlines()[-1] == "no problems found"


@pytest.mark.sqlite_only("what its file takes")
def test_a_running_service(sceneprint, working, monkeypatch):
    """The address alone: what the service tells, and nothing of this machine."""
    with Client(working) as client:
        if not any(one.name == "looked-at" for one in client.maps()):
            client.create_map("looked-at", model="lidar")
        model = client.map("looked-at").model
    monkeypatch.delenv("SCENEPRINT_URL")

    def ask():  # until jobs that other tests left, or that begin by themselves, are over
        said = str(sceneprint("doctor", "--url", working).stdout)
        return said if "0 jobs waiting, 0 running" in said else ""

    said = until(ask)
    found = verdicts(said)
    assert list(found) == SERVICE
    assert set(found.values()) <= {"ok", "note"}
    for told in (
        "accepts uploads and answers queries", r"clock differs from this machine's by 0\.\d s",
        r"database of \d+\.\d MB, blobs of", "1 worker runs, ", rf"{model}: .*looked-at",
    ):  # fmt: skip
        assert re.search(told, said), told


def test_a_key_that_may_not_see_all(sceneprint, service_url, monkeypatch):
    def asked(key):
        with Client(service_url, key) as client:
            client._http.headers["X-Forwarded-For"] = "192.0.2.7"  # as behind a proxy
            return list(service_checks(client, service_url))

    with Client(service_url) as client:
        few = client.create_key("doctor-few", {"nowhere": "read"}).secret
    none, few_found, wrong = asked(None), asked(few), asked("sp_wrong")
    assert [one.subject for one in none] == ["service", "ready", "workers"]
    assert "requires a key; pass one with --key" in none[-1].text
    assert [one.subject for one in few_found] == ["service", "ready", "workers", "models"]
    assert "only to a key for all maps" in few_found[-2].text
    assert few_found[-1].text == "no maps yet"
    assert [one.verdict for one in wrong] == ["WRONG"]


@pytest.mark.sqlite_only("this server is told not to wait for its disk")
def test_without_an_address_the_default_folder_is_named(
    sceneprint, service_url, tmp_path, monkeypatch
):
    monkeypatch.delenv("SCENEPRINT_URL")
    monkeypatch.setattr(doctor, "DEFAULT_URL", service_url)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    done = sceneprint("doctor")
    assert f"{tmp_path}/sceneprint can be created, the default of --data" in done.stdout
    assert f"`sceneprint doctor --url {service_url}` checks the service itself" in done.stdout
    assert list(verdicts(done.stdout))[-1] == "service"


@pytest.mark.sqlite_only("this server is told not to wait for its disk")
def test_a_machine_where_nothing_was_used_yet(sceneprint, tmp_path, monkeypatch):
    monkeypatch.delenv("SCENEPRINT_URL")
    monkeypatch.setattr(doctor, "DEFAULT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("SCENEPRINT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(
        pair_features, "machine_code_folder", lambda: (str(tmp_path / "numba"), False)
    )
    done = sceneprint("doctor", "--data", tmp_path / "new" / "data")
    found = verdicts(done.stdout)
    for made_later in ("kernels", "table depth", "table paper", "service"):
        assert found[made_later] == "note"
    assert (found["data folder"], found["database"]) == ("ok", "ok")
    assert "none yet" in done.stdout
    assert "`sceneprint serve` starts one" in done.stdout
    assert list(tmp_path.rglob("*")) == []  # looking makes nothing


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
    return {one.subject: one for one in doctor.machine(settings)}


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
    with sqlite3.connect(path) as connection:
        connection.execute("DELETE FROM alembic_version")
    connection.close()
    assert found_in(settings)["database"].verdict == "note"


def test_a_decoder_is_tried(tmp_path):
    settings = Settings(data_dir=tmp_path, decoders=1)
    finding = found_in(settings)["decoders"]
    assert (finding.verdict, "seccomp" in finding.text) == ("ok", True)
    finding = found_in(settings.model_copy(update={"decoders": 0}))["decoders"]
    assert (finding.verdict, "SCENEPRINT_DECODERS is 0" in finding.text) == ("note", True)


def content(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("sceneprint.db*"))}


@pytest.mark.sqlite_only("what is in its file")
def test_looking_at_a_database_changes_nothing(tmp_path):
    """One that was closed, one that is in use, one whose process was killed, and a copy of that."""
    path, killed, copy = (tmp_path / one / "sceneprint.db" for one in ("data", "killed", "copy"))
    Client.embedded(path.parent).close()
    settings = Settings(data_dir=path.parent, database_url=None)

    def look(where=path):
        before, used = content(where.parent), where is path and path.with_suffix(".db-wal").exists()
        url = None if where is path else SecretStr(f"sqlite:///{where}")
        verdict = found_in(settings.model_copy(update={"database_url": url}))["database"].verdict
        after = content(where.parent)
        if used:  # threads of one process share the index of the log, and note what they read
            assert before.pop("sceneprint.db-shm")
            assert after.pop("sceneprint.db-shm")
        assert after == before
        return verdict

    assert list(content(path.parent)) == ["sceneprint.db"]
    assert look() == "ok"
    with sqlite3.connect(path) as writer:
        writer.execute("PRAGMA wal_autocheckpoint = 0")
        writer.execute("UPDATE alembic_version SET version_num = '9999'")
        writer.execute("UPDATE schema_range SET least_revision = '9999'")
        writer.commit()
        assert look() == "WRONG"  # what is in the log only is seen too
        shutil.copytree(path.parent, killed.parent)
        writer.execute("DELETE FROM alembic_version")
        writer.commit()
        assert look() == "note"
    writer.close()
    assert sorted(content(killed.parent)) == [f"sceneprint.db{end}" for end in ("", "-shm", "-wal")]
    assert look(killed) == "WRONG"
    copy.parent.mkdir()
    for end in ("", "-wal"):
        shutil.copy(f"{killed}{end}", f"{copy}{end}")
    assert look(copy) == "note"


@pytest.mark.parametrize(
    ("url", "verdict", "said"),
    [
        ("sqlite:////{tmp}/x.db", "ok", "none yet; the first use creates {tmp}/x.db"),
        ("sqlite:///file:{tmp}/x%20y.db?uri=true", "ok", "the first use creates {tmp}/x y.db"),
        ("sqlite:////{tmp}/none/x.db", "WRONG", "the folder of {tmp}/none/x.db does not exist"),
        ("sqlite://", "WRONG", "is an in-memory database"),
        ("sqlite:///file:x?mode=memory&uri=true", "WRONG", "is an in-memory database"),
        ("postgresql://me:p@ss:hidden@host/db", "WRONG", "the port is not a number"),
        ("nonsense", "WRONG", "not an SQLAlchemy URL"),
        ("nosuch://host/db", "WRONG", "'nosuch' is not a supported database"),
    ],
)
def test_addresses_of_databases(sceneprint, tmp_path, monkeypatch, url, verdict, said):
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", url.format(tmp=str(tmp_path).lstrip("/")
        if url.startswith("sqlite:////") else tmp_path))  # fmt: skip
    done = sceneprint("doctor", "--data", tmp_path, expect=2 if verdict == "WRONG" else 0)
    (line,) = [one for one in done.stdout.splitlines() if one[7:].startswith("database ")]
    assert line.startswith(verdict)
    assert said.format(tmp=tmp_path) in line
    assert "hidden" not in done.stdout + done.stderr  # half of a password
    last = "1 problem found" if verdict == "WRONG" else "no problems found"
    assert done.stdout.splitlines()[-1] == last
    assert list(tmp_path.iterdir()) == []


def test_what_a_machine_may_lack(tmp_path, monkeypatch):
    monkeypatch.setitem(doctor.OPEN3D_LIBRARIES, "libabsent.so.1", "libabsent1")
    monkeypatch.setattr(checks, "LEAST_FREE", 1 << 62)
    monkeypatch.setattr(doctor, "OLDEST_SQLITE", (99, 0, 0))
    found = found_in(Settings(data_dir=tmp_path, database_url=None))
    assert found["open3d"].verdict == "note"
    assert "libabsent1" in found["open3d"].text.split("apt-get install ")[1].split()
    assert (found["disk"].verdict, found["sqlite"].verdict) == ("WRONG", "WRONG")
    assert "SQLite 99.0.0 or later" in found["sqlite"].text


def test_open3d_may_be_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "find_spec", lambda _name: None)
    found = found_in(Settings(data_dir=tmp_path, database_url=None))["open3d"]
    assert (found.verdict, found.text.split(": ")[1]) == ("note", "pip install open3d")


@pytest.fixture(scope="module")
def waiting(tmp_path_factory, rooms):
    """A map with a frame that nobody signs."""
    with Client.embedded(tmp_path_factory.mktemp("waiting") / "data") as client:
        client.create_map("m")
        client.upload("m", find_sequences(rooms)[0].frames[0])
        yield client


def test_workers_that_are_missing(waiting):
    stats = waiting.stats(minutes=1)
    assert (stats.workers, stats.waiting) == ([], 1)
    found = worker_check(stats, read_only=False)
    assert found.verdict == "note"
    assert "wait if the service has just started" in found.text
    assert re.fullmatch(r"1 job waiting, 0 running, the oldest for \d+ s", queue_check(stats).text)
    late = stats.model_copy(
        update={"oldest_waiting_s": {"sign": 100.0}, "jobs": {"queued": 1, "dead": 2}}
    )
    found = worker_check(late, read_only=False)
    assert found.verdict == "WRONG"
    assert "not signed. Start workers with `sceneprint work`, and read their log" in found.text
    assert worker_check(late, read_only=True).verdict == "ok"  # there is nothing for them to do
    queue = queue_check(late)
    assert queue.verdict == "note"
    assert "the oldest for 100 s; 2 failed in every attempt: `sceneprint jobs" in queue.text


def test_why_jobs_wait(waiting):
    stats = waiting.stats(minutes=1)
    assert waiting_reason(stats, 1).startswith("Check that workers are running;")
    busy = [WorkerSeen(name="host:1", job_id="j"), WorkerSeen(name="host:2", job_id=None)]
    many = stats.model_copy(update={"workers": busy, "waiting": 45})
    assert waiting_reason(many, 3) == "1 of 2 workers busy, 42 jobs ahead."
    one = stats.model_copy(update={"workers": busy[:1]})
    assert waiting_reason(one, 0) == "1 of 1 worker busy, 1 job ahead."


def test_what_a_service_may_tell(waiting):
    status = Status(version="99.1", frames={"indexed": 2, "rejected": 1}, jobs={})
    found = version_check("http://x", status)
    assert found.verdict == "note"
    assert f"version 99.1, 3 frames; this is version {__version__}" in found.text
    found = ready_check(status.model_copy(update={"read_only": True}))
    assert (found.verdict, "refuses uploads" in found.text) == ("note", True)
    for there, verdict, text in (
        (99.0, "ok", "0.0 s"),
        (103.5, "note", "3.5 s"),
        (90.0, "note", "5.0 s"),
    ):
        found = clock_check(95.0, there, 100.0)
        assert (found.verdict, text in found.text) == (verdict, True)
    (one,) = waiting.maps()
    assert model_check([one], waiting.models()).verdict == "ok"
    old = one.model_copy(update={"model": "depth-00000000", "model_id": "0" * 64})
    found = model_check([one, old, old], waiting.models())
    assert found.verdict == "note"
    assert (
        "2 maps have an older model than this version contains: `sceneprint reencode m"
        in found.text
    )


def test_the_first_use_says_what_it_waits_for(tmp_path, monkeypatch):
    said = []
    prepare_presets(Settings(data_dir=tmp_path), said.append)
    said.clear()  # of a checkout in which nothing was compiled
    prepare_presets(Settings(data_dir=tmp_path), said.append)
    assert said == []
    waits = []
    monkeypatch.setattr(compilation, "missing", lambda _: ("signing", "validation"))
    monkeypatch.setattr(compilation, "_run", lambda *_: waits.append(True))  # not told to stop
    prepare_presets(Settings(data_dir=tmp_path), said.append)
    first, last = said
    assert "compiling kernels for signing and validation; this" in first
    assert re.fullmatch(r"compilation finished in \d+ s", last)
    assert waits == [True, True]
