"""Tests of a recovery to the moment before an accidental deletion."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections import Counter
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import pytest

from benchmarks.postgres import OPTIONS, Server, binaries, nobody_prefix
from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import UnknownFrame
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint_client.api import JobState, NewMap, Query
from tests.whole_engine import Engine

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "deployment" / "recover.sh"
#: Of the server's command line, which the copy in its folder does not have.
OPTIONS_TOLD = f"-c max_connections={OPTIONS['max_connections']} -c unix_socket_directories="


def recover(*arguments, options=""):
    """Run the script as who runs PostgreSQL."""
    path = f"{binaries()}:{os.environ['PATH']}"
    command = [*nobody_prefix(), "env", f"PATH={path}", f"PGOPTS={options}", "bash", str(SCRIPT)]
    given = [*command, *map(str, arguments)]
    return subprocess.run(
        given, capture_output=True, text=True, timeout=PATIENCE_S, cwd="/", check=False
    )


@pytest.fixture
def place(tmp_path_factory):
    """A folder in which PostgreSQL's user may write."""
    place = tmp_path_factory.mktemp("drill")
    for folder in (place, *place.parents[:2]):
        folder.chmod(0o755)
    (place / "archive").mkdir()
    if os.geteuid() == 0:
        for folder in (place, place / "archive"):
            shutil.chown(folder, 65534, 65534)
    return place


def archiving(page, archive):
    """The settings of a page's section, for another folder."""
    section = page.read_text().partition("### Point-in-time recovery")[2]
    told = re.findall(r"^(archive_\w+) = '?(.*?)'?$", section, re.MULTILINE)
    return {name: value.replace("/backup/log", str(archive)) for name, value in told}


@pytest.fixture
def primary(place):
    options = archiving(SCRIPT.parents[1] / "deployment.md", place / "archive")
    assert sorted(options) == ["archive_command", "archive_mode", "archive_timeout"]
    server = Server(place / "primary", durable=True, options=options)
    server.start()
    yield server
    server.kill()


def settings_of(url, data):
    given = {"database_url": url, "data_dir": data, "undo_window_s": 0, "unindexed_frames": 1}
    return Settings.model_validate(given)


def add(engine, frame, name="hall"):
    added, _ = engine.add_frame(name, *frame)
    work = engine.claim("w")
    assert engine.run(work) == JobState.SUCCEEDED
    return added.frame_id


def found(engine, frame, name="hall"):
    asked = Query(k=9, candidates=9, keep=False, stages=["retrieve"])
    return [one.frame_id for one in engine.queries.upload([name], *frame, asked).matches]


def kinds(url, data):
    """What fsck finds, notes as well."""
    return Counter(one.kind for one in fsck(settings_of(url, data)))


class Drill(NamedTuple):
    """What was there at the moment: frames of two maps; and what came after it."""

    moment: str
    hall: list[str]
    yard: list[str]
    late: list[str]


def mistake(primary, place, data, small, until):
    """A map is deleted and begun again, and another goes on: published indexes know all that."""
    with Engine(settings_of(primary.create("fleet"), data)) as engine:
        for name in ("hall", "yard"):
            engine.create_map(NewMap(name=name, model="depth"))
        hall = [add(engine, small[0])]
        primary._run(
            "pg_basebackup", "--pgdata", str(place / "base"), "--host=127.0.0.1",
            f"--port={primary.port}", "--username=postgres", "--checkpoint=fast",
        )  # fmt: skip
        hall += [add(engine, frame) for frame in small[1:3]]
        yard = [add(engine, frame, "yard") for frame in small[5:7]]
        shutil.copytree(data / "blobs", data.parent / "versions")
        (known,) = primary.execute("SELECT clock_timestamp()")
        moment = datetime.fromisoformat(str(known[0])).astimezone(UTC)
        time.sleep(0.05)  # a commit of that very moment would be before it
        engine.delete_map("hall")
        engine.create_map(NewMap(name="hall", model="depth"))
        late = [add(engine, small[3])] + [add(engine, one, "yard") for one in small[7:9]]
        assert engine.publish_due() == 1  # of the yard
    (last,) = primary.execute("SELECT pg_walfile_name(pg_switch_wal())")
    until((place / "archive" / str(last[0])).is_file)
    return Drill(moment.isoformat(" "), hall, yard, late)


@contextmanager
def recovered(place, data, moment):
    """A server that the script made."""
    new = Server(data.with_suffix(".unused"))  # of which the port is taken, and nothing else
    done = recover(
        place / "base", place / "archive", data, moment, new.port, options=OPTIONS_TOLD
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert said[:2] == [f"copying {place / 'base'}", f"recovering to {moment}"]
    assert said[-1] == f"recovered: {data} serves port {new.port}"
    try:
        yield new
    finally:
        stopping = [str(binaries() / "pg_ctl"), "-D", str(data), "-m", "immediate", "stop"]
        subprocess.run([*nobody_prefix(), *stopping], check=True, capture_output=True, cwd="/")


@pytest.mark.thorough
def test_a_map_that_was_deleted_by_mistake_is_brought_back(primary, place, tmp_path, small, until):
    data, versions = tmp_path / "data", tmp_path / "versions"
    drill = mistake(primary, place, data, small, until)
    with recovered(place, place / "recovered", drill.moment) as server:
        url = server.url("fleet")
        # what the deletion removed is named
        assert kinds(url, data) == {"missing-upload": 3, "missing-artifact": 3}
        with Engine(settings_of(url, data)) as engine:
            assert sorted(found(engine, small[2])) == sorted(drill.hall)
        shutil.copytree(versions, data / "blobs", dirs_exist_ok=True)
        assert kinds(url, data) == {}
        _check_recovered(settings_of(url, data), small, drill)
        assert kinds(url, data) == {}


def _check_recovered(settings, small, drill):
    with Engine(settings) as engine:
        assert engine.store.database.history == "00000002"
        assert engine.get_map("hall").frames == {"indexed": 3}
        assert engine.get_map("yard").frames == {"indexed": 2}
        for one in drill.late:
            with pytest.raises(UnknownFrame):
                engine.get_frame("hall" if one == drill.late[0] else "yard", one)
        assert sorted(found(engine, small[2])) == sorted(drill.hall)
        assert found(engine, small[2])[0] == drill.hall[2]
        # the yard goes on with the keys and the revisions that the lost frames had
        yard = [*drill.yard, *(add(engine, one, "yard") for one in small[9:11])]
        assert sorted(found(engine, small[7], "yard")) == sorted(yard)
        assert engine.publish_due() == 2
    with Engine(settings) as engine:  # which begins with the new indexes
        assert found(engine, small[10], "yard")[0] == yard[-1]
        assert sorted(found(engine, small[10], "yard")) == sorted(yard)


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (0, "none", "is no base backup"), (1, "none", "is no folder"),
        (3, "2026' OR", "are refused"),
    ],
)  # fmt: skip
def test_what_it_is_given_is_checked_first(place, at, value, said):
    (place / "base").mkdir()
    (place / "base" / "PG_VERSION").write_text("18")
    given = [place / "base", place / "archive", place / "data", "2026-11-28 12:00+00"]
    given[at] = value
    done = recover(*given)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (place / "data").exists()


def test_the_archive_takes_a_file_again_and_never_another_of_its_name(place):
    archive = place / "archive"
    command = archiving(SCRIPT.parents[1] / "deployment.md", archive)["archive_command"]

    def take(content):
        (place / "wal").write_text(content)
        told = command.replace("%p", str(place / "wal")).replace("%f", "0001")
        return subprocess.run(["sh", "-c", told], capture_output=True, check=False).returncode

    assert [take("first"), take("first")] == [0, 0]
    assert take("second") != 0
    assert (archive / "0001").read_text() == "first"
    assert [path.name for path in archive.iterdir()] == ["0001"]
