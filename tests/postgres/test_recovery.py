"""Tests of a recovery to the moment before an accidental deletion."""

import os
import re
import shutil
import subprocess
import time
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from benchmarks.postgres import OPTIONS, Server, binaries, nobody_prefix
from benchmarks.waiting import PATIENCE_S
from sceneprint.store import open_database
from sceneprint.store.deletion import remove_map
from sceneprint.store.maps import add_map, find_map, list_maps, store_model

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "deployment" / "recover.sh"
MODEL = "ab" * 32
#: Options of the server's command line, which the copy in its folder does not have.
COMMAND_LINE = f"-c max_connections={OPTIONS['max_connections']} -c unix_socket_directories="


def recover(*arguments, options=""):
    """Run the script as who runs PostgreSQL."""
    path = f"{binaries()}:{os.environ['PATH']}"
    command = [*nobody_prefix(), "env", f"PATH={path}", f"PGOPTS={options}", "bash", str(SCRIPT)]
    args = [*command, *map(str, arguments)]
    return subprocess.run(
        args, capture_output=True, text=True, timeout=PATIENCE_S, cwd="/", check=False
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
    settings = re.findall(r"^(archive_\w+) = '?(.*?)'?$", section, re.MULTILINE)
    return {name: value.replace("/backup/log", str(archive)) for name, value in settings}


@pytest.fixture
def primary(place):
    options = archiving(SCRIPT.parents[1] / "deployment.md", place / "archive")
    assert sorted(options) == ["archive_command", "archive_mode", "archive_timeout"]
    server = Server(place / "primary", durable=True, options=options)
    server.start()
    yield server
    server.kill()


@contextmanager
def recovered(place, data, moment):
    """A server that the script made."""
    new = Server(data.with_suffix(".unused"))  # of which the port is taken, and nothing else
    done = recover(
        place / "base", place / "archive", data, moment, new.port, options=COMMAND_LINE
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
def test_a_map_that_was_deleted_by_mistake_is_brought_back(primary, place, tmp_path, until):
    with closing(open_database(primary.create("fleet"))) as database:

        def add(name):
            with database.write() as connection:
                add_map(connection, name, None, MODEL)

        with database.write() as connection:
            store_model(connection, MODEL, "toy", b"a model")
        add("hall")
        primary._run(
            "pg_basebackup", "--pgdata", str(place / "base"), "--host=127.0.0.1",
            f"--port={primary.port}", "--username=postgres", "--checkpoint=fast",
        )  # fmt: skip
        add("yard")
        ((now,),) = primary.execute("SELECT clock_timestamp()")
        moment = datetime.fromisoformat(str(now)).astimezone(UTC).isoformat(" ")
        time.sleep(0.05)  # a commit of that very moment would be before it
        with database.write() as connection:
            remove_map(connection, find_map(connection, "hall"))
        add("late")
    ((last,),) = primary.execute("SELECT pg_walfile_name(pg_switch_wal())")
    until((place / "archive" / str(last)).is_file)
    with (
        recovered(place, place / "recovered", moment) as server,
        closing(open_database(server.url("fleet"))) as database,
    ):
        assert database.history == "00000002"
        with database.write() as connection:  # it is promoted
            assert [row.name for row in list_maps(connection)] == ["hall", "yard"]


def test_arguments_are_checked_first(place):
    (place / "base").mkdir()
    (place / "base" / "PG_VERSION").write_text("18")
    arguments = [place / "base", place / "archive", place / "data", "2026-11-28 12:00+00"]
    for at, value, said in (
        (0, "none", "is no base backup"), (1, "none", "is no folder"),
        (3, "2026' OR", "are refused"),
    ):  # fmt: skip
        done = recover(*arguments[:at], value, *arguments[at + 1 :])
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert said in done.stderr
    assert not (place / "data").exists()


def test_the_archive_takes_a_file_again_and_never_another_of_its_name(place):
    archive = place / "archive"
    command = archiving(SCRIPT.parents[1] / "deployment.md", archive)["archive_command"]

    def take(content):
        (place / "wal").write_text(content)
        shell = command.replace("%p", str(place / "wal")).replace("%f", "0001")
        return subprocess.run(["sh", "-c", shell], capture_output=True, check=False).returncode

    assert [take("first"), take("first")] == [0, 0]
    assert take("second") != 0
    assert (archive / "0001").read_text() == "first"
    assert [path.name for path in archive.iterdir()] == ["0001"]
