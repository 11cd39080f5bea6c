"""Tests of statistics, models, event retention, and remains of deleted maps."""

import os
import shutil
import time

import numpy as np
import pytest
from sqlalchemy import func, select, update

from sceneprint.engine.admin import statistics
from sceneprint.errors import Conflict, IdempotencyConflict, InvalidRequest, UnknownMap
from sceneprint.models import PRESETS, read_model
from sceneprint.process import FIRST_S, STEP, Latencies, bin_of, merged, quantile
from sceneprint.store.events import record_event
from sceneprint.store.keys import IdempotentRequest, remove_old_requests
from sceneprint.store.store_counts import add_sample
from sceneprint.store.tables import events, idempotency, jobs, samples
from sceneprint_client.api import NewMap
from sceneprint_client.api.admin import IndexRecall


@pytest.fixture
def noon(monkeypatch):
    """A time that does not go on, half a minute after a full one."""
    at = 1_800_000_030.0
    assert at % 60 == 30
    monkeypatch.setattr(statistics.time, "time", lambda: at)
    return at


def age_last(connection, table, at):
    number = select(func.max(table.c.number)).scalar_subquery()
    connection.execute(update(table).where(table.c.number == number).values(at=at))


def test_history_is_that_of_all_processes(make_engine, noon):
    engine = make_engine()
    engine.create_map(NewMap(name="hall"))
    times = {"a": [0.1] * 98 + [3.0, 3.0], "b": [0.1] * 100}
    with engine.store.database.write() as connection:
        connection.execute(events.delete())
        for ago, kind, name in (
            (5, "received", "hall"), (5, "indexed", "hall"), (65, "indexed", "hall"),
            (65, "indexed", "shop"), (100, "deleted", "hall"), (700, "received", "hall"),
        ):  # fmt: skip
            record_event(connection, f"frame.{kind}", name)
            age_last(connection, events, noon - ago)
        for process, ago, statuses, queries in (
            ("a", 20, {"200": 7, "404": 2, "503": 1}, {"found": 3}),
            ("b", 20, {"200": 1, "500": 4}, {"found": 2, "not_found": 5}),
            ("a", 40, {"429": 6}, {}),
            ("b", 700, {"200": 99}, {}),
        ):
            kept = Latencies()
            for seconds in times[process] if ago == 20 else ():
                kept.add(seconds)
            result = {"statuses": statuses, "queries": queries, "latencies": kept.as_json()}
            add_sample(connection, "service", process, result)
            age_last(connection, samples, noon - ago)
    stats = engine.statistics.collect(3)
    assert [minute.at.timestamp() - noon for minute in stats.minutes] == [-150, -90, -30]
    assert [minute.received for minute in stats.minutes] == [0, 0, 1]
    assert [minute.indexed for minute in stats.minutes] == [0, 2, 1]
    assert [m.deleted for m in stats.minutes] == [1, 0, 0]  # 100 s ago: two minutes before
    last = stats.minutes[-1]
    assert last.queries == {"found": 5, "not_found": 5}
    assert (last.requests, last.refused, last.busy, last.broken) == (15, 2, 1, 4)
    assert (stats.minutes[1].requests, stats.minutes[1].refused) == (6, 6)
    assert (stats.total.requests, stats.total.refused, stats.total.received) == (21, 8, 1)
    assert stats.minutes[1].latency is None
    assert bin_of(last.latency.p50) == bin_of(last.latency.p95) == bin_of(0.1)
    assert bin_of(last.latency.p99) == bin_of(0.1)  # the 198th of 200; the 199th took 3 s
    own = engine.statistics.collect(3, "hall")
    assert [minute.indexed for minute in own.minutes] == [0, 1, 1]
    assert (own.total.queries, own.total.latency, own.workers, own.bytes.free) == (None,) * 4
    with pytest.raises(UnknownMap):
        engine.statistics.collect(3, "shop")


def test_what_waits_and_who_works(make_engine, uploads):
    engine = make_engine()
    for name in ("hall", "shop"):
        engine.create_map(NewMap(name=name, model="depth"))
    for i in range(3):
        engine.add_frame("shop" if i else "hall", uploads[i].data, uploads[i].meta)
    with engine.store.database.write() as connection:
        for number in (1, 2, 3):
            at = time.time() - 100 * number
            connection.execute(update(jobs).where(jobs.c.number == number).values(created_at=at))
    stats = engine.statistics.collect(1)
    assert (stats.maps, stats.frames, stats.jobs) == (2, {"received": 3}, {"queued": 3})
    assert (stats.waiting, stats.workers) == (3, [])
    assert stats.oldest_waiting_s == {"sign": pytest.approx(100, abs=20)}  # the least number
    of_shop = engine.statistics.collect(1, "shop")
    assert (of_shop.frames, of_shop.jobs, of_shop.waiting) == ({"received": 2}, {"queued": 2}, 2)
    assert of_shop.oldest_waiting_s == {"sign": pytest.approx(200, abs=20)}
    work = engine.claim("far:17")
    with engine.bell.listen():
        stats = engine.statistics.collect(1)
    here = f"{os.uname().nodename}:{os.getpid()}"
    assert {worker.name: worker.job_id for worker in stats.workers} == {
        "far:17": work.job.id, here: None
    }  # fmt: skip
    engine.put_back(work)
    assert engine.statistics.collect(1).workers == []


@pytest.mark.sqlite_only("reads the size of its file")
def test_indexes_and_sizes_are_told(data, make_engine):
    engine = make_engine(data)
    indexed = engine.get_map("hall").frames["indexed"]
    (index,) = engine.statistics.collect(1).indexes
    assert (index.map, index.version, index.tail) == ("hall", None, indexed)
    assert index.recall is None
    engine.rebuild_index("hall")
    (index,) = engine.statistics.collect(1).indexes
    assert (index.version, index.tail) == (1, 0)
    assert index.recall == IndexRecall(  # compared whole
        share=1, near=10, sample=0, probes=0, frames=indexed
    )
    result = statistics.sizes(engine.settings, engine.store)
    assert result.database >= (data / "sceneprint.db").stat().st_size
    assert result.free == pytest.approx(shutil.disk_usage(data).free, rel=0.2)
    assert result.disk == shutil.disk_usage(data).total


def test_requests_are_remembered_for_a_day_and_their_keys_then_removed(make_engine):
    database, day = make_engine().store.database, 86_400.0
    requests = [IdempotentRequest("robot", f"key {i}", f"{i}" * 64) for i in range(3)]
    with database.write() as connection:
        for request, ago in zip(requests, (day - 60, day + 1, 2 * day), strict=True):
            request.store(connection, {"job_id": request.key})
            own = update(idempotency).where(idempotency.c.key == request.key)
            connection.execute(own.values(created_at=time.time() - ago))
        actual = [request.stored_result(connection) for request in requests]
        assert actual == [{"job_id": "key 0"}, None, None]
        # what is forgotten gives way though it was not removed yet: another request may have it
        other = IdempotentRequest("robot", "key 1", "f" * 64)
        other.store(connection, {"job_id": "other"})
        assert other.stored_result(connection) == {"job_id": "other"}
    assert (remove_old_requests(database), remove_old_requests(database)) == (1, 0)
    with database.read() as connection:
        assert requests[0].stored_result(connection) == {"job_id": "key 0"}
        with pytest.raises(IdempotencyConflict, match="'key 1' was used for another request"):
            requests[1].stored_result(connection)


def test_models_are_listed_with_the_maps_that_may_be_named(make_engine, small_model):
    engine = make_engine()
    for name in ("hall", "shop"):
        engine.create_map(NewMap(name=name, model="depth"))
    engine.reencode("shop", small_model)
    actual = {one.name: one for one in engine.catalogue.list_all(lambda name: name != "hall")}
    assert list(actual) == [*PRESETS, "small"]
    small = actual["small"]
    assert actual["depth"].maps == ["shop"]
    assert (small.maps, small.preset, actual["depth"].preset) == (["shop"], False, True)
    assert actual["paper"].maps == []
    assert (small.components, small.levels, small.signature_bytes) == (8, 2, 25 * 8 * 2)
    for name in ("small", "/etc/passwd", ""):
        with pytest.raises(InvalidRequest, match="There is no model"):
            engine.catalogue.find(name)
    for name in (small_model.id, small_model.label):
        assert engine.catalogue.find(name, "shop".__eq__).id == small_model.id
        with pytest.raises(InvalidRequest, match="There is no model"):  # another's alone
            engine.catalogue.find(name, "hall".__eq__)
    label = read_model("depth").label
    assert engine.catalogue.find(label, lambda _: False).id == actual["depth"].model_id
    with pytest.raises(Conflict, match="is already switching to"):
        engine.reencode("shop", engine.catalogue.find("paper"))


def test_quantiles_of_several_processes_are_those_of_all_times():
    rng = np.random.default_rng(3)
    times = np.exp(rng.normal(np.log(0.08), 1.0, 5000)).clip(FIRST_S, 600)
    processes = [Latencies() for _ in range(3)]
    for i, moment in enumerate(times):
        processes[i % 3].add(float(moment))
    together = merged([process.as_json() for process in processes])
    assert sum(together.values()) == 5000
    for share in (0.5, 0.95, 0.99, 1.0):
        exact = float(np.quantile(times, share, method="inverted_cdf"))
        actual = quantile(together, share)
        # the middle of a bin is at most half a bin from whatever is in it
        assert abs(np.log(actual / exact)) <= np.log(STEP) / 2 + 1e-9


def test_a_map_is_weighed(full):
    full.create_map(NewMap(name="shop", model="depth"))
    full.rebuild_index("hall")
    folder = full.settings.data_dir
    result = full.statistics.collect(1, "hall").bytes
    assert result.blobs == sum(path.stat().st_size for path in (folder / "blobs").glob("*/*"))
    index = sum(path.stat().st_size for path in (folder / "index").rglob("*") if path.is_file())
    assert result.index == index
    assert (result.free, result.disk) == (None, None)
    shop = full.statistics.collect(1, "shop").bytes
    assert (shop.database, shop.blobs, shop.index) == (0, 0, 0)
