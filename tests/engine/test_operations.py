"""Tests of statistics, models, event retention, and remains of deleted maps."""

import gc
import hashlib
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select, update

from sceneprint.engine.admin import statistics
from sceneprint.engine.admin import statistics as measuring
from sceneprint.engine.admin.statistics import anchors
from sceneprint.engine.search import retrieval
from sceneprint.errors import Conflict, IdempotencyConflict, InvalidRequest, UnknownMap
from sceneprint.models import PRESETS, read_model
from sceneprint.process import BINS, FIRST_S, STEP, Latencies, bin_of, merged, quantile
from sceneprint.store.events import EventFilter, record_event
from sceneprint.store.keys import IdempotentRequest, remove_old_requests
from sceneprint.store.store_counts import add_sample, samples_since
from sceneprint.store.tables import events, idempotency, jobs, samples
from sceneprint_client.api import NewMap, Query
from sceneprint_client.api.admin import IndexRecall


@pytest.fixture
def noon(monkeypatch):
    """A time that does not go on, half a minute after a full one."""
    at = 1_800_000_030.0
    assert at % 60 == 30
    monkeypatch.setattr(statistics.time, "time", lambda: at)
    return at


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
            number = select(func.max(events.c.number)).scalar_subquery()
            connection.execute(
                update(events).where(events.c.number == number).values(at=noon - ago)
            )
        for process, ago, statuses, queries in (
            ("a", 20, {"200": 7, "404": 2, "503": 1}, {"found": 3}),
            ("b", 20, {"200": 1, "500": 4}, {"found": 2, "not_found": 5}),
            ("a", 40, {"429": 6}, {}),
            ("b", 700, {"200": 99}, {}),
        ):
            kept = Latencies()
            for seconds in times[process] if ago == 20 else ():
                kept.add(seconds)
            told = {"statuses": statuses, "queries": queries, "latencies": kept.as_json()}
            add_sample(connection, "service", process, told)
            number = select(func.max(samples.c.number)).scalar_subquery()
            connection.execute(
                update(samples).where(samples.c.number == number).values(at=noon - ago)
            )
    stats = engine.statistics.collect(3)
    assert [one.at.timestamp() - noon for one in stats.minutes] == [-150, -90, -30]
    assert [one.received for one in stats.minutes] == [0, 0, 1]
    assert [one.indexed for one in stats.minutes] == [0, 2, 1]
    assert [one.deleted for one in stats.minutes] == [1, 0, 0]  # 100 s ago: two minutes before
    last = stats.minutes[-1]
    assert last.queries == {"found": 5, "not_found": 5}
    assert (last.requests, last.refused, last.busy, last.broken) == (15, 2, 1, 4)
    assert (stats.minutes[1].requests, stats.minutes[1].refused) == (6, 6)
    assert (stats.total.requests, stats.total.refused, stats.total.received) == (21, 8, 1)
    assert stats.minutes[1].latency is None
    assert bin_of(last.latency.p50) == bin_of(last.latency.p95) == bin_of(0.1)
    assert bin_of(last.latency.p99) == bin_of(0.1)  # the 198th of 200; the 199th took 3 s
    own = engine.statistics.collect(3, "hall")
    assert [one.indexed for one in own.minutes] == [0, 1, 1]
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
            made = time.time() - 100 * number
            connection.execute(update(jobs).where(jobs.c.number == number).values(created_at=made))
    stats = engine.statistics.collect(1)
    assert (stats.maps, stats.frames, stats.jobs) == (2, {"received": 3}, {"queued": 3})
    assert stats.waiting == 3
    assert stats.oldest_waiting_s == {"sign": pytest.approx(100, abs=20)}  # the least number
    of_shop = engine.statistics.collect(1, "shop")
    assert (of_shop.frames, of_shop.jobs, of_shop.waiting) == ({"received": 2}, {"queued": 2}, 2)
    assert of_shop.oldest_waiting_s == {"sign": pytest.approx(200, abs=20)}
    with engine.store.database.write() as connection:
        connection.execute(update(jobs).where(jobs.c.number == 3).values(kind="associate"))
    assert engine.statistics.collect(1, "shop").oldest_waiting_s == {
        "associate": pytest.approx(300, abs=60), "sign": pytest.approx(200, abs=60),
    }  # fmt: skip
    with engine.store.database.write() as connection:
        connection.execute(update(jobs).where(jobs.c.number == 3).values(kind="sign"))
    assert stats.workers == []
    work = engine.claim("far:17")
    with engine.bell.listen():
        stats = engine.statistics.collect(1)
    here = f"{os.uname().nodename}:{os.getpid()}"
    assert {one.name: one.job_id for one in stats.workers} == {
        "far:17": work.job.id, here: None
    }  # fmt: skip
    assert engine.statistics.collect(1).workers == [stats.workers[0]]
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
    told = measuring.sizes(engine.settings, engine.store)
    assert told.index == sum(p.stat().st_size for p in (data / "index").rglob("*") if p.is_file())
    assert told.blobs == sum(p.stat().st_size for p in (data / "blobs").rglob("*") if p.is_file())
    assert told.database is not None
    assert told.database >= (data / "sceneprint.db").stat().st_size
    assert told.free == pytest.approx(shutil.disk_usage(data).free, rel=0.2)
    assert told.disk == shutil.disk_usage(data).total


def test_the_disk_of_a_data_folder_that_is_not_made_yet(make_engine, tmp_path):
    """Nobody makes it where no worker runs, and database and blobs are elsewhere."""
    engine = make_engine()
    missing = engine.settings.model_copy(update={"data_dir": tmp_path / "not" / "yet"})
    told = measuring.sizes(missing, engine.store)
    assert told.free == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.2)
    assert told.disk == shutil.disk_usage(tmp_path).total
    assert not (tmp_path / "not").exists()


def test_of_a_large_store_what_was_counted_is_told_while_a_thread_counts_again(
    make_engine, uploads, monkeypatch
):
    """Whoever asks waits for no count, and of what waits is told the present number."""
    engine = make_engine()
    engine.create_map(NewMap(name="hall"))
    for upload in uploads[:3]:
        engine.add_frame("hall", upload.data, upload.meta)
    seen = engine.statistics
    first = seen.collect()
    assert (first.frames, first.counted_at) == ({"received": 3}, first.counted_at)
    engine.add_frame("hall", uploads[3].data, uploads[3].meta)
    assert seen.collect().frames == {"received": 4}  # few are counted anew
    monkeypatch.setattr(statistics, "MANY", 8)  # four frames and their jobs
    threads, begin = [], statistics.threading.Thread.start
    monkeypatch.setattr(
        statistics.threading.Thread,
        "start",
        lambda one: threads.append(one) if one.name == "counts" else begin(one),
    )
    monkeypatch.setattr(statistics, "COUNTING", 1e-12)  # what was counted is young for years
    known = seen.collect()
    engine.add_frame("hall", uploads[4].data, uploads[4].meta)
    again = seen.collect()
    assert (again.frames, again.waiting, threads) == ({"received": 4}, 5, [])
    assert again.counted_at == known.counted_at < again.at
    assert engine.statistics.state_counts()[0] == {"received": 4}
    monkeypatch.setattr(statistics, "COUNTING", 1e12)  # and old at once
    assert seen.collect().frames == {"received": 4}
    assert seen.collect().frames == {"received": 4}
    (counter,) = threads  # one of those that asked began it
    monkeypatch.setattr(statistics, "COUNTING", 1e-12)
    counter.run()
    fresh = seen.collect()
    assert fresh.frames == {"received": 5}
    assert fresh.counted_at > again.counted_at


def test_many_blobs_are_measured_by_a_part_of_them(make_engine, monkeypatch):
    engine = make_engine()
    for i in range(600):
        digest = hashlib.sha256(bytes([i % 256, i // 256])).hexdigest()  # unlike `put`, no fsync
        path = engine.settings.blob_dir / digest[:2] / digest
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(1001))
    assert measuring.sizes(engine.settings, engine.store).blobs == 600 * 1001
    monkeypatch.setattr(measuring, "MEASURED_FILES", 150)
    estimate = measuring.sizes(engine.settings, engine.store).blobs
    assert estimate == pytest.approx(600 * 1001, rel=0.25)


def test_samples_are_forgotten_after_two_hours(make_engine):
    engine = make_engine()
    with engine.store.database.write() as connection:
        for ago in (7300.0, 7100.0, 0.0):
            add_sample(connection, "service", "a", {"ago": ago})
            number = select(func.max(samples.c.number)).scalar_subquery()
            connection.execute(
                update(samples).where(samples.c.number == number).values(at=time.time() - ago)
            )
        add_sample(connection, "service", "a", {"ago": -1})
        found = [one.data["ago"] for one in samples_since(connection, "service", 0.0)]
    assert found == [7100.0, 0.0, -1]


def test_requests_are_remembered_for_a_day_and_their_keys_then_removed(make_engine):
    engine = make_engine()
    database, day = engine.store.database, 86_400.0
    asked = [IdempotentRequest("robot", f"key {i}", f"{i}" * 64) for i in range(3)]
    with database.write() as connection:
        for one in asked:
            one.store(connection, {"job_id": one.key})
        asked[0].store(connection, {"job_id": "again"})  # of a map that was made anew since
        for one, ago in zip(asked, (day - 60, day + 1, 2 * day), strict=True):
            connection.execute(
                update(idempotency)
                .where(idempotency.c.key == one.key)
                .values(created_at=time.time() - ago)
            )
        found = [one.stored_result(connection) for one in asked]
        assert found == [{"job_id": "again"}, None, None]
        # what is forgotten gives way though it was not removed yet: another request may have it
        other = IdempotentRequest("robot", "key 1", "f" * 64)
        other.store(connection, {"job_id": "other"})
        assert other.stored_result(connection) == {"job_id": "other"}
    assert remove_old_requests(database) == 1
    assert remove_old_requests(database) == 0
    with database.read() as connection:
        left = connection.execute(select(idempotency.c.key).order_by(idempotency.c.key)).scalars()
        assert list(left) == ["key 0", "key 1"]
        assert asked[0].stored_result(connection) == {"job_id": "again"}
        with pytest.raises(IdempotencyConflict, match="'key 1' was used for another request"):
            asked[1].stored_result(connection)


def test_events_that_are_not_kept_go_and_no_index_is_doubted(data, make_engine):
    engine = make_engine(data, events_per_map=1000)
    engine.rebuild_index("hall")
    (anchor,) = anchors(engine.settings.indexes)
    seals = engine.store.seals
    before = seals.open("event", engine.events.page(EventFilter(), limit=1).newest)
    with engine.store.database.write() as connection:
        for _ in range(2500):
            record_event(connection, "frame.received", "hall")
    assert engine.events.tidy() == 0  # it is not time yet
    # of what was there before the newest 1000, the anchor stays, and the last of the map
    floor = before + 1500
    assert engine.events.remove_surplus() == floor - 2
    assert engine.events.remove_surplus() == 0
    page = engine.events.page(EventFilter(), limit=1000)
    numbers = [seals.open("event", one.id) for one in page.items[:3]]
    assert numbers == [anchor, floor, floor + 1]
    other = make_engine(data)
    answer = other.query_frame("hall", other.list_frames("hall").items[0].frame_id,
                               Query(stages=("retrieve",)))  # fmt: skip
    assert answer.index_version == 1


def test_a_map_that_another_process_deleted_is_let_go(data, make_engine, monkeypatch):
    monkeypatch.setattr(retrieval, "_TIDY_S", 1e9)  # by `MemoryPurging` alone
    engine, other = make_engine(data), make_engine(data)
    engine.rebuild_index("hall")
    frame = engine.list_frames("hall").items[0].frame_id
    engine.query_frame("hall", frame, Query(stages=("retrieve",)))

    def mapped():
        gc.collect()
        index = str(data / "index")
        return [line for line in Path("/proc/self/maps").read_text().splitlines() if index in line]

    assert mapped()
    engine.memory_purging.run()
    assert mapped()  # it is there
    other.delete_map("hall")
    assert mapped()
    engine.memory_purging.run()
    assert mapped() == []


def test_models_are_listed_with_the_maps_that_may_be_named(make_engine, small_model):
    engine = make_engine()
    for name in ("hall", "shop"):
        engine.create_map(NewMap(name=name, model="depth"))
    engine.reencode("shop", small_model)
    found = {one.name: one for one in engine.catalogue.list_all(lambda name: name != "hall")}
    assert list(found) == [*PRESETS, "small"]
    depth, small = read_model("depth"), found["small"]
    assert found["depth"].maps == ["shop"]
    assert (small.maps, small.preset, found["depth"].preset) == (["shop"], False, True)
    assert found["paper"].maps == []
    assert (small.components, small.levels, small.signature_bytes) == (8, 2, 25 * 8 * 2)
    assert small.unrelated_distance == 1000.0
    assert small.parameters["segmentation"]["n_patches"] == 150
    assert small.provenance == {"made": "by a test"}
    assert found["depth"].model_id == depth.id
    for name in ("small", "/etc/passwd", "", small_model.id[:12]):
        with pytest.raises(InvalidRequest, match="There is no model"):
            engine.catalogue.find(name)
    for name in (small_model.id, small_model.label):
        assert engine.catalogue.find(name).id == small_model.id
        assert engine.catalogue.find(name, "shop".__eq__).id == small_model.id
        with pytest.raises(InvalidRequest, match="There is no model"):  # another's alone
            engine.catalogue.find(name, "hall".__eq__)
    assert engine.catalogue.find(depth.label, lambda _: False).id == depth.id
    with pytest.raises(Conflict, match="is already switching to"):
        engine.reencode("shop", engine.catalogue.find("paper"))


@pytest.mark.parametrize("spread", [0.3, 1.0, 2.0])
def test_quantiles_of_several_processes_are_those_of_all_times(spread):
    rng = np.random.default_rng(3)
    times = np.exp(rng.normal(np.log(0.08), spread, 5000)).clip(FIRST_S, 600)
    processes = [Latencies() for _ in range(3)]
    for i, one in enumerate(times):
        processes[i % 3].add(float(one))
    together = merged([one.as_json() for one in processes])
    assert sum(together.values()) == 5000
    for share in (0.5, 0.95, 0.99, 1.0):
        exact = float(np.quantile(times, share, method="inverted_cdf"))
        found = quantile(together, share)
        assert found is not None
        # the middle of a bin is at most half a bin from whatever is in it
        assert abs(np.log(found / exact)) <= np.log(STEP) / 2 + 1e-9


def test_bins_meet_without_a_gap():
    for place in range(1, BINS - 1):
        lower = FIRST_S * STEP**place
        assert (bin_of(lower * 1.0001), bin_of(lower * 0.9999)) == (place, place - 1)
    assert (bin_of(0.0), bin_of(-1.0), bin_of(1e9)) == (0, 0, BINS - 1)


def test_of_nothing_there_is_no_quantile():
    assert quantile({}, 0.5) is None
    assert merged([]) == {}
    one = Latencies()
    one.add(0.25)
    for share in (0.0, 0.5, 1.0):  # of one answer it is that answer
        found = quantile(merged([one.as_json()]), share)
        assert found is not None
        assert 0.9 < found / 0.25 < 1.1
