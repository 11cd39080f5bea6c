"""Qdrant's engine in a generation: the answers of the exact scan, whatever it rounds or loses."""

from __future__ import annotations

import json
import logging
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sceneprint.errors import DamagedIndex, UnusableStore
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.index import (
    Generation,
    SearchHits,
    Tail,
    generation_files,
    newest,
    publish,
    scrub,
    search,
)
from sceneprint.index.generation_files import CONTENTS, manifests, read_manifest
from sceneprint.index.qdrant_shard import Shard, can_hold, open_shard, write_shard
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]
METRICS: tuple[Metric, ...] = ("l1", "l2")
LENGTH = 64


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rows the engine was asked for, each time."""
    counts, real = list[int](), Shard.nearest

    def nearest(self: Shard, query: Bytes, count: int, free: Any) -> Any:
        counts.append(count)
        return real(self, query, count, free)

    monkeypatch.setattr(Shard, "nearest", nearest)
    return counts


def naive(
    query: Bytes, frames: dict[int, Bytes], size: int, metric: Metric
) -> tuple[list[int], list[int]]:
    power = {"l1": 1, "l2": 2}[metric]
    found = sorted(
        (int((np.abs(x.astype(int) - query) ** power).sum()), key) for key, x in frames.items()
    )
    return [key for _, key in found[:size]], [distance for distance, _ in found[:size]]


def answer(hits: SearchHits) -> tuple[list[int], list[int]]:
    return hits.keys.tolist(), hits.distances.tolist()


def frames_of(keys: np.ndarray, signatures: Bytes) -> dict[int, Bytes]:
    return dict(zip(keys.tolist(), signatures, strict=True))


def shard_folder(folder: Path) -> Path:
    """Of the newest generation."""
    (_, path), *_ = manifests(folder)
    (name,) = [name for name, _ in read_manifest(path).files if name.endswith(".qdrant")]
    return folder / name


def shard_of(generation: Generation) -> Shard | None:
    """Of its only segment."""
    (segment,) = generation.segments
    return segment.shard


def number_of(folder: Path) -> int | None:
    found = newest(folder, "model", LENGTH)
    return None if found is None else found.number


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("seed", range(4))
def test_answers_are_those_of_the_exact_scan(
    walk: Walk, published: Publish, asked: list[int], metric: Metric, seed: int
) -> None:
    """Deleted, replaced and chosen frames, and a tail."""
    rng = np.random.default_rng(seed)
    keys, signatures = rng.permutation(3000)[:700].astype(np.int64), walk(760, LENGTH, seed)
    first = published(keys[:300], signatures[:300], qdrant=metric)
    made = published(
        keys[300:], signatures[300:700], first, drop=frozenset(keys[:9].tolist()), qdrant=metric
    )
    assert shard_of(made) is not None
    tail = Tail(np.append(keys[20:30], np.arange(5000, 5050)), signatures[700:])
    frames = frames_of(keys[9:], signatures[9:700]) | frames_of(tail.keys, tail.signatures)
    for _ in range(8):
        some = rng.choice(len(frames), rng.integers(200, len(frames)), replace=False)
        among = None if rng.random() < 0.5 else np.array(list(frames), np.int64)[some]
        gone = rng.choice(list(frames), rng.integers(0, 60), replace=False)
        dead = frozenset(gone.tolist())
        wanted = {
            key: row for key, row in frames.items()
            if key not in dead and (among is None or key in among)
        }  # fmt: skip
        query, size = walk(1, LENGTH, seed + 9)[0], int(rng.integers(1, 60))
        for exact in (False, True):
            hits = search(query, made, tail, size, metric=metric, dead=dead, among=among,
                          exact=exact)  # fmt: skip
            assert answer(hits) == naive(query, wanted, size, metric)
            assert (hits.exact, hits.compared) == (True, len(wanted))
    assert len(asked) >= 16


@pytest.mark.parametrize("metric", METRICS)
def test_more_are_asked_for_where_many_are_as_near(
    published: Publish, asked: list[int], metric: Metric
) -> None:
    """Of equal frames those that came first are found, and the engine knows no such order."""
    signatures = np.full((900, LENGTH), 7, np.uint8)
    signatures[600:] = np.random.default_rng(1).integers(100, 255, (300, LENGTH))
    signatures[:3] = 8
    keys = np.random.default_rng(2).permutation(900).astype(np.int64)
    made = published(keys, signatures, qdrant=metric)
    query, frames = signatures[5], frames_of(keys, signatures)
    for size in (1, 40):
        hits = search(query, made, Tail.empty(LENGTH), size, metric=metric)
        assert answer(hits) == naive(query, frames, size, metric)
    assert asked == [17, 68, 272, 56, 224]  # and then all were compared here


@pytest.mark.parametrize(("metric", "length"), [("l1", 125_000), ("l2", 12_800)])
def test_distances_that_floats_cannot_hold_are_exact(
    published: Publish, asked: list[int], metric: Metric, length: int
) -> None:
    rng = np.random.default_rng(3)
    signatures = rng.integers(0, 2, (120, length), np.uint8) * 255
    query = 255 - signatures[0]
    made = published(np.arange(120), signatures, qdrant=metric)
    hits = search(query, made, Tail.empty(length), 30, metric=metric)
    assert answer(hits) == naive(query, frames_of(np.arange(120), signatures), 30, metric)
    assert hits.distances.min() > 1 << 23
    assert asked[0] == 46


def test_what_the_engine_says_bounds_what_it_leaves_out(walk: Walk, tmp_path: Path) -> None:
    for metric in METRICS:
        folder = tmp_path / metric
        folder.mkdir()
        signatures = walk(400, LENGTH)
        write_shard(folder, signatures, metric)
        shard = open_shard(folder, 400, LENGTH, metric)
        power = {"l1": 1, "l2": 2}[metric]
        apart = (np.abs(signatures.astype(int) - signatures[7]) ** power).sum(axis=1)
        for count in (1, 30, 399):
            rows, limit = shard.nearest(signatures[7], count, None)
            others = np.delete(apart, rows)
            assert apart[rows].max() <= others.min()
            assert limit < apart[rows].max() + 1
            assert limit > apart[rows].max() * 0.999 - 3


@pytest.mark.parametrize("few", [True, False])
def test_only_rows_that_may_be_found_are(walk: Walk, tmp_path: Path, few: bool) -> None:
    """Named to the engine are those, or the others, whichever are fewer."""
    signatures = walk(400, LENGTH)
    write_shard(tmp_path, signatures, "l2")
    free = np.arange(400) % 3 == 0
    if not few:
        free = ~free
    rows, _ = open_shard(tmp_path, 400, LENGTH, "l2").nearest(signatures[7], 30, free)
    apart = ((signatures.astype(int) - signatures[7]) ** 2).sum(axis=1)
    apart[~free] = 1 << 40
    assert sorted(apart[rows].tolist()) == sorted(apart.tolist())[:30]


def test_a_failing_engine_costs_time_and_no_answer(
    walk: Walk, published: Publish, caplog: pytest.LogCaptureFixture
) -> None:
    signatures = walk(300, LENGTH)
    made = published(np.arange(300), signatures, qdrant="l2")
    shard = shard_of(made)
    assert shard is not None
    shard.engine.close()
    hits = search(signatures[3], made, Tail.empty(LENGTH), 20, metric="l2")
    assert answer(hits) == naive(signatures[3], frames_of(np.arange(300), signatures), 20, "l2")
    (told,) = [one for one in caplog.records if one.name == "sceneprint.index.segment"]
    assert told.levelno == logging.WARNING
    assert "Qdrant failed; all signatures are compared" in told.message


@pytest.mark.parametrize("found", [[0, 1, 1], [0, 1, 400], [0, 1, -1], [0, 1], [0, 1, 9]])
def test_what_the_engine_finds_is_looked_at(
    walk: Walk, tmp_path: Path, found: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows that are there twice, of no frame, too few, or that may not be found."""
    write_shard(tmp_path, walk(400, LENGTH), "l2")
    sound = open_shard(tmp_path, 400, LENGTH, "l2")

    class Point:
        score = 1.0

        def __init__(self, row: int) -> None:
            self.id = row

    class Broken:
        def query(self, request: object) -> list[Point]:
            return [Point(row) for row in found]

    broken = Shard(tmp_path, Broken(), sound.size, "l2")  # type: ignore[arg-type]
    free = np.ones(400, np.bool_)
    free[9] = False
    with pytest.raises(DamagedIndex, match="found"):
        broken.nearest(walk(1, LENGTH)[0], 3, free)


@pytest.fixture
def folder(walk: Walk, published: Publish, tmp_path: Path) -> Path:
    """Two generations, of 200 and of 450 frames."""
    signatures = walk(450, LENGTH)
    first = published(np.arange(200), signatures[:200], qdrant="l2")
    published(np.arange(200, 450), signatures[200:], first, qdrant="l2")
    return tmp_path / "map"


def test_no_changed_file_is_opened(folder: Path) -> None:
    place, rng = shard_folder(folder), random.Random(5)
    listed = json.loads((place / CONTENTS).read_bytes())
    assert any(name.endswith("segment.json") for name in listed)
    for path in (place / CONTENTS, *(place / name for name in listed)):
        at = rng.randrange(path.stat().st_size)
        with path.open("r+b", buffering=0) as file:
            file.seek(at)
            byte = file.read(1)[0]
            for changed in (byte ^ 1 << at % 8, byte):
                file.seek(at)
                file.write(bytes([changed]))
                if changed != byte:
                    assert number_of(folder) == 1, path
    assert number_of(folder) == 2
    (place / "journal").write_bytes(b"of the engine")  # it does without
    assert number_of(folder) == 2


def test_no_short_or_missing_file_is_opened(folder: Path) -> None:
    place = shard_folder(folder)
    (segment,) = place.rglob("segment.json")
    for path in (place / CONTENTS, segment):
        data = path.read_bytes()
        for other in (data[:-1], data + b"\n"):
            path.write_bytes(other)
            assert number_of(folder) == 1
        path.unlink()
        assert number_of(folder) == 1
        assert [one for one in scrub(folder) if one is not None] == [place]
        path.write_bytes(data)
    assert number_of(folder) == 2
    generation_files.remove(place)
    assert number_of(folder) == 1


def test_a_hole_and_zeros_are_the_same(tmp_path: Path) -> None:
    data = bytearray(5 << 20)
    data[9000:9004] = data[(3 << 20) - 2 : (3 << 20) + 2] = b"data"
    whole, sparse = tmp_path / "whole", tmp_path / "sparse"
    whole.write_bytes(data)
    with sparse.open("wb") as file:
        file.truncate(len(data))
        for at in (9000, (3 << 20) - 2):
            file.seek(at)
            file.write(b"data")
    assert sparse.stat().st_blocks < whole.stat().st_blocks
    found = []
    for path in (whole, sparse):
        with path.open("rb") as file:
            found.append(list(generation_files._nonzero(file.fileno(), len(data))))
    assert found[0] == found[1]
    assert [one.partition(b" ")[0] for one in found[0]] == [b"0", b"2097152", b"3145728"]


def test_a_shard_of_other_signatures_is_refused(walk: Walk, tmp_path: Path) -> None:
    write_shard(tmp_path, walk(40, LENGTH), "l2")
    with pytest.raises(DamagedIndex, match="40 points, where there are 41 signatures"):
        open_shard(tmp_path, 41, LENGTH, "l2")
    with pytest.raises(DamagedIndex, match="Qdrant's engine failed"):
        open_shard(tmp_path, 40, LENGTH + 1, "l2")
    with pytest.raises(DamagedIndex, match="Qdrant's engine failed"):
        open_shard(tmp_path, 40, LENGTH, "l1")
    with pytest.raises(DamagedIndex, match="Qdrant's engine failed"):
        open_shard(tmp_path / "none", 40, LENGTH, "l2")


def test_without_the_package_nothing_is_half_written(
    walk: Walk, published: Publish, folder: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    before = sorted(path.name for path in folder.iterdir())
    monkeypatch.setitem(sys.modules, "qdrant_edge", None)
    with pytest.raises(UnusableStore, match="cannot write a shard"):
        published(np.arange(900, 950), walk(50, LENGTH), number_two(folder), qdrant="l2")
    assert set(before) <= {path.name for path in folder.iterdir()}
    assert not list(folder.glob(".*.part"))
    plain = newest(folder, "model", LENGTH, qdrant="l2")
    assert plain is not None
    assert (plain.number, shard_of(plain)) == (2, None)
    assert "Qdrant's engine is not installed" in caplog.text
    hits = search(walk(1, LENGTH)[0], plain, Tail.empty(LENGTH), 9, metric="l2")
    assert answer(hits) == naive(
        walk(1, LENGTH)[0], frames_of(np.arange(450), walk(450, LENGTH)), 9, "l2"
    )


def number_two(folder: Path) -> Generation:
    found = newest(folder, "model", LENGTH)
    assert found is not None
    assert found.number == 2
    return found


def test_signatures_that_would_overflow_are_refused(tmp_path: Path) -> None:
    """A difference of bytes is 255 at most, and 2^31 - 1 the largest sum."""
    assert [can_hold(n, "l2") for n in (448, 33_025, 33_026)] == [True, True, False]
    assert [can_hold(n, "l1") for n in (125_000, 8_421_504, 8_421_505)] == [True, True, False]
    with pytest.raises(ValueError, match="33026 bytes by l2"):
        write_shard(tmp_path, np.zeros((2, 33_026), np.uint8), "l2")


def test_what_is_open_is_searched_after_its_files_are_gone(
    walk: Walk, published: Publish, tmp_path: Path
) -> None:
    """And `clean` leaves nothing of the generation before."""
    signatures, empty = walk(400, LENGTH), Tail.empty(LENGTH)
    first = published(np.arange(300), signatures[:300], qdrant="l1")
    before = answer(search(signatures[9], first, empty, 30, metric="l1"))
    place = shard_folder(tmp_path / "map")
    assert place.stat().st_mode & 0o777 == 0o700  # whatever the engine gives its files
    second = published(
        np.arange(300, 400), signatures[300:], first, drop=frozenset([9]), clean=True, qdrant="l1"
    )
    assert [path.name for path in (tmp_path / "map").glob("*.qdrant")] == [
        shard_folder(tmp_path / "map").name
    ]
    assert not place.exists()
    assert answer(search(signatures[9], first, empty, 30, metric="l1")) == before
    frames = frames_of(np.arange(400), signatures)
    del frames[9]
    hits = search(signatures[9], second, empty, 30, metric="l1")
    assert answer(hits) == naive(signatures[9], frames, 30, "l1")


#: Opens the newest generation again and again, and searches it.
READER = """
import sys
from pathlib import Path
from sceneprint.index import Tail, newest, search

for line in sys.stdin:
    found = newest(Path(sys.argv[1]), "model", 64, qdrant="l2")
    (one,) = found.segments
    rows, _ = one.shard.nearest(one.vectors[int(line)], 5, None)
    print(found.number, int(line) in rows.tolist(), flush=True)
"""


def test_processes_that_open_one_shard_leave_it_as_it_was(folder: Path) -> None:
    """The engine writes when it opens: what it writes is what was there."""
    readers = [
        subprocess.Popen(
            [sys.executable, "-c", READER, str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )
        for _ in range(2)
    ]  # fmt: skip
    try:
        for row in range(3, 40, 12):
            for one in readers:  # both at once
                assert one.stdin is not None
                one.stdin.write(f"{row}\n")
            for one in readers:
                assert one.stdout is not None
                assert one.stdout.readline() == "2 True\n"
    finally:
        for one in readers:
            one.communicate()
    assert number_of(folder) == 2
    assert [one.returncode for one in readers] == [0, 0]


#: Publishes, and says when the engine is at work.
BUILDER = """
import sys
from pathlib import Path
import numpy as np
from sceneprint.index import generation_files, newest, publish, qdrant_shard

folder, moment = Path(sys.argv[1]), sys.argv[2]
before = newest(folder, "model", 64)

def wait(*_):
    print("now", flush=True)
    sys.stdin.read()

if moment == "written":
    real = qdrant_shard.open_shard
    qdrant_shard.open_shard = wait
elif moment == "listed":
    generation_files.write_durable = wait
else:
    generation_files.sync_folder = wait
publish(folder, model_id="model", revision=9, previous=before, qdrant="l2",
        blocks=[(np.arange(900, 950), np.zeros((50, 64), np.uint8))])
"""


@pytest.mark.parametrize("moment", ["written", "listed", "synced"])
def test_a_builder_killed_while_it_writes_a_shard(
    folder: Path, published: Publish, walk: Walk, moment: str
) -> None:
    builder = subprocess.Popen(
        [sys.executable, "-c", BUILDER, str(folder), moment],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with builder:
        assert builder.stdout is not None
        assert builder.stdout.readline() == "now\n"
        builder.kill()
    assert number_of(folder) == 2
    before = newest(folder, "model", LENGTH, qdrant="l2")
    made = published(np.arange(900, 950), walk(50, LENGTH), before, qdrant="l2")
    assert made.number == 3
    assert [one.shard is not None for one in made.segments] == [True, True]
    assert list(folder.glob(".*.part")) == []
    assert len(list(folder.glob("*.qdrant"))) == 2


def test_a_full_disk_leaves_what_was_there(
    walk: Walk, published: Publish, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(path.name for path in folder.iterdir())

    def full(_path: Path, _data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(generation_files, "write_durable", full)
    with pytest.raises(OSError, match="No space left"):
        published(np.arange(900, 950), walk(50, LENGTH), number_two(folder), qdrant="l2")
    assert set(before) <= {path.name for path in folder.iterdir()}
    assert not list(folder.glob(".*.part"))
    assert number_of(folder) == 2


def test_each_segment_has_a_shard_that_stays_with_it(
    walk: Walk, published: Publish, tmp_path: Path, asked: list[int]
) -> None:
    """Also where frames of it are gone; and one that has none gets it."""
    signatures, empty = walk(700, LENGTH), Tail.empty(LENGTH)
    first = published(np.arange(600), signatures[:600])
    second = published(
        np.arange(600, 700), signatures[600:], first, drop=frozenset([3]), qdrant="l2"
    )
    large, small = sorted(second.segments, key=len, reverse=True)
    assert (len(large), len(small)) == (599, 100)
    assert None not in (large.shard, small.shard)
    third = published(np.arange(0), signatures[:0], second, drop=frozenset([5]), qdrant="l2")
    names = [one.record.file("qdrant") for one in (large, small)]
    assert {one.record.file("qdrant") for one in third.segments} == set(names)
    frames = frames_of(np.arange(700), signatures)
    del frames[3], frames[5]
    hits = search(signatures[4], third, empty, 30, metric="l2")
    assert answer(hits) == naive(signatures[4], frames, 30, "l2")
    assert sorted(asked) == [46, 46]


def test_publishing_without_it_drops_the_shard(
    walk: Walk, published: Publish, tmp_path: Path
) -> None:
    signatures = walk(90, LENGTH)
    first = published(np.arange(60), signatures[:60], qdrant="l2")
    second = publish(
        tmp_path / "map", model_id="model", revision=1, previous=first, clean=True,
        blocks=[(np.arange(60, 90), signatures[60:])],
    )  # fmt: skip
    assert second is not None
    assert shard_of(second) is None
    assert not list((tmp_path / "map").glob("*.qdrant"))
