"""Tests that frames are checked in blocks of constant cost."""

from collections import Counter
from contextlib import closing

import pytest
from sqlalchemy import insert

from sceneprint.maintenance.fsck import findings
from sceneprint.maintenance.fsck.findings import Folder
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.maps import add_map, store_model
from sceneprint.store.tables import frames

N, BLOCK = 2_000, 100


@pytest.fixture
def store(tmp_path):
    """Rows of two maps in turn."""
    with closing(open_store(f"sqlite:///{tmp_path}/sceneprint.db", tmp_path / "blobs")) as opened:
        with opened.database.write() as connection:
            store_model(connection, "m", "toy", b"")
            maps = [add_map(connection, name, None, "m") for name in ("hall", "yard")]
            rows = [{"state": "received", "received_at": 0.0, "blob": "0" * 64, "bytes": 1,
                     "intrinsics": {}, "tags": [], "content_id": "c" * 64, "depth_scale": 1.0,
                     "depth_along_ray": False, "id": f"{i:032x}",
                     "map_number": maps[i % 2].number} for i in range(N)]  # fmt: skip
            connection.execute(insert(frames), rows)
        yield opened


@pytest.mark.parametrize("map_name", [None, "hall"])
def test_a_late_block_costs_no_more_than_the_first(store, tmp_path, monkeypatch, map_name):
    """Reading all before it again made the whole quadratic: a million frames took hours."""
    monkeypatch.setattr(findings, "BLOCK", BLOCK)
    settings = Settings(data_dir=tmp_path, database_url=None)
    folder = Folder(settings, store, map_name, False, 0.0, lambda *_: None, Counter())
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
    assert seen == sorted(set(seen))
    assert (len(seen), len(costs)) == (n, n // BLOCK)
    # the first has counted all frames before
    assert max(costs[1:]) < 1.1 * min(costs[1:])
