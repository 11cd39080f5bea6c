"""Tests of the spool of an offline robot, which never loses or duplicates frames after a kill."""

import json
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.depth_file import encode_png
from sceneprint_client import Client, Spool, meta_of
from sceneprint_client.api import CameraIntrinsics, FrameMeta
from sceneprint_client.api.base import GivenPose
from sceneprint_client.errors import (
    InvalidIntrinsics,
    InvalidRequest,
    RateLimited,
    UnknownMap,
    UnreadableFrame,
    UnusableStore,
)
from sceneprint_client.spool import SpoolPlace, separation

START = datetime(2026, 11, 26, 9, 0, tzinfo=UTC)
CAMERA = CameraIntrinsics(width=16, height=12, fx=14, fy=14, cx=7.5, cy=5.5)
#: A frame of these is charged two pages.
CHARGE = 2 * 4096


def meta(x=None, seconds=0.0, **more):
    pose = None
    if x is not None:
        matrix = np.eye(4)
        matrix[0, 3] = x
        pose = GivenPose(matrix=matrix.tolist(), parent_frame="hall")
    return FrameMeta(
        intrinsics=CAMERA, captured_at=START + timedelta(seconds=seconds), pose=pose,
        **({"session": "drive"} | more),
    )  # fmt: skip


def depth(number):
    """A small depth image that no other number has, millimetres."""
    image = np.full((12, 16), 2000, np.uint16)
    image[0, :2] = 1000 + number % 1000, 1000 + number // 1000
    return image


def large(number, fields):
    lens = CAMERA.model_copy(update={"width": 64, "height": 48})
    return np.tile(depth(number), (4, 4)), fields.model_copy(update={"intrinsics": lens})


def broken(number, fields):
    """None, of 150 kB, which a service refuses."""
    return f"none, {number}".encode().ljust(150_000), fields


def names(path):
    with closing(sqlite3.connect(path)) as database, database:
        rows = database.execute("SELECT meta FROM frames WHERE reason IS NULL ORDER BY id")
        return [json.loads(text)["name"] for (text,) in rows]


def test_what_its_robot_can_still_mend_is_not_kept(tmp_path):
    png = encode_png(depth(1))
    with Spool(tmp_path / "spool") as spool:
        with pytest.raises(UnreadableFrame, match="The frame is empty"):
            spool.add(b"", meta())
        with pytest.raises(InvalidIntrinsics, match="its intrinsics are missing"):
            spool.add(png, FrameMeta(robot="cart"))
        assert spool.status().waiting == 0
        assert spool.add(png, meta())


# What a full spool gives up.


def test_a_metre_thirty_degrees_and_a_minute_weigh_the_same():
    here, there = np.eye(4), np.eye(4)
    there[:3, :3] = [[np.sqrt(3) / 2, -0.5, 0], [0.5, np.sqrt(3) / 2, 0], [0, 0, 1]]  # 30 degrees
    there[:3, 3] = 0, 0.6, 0.8
    assert separation(SpoolPlace(0, here), SpoolPlace(60, there)) == pytest.approx(3.0)
    assert separation(SpoolPlace(30, here), SpoolPlace(0, here)) == pytest.approx(0.5)
    assert separation(SpoolPlace(0, here), SpoolPlace(90)) == pytest.approx(1.5)
    back = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert separation(SpoolPlace(0, here), SpoolPlace(0, back)) == pytest.approx(6.0)


def test_a_full_spool_gives_up_the_frame_nearest_to_its_neighbours(tmp_path):
    """Sums of the distances to the frames before and after, by hand."""
    path, contents = tmp_path / "spool", []
    with Spool(path, 5 * CHARGE) as spool:
        for number, x in enumerate((0, 1, 1.25, 3, 5, 7, 7.1, 9)):
            assert spool.add(depth(number), meta(x, name=f"{x:g}"))
            contents.append(" ".join(names(path)))
        now = spool.status()
    assert contents[4:] == [
        "0 1 1.25 3 5",
        "0 1.25 3 5 7",  # 1: 1 + 0.25; 1.25: 0.25 + 1.75; 3: 1.75 + 2
        "0 3 5 7 7.1",  # 1.25: 1.25 + 1.75; 3: 1.75 + 2; 5: 2 + 2
        "0 3 5 7.1 9",  # 3: 3 + 2; 5: 2 + 2; 7: 2 + 0.1
    ]
    assert (now.waiting, now.thinned, now.bytes) == (5, 3, 5 * CHARGE)


def test_without_poses_time_alone_decides_and_the_oldest_of_equals_goes(tmp_path):
    path, contents = tmp_path / "spool", []
    with Spool(path, 5 * CHARGE) as spool:
        for minute in range(7):
            spool.add(depth(minute), meta(seconds=60 * minute, name=f"{minute}"))
            contents.append(" ".join(names(path)))
    assert contents[5:] == ["0 2 3 4 5", "0 2 4 5 6"]  # all 2; then 2: 2 + 1, 3 and 4: 1 + 1


def test_runs_are_thinned_apart_and_their_ends_stay(tmp_path):
    """Where only ends are left, the oldest goes."""
    path, contents = tmp_path / "spool", []
    drives = (("a", 0), ("b", 0), ("a", 9), ("b", 0.1), ("a", 9.5), ("a", 20), ("b", 5), ("b", 6))
    with Spool(path, 5 * CHARGE) as spool:
        for number, (session, x) in enumerate(drives):
            spool.add(depth(number), meta(x, session=session, name=f"{session}{x:g}"))
            contents.append(" ".join(names(path)))
    assert contents[5:] == [
        "a0 b0 b0.1 a9.5 a20",  # a9: 9 + 0.5, and no other lies between two
        "a0 b0 b0.1 a20 b5",
        "a0 b0 a20 b5 b6",
    ]
    with Spool(tmp_path / "ends", 2 * CHARGE) as spool:
        for number in range(4):
            spool.add(depth(number), meta(0, session=f"{number}", name=f"{number}"))
    assert names(tmp_path / "ends") == ["2", "3"]


# What a spool takes.


def test_a_frame_is_there_once_and_survives(tmp_path):
    path = tmp_path / "spool"
    with Spool(path, 100 * CHARGE) as spool:
        assert spool.add(depth(1), meta(0))
        assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o600}
        assert not spool.add(depth(1), meta(0))
        assert spool.add(depth(1), meta(1))
        assert spool.add(depth(2), meta(0))
    with Spool(path) as spool:
        assert not spool.add(depth(2), meta(0))
        now = spool.status()
    assert (now.waiting, now.bytes, now.most_bytes) == (3, 3 * CHARGE, 100 * CHARGE)
    assert (now.uploaded, now.refused, now.thinned, now.oldest) == (0, 0, 0, START)


def test_what_a_spool_cannot_take_is_refused(tmp_path):
    with Spool(tmp_path / "spool", CHARGE) as spool:
        with pytest.raises(InvalidRequest, match=r"takes 16384 bytes.*limit of 8192"):
            spool.add(np.full((64, 64), 2000, np.uint16), meta())
        assert spool.add(depth(1), meta())
    with pytest.raises(InvalidRequest, match="above 0"):
        Spool(tmp_path / "spool", 0)
    other = tmp_path / "other.db"
    with closing(sqlite3.connect(other)) as database, database:
        database.execute("CREATE TABLE a (b)")
    with pytest.raises(UnusableStore, match="not a spool"):
        Spool(other)
    (tmp_path / "text").write_text("no database, " * 100)
    with pytest.raises(UnusableStore, match="file is not a database"):
        Spool(tmp_path / "text")
    with pytest.raises(UnusableStore, match="unable to open"):
        Spool(tmp_path / "nowhere" / "spool")


@contextmanager
def longest_file(size):
    """No file of this process grows beyond so many bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def fill(spool, kind):
    for number in range(1000):
        spool.add(*kind(number, meta(name=f"{number}")))


def test_a_full_disk_leaves_the_spool_as_it_was(tmp_path):
    path = tmp_path / "spool"
    with Spool(path) as spool:
        with longest_file(path.stat().st_size + 10 * CHARGE):
            with pytest.raises(UnusableStore, match=r"spool: .*nothing was changed"):
                fill(spool, large)
            count = spool.status().waiting
        assert 200 <= count <= 600  # also what was reserved for the journal is used for frames
        assert spool.add(depth(count), meta(name=f"{count}"))
    assert names(path) == [str(number) for number in range(count + 1)]
    with closing(sqlite3.connect(path)) as database, database:
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_a_full_disk_does_not_stop_uploads(remote, map_name, tmp_path):
    remote.create_map(map_name, model="depth")
    path = tmp_path / "spool"
    with Spool(path) as spool, longest_file(path.stat().st_size + 10 * CHARGE):
        with pytest.raises(UnusableStore):
            fill(spool, broken)
        count = spool.status().waiting
        assert count > 5
        report = spool.sync(remote, map_name)
        assert (report.received, report.refused, spool.status().waiting) == (0, count, 0)
        explained = [refusal for refusal in spool.refusals() if "none of" in refusal.reason]
        assert count / 2 < len(explained) <= count  # the disk has no room for all reasons


@pytest.mark.parametrize("refused", [False, True])
def test_a_frame_larger_than_the_journal_leaves_it_as_large(tmp_path, refused):
    """A full disk has no room for more."""
    journal = tmp_path / "spool-journal"
    with Spool(tmp_path / "spool") as spool:
        spool.add(b"x" * (3 << 20), meta(name="a"))
        before = journal.stat().st_size
        assert before < 3 << 20
        spool._record_results(*(([], {1: "a reason"}) if refused else ([1], {})))
        assert journal.stat().st_size == before
        assert [refusal.reason for refusal in spool.refusals()] == ["a reason"] * refused
        assert spool.status().uploaded == (not refused)
        assert (spool.retry_refused(), spool.status().waiting) == (refused, refused)
        assert journal.stat().st_size == before


# Uploads.


def test_nothing_is_sent_from_a_spool_that_cannot_be_written(remote, map_name, tmp_path):
    remote.create_map(map_name, model="depth")
    with Spool(tmp_path / "spool") as spool:
        spool.add(depth(1), meta())
        spool._database.close()  # and open it as who may only read it
        spool._database = sqlite3.connect(
            f"file:{tmp_path}/spool?mode=ro", uri=True, isolation_level=None
        )
        with pytest.raises(UnusableStore, match="readonly"):
            spool.sync(remote, map_name)
    assert list(remote.frames(map_name)) == []


def test_what_waits_is_uploaded_and_refusals_are_set_aside(remote, map_name, references, tmp_path):
    remote.create_map(map_name, model="depth")
    there = remote.upload(map_name, references[0], meta_of(references[0]))
    progress = []
    with Spool(tmp_path / "spool") as spool:
        for reference in references[:3]:
            spool.add(reference, meta_of(reference))
        spool.add(b"no depth image", meta(name="broken"))
        spool.add(depth(1), meta(0, name="last"))
        with pytest.raises(UnknownMap):
            spool.sync(remote, "nowhere")
        assert spool.status().waiting == 5
        report = spool.sync(remote, map_name, progress=lambda *one: progress.append(one))
        assert (report.received, report.there, report.refused) == (3, 1, 1)
        assert progress == [(5, 5)]
        [refusal] = spool.refusals()
        assert (refusal.name, refusal.captured_at) == ("broken", START)
        assert refusal.reason
        now = spool.status()
        assert (now.waiting, now.refused, now.uploaded, now.thinned) == (0, 1, 4, 0)
        assert now.bytes == CHARGE
        frames = list(remote.frames(map_name))
        assert frames[0].frame_id == there.frame_id
        assert [frame.name for frame in frames[1:]] == [
            *(reference.path.name for reference in references[1:3]), "last",
        ]  # fmt: skip
        assert frames[-1].captured_at == START
        assert frames[-1].pose is not None
        assert spool.retry_refused() == 1
        report = spool.sync(remote, map_name)
        assert (report.received, report.there, report.refused) == (0, 0, 1)


def test_refused_frames_go_before_any_that_waits(remote, map_name, tmp_path):
    remote.create_map(map_name, model="depth")
    path = tmp_path / "spool"
    with Spool(path, 2 * CHARGE) as spool:
        spool.add(b"no depth image", meta(name="broken"))
        spool.sync(remote, map_name)
        spool.add(depth(1), meta(name="1"))
        assert spool.status().refused == 1
        spool.add(depth(2), meta(name="2"))
        now = spool.status()
    assert (now.refused, now.discarded, now.thinned, names(path)) == (0, 1, 0, ["1", "2"])


def test_a_request_that_is_too_large_is_halved(remote, map_name, tmp_path):
    """The service of these tests takes 2 MiB; the third frame alone is larger."""
    remote.create_map(map_name, model="depth")
    sizes = {"a": 600, "b": 600, "c": 1100, "d": 600}
    with Spool(tmp_path / "spool") as spool:
        for number, (name, side) in enumerate(sizes.items()):
            lens = CAMERA.model_copy(update=dict.fromkeys(("width", "height", "fx", "fy"), side))
            image = np.full((side, side), 2000 + number, np.uint16)
            fields = meta(number, name=name).model_copy(update={"intrinsics": lens})
            spool.add(image, fields)
        report = spool.sync(remote, map_name)
        [refusal] = spool.refusals()
    assert (report.received, report.refused) == (3, 1)
    assert [frame.name for frame in remote.frames(map_name)] == ["a", "b", "d"]
    assert refusal.name == "c"
    assert "2097152" in refusal.reason


def test_a_service_that_asks_to_come_back_is_waited_for(scripted, monkeypatch, tmp_path):
    problem = {"type": "/problems/rate-limited", "title": "", "status": 429, "detail": "Later."}
    frame = {"frame_id": "f", "job_id": "j", "state": "received"}
    done = {"items": [{"status": 202, "frame": frame, "problem": None}]}
    busy = (429, {"Retry-After": "45"}, problem)  # longer than the client waits by itself
    server = scripted([busy, busy, (200, {}, done)])
    pauses = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    with Client(server.url) as client, Spool(tmp_path / "spool") as spool:
        spool.add(depth(1), meta())
        with pytest.raises(RateLimited, match="Later"):
            spool.sync(client, "hall", patience_s=44)
        assert (pauses, spool.status().waiting) == ([], 1)
        assert spool.sync(client, "hall", patience_s=46).received == 1
        assert (pauses, spool.status().waiting) == ([45.0], 0)
    assert len(server.requests) == 3


# Kills. A child adds frames or uploads them, and is killed; everything it said has to hold.

CHILD = """
import os, resource, signal, sys
sys.path[:0] = [sys.argv[1], os.path.join(sys.argv[1], "..", "..")]
from test_spool import Client, Spool, UnusableStore, drive_meta, large
what, path, *rest = sys.argv[2:]
with Spool(path) as spool:
    if what == "add":
        first, count, room = map(int, rest)
        if room:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            size = os.stat(path).st_size + room
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
        try:
            for number in range(first, count):
                spool.add(*large(number, drive_meta(number)))
                os.write(1, b"%d\\n" % number)
        except UnusableStore:
            os.write(1, b"full\\n")
    else:
        url, name, answers = rest
        with Client(url) as client:
            seen = []
            def counted(send):
                def sent(*given, **how):
                    items = send(*given, **how)
                    seen.append(items)
                    if len(seen) == int(answers):  # the service has them: the spool knows nothing
                        os.kill(os.getpid(), signal.SIGKILL)
                    return items
                return sent
            client.upload_batch = counted(client.upload_batch)
            spool.sync(client, name, progress=lambda *_: os.write(1, b"sent\\n"))
"""


def drive_meta(number):
    return meta(0.3 * number, number, name=f"{number}")


@contextmanager
def child(*arguments):
    """A process that works with the spool; killed in the end."""
    code = [sys.executable, "-c", CHILD, str(Path(__file__).parent), *map(str, arguments)]
    process = subprocess.Popen(code, stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def add_until(path, first, count, acknowledged, room=0):
    """What a child said that is killed once it has said so many lines."""
    with child("add", path, first, count, room) as process:
        said = []
        for line in process.stdout:
            said.append(line.decode().strip())
            if len(said) == acknowledged:
                process.kill()
    return said  # with what was in the pipe when it died


def test_a_spool_of_another_version_is_left_as_it_is(tmp_path):
    path = tmp_path / "spool"
    Spool(path).close()
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 2")
        database.commit()
    before = path.read_bytes()
    with pytest.raises(UnusableStore, match="another version"):
        Spool(path)
    assert path.read_bytes() == before


@pytest.mark.thorough
def test_an_hour_offline_through_kills_and_a_full_disk(tmp_path):
    """3,600 frames, a frame a second: the bound of an offline robot."""
    count, chance = 3600, random.Random(1)
    path, data = tmp_path / "spool", tmp_path / "data"
    with Client.embedded(data) as client:
        client.create_map("hall", model="depth")
    kills, full, first = 0, 0, 0
    while first < count:
        room = chance.randrange(1, 40) * CHARGE if path.exists() and chance.random() < 0.4 else 0
        said = add_until(path, first, count, count if room else chance.randrange(1, 150), room)
        full += said[-1:] == ["full"]
        kills += said[-1:] != ["full"]
        numbers = [int(text) for text in said if text != "full"]
        assert numbers == list(range(first, first + len(numbers)))
        first += len(numbers)  # one more may be durable: it is added again
    assert names(path) == [str(number) for number in range(count)]
    assert min(kills, full) >= 10
    serve = ["serve", "--port", "0", "--data", str(data), "--workers", "0"]
    with (tmp_path / "log").open("wb") as log:
        service = subprocess.Popen(
            [sys.executable, "-m", "sceneprint", *serve], stdout=subprocess.PIPE, stderr=log,
            env=dict(os.environ), start_new_session=True,
        )  # fmt: skip
    try:
        url = service.stdout.readline().decode().split()[-1]
        syncs = 0
        with Client(url) as client:
            while names(path):
                with child("sync", path, url, "hall", chance.randrange(1, 6)) as process:
                    if chance.random() < 0.5:  # somewhere in the middle of a request
                        try:
                            process.wait(timeout=chance.uniform(0.5, 4.0))
                        except subprocess.TimeoutExpired:
                            process.kill()
                    process.wait()
                syncs += process.returncode == -signal.SIGKILL
            frames = [frame.name for frame in client.frames("hall")]
            contents = {frame.content_id for frame in client.frames("hall")}
    finally:
        os.killpg(service.pid, signal.SIGTERM)
        service.communicate(timeout=PATIENCE_S)
    with Spool(path) as spool:
        now = spool.status()
    sys.stdout.write(f"{count} frames: {kills} kills, {full} full disks, {syncs} kills of sync\n")
    assert frames == [str(number) for number in range(count)]  # 0 lost, 0 doubled, in order
    assert len(contents) == count
    assert (now.waiting, now.refused, now.thinned, now.uploaded) == (0, 0, 0, count)
    assert syncs >= 10


def test_a_full_spool_reports_what_it_gave_up_of_a_drive(tmp_path):
    """Every frame added is either waiting or counted, and the file keeps its bound."""
    path, most = tmp_path / "spool", 50 * CHARGE
    with Spool(path, most) as spool:
        for number in range(200):
            spool.add(depth(number), drive_meta(number))
        now = spool.status()
    assert (now.waiting, now.thinned) == (50, 150)
    contents = [int(name) for name in names(path)]
    assert (contents[0], contents[-1]) == (0, 199)
    # even along the drive: no gap is more than twice the mean of 4 but for the ends
    assert max(np.diff(contents)) <= 8
    assert path.stat().st_size <= most + (2 << 20) + 20 * 4096  # what was reserved for the journal
