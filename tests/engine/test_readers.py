"""Tests of queries while maps grow, are indexed, shrink and are recreated."""

import shutil

import pytest

from sceneprint_client.api import JobState, NewMap, Query

ALL = Query(stages=("retrieve",), k=50)
pytestmark = pytest.mark.usefixtures("_always_look")


@pytest.fixture
def more(uploads, work_off):
    """Index that many frames more, by cameras that differ by half a pixel."""
    shifts = iter(range(1, 100))

    def add(engine, count):
        added = []
        for _ in range(count):
            shift = next(shifts)
            meta = uploads[shift % 12].meta
            camera = meta.intrinsics.model_copy(update={"cx": meta.intrinsics.cx + shift / 2})
            given = meta.model_copy(update={"intrinsics": camera})
            added.append(engine.add_frame("hall", uploads[shift % 12].data, given)[0].frame_id)
        assert work_off(engine) == [JobState.SUCCEEDED] * count
        return added

    return add


def found(answer):
    assert answer.counts.map == answer.counts.ranked == len(answer.matches)
    return [(match.frame_id, match.distance) for match in answer.matches]


def ask(engine, uploads, which=2, query=ALL):
    return engine.queries.upload(["hall"], uploads[which].data, uploads[which].meta, query)


def truth(make, uploads, folder, tmp_path):
    """What an engine says that has no index and has held nothing before."""
    fresh = make(folder, index_dir=tmp_path / "none", unindexed_frames=100_000)
    answer = ask(fresh, uploads)
    assert answer.index_version == 0
    return found(answer)


def test_publishing_changes_no_answer(data, make_engine, uploads, more, ids):
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
    gone = ids(reader)[3]
    builder.delete_frame("hall", gone)
    left = [pair for pair in found(before[0]) if pair[0] != gone]
    for engine in (reader, fresh, make_engine(data, unindexed_frames=5)):
        assert found(ask(engine, uploads)) == left  # at once, and whoever deleted it
    shutil.rmtree(data / "index")
    for engine in (reader, fresh, make_engine(data, unindexed_frames=5)):
        assert found(ask(engine, uploads)) == left
    assert builder.publish_due() == 1  # it sees that what it published is gone
    assert make_engine(data, unindexed_frames=5).publish_due() == 0


def test_an_index_is_due_beyond_so_many_frames(data, make_engine):
    assert make_engine(data, unindexed_frames=12).publish_due() == 0
    assert make_engine(data, unindexed_frames=11).publish_due() == 1


def test_readers_follow_a_map_through_versions(data, make_engine, uploads, more, ids, tmp_path):
    first, builder = make_engine(data, unindexed_frames=3), make_engine(data, unindexed_frames=3)
    ask(first, uploads)
    assert builder.publish_due() == 1
    late = make_engine(data, unindexed_frames=3)
    ask(late, uploads)
    for step in range(3):
        new = more(builder, 2)
        builder.delete_frame("hall", ids(builder)[2 * step])
        builder.delete_frame("hall", new[0])  # before any index has it
        wanted = truth(make_engine, uploads, data, tmp_path)
        assert len(wanted) == 12  # two came, two went
        for engine in (first, late, make_engine(data, unindexed_frames=3)):
            assert found(ask(engine, uploads)) == wanted
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
        assert (found(answer), answer.index_version) == (wanted, 3)
    more(builder, 3)
    wanted = truth(make_engine, uploads, data, tmp_path)
    for engine in (first, late):
        assert found(ask(engine, uploads)) == wanted


def test_a_map_made_anew_has_none_of_the_old_frames(data, make_engine, uploads, work_off):
    reader, other = make_engine(data, unindexed_frames=5), make_engine(data, unindexed_frames=5)
    assert len(found(ask(reader, uploads))) == len(found(ask(other, uploads))) == 12
    assert other.publish_due() == 1
    other.delete_map("hall")
    other.create_map(NewMap(name="hall", model="depth"))
    for engine in (reader, other, make_engine(data, unindexed_frames=5)):
        assert found(ask(engine, uploads)) == []
    added, _ = other.add_frame("hall", uploads[7].data, uploads[7].meta)
    assert work_off(other) == [JobState.SUCCEEDED]
    for engine in (reader, other, make_engine(data, unindexed_frames=5)):
        answer = ask(engine, uploads, 7)
        assert found(answer) == [(added.frame_id, 0)]
        assert answer.index_version == 0
