"""Tests of answers while frames are added, deleted and damaged."""

import pytest

from sceneprint.engine.search import local_index, verification
from sceneprint.engine.search.retrieval import Deadline, prepare_stored
from sceneprint.engine.upkeep import index_upkeep
from sceneprint.errors import UnknownMap
from sceneprint.pipeline import associate
from sceneprint_client.api import NewMap, Query

R = Query(stages=("retrieve",), k=50)


def test_what_is_deleted_while_a_query_runs_is_not_told(full, uploads, ids, monkeypatch):
    names, search = ids(full), local_index.search
    gone = [names[6], names[1]]

    def then_delete(*given, **more):
        hits = search(*given, **more)
        if gone:
            full.delete_frame("hall", gone.pop())
        return hits

    monkeypatch.setattr(local_index, "search", then_delete)
    for query, missing in ((Query(), names[1]), (R, names[6])):
        answer = full.queries.upload(["hall"], uploads[1].data, uploads[1].meta, query)
        assert missing not in [m.frame_id for m in answer.matches]
        assert len(answer.matches) == (9 if query != R else 10)
    assert gone == []


def test_a_frame_deleted_after_it_was_asked_for_is_answered(empty, uploads, work_off, ids):
    empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    work_off(empty)
    (name,) = ids(empty)
    row = empty.row("hall")
    asked = prepare_stored(empty.store, empty.signers, "hall", name, Query())
    empty.delete_frame("hall", name)
    answer = empty.queries.answer([row], asked, Query(), Deadline(None))
    assert (answer.status, answer.matches, answer.counts.map) == ("not_found", [], 0)


def test_a_map_made_anew_while_it_was_asked_is_not_answered_for(empty, uploads, work_off, ids):
    empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    work_off(empty)
    row = empty.row("hall")
    asked = prepare_stored(empty.store, empty.signers, "hall", ids(empty)[0], Query())
    empty.delete_map("hall")
    empty.create_map(NewMap(name="hall", model="paper"))  # whose signatures are longer
    with pytest.raises(UnknownMap, match="created again during the query"):
        empty.queries.answer([row], asked, Query(), Deadline(None))


def test_matches_that_are_deleted_while_they_are_validated_are_not_found(
    empty, uploads, work_off, ids, monkeypatch
):
    empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    work_off(empty)
    (name,) = ids(empty)

    def then_delete(*arguments, **named):
        found = associate(*arguments, **named)
        assert [match.validation.status for match in found] == ["accepted"]
        empty.delete_frame("hall", name)
        return found

    monkeypatch.setattr(verification, "associate", then_delete)
    answer = empty.queries.upload(["hall"], uploads[0].data, uploads[0].meta, Query())
    assert (answer.status, answer.matches, answer.location) == ("not_found", [], None)
    assert (answer.counts.validated, answer.counts.accepted) == (0, 0)


def test_what_is_deleted_while_an_index_is_published_stays_deleted(
    full, make_engine, uploads, ids, work_off, monkeypatch
):
    """The version holds it, and readers have heard of its end but never of its beginning."""
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)
    reader, builder = make_engine(unindexed_frames=5), make_engine(unindexed_frames=5)
    names, publish = ids(full), index_upkeep.publish
    assert full.get_map("hall").revision == 12
    reader.query_frame("hall", names[0], R)
    meta = uploads[3].meta
    camera = meta.intrinsics.model_copy(update={"cx": meta.intrinsics.cx + 1})
    given = meta.model_copy(update={"intrinsics": camera})
    gone = full.add_frame("hall", uploads[3].data, given)[0].frame_id
    work_off(full)

    def slowly(*given, **more):
        full.delete_frame("hall", gone)
        assert len(reader.query_frame("hall", names[0], R).matches) == 11
        return publish(*given, **more)

    monkeypatch.setattr(index_upkeep, "publish", slowly)
    assert builder.publish_due() == 1
    full.delete_frame("hall", names[11])
    for engine in (reader, make_engine(unindexed_frames=5)):
        answer = engine.query_frame("hall", names[0], R)
        assert answer.index_version == 1
        assert answer.counts.map == answer.counts.ranked == len(answer.matches) == 10
        assert {m.frame_id for m in answer.matches} == set(names[1:11])
