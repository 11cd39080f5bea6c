"""Tests of `python -m benchmarks.soak` at reduced size, and of its detection of losses."""

import os
from collections import Counter
from contextlib import closing
from dataclasses import replace

import pytest

from benchmarks.postgres import NoServer, binaries
from benchmarks.soak import audit, faults
from benchmarks.soak.audit import AuditCounts, check, count_separated
from benchmarks.soak.failover_client import FailoverClient, RequestLog
from benchmarks.soak.faults import CUT_OFF, FROZEN, FULL, PRIMARY
from benchmarks.soak.lock_samples import LockShares
from benchmarks.soak.operations import call_as_everybody
from benchmarks.soak.plan import Plan
from benchmarks.soak.recordings import walks
from benchmarks.soak.robots import Acknowledged, Ledger, Listener
from benchmarks.soak.run import SoakFigures, drive
from benchmarks.waiting import PATIENCE_S
from sceneprint.store import open_store
from sceneprint.store.tables import audit as audit_table
from sceneprint_client import Client

#: At reduced size, on either store.
SMALL = Plan(
    "sqlite", {"kill": 3}, seconds=6, robots=2, rate=2, readers=1, seed=1, workers=1,
    most_turn_ms=1e4, most_query_ms=1e3 * PATIENCE_S,  # machines of tests are busy
)  # fmt: skip
#: All kinds of faults of servers at once.
HARD = replace(
    SMALL, store="postgresql",
    faults={"kill": 1, "failover": 1, "partition": 1, "freeze": 1, "offline-hour": 5},
    robots=6, rate=1, retention_s=2.0, objects=True, delays=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def recording(building):
    return building / "room-0"


@pytest.fixture(scope="module")
def shots(recording):
    return [shot for walk in walks(recording, 4, 6) for shot in walk]


@pytest.fixture
def soon(monkeypatch):
    """Restart killed parts at once, and compare few frames."""
    monkeypatch.setattr(faults, "AWAY_S", (0.0, 0.0))
    monkeypatch.setattr(faults, "UNNOTICED_S", 0.2)
    monkeypatch.setattr(audit, "COMPARED", 4)


def assert_sound(figures):
    """What is counted is what a run without a loss has."""
    n = figures.found.acknowledged
    looked_up = figures.found.looked_up
    assert (figures.faults, figures.found.wrong, figures.exceeded) == ([], [], [])
    assert figures.found == AuditCounts(
        acknowledged=n, indexed=n - figures.found.aged, aged=figures.found.aged,
        looked_up=looked_up, found=looked_up, searches=figures.found.searches,
    )  # fmt: skip
    assert figures.sound
    assert n > 24  # more than the frames that are there from the beginning
    assert 0 < looked_up <= n
    assert figures.found.searches > 4


@pytest.mark.thorough
@pytest.mark.usefixtures("soon")
def test_kills_and_a_full_disk_lose_nothing(tmp_path, recording, monkeypatch):
    monkeypatch.setattr(faults, "FULL_S", 2.0)
    full = int(os.geteuid() == 0)  # who may mount a disk
    report = drive(tmp_path, replace(SMALL, data=recording, faults={"kill": 3, "full-disk": full}))
    assert_sound(report)
    assert (report.kills.total(), report.kills[FULL]) == (3 + full, full)
    assert report.deleted > 0


@pytest.mark.thorough
@pytest.mark.usefixtures("soon")
def test_a_fleet_loses_nothing_whatever_becomes_of_it(tmp_path, recording, monkeypatch):
    try:
        binaries()
    except NoServer as error:
        pytest.skip(str(error))
    monkeypatch.setattr(faults, "CUT_OFF_S", 6.0)
    report = drive(tmp_path, replace(HARD, data=recording))
    assert_sound(report)
    assert (report.kills[CUT_OFF], report.kills[FROZEN], report.spooled) == (1, 1, 5)
    assert report.kills[PRIMARY] == 1
    [promotion] = report.promotions
    assert promotion.unreceived == frozenset()
    assert 0 < report.locks.one_map < report.locks.seconds


@pytest.mark.thorough
def test_every_operation_answers_as_declared(tmp_path, shots):
    report = call_as_everybody(tmp_path, shots[:2], examples=2, phases="fuzzing")
    assert [service.report[-2000:] for service in report if not service.sound] == []
    assert len(report) == 5
    assert all(service.requests > service.operations >= 40 for service in report[:4])


def test_what_is_lost_is_seen(tmp_path, shots, monkeypatch):
    monkeypatch.setattr(audit, "EVENTS_S", 0.0)
    with Client.embedded(tmp_path) as client:
        client.create_map("fleet", model="depth")
        added = [client.upload("fleet", s.png, s.meta, wait_s=PATIENCE_S) for s in shots[:5]]
        waiting = client.upload("fleet", shots[5].png, shots[5].meta)
        kept = [
            Acknowledged(one.frame_id, "fleet", shot, 0.0)
            for one, shot in zip([*added, waiting], shots, strict=False)
        ]
        client.delete_frame("fleet", added[1].frame_id)
        wrong = replace(kept[2], shot=shots[3])
        # the second is gone, the third was acknowledged as the fourth, nobody knows of the fourth,
        # and the fifth was deleted
        ledger = Ledger(
            frames=[kept[0], kept[1], wrong, kept[4], kept[5]], deleted={kept[4].frame_id: (0, 1)}
        )
        client_of_nobody = FailoverClient(["http://127.0.0.1:1"], RequestLog())
        listener = Listener("fleet", "secret", client_of_nobody, RequestLog())
        listener.heard["frame.received", kept[0].frame_id] = 2
        result = check(ledger, [kept[0].frame_id], [client, client], [listener])
        ages = {"fleet": 10.0}
        for at, missing in ((9.0, {kept[1].frame_id}), (10.0, set[str]())):
            listener.retired = {kept[1].frame_id: at}  # its robot began to send it at 0
            aged = check(ledger, [kept[0].frame_id], [client, client], [listener], ages)
            assert (aged.missing, aged.aged, aged.looked_up) == (missing, 1 - len(missing), 0)
    assert result.wrong
    assert replace(result, wrong=[]) == AuditCounts(
        acknowledged=4, indexed=2, looked_up=2, found=1, missing={kept[1].frame_id}, returned=1,
        stuck=1, strangers=1, unheard=2, heard_twice=1, searches=2,
    )  # fmt: skip
    with (
        closing(open_store(f"sqlite:///{tmp_path}/sceneprint.db", tmp_path / "blobs")) as store,
        store.database.write() as connection,
    ):
        before = count_separated(connection, ["fleet"])
        connection.execute(audit_table.delete().where(audit_table.c.target == kept[0].frame_id))
        assert (before, count_separated(connection, ["fleet"])) == (0, 1)


@pytest.mark.parametrize(
    ("counts", "changed", "sound"),
    [
        ({"indexed": 7, "looked_up": 5, "found": 5, "aged": 2}, {}, True),
        ({"indexed": 7, "looked_up": 5, "found": 5, "aged": 1}, {}, False),
        ({"wrong": ["w"]}, {}, False),
        ({}, {"waits_ms": {"query": (90.0, 25_001.0)}}, False),
        ({}, {"memory": (2 << 30, 1)}, False),
        ({}, {"locks": LockShares(5_000, 100.0, 0.9, 0.9)}, False),  # 100 ms a frame
        ({}, {"faults": ["upload: 500"]}, False),
    ],
)
def test_what_is_wrong_fails(counts, changed, sound):
    counts = {"acknowledged": 9, "indexed": 9, "looked_up": 9, "found": 9} | counts
    figures = {
        "plan": Plan(), "kills": Counter(), "outages": {}, "promotions": [], "seconds": 99.0,
        "waits_ms": {"query": (90.0, 1200.0)}, "memory": (200_000_000, 100_000_000),
        "locks": LockShares(5_000, 100.0, 0.09, 0.9),
    }  # fmt: skip
    assert SoakFigures(found=AuditCounts(**counts), **figures | changed).sound is sound
