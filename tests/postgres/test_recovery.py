"""A drill: a map is deleted by mistake, and the fleet's database goes back to the moment before."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet.postgres import Server, binaries, of_nobody
from sceneprint.engine import Engine
from sceneprint.errors import UnknownFrame
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint_client.api import JobState, NewMap, Query

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "deployment" / "recover.sh"
Until = Callable[[Callable[[], Any]], Any]


def recover(*arguments: object, options: str = "") -> subprocess.CompletedProcess[str]:
    """Run the script as who runs PostgreSQL."""
    path = f"{binaries()}:{os.environ['PATH']}"
    command = [*of_nobody(), "env", f"PATH={path}", f"PGOPTS={options}", "bash", str(SCRIPT)]
    given = [*command, *map(str, arguments)]
    return subprocess.run(given, capture_output=True, text=True, timeout=300, cwd="/", check=False)


@pytest.fixture
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which PostgreSQL's user may write."""
    place = tmp_path_factory.mktemp("drill")
    for folder in (place, *place.parents[:2]):
        folder.chmod(0o755)
    (place / "archive").mkdir()
    if os.geteuid() == 0:
        for folder in (place, place / "archive"):
            shutil.chown(folder, 65534, 65534)
    return place


@pytest.fixture
def primary(place: Path) -> Iterator[Server]:
    kept = place / "archive" / "%f"
    options = {
        "archive_mode": "on", "archive_command": f"test ! -f {kept} && cp %p {kept}",
        "wal_level": "replica", "unix_socket_directories": "",
    }  # fmt: skip
    server = Server(place / "primary", options=options)
    server.start()
    yield server
    server.kill()


def settings_of(url: str, data: Path) -> Settings:
    return Settings.model_validate({"database_url": url, "data_dir": data, "undo_s": 0})


def add(engine: Engine, frame: Any) -> str:
    added, _ = engine.add_frame("hall", *frame)
    work = engine.claim("w")
    assert work is not None
    assert engine.run(work) == JobState.SUCCEEDED
    return added.frame_id


def test_a_map_that_was_deleted_by_mistake_is_brought_back(
    primary: Server, place: Path, tmp_path: Path, small: list[Any], until: Until
) -> None:
    url, data = primary.create("fleet"), tmp_path / "data"
    with Engine(settings_of(url, data)) as engine:
        engine.create_map(NewMap(name="hall"))
        ids = [add(engine, small[0])]
        primary._run(
            "pg_basebackup", "--pgdata", str(place / "base"), "--host=127.0.0.1",
            f"--port={primary.port}", "--username=postgres", "--checkpoint=fast", "--no-sync",
        )  # fmt: skip
        ids += [add(engine, frame) for frame in small[1:3]]
        versions = shutil.copytree(data / "blobs", tmp_path / "versions")
        (known,) = primary.execute("SELECT clock_timestamp()")
        moment = datetime.fromisoformat(str(known[0])).astimezone(UTC)
        time.sleep(0.05)  # a commit of that very moment would be before it
        engine.delete_map("hall")
        engine.create_map(NewMap(name="hall"))
        late = add(engine, small[3])
    (found,) = primary.execute("SELECT pg_walfile_name(pg_switch_wal())")
    until((place / "archive" / str(found[0])).is_file)

    new = Server(place / "unused")  # of which the port is taken, and nothing else
    given = place / "base", place / "archive", place / "recovered", moment.isoformat(" ")
    (shown,) = primary.execute("SHOW max_connections")
    options = f"-c max_connections={shown[0]} -c unix_socket_directories="
    done = recover(*given, new.port, options=options)
    assert done.returncode == 0, done.stderr
    assert "recovered:" in done.stdout
    try:
        _check_recovered(new.url("fleet"), tmp_path, versions, small, ids, late)
    finally:
        stopping = [str(binaries() / "pg_ctl"), "-D", str(given[2]), "-m", "immediate", "stop"]
        subprocess.run([*of_nobody(), *stopping], check=True, capture_output=True, cwd="/")
    again = recover(*given, new.port)
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr.count("\n") == 1
    assert "is not empty, and nothing is overwritten" in again.stderr


def _check_recovered(
    url: str, tmp_path: Path, versions: Path, small: list[Any], ids: list[str], late: str
) -> None:
    back = tmp_path / "back"
    back.mkdir()
    versions.rename(back / "blobs")
    with Engine(settings_of(url, back)) as engine:
        assert engine.get_map("hall").frames == {"indexed": 3}
        with pytest.raises(UnknownFrame):
            engine.get_frame("hall", late)
        asked = Query(k=3, candidates=3, keep=False, stages=["retrieve"])
        answer = engine.queries.upload(["hall"], *small[2], asked)
        assert {one.frame_id for one in answer.matches} == {*ids}
        assert answer.matches[0].frame_id == ids[2]
        ids.append(add(engine, small[4]))  # and it goes on
        assert engine.get_map("hall").frames == {"indexed": 4}
    assert [one for one in fsck(settings_of(url, back)) if one.left] == []
    # where blobs have no versions, what the deletion removed is named
    lost = [one.finding.kind for one in fsck(settings_of(url, tmp_path / "data")) if one.left]
    assert "missing-upload" in lost


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (0, "none", "is no base backup"), (1, "none", "is no folder"),
        (3, "2026' OR", "are refused"), (4, "", "usage"),
    ],
)  # fmt: skip
def test_what_it_is_given_is_checked_first(place: Path, at: int, value: str, said: str) -> None:
    (place / "base").mkdir()
    (place / "base" / "PG_VERSION").write_text("18")
    given: list[object] = [place / "base", place / "archive", place / "data", "2026-11-28 12:00+00"]
    given[at:] = [value, *given[at + 1 :]] if at < len(given) else [5432, "more"]
    done = recover(*given)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (place / "data").exists()
