"""Fixtures of the PostgreSQL tests: stores, and waits for conditions."""

from typing import NamedTuple

import pytest
from sqlalchemy import text

from benchmarks.postgres import Server
from sceneprint.store import open_store
from sceneprint.store.maps import add_map, store_model
from sceneprint_client.api import FrameMeta

MODEL = "ab" * 32


class Small(NamedTuple):
    """A small depth image."""

    png: bytes
    meta: FrameMeta


@pytest.fixture(scope="session")
def small(room_frames, small_image):
    """Frames with different content, from different offsets."""
    results = []
    for number in range(12):
        data, lens = small_image(room_frames[number % 6], *divmod(number, 4))
        results.append(Small(data, FrameMeta(intrinsics=lens)))
    return results


@pytest.fixture
def server_store(postgres_url, tmp_path):
    """A store on PostgreSQL."""
    opened = open_store(postgres_url, tmp_path / "blobs")
    yield opened
    opened.database.close()


@pytest.fixture
def rows(server_store):
    """Three empty maps: a, b and c."""
    with server_store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"a model")
        return [add_map(connection, name, None, MODEL) for name in ("a", "b", "c")]


@pytest.fixture(scope="session")
def waiting():
    """A function that counts the advisory locks that somebody waits for."""
    statement = text(
        "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted "
        "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
    )

    def count(store):
        with store.database.read() as connection:
            return int(connection.execute(statement).scalar_one())

    return count


@pytest.fixture
def pair(tmp_path_factory):
    """A primary and an asynchronous standby."""
    folder = tmp_path_factory.mktemp("pair")
    primary = Server(folder / "primary")
    primary.start()
    primary.create("fleet")
    standby = primary.standby(folder / "standby", synchronous=False)
    yield primary, standby
    primary.kill()
    standby.kill()
