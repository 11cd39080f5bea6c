"""Tests of queries while an index is published, follows its map, is damaged and is rebuilt."""

import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from sceneprint.engine.search import local_index
from sceneprint.engine.search.local_index import AppendBuffer
from sceneprint.index.index_manifest import scrub
from sceneprint.index.index_version import newest
from sceneprint.models import read_model
from sceneprint.store.signatures import SignatureChange
from sceneprint_client.api import JobState, NewMap, Query
from tests.engine.conftest import flip

ALL = Query(stages=("retrieve",), k=50)
#: Bytes of a signature.
LENGTH = read_model("depth").signature_bytes
pytestmark = pytest.mark.usefixtures("_always_look")


def ranked(engine, uploads):
    answer = engine.ask(uploads[2], ALL)
    return [(match.frame_id, match.distance) for match in answer.matches], answer.index_version


def until_healed(engine):
    """Versions that upkeep publishes until a round of verifying is over."""
    published = 0
    for _ in range(20):
        published += engine.publish_due()
    return published


@pytest.mark.parametrize("kind", ["faiss", "keys", "json"])
def test_a_flipped_byte_of_an_index_is_found_and_healed(data, make_engine, uploads, kind):
    builder = make_engine(data, unindexed_frames=1, index_check_interval_s=1)
    served = make_engine(data)  # holds the index open all the time
    wanted, _ = ranked(make_engine(data), uploads)
    assert builder.publish_due() == 1
    assert ranked(served, uploads) == (wanted, 1)
    (path,) = data.glob(f"index/hall-*/*.{kind}")
    flip(path, random.Random(kind).randrange(path.stat().st_size))
    again = make_engine(data, unindexed_frames=1, index_check_interval_s=1)
    (data / "index" / ".scrubbed").unlink(missing_ok=True)  # it is time
    assert until_healed(again) == 1
    assert until_healed(again) == 0
    folder = next(data.glob("index/hall-*"))
    sound = newest(folder, served.get_map("hall").model_id, LENGTH)
    assert (sound.number, len(sound)) == (2, 12)
    for engine in (served, make_engine(data)):
        assert ranked(engine, uploads) == (wanted, 2)


def test_a_frame_signed_anew_is_found_once_with_its_new_signature():
    tail = AppendBuffer(4, Path("unused"))
    tail.append(SignatureChange(7, "", 1, None), np.full(4, 1, np.uint8))
    tail.append(SignatureChange(8, "", 2, None), np.full(4, 2, np.uint8))
    handed_out = tail.tail()
    other = tail.copy(0, without={7})
    other.append(SignatureChange(7, "", 3, None), np.full(4, 3, np.uint8))
    assert (tail.revision_of(7), other.revision_of(7), other.revision_of(9)) == (1, 3, 0)
    np.testing.assert_array_equal(other.tail().keys, [8, 7])
    np.testing.assert_array_equal(other.tail().signatures[:, 0], [2, 3])
    np.testing.assert_array_equal(handed_out.signatures[:, 0], [1, 2])


@pytest.mark.parametrize("in_memory", [10**9, 0])
def test_a_tail_in_a_file_is_as_one_in_memory(tmp_path, monkeypatch, in_memory):
    monkeypatch.setattr(local_index, "IN_MEMORY", in_memory)
    rows = np.random.default_rng(3).integers(0, 256, (300, 50), np.uint8)
    tail, views = AppendBuffer(50, tmp_path / "index"), []
    for i, row in enumerate(rows):
        tail.append(SignatureChange(i, "", i + 1, None), row)
        if i % 50 == 0:
            views.append(tail.tail())
    assert tail.bytes_held == (512 * 50 if in_memory else 0)
    for n, view in zip(range(1, 300, 50), views, strict=True):
        np.testing.assert_array_equal(view.signatures, rows[:n])
        np.testing.assert_array_equal(view.keys, np.arange(n))
    late = tail.copy(200)
    np.testing.assert_array_equal(late.tail().signatures, rows[200:])
    np.testing.assert_array_equal(late.tail().keys, np.arange(200, 300))
    assert list(tmp_path.glob("index/*")) == []  # nothing to be left behind


def test_what_is_out_of_reach_for_a_moment_is_not_removed(data, make_engine, monkeypatch):
    assert make_engine(data, unindexed_frames=1).publish_due() == 1
    (folder,) = data.glob("index/hall-*")
    before = sorted(path.name for path in folder.iterdir())
    real = Path.open

    def no_descriptor(path, *arguments, **options):
        if path.suffix == ".faiss":
            raise OSError(24, "Too many open files")
        return real(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", no_descriptor)
    assert [one for one in scrub(folder) if one is not None] == []
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.fixture
def more(uploads):
    """Index that many frames more, by cameras that differ by half a pixel."""
    shifts = iter(range(1, 100))

    def add(engine, count):
        added = []
        for _ in range(count):
            shift = next(shifts)
            meta = uploads[shift % 12].meta
            camera = meta.intrinsics.model_copy(update={"cx": meta.intrinsics.cx + shift / 2})
            own_meta = meta.model_copy(update={"intrinsics": camera})
            added.append(engine.add_frame("hall", uploads[shift % 12].data, own_meta)[0].frame_id)
        assert engine.work_off() == [JobState.SUCCEEDED] * count
        return added

    return add


def matches_of(answer):
    assert answer.counts.map == answer.counts.ranked == len(answer.matches)
    return [(match.frame_id, match.distance) for match in answer.matches]


def ask(engine, uploads, which=2, query=ALL):
    return engine.ask(uploads[which], query)


def truth(make, uploads, folder, tmp_path):
    fresh = make(folder, index_dir=tmp_path / "none", unindexed_frames=100_000)
    answer = ask(fresh, uploads)
    assert answer.index_version == 0
    return matches_of(answer)


def test_publishing_changes_no_answer(data, make_engine, uploads, more):
    reader, builder = make_engine(data, unindexed_frames=5), make_engine(data, unindexed_frames=5)
    for query in (ALL, Query()):
        ask(reader, uploads, query=query)
    before = [ask(reader, uploads, query=query) for query in (ALL, Query())]
    assert builder.publish_due() == 1
    assert builder.publish_due() == 0
    fresh = make_engine(data, unindexed_frames=5)
    for engine in (reader, fresh):
        for query, old in zip((ALL, Query()), before, strict=True):
            new = ask(engine, uploads, query=query)
            assert new.index_version == 1  # the reader has looked
            free = {"query_id": "", "milliseconds": {}, "index_version": 0}
            assert new.model_copy(update=free) == old.model_copy(update=free)
    gone = reader.ids()[3]
    builder.delete_frame("hall", gone)
    left = [pair for pair in matches_of(before[0]) if pair[0] != gone]
    for engine in (reader, fresh, make_engine(data, unindexed_frames=5)):
        assert matches_of(ask(engine, uploads)) == left  # at once, and whoever deleted it
    shutil.rmtree(data / "index")
    for engine in (reader, fresh, make_engine(data, unindexed_frames=5)):
        assert matches_of(ask(engine, uploads)) == left
    assert builder.publish_due() == 1  # it sees that what it published is gone
    assert make_engine(data, unindexed_frames=5).publish_due() == 0


def test_an_index_is_due_beyond_so_many_frames(data, make_engine):
    assert make_engine(data, unindexed_frames=12).publish_due() == 0
    assert make_engine(data, unindexed_frames=11).publish_due() == 1


def test_readers_follow_a_map_through_versions(data, make_engine, uploads, more, tmp_path):
    first, builder = make_engine(data, unindexed_frames=3), make_engine(data, unindexed_frames=3)
    ask(first, uploads)
    assert builder.publish_due() == 1
    late = make_engine(data, unindexed_frames=3)
    ask(late, uploads)
    for step in range(3):
        new = more(builder, 2)
        builder.delete_frame("hall", builder.ids()[2 * step])
        builder.delete_frame("hall", new[0])  # before any index has it
        wanted = truth(make_engine, uploads, data, tmp_path)
        assert len(wanted) == 12  # two came, two went
        for engine in (first, late, make_engine(data, unindexed_frames=3)):
            assert matches_of(ask(engine, uploads)) == wanted
    assert builder.publish_due() == 1  # six deletions; of frames alone three were left to index
    new = more(builder, 3)
    assert builder.publish_due() == 0
    new += more(builder, 1)
    assert builder.publish_due() == 1
    more(builder, 1)  # newer than the version: it stays in the tail
    builder.delete_frame("hall", new[0])  # in the version
    wanted = truth(make_engine, uploads, data, tmp_path)
    for engine in (first, late, make_engine(data, unindexed_frames=3)):
        answer = ask(engine, uploads)
        assert (matches_of(answer), answer.index_version) == (wanted, 3)
    more(builder, 3)
    wanted = truth(make_engine, uploads, data, tmp_path)
    for engine in (first, late):
        assert matches_of(ask(engine, uploads)) == wanted


def test_a_map_made_anew_has_none_of_the_old_frames(data, make_engine, uploads):
    reader, other = make_engine(data, unindexed_frames=5), make_engine(data, unindexed_frames=5)
    assert len(matches_of(ask(reader, uploads))) == len(matches_of(ask(other, uploads))) == 12
    assert other.publish_due() == 1
    other.delete_map("hall")
    other.create_map(NewMap(name="hall", model="depth"))
    for engine in (reader, other, make_engine(data, unindexed_frames=5)):
        assert matches_of(ask(engine, uploads)) == []
    added, _ = other.add(uploads[7])
    assert other.work_off() == [JobState.SUCCEEDED]
    for engine in (reader, other, make_engine(data, unindexed_frames=5)):
        answer = ask(engine, uploads, 7)
        assert matches_of(answer) == [(added.frame_id, 0)]
        assert answer.index_version == 0
