"""`make fleet` at reduced size, with real processes; and that it would see what is wrong."""

from __future__ import annotations

import random
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet import audit, failover_client, faults
from benchmarks.fleet.__main__ import marks, table
from benchmarks.fleet.audit import Found, check
from benchmarks.fleet.failover_client import FailoverClient, RequestLog, Unreachable, Wait
from benchmarks.fleet.faults import CUT_OFF, FROZEN, PRIMARY, Kill, Promotion, schedule
from benchmarks.fleet.lock_samples import LockSampler, LockShares
from benchmarks.fleet.paper import Costs, paper
from benchmarks.fleet.postgres import NoServer, binaries
from benchmarks.fleet.qdrant_search import Compared, Searched
from benchmarks.fleet.qdrant_search import measure as measure_qdrant
from benchmarks.fleet.qdrant_search import table as qdrant_table
from benchmarks.fleet.recordings import GRIDS, walks
from benchmarks.fleet.resource_usage import Work
from benchmarks.fleet.robots import Kept, Listener
from benchmarks.fleet.run import FleetFigures, Plan, drive, outages
from benchmarks.pages import put_between
from benchmarks.soak.load import free_port
from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.store import open_store
from sceneprint.types import DepthFrame
from sceneprint_client import Client

#: At reduced size.
SMALL = Plan(seconds=6, robots=2, rate=2, kills=2, promotions=1, seed=1, workers=1)
#: The same with robots that sign their frames, one that is offline, and all kinds of faults.
HARD = replace(
    SMALL, robots=6, rate=1, kills=1, partitions=1, offline=5, retention_s=2.0,
    signed=True, objects=True, delays=True,
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


@pytest.mark.parametrize(("retention_s", "shared"), [(None, [0, 1, 2, 4, 5, 6]), (9.0, [3, 7])])
def test_robots_share_a_map_or_have_one_of_few(
    retention_s: float | None, shared: list[int]
) -> None:
    plan = Plan(robots=1000, retention_s=retention_s)
    maps = [plan.map_of(i) for i in range(1000)]
    assert [i for i in range(8) if maps[i] == "fleet"] == shared
    assert 19 <= len(set(maps)) <= 58
    assert maps[5 if retention_s else 7] == ("fleet-5" if retention_s else "fleet-7")


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


@pytest.mark.parametrize(
    ("waits", "told"),
    [
        ([], [0.0, 0.0, 0.0]),
        ([Wait("upload", 9.0, 12.0)], [2.0, 0.0, 0.0]),  # from the kill on
        ([Wait("upload", 11.0, 12.5), Wait("query", 11.5, 12.0)], [1.5, 0.0, 0.0]),
        ([Wait("upload", 9.0, 22.0)], [12.0, 0.0, 0.0]),  # not back at the second
        ([Wait("upload", 31.0, 34.0), Wait("upload", 19.0, 21.0)], [0.0, 1.0, 3.0]),
        ([Wait("upload", 1.0, 2.0)], [0.0, 0.0, 0.0]),  # before anything was killed
    ],
)
def test_a_wait_is_put_down_to_one_kill(waits: list[Wait], told: list[float]) -> None:
    kills = [Kill("service", 10.0), Kill(PRIMARY, 20.0), Kill("service", 30.0)]
    first, second, third = told
    assert outages(kills, waits) == {"service": [first, third], PRIMARY: [second]}


@contextmanager
def answering(*statuses: int) -> Iterator[str]:
    """A server that gives these answers, one after the other, and its address."""
    left = list(statuses)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(left.pop(0))
            self.send_header("Retry-After", "0")
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


def test_a_robot_asks_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failover_client, "PAUSE_S", 0.01)
    log = RequestLog()
    with answering(503, 200, 500, 404) as url:
        dead = f"http://127.0.0.1:{free_port()}"
        with FailoverClient([dead, url], log) as asked:
            assert asked.ask("upload", "GET", "/").status_code == 200
            assert asked.ask("query", "GET", "/").status_code == 404
    assert log.repeated == 3 + 2  # dead, 503, dead, 200; 500, dead, 404
    assert [wait.kind for wait in log.waits] == ["upload", "query"]
    assert [line[:10] for line in log.faults] == ["query: 500"]  # to be retried, and a fault


def test_a_robot_gives_up_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failover_client, "PAUSE_S", 0.01)
    monkeypatch.setattr(failover_client, "PATIENCE_S", 0.1)
    nobody = [f"http://127.0.0.1:{free_port()}"]
    with FailoverClient(nobody, RequestLog()) as asked, pytest.raises(Unreachable):
        asked.ask("upload", "GET", "/")


def test_what_is_not_there_is_seen(
    tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "EVENTS_S", 0.0)
    [walk] = walks(recording, 1, 5)
    with Client.embedded(tmp_path) as client:
        client.create_map("fleet", model="depth")
        added = [client.upload("fleet", one.png, one.meta, wait_s=60) for one in walk[:4]]
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
        ({}, {"promotions": [Promotion(None, 1.0, 2.0, {}, frozenset(), frozenset())]}, True),
        ({}, {"promotions": [Promotion(None, 1.0, 2.0, {}, frozenset(), frozenset("a"))]}, False),
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


def test_the_page_is_rewritten_between_its_marks(tmp_path: Path) -> None:
    page, (begin, end) = tmp_path / "page.md", marks(Plan())
    page.write_text(f"before\n{begin}\nold\n{end}\nafter\n")
    put_between(page, begin, end, table(figures(Found(acknowledged=9, indexed=9, found=9))))
    text = page.read_text()
    assert text.startswith(f"before\n{begin}\n### 8 robots for 120 s, a synchronous standby\n")
    assert text.endswith(f"{end}\nafter\n")
    assert "SIGKILL of 1 of primary, 2 of service." in text
    assert "| **lost** | **0** |" in text
    assert "| query: median, p99 | 90, 1,200 ms |" in text
    assert "| of a frame, all writers wait for one; those of its map do | 10.0, 100.0 ms |" in text
    assert "of a worker's | 200, 100 MB |" in text
    assert "| service | 0.0, 1.2 |" in text
    assert "each service answered 0.5, 2.0 s after that" in text
    assert "came back" not in text


def test_a_crowd_tells_what_it_met_with() -> None:
    plan = Plan(robots=1000, signed=True, partitions=2, offline=360, retention_s=40.0)
    found = Found(acknowledged=9, indexed=6, looked_for=5, found=5, aged=3)
    back = [Promotion(None, 1.0, 2.0, {"a": 0.5}, frozenset(), frozenset({"a", "b"}))]
    kills = Counter({"service": 2, PRIMARY: 1, CUT_OFF: 2})
    more = {"kills": kills, "promotions": back, "spooled": 360, "spooled_twice": 4}
    told = "\n".join(table(figures(found, plan=plan, **more)))
    assert "1,000 robots send 1 frames a second each, and send their signatures along" in told
    assert "A host was cut off twice from its servers for 12 s." in told
    assert "SIGKILL of 1 of primary, 2 of service." in told
    assert "keep a frame for 40 s" in told
    assert "| deleted as they were too old, and told to have been | 3 |" in told
    assert (
        "| frames spooled by the robot that was offline, sent again, doubled | 360, 4, 0 |" in told
    )
    assert "frames that came to it: **2**." in told
    assert marks(plan)[0] == "<!-- fleet-crowd:begin -->"


def test_what_is_on_paper_is_multiplied_right() -> None:
    costs = Costs(
        model="depth", signature_bytes=12_800, frames=50,
        upload=Work(30.0, 12.0, 2.0, 3.0, (1.0, 0.0), 3_000.0, {"PUT": 1.0}),
        sign=Work(90.0, 60.0, 3.0, 5.0, (1.0, 1.0), 27_000.0, {"GET": 1.0, "PUT": 1.0}),
        query=Work(200.0, 180.0, 1.0, 0.0, (0.0, 0.0), 0.0, {"HEAD": 1.0, "POST": 0.5}),
        tables={"signatures": 14_000.0, "frames": 2_000.0}, blobs=(76_000.0, 174_000.0),
        commit_ms={"alone": (4.0, 9.0)}, linked=(2_000.0, 340.0, 560.0), memory={"worker": 10**8},
    )  # fmt: skip
    lines = paper(costs)
    more = lines.index("### On paper: 100,000,000 frames in 50 maps, `depth`")
    told, tenfold = (
        {line.split(" | ")[0]: line.split(" | ")[-1] for line in some}
        for some in (lines[:more], lines[more:])
    )
    assert told["| processors for signing"] == "10 |"  # 100 a second x 60 ms / 0.6
    assert told["| processors for queries"] == "30 |"
    assert told["| processors of the database"] == "1.0 |"
    assert told["| a map's turn is full at"] == "125 frames a second |"
    assert (
        told["| log of the database (WAL), and to each standby"]
        == "3.0 MB a second, 259 GB a day |"
    )
    # 100 a second x 30 days = 259 million, x 2.5 x 5 and x 2 x 0.4 dollars a million
    assert told["| requests of objects that write"] == "$3,240 a month |"
    assert told["| that read"] == "$207 a month |"
    assert told["| rows of the database"] == "160 GB |"
    assert tenfold["| rows of the database"] == "1,600 GB |"
    assert told["| blobs"] == "2.5 TB |"
    assert tenfold["| keeping them"] == "$575 a month |"
    assert told["| vectors and their graph in the database, to be held in its memory"] == "9 GB |"
    assert told["| linking all of them anew, one processor"] == "1.4 h |"
    assert told["| of one that asks all maps"] == "160 MB, 144.1 GB |"  # 12,800 + 1,600 + 8
    assert tenfold["| reading all blobs, at 100 MB/s"] == "69 h |"


def test_figures_of_qdrant_beside_our_own_search() -> None:
    own, other = Searched(0.0, 1234.5, 14.04, 0.0), Searched(12.34, 987.0, 58.06, 250_180.4)
    told = qdrant_table([Compared("paper", 3000, 125_000, (own, other), 4.14)])
    assert told[0] == "| | 3,000 x 125,000 B, own | 3,000 x 125,000 B, Qdrant |"
    assert told[2:6] == [
        "| publish the index, CPU s | none | 12.3 |",
        "| first query after a start, CPU ms | 1,234 | 987 |",
        "| later queries, median, CPU ms | 14.0 | 58.1 |",
        "| index on the disk, bytes a frame | 0 | 250,180 |",
    ]
    assert "4.1 times as long by the clock" in told[7]


@pytest.mark.thorough
def test_our_own_search_and_qdrant_are_measured(tmp_path: Path) -> None:
    """It ends with an error where their answers differ."""
    told = measure_qdrant("depth", 600, tmp_path)
    assert [one.publish_s > 0 for one in told.nodes] == [True, True]
    assert told.nodes[1].bytes_per_frame > told.nodes[0].bytes_per_frame > told.signature_bytes
    assert told.ratio > 0
