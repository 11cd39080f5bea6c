"""Tests that frames are checked in blocks of constant cost."""

from collections import Counter

import pytest
from sqlalchemy import insert

from sceneprint.maintenance.fsck import findings
from sceneprint.maintenance.fsck.findings import Folder
from sceneprint.settings import Settings
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames
from sceneprint_client.api import NewMap
from tests.whole_engine import Engine

N, BLOCK = 2_000, 100


@pytest.fixture
def engine(tmp_path):
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as opened:
        for name in ("hall", "yard"):
            opened.create_map(NewMap(name=name))
        yield opened


def fill(store, *maps):
    values = {"state": "received", "received_at": 0.0, "blob": "0" * 64, "bytes": 1,
              "intrinsics": {}, "tags": [], "content_id": "c" * 64, "depth_scale": 1.0,
              "depth_along_ray": False}  # fmt: skip
    with store.database.write() as connection:
        rows = [{**values, "id": f"{i:032x}", "map_number": maps[i % len(maps)].number}
                for i in range(N)]  # fmt: skip
        connection.execute(insert(frames), rows)


@pytest.mark.sqlite_only("counts SQLite's steps")
@pytest.mark.parametrize("map_name", [None, "hall"])
def test_a_late_block_costs_no_more_than_the_first(engine, monkeypatch, map_name):
    """Reading all before it again made the whole quadratic: a million frames took hours."""
    store = engine.store
    with store.database.read() as connection:
        hall, yard = (find_map(connection, name) for name in ("hall", "yard"))
    fill(store, hall, yard)
    monkeypatch.setattr(findings, "BLOCK", BLOCK)
    told = list[tuple[int, int]]()
    folder = Folder(
        engine.settings, store, map_name, False, 0.0,
        lambda _subject, done, total: told.append((done, total)), Counter(),
    )  # fmt: skip
    with store.database.read() as connection:
        raw = connection.connection.driver_connection
    steps, costs, seen = [0], list[int](), list[int]()

    def count():
        steps[0] += 1
        return 0

    raw.set_progress_handler(count, 1)
    try:
        for block in folder.numbers("rows"):
            seen += block
            costs.append(steps[0])
            steps[0] = 0
    finally:
        raw.set_progress_handler(None, 1)
    n = N if map_name is None else N // 2
    assert seen == sorted(seen)
    assert (len(seen), len(set(seen)), told[0], told[-1]) == (n, n, (0, n), (n, n))
    assert len(costs) == n // BLOCK
    # the first has counted all frames before
    assert max(costs[1:]) < 1.1 * min(costs[1:])
