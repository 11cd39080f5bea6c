"""`make fleet` at reduced size, with real processes; and that it would see what is wrong."""

from __future__ import annotations

import random
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet import audit, faults
from benchmarks.fleet.audit import Found, check
from benchmarks.fleet.failover_client import FailoverClient, RequestLog
from benchmarks.fleet.faults import CUT_OFF, FROZEN, PRIMARY, Promotion, schedule
from benchmarks.fleet.lock_samples import LockSampler, LockShares
from benchmarks.fleet.postgres import NoServer, binaries
from benchmarks.fleet.recordings import GRIDS, walks
from benchmarks.fleet.robots import Kept, Listener
from benchmarks.fleet.run import FleetFigures, Plan, drive
from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.store import open_store
from sceneprint.types import DepthFrame
from sceneprint_client import Client

#: At reduced size.
SMALL = Plan(seconds=6, robots=2, rate=2, kills=2, promotions=1, seed=1, workers=1)
#: The same with a robot that is offline, and all kinds of faults.
HARD = replace(
    SMALL, robots=6, rate=1, kills=1, partitions=1, offline=5, retention_s=2.0,
    objects=True, delays=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def recording(
    room_frames: tuple[DepthFrame, ...], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Six frames of two rooms as one sequence, which is enough for walks of many grids."""
    folder = tmp_path_factory.mktemp("recording") / "seq-01"
    folder.mkdir()
    write_intrinsics(folder, Camera(room_frames[0].intrinsics, 1000.0, along_ray=False))
    for number, frame in enumerate(room_frames):
        assert frame.pose is not None
        write_depth_png(folder / f"frame-{number:06d}.depth.png", frame.depth, 1000.0)
        write_pose(folder / f"frame-{number:06d}.pose.txt", frame.pose)
    return folder.parent


def begin_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bring killed parts back at once, where there is a PostgreSQL to run."""
    try:
        binaries()
    except NoServer as error:
        pytest.skip(str(error))
    monkeypatch.setattr(faults, "AWAY_S", (0.0, 0.0))
    monkeypatch.setattr(faults, "UNNOTICED_S", 0.2)


@pytest.mark.thorough
def test_a_fleet_loses_nothing(
    tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin_soon(monkeypatch)
    monkeypatch.setattr(audit, "COMPARED", 4)
    plan = Plan(**vars(SMALL) | {"data": recording})
    found = drive(tmp_path, plan)
    assert (found.kills["service"], found.kills[PRIMARY], found.kills.total()) == (1, 1, 3)
    assert (found.lost, found.window, found.damaged, found.faults) == (0, 0, 0, [])
    assert found.found == Found(
        acknowledged=found.found.acknowledged, indexed=found.found.acknowledged,
        looked_for=found.found.acknowledged, found=found.found.acknowledged,
    )  # fmt: skip
    assert found.found.acknowledged > 6
    assert found.sound
    [promotion] = found.promotions
    assert len(promotion.resumed) == 2
    assert max(promotion.resumed.values()) < 60  # the claim is 10 s; machines of tests are busy
    assert promotion.unreceived == frozenset()


@pytest.mark.thorough
def test_a_fleet_loses_nothing_whatever_becomes_of_it(
    tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin_soon(monkeypatch)
    monkeypatch.setattr(faults, "CUT_OFF_S", 6.0)
    found = drive(tmp_path, replace(HARD, data=recording))
    assert (found.lost, found.window, found.damaged, found.faults) == (0, 0, 0, [])
    assert found.kills[CUT_OFF] == 1
    assert found.found.looked_for == found.found.found > 5  # of the spool, and of the shared map
    assert found.found.acknowledged >= 11
    assert found.locks.samples > 50
    assert 0 < found.locks.one_map < found.locks.seconds
    assert found.sound, found.exceeded


def test_the_schedule_is_that_of_its_seed() -> None:
    due = schedule(100, 20, 2, random.Random(3))
    assert due == schedule(100, 20, 2, random.Random(3)) != schedule(100, 20, 2, random.Random(4))
    assert due == sorted(due)
    assert all(10 <= at <= 90 for at, _ in due)
    primaries = [at for at, victim in due if victim == PRIMARY]
    assert len(due) == 22
    assert [at < 50 for at in primaries] == [True, False]
    more = schedule(100, 20, 2, random.Random(3), freezes=1, partitions=3)
    assert Counter(victim for _, victim in more)[CUT_OFF] == 3
    assert [one for one in more if one[1] not in (CUT_OFF, FROZEN)] == due


def test_walks_have_nothing_in_common(recording: Path) -> None:
    found = walks(recording, 3, 24)
    assert [len(one) for one in found] == [24, 24, 24]
    assert len({shot.png for walk in found for shot in walk}) == 72
    assert {shot.meta.intrinsics.width for shot in found[0] if shot.meta.intrinsics} == {160}
    short = walks(recording, 30, 3)  # two robots share the frames of a grid
    assert len({shot.png for walk in short for shot in walk}) == 90
    with pytest.raises(DatasetError, match=f"fewer than 850 frames in {GRIDS} grids"):
        walks(recording, 1, 850)


def test_locks_are_sampled(postgres_url: str, tmp_path: Path) -> None:
    with closing(open_store(postgres_url, tmp_path)) as store:
        with store.database.write():  # everybody waits
            everybody = sampled(postgres_url)
        with store.database.write(map_number=7), store.database.write(map_number=8):
            two_maps = sampled(postgres_url)
        nobody = sampled(postgres_url)
    assert everybody.everybody == everybody.seconds > 0 == everybody.one_map
    assert two_maps.one_map == pytest.approx(2 * two_maps.seconds)
    assert two_maps.everybody == nobody.everybody == nobody.one_map == 0 < nobody.seconds


def sampled(url: str) -> LockShares:
    """A few samples of the locks of a server."""
    sampler = LockSampler(lambda: url.replace("+psycopg", ""))
    sampler.start()
    while sampler.shares.samples < 5 and sampler.is_alive():
        pass
    sampler.stop()
    return sampler.shares


def test_what_is_not_there_is_seen(
    tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "EVENTS_S", 0.0)
    [walk] = walks(recording, 1, 5)
    with Client.embedded(tmp_path) as client:
        client.create_map("fleet", model="depth")
        added = [client.upload("fleet", one.png, one.meta, wait_s=PATIENCE_S) for one in walk[:4]]
        waiting = client.upload("fleet", walk[4].png, walk[4].meta)
        kept = [
            Kept(one.frame_id, "fleet", shot, 0.0)
            for one, shot in zip([*added, waiting], walk, strict=True)
        ]
        client.delete_frame("fleet", added[1].frame_id)
        # the second is gone, the third was told of as the fourth, and nobody of the fourth
        told = [kept[0], kept[1], Kept(kept[2].frame_id, "fleet", walk[3], 0.0), kept[4]]
        nobody = FailoverClient(["http://127.0.0.1:1"], RequestLog())
        listener = Listener("fleet", "secret", nobody)
        listener.heard["frame.received", kept[0].frame_id] = 2
        found = check(told, [client, client], [listener])
        ages = {"fleet": 10.0}
        for at, missing in ((9.0, {kept[1].frame_id}), (10.0, set[str]())):
            listener.retired = {kept[1].frame_id: at}  # its robot began to send it at 0
            aged = check(told, [client, client], [listener], ages)
            assert (aged.missing, aged.aged, aged.looked_for) == (missing, 1 - len(missing), 0)
    assert found == Found(
        acknowledged=4, indexed=2, looked_for=2, found=1, missing={kept[1].frame_id}, stuck=1,
        strangers=1, unheard=2, heard_twice=1,
    )  # fmt: skip


def figures(found: Found, **changed: Any) -> FleetFigures:
    same: dict[str, Any] = {
        "plan": Plan(), "kills": Counter(service=2, primary=1),
        "outages": {"service": [1.25, 0.0], PRIMARY: [3.0]},
        "promotions": [Promotion(None, 10.0, 11.5, {"a": 0.5, "b": 2.0}, frozenset())],
        "waits_ms": {"query": (90.0, 1200.0)},
        "memory": (200_000_000, 100_000_000),
        "answers": Counter(found=3), "repeated": 4, "faults": [], "damaged": 0, "leftovers": 0,
        "lost": 0, "window": 0, "seconds": 99.0, "spooled": 0, "spooled_twice": 0,
        "locks": LockShares(5_000, 100.0, 0.09, 0.9),
    }  # fmt: skip
    return FleetFigures(found=found, **same | changed)


@pytest.mark.parametrize(
    ("found", "changed", "sound"),
    [
        ({}, {}, True),
        ({}, {"leftovers": 3}, True),
        ({"indexed": 8, "looked_for": 8, "found": 8, "stated": 1}, {}, True),
        ({"indexed": 7, "looked_for": 5, "found": 5, "aged": 2}, {}, True),
        ({"indexed": 7, "looked_for": 5, "found": 5, "aged": 1}, {}, False),
        ({}, {"locks": LockShares(5_000, 100.0, 0.9, 0.9)}, False),  # 100 ms a frame
        # 12 s are a host's that was cut off, and 0.225 s those of 9 frames
        ({}, {"plan": Plan(partitions=1), "locks": LockShares(5_000, 99.0, 12.2, 0.9)}, True),
        ({}, {"plan": Plan(partitions=1), "locks": LockShares(5_000, 99.0, 12.3, 0.9)}, False),
        ({}, {"waits_ms": {"query": (90.0, 25_001.0)}}, False),
        ({}, {"memory": (2 << 30, 1)}, False),
        ({}, {"locks": LockShares(5_000, 59.0, 0.0, 0.0)}, False),  # half of 120 s is too few
        ({}, {"plan": Plan(offline=9), "spooled": 9}, True),
        ({}, {"plan": Plan(offline=9), "spooled": 8}, False),
        ({"acknowledged": 0, "indexed": 0, "found": 0}, {}, False),
        ({"found": 8}, {}, False),
        ({"indexed": 8, "looked_for": 8, "found": 8}, {}, False),
        ({"stuck": 1}, {}, False),
        ({"doubled": 1}, {}, False),
        ({"strangers": 1}, {}, False),
        ({"unheard": 1}, {}, False),
        ({"heard_twice": 1}, {}, False),
        ({"disagreeing": 1}, {}, False),
        ({}, {"lost": 1}, False),
        ({}, {"damaged": 1}, False),
        ({}, {"faults": ["upload: 500"]}, False),
        # what an asynchronous standby had not received is missing, and nothing else
        ({"indexed": 8, "looked_for": 8, "found": 8, "missing": {"a"}}, {"window": 1}, True),
        ({"indexed": 8, "looked_for": 8, "found": 8, "missing": {"a"}}, {"window": 2}, False),
    ],
)
def test_what_is_wrong_fails(found: dict[str, Any], changed: dict[str, Any], sound: bool) -> None:
    whole: dict[str, Any] = {"acknowledged": 9, "indexed": 9, "looked_for": 9, "found": 9}
    assert figures(Found(**whole | found), **changed).sound is sound
