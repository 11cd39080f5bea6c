"""An old primary that returns after its standby was promoted: no process goes back to it."""

from __future__ import annotations

import json
import logging
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet.postgres import Server
from sceneprint.cli import doctor
from sceneprint.cli.checks import Check
from sceneprint.engine import Engine
from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.blobs.folder import TIMELINE, FolderBlobs
from sceneprint.store.database import Database, reach_database
from sceneprint.store.postgres import timelines
from sceneprint_client.api import NewMap


def url_of(*servers: Server) -> str:
    hosts = "&".join(f"host=127.0.0.1:{server.port}" for server in servers)
    return f"postgresql+psycopg://postgres@/fleet?{hosts}&target_session_attrs=read-write"


def settings(folder: Path, *servers: Server) -> Settings:
    return Settings.model_validate({"database_url": url_of(*servers), "data_dir": folder})


def caught_up(primary: Server, standby: Server, until: Any) -> None:
    [(at,)] = primary.execute("SELECT pg_current_wal_lsn()::text")
    until(lambda: standby.execute(f"SELECT pg_last_wal_replay_lsn() >= '{at}'")[0][0])


def maps_in(server: Server) -> list[object]:
    return [name for (name,) in server.execute("SELECT name FROM maps ORDER BY name", "fleet")]


def place_of(database: Database) -> int:
    """Port of the server that a database reads from."""
    with database.read() as connection:
        found = connection.connection.driver_connection
        assert found is not None
        return int(found.info.port)


def test_neither_a_running_process_nor_a_new_one_goes_back_to_it(
    pair: tuple[Server, Server], tmp_path: Path, until: Any, caplog: pytest.LogCaptureFixture
) -> None:
    old, new = pair
    with Engine(settings(tmp_path, old, new)) as engine:
        engine.create_map(NewMap(name="before", model="depth"))
        caught_up(old, new, until)
        old.kill()
        new.promote()
        until(lambda: _made(engine, "after"))
        old.start()  # it takes writes, and is the first host of the URL
        caplog.set_level(logging.ERROR)
        new.execute(  # all connections of the process
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = 'fleet'"
        )
        until(lambda: _made(engine, "later"))
        with Engine(settings(tmp_path, old, new)) as other:  # a process that begins now
            other.create_map(NewMap(name="last", model="depth"))
        told = [one for one in caplog.records if one.message == "old primary refused"]
        assert len(told) == 2  # once in each process
        assert f"127.0.0.1:{old.port} is an old primary: it writes timeline 1" in vars(told[0])[
            "reason"
        ]  # fmt: skip
        with pytest.raises(StoreAway, match="that was promoted since writes 2"):
            Engine(settings(tmp_path, old)).close()
    assert maps_in(old) == ["before"]
    assert maps_in(new) == ["after", "before", "last", "later"]


def _made(engine: Engine, name: str) -> bool:
    try:
        engine.create_map(NewMap(name=name, model="depth"))
    except StoreAway:
        return False
    return True


def test_connections_that_are_open_to_it_are_given_up(
    pair: tuple[Server, Server], tmp_path: Path, until: Any
) -> None:
    old, new = pair
    blobs = FolderBlobs(tmp_path)
    with closing(reach_database(url_of(old, new))) as database:
        assert place_of(database) == old.port
        caught_up(old, new, until)
        new.promote()  # and the old one lives, as beyond a network that fell apart
        assert place_of(database) == old.port  # nobody has told yet
        with closing(reach_database(url_of(new))) as other:
            other.refuse_old_primaries(blobs)
        before = json.loads((tmp_path / TIMELINE).read_text())
        assert before["number"] == 2
        database.refuse_old_primaries(blobs)
        assert place_of(database) == new.port
        with closing(database.driver_connection()) as connection:
            assert connection.info.port == new.port
        assert json.loads((tmp_path / TIMELINE).read_text()) == before
        [system] = old.execute("SELECT (pg_control_system()).system_identifier::text")[0]
        assert database.history == f"{system}/00000002"
        assert [one for one in blobs.entries() if not one.unfinished] == []  # fsck minds no note


class Away(FolderBlobs):
    """Blobs whose notes cannot be read."""

    def get_note(self, name: str) -> bytes | None:
        raise UnusableStore(f"{name}: away")


def test_a_running_process_learns_from_the_note(
    pair: tuple[Server, Server], tmp_path: Path, until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was cut off while the standby was promoted, and others used that."""
    old, new = pair
    blobs = FolderBlobs(tmp_path)
    with closing(reach_database(url_of(old, new))) as database:
        database.refuse_old_primaries(blobs)
        assert place_of(database) == old.port
        caught_up(old, new, until)
        new.promote()
        with closing(reach_database(url_of(new))) as other:
            other.refuse_old_primaries(blobs)
        with closing(database.driver_connection()) as connection:
            assert connection.info.port == old.port  # it looked a moment ago
        monkeypatch.setattr(timelines, "COMPARED_S", 0.0)
        with closing(database.driver_connection()) as connection:
            assert connection.info.port == new.port
        assert place_of(database) == new.port


def test_a_note_is_never_lowered(pair: tuple[Server, Server], tmp_path: Path) -> None:
    server, _ = pair
    [(system,)] = server.execute("SELECT (pg_control_system()).system_identifier::text")
    noted = json.dumps({"system": system, "number": 7}).encode()
    FolderBlobs(tmp_path).put_note(TIMELINE, noted)
    with closing(reach_database(url_of(server))) as database:
        assert place_of(database) == server.port
        database.refuse_old_primaries(Away(tmp_path))  # nothing is learnt, and nothing noted
        assert place_of(database) == server.port
        assert FolderBlobs(tmp_path).get_note(TIMELINE) == noted
        with pytest.raises(StoreAway):
            database.refuse_old_primaries(FolderBlobs(tmp_path))
    assert FolderBlobs(tmp_path).get_note(TIMELINE) == noted


def test_doctor_names_it(pair: tuple[Server, Server], tmp_path: Path, until: Any) -> None:
    old, new = pair

    def found(*servers: Server) -> dict[str, Check]:
        return {one.subject: one for one in doctor.server(settings(tmp_path, *servers))}

    Engine(settings(tmp_path, old, new)).close()
    caught_up(old, new, until)
    noted = next(tmp_path.rglob(TIMELINE))
    before = noted.read_bytes()
    new.promote()
    assert found(new)["database server"].verdict == "ok"
    assert noted.read_bytes() == before  # looking changes nothing
    assert found(old, new)["database server"].verdict == "ok"  # nobody has used the new one
    Engine(settings(tmp_path, new)).close()
    checks = found(old, new)
    told = checks["database server"]
    assert told.verdict == "WRONG"
    assert f"127.0.0.1:{old.port} is an old primary: it writes timeline 1, and" in told.text
    assert "Stop it, or make it a standby." in told.text
    assert "durability" in checks  # of the other host
    assert found(new)["database server"].verdict == "ok"
    [alone] = found(old).values()
    assert (alone.verdict, alone.subject) == ("WRONG", "database server")
    assert f"127.0.0.1:{old.port} is an old primary" in alone.text


def test_a_role_that_may_not_ask_for_the_system(pair: tuple[Server, Server]) -> None:
    server, _ = pair
    server.execute("REVOKE EXECUTE ON FUNCTION pg_control_system() FROM PUBLIC", "fleet")
    server.execute("CREATE ROLE robot LOGIN")
    url = f"postgresql+psycopg://robot@127.0.0.1:{server.port}/fleet"
    with closing(reach_database(url)) as database:
        assert place_of(database) == server.port
        assert database.history == "/00000001"


def test_another_database_in_its_place_is_used(
    postgres_url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A copy of its rows in a new cluster begins with timeline 1; a damaged note is none."""
    FolderBlobs(tmp_path).put_note(TIMELINE, b'{"system": "1", "number": 7}')
    with closing(open_store(postgres_url, tmp_path)) as store:
        system = json.loads((tmp_path / TIMELINE).read_text())["system"]
        assert store.database.history == f"{system}/00000001"
    for unreadable in (b"{", b"[]", b'{"system": "1"}', b"[" * 100_000):
        FolderBlobs(tmp_path).put_note(TIMELINE, unreadable)
        with closing(open_store(postgres_url, tmp_path)) as store:
            assert store.database.history == f"{system}/00000001"
        assert json.loads((tmp_path / TIMELINE).read_text()) == {"system": system, "number": 1}
    assert [one.message for one in caplog.records].count("timeline note unreadable") == 4


def test_the_note_lies_in_the_object_store(postgres_url: str, bucket: str) -> None:
    place = f"{bucket}/blobs"
    with closing(open_store(postgres_url, place)) as store:
        noted = store.blobs.get_note(TIMELINE)
        assert noted is not None
        given: dict[str, Any] = {"database_url": postgres_url, "blob_url": place}
        looked = Settings.model_validate(given)
        assert next(doctor.server(looked)).verdict == "ok"
        found = json.loads(noted)
        assert store.database.history == f"{found['system']}/{found['number']:08X}"
        assert list(store.blobs.entries()) == []
        store.blobs.put_note(TIMELINE, json.dumps({**found, "number": 9}).encode())
    with pytest.raises(StoreAway, match=f"a standby that was promoted since writes 9.*{TIMELINE}"):
        open_store(postgres_url, place)
    told = next(doctor.server(looked))
    assert (told.verdict, told.subject) == ("WRONG", "database server")
    assert "that was promoted since writes 9" in told.text
