"""Tests of deletions and edits of selected frames and of sessions, in blocks, and of undo."""

import pytest
from pydantic import ValidationError

from sceneprint.engine.maps import selections as module
from sceneprint.engine.maps.map_frames import list_sessions
from sceneprint.engine.maps.selections import (
    delete_selection,
    delete_session,
    edit_selection,
    edit_session,
)
from sceneprint.errors import InvalidRequest, UnknownFrame, UnknownMap, UnknownSession
from sceneprint_client.api import FrameMeta
from sceneprint_client.api.listing import FrameListing, FramesEdit, FrameSelection, SessionEdit

#: Session, robot and tags of each of twelve uploads.
TAKEN = [("a", "r1", ["x"])] * 5 + [("b", "r2", ["x", "y"])] * 4 + [(None, None, [])] * 3
OF_SESSIONS = [("a", "r1")] * 5 + [("a", "r2")] * 3 + [("a/..", "r1")] * 2 + [(None, "r1")] * 2


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch):
    monkeypatch.setattr(module, "AT_ONCE", 2)


def fill(engine, uploads, taken):
    """Add frames that nobody signs: states do not matter."""
    ids = []
    for i, (upload, (session, robot, tags)) in enumerate(zip(uploads, taken, strict=True)):
        fields = {"session": session, "robot": robot, "tags": tags, "name": f"{i:02d}.png"}
        meta = FrameMeta.model_validate(upload.meta.model_dump() | fields)
        ids.append(engine.add_frame("hall", upload.data, meta)[0].frame_id)
    return ids


@pytest.fixture
def ids(empty, uploads):
    return fill(empty, uploads, TAKEN)


@pytest.fixture
def of_sessions(empty, uploads):
    return fill(empty, uploads, [(*row, ["old"]) for row in OF_SESSIONS])


def known(engine):
    """Session, robot and tags of all frames by their ids."""
    actual = engine.list_frames("hall", None, 100).items
    return {item.frame_id: (item.session, item.robot, sorted(item.tags)) for item in actual}


def delete(engine, **wanted):
    return delete_selection(engine.store, "hall", FrameSelection(**wanted), engine.tombstones)


def edit(engine, seconds=10.0, **wanted):
    return edit_selection(engine.store, "hall", FramesEdit(**wanted), seconds)


def test_frames_are_deleted_by_their_ids_once(empty, ids):
    result = delete(empty, frame_ids=[ids[0], ids[7], "none", ids[0], ids[3]])
    assert (result.frames, result.remaining, result.deletion.frames) == (3, 0, 3)
    assert list(known(empty)) == [f for f in ids if f not in (ids[0], ids[3], ids[7])]
    again = delete(empty, frame_ids=[ids[0], ids[7]])
    assert (again.frames, again.remaining, again.deletion) == (0, 0, None)
    assert len(empty.tombstones.list_all("hall", None, 9).items) == 1
    with pytest.raises(UnknownMap):
        delete_selection(empty.store, "attic", FrameSelection(frame_ids=ids), empty.tombstones)


def test_frames_are_deleted_by_a_filter(empty, ids):
    for wanted, selected in (
        ({"session": ["a"]}, [0, 1, 2, 3, 4]), ({"robot": "r2"}, [5, 6, 7, 8]),
        ({"tag": ["x", "y"]}, [5, 6, 7, 8]), ({"name": "0"}, list(range(10))),
        ({"find": "1"}, [10, 11]), ({"find": "b"}, [5, 6, 7, 8]), ({"session": ["c"]}, []),
        ({"state": "received", "order": "desc"}, list(range(12))),
    ):  # fmt: skip
        start = wanted.get("find", "-")  # an id may begin so as well
        places = [i for i, f in enumerate(ids) if i in selected or f.startswith(start)]
        result = delete(empty, filter=wanted)
        assert (result.frames, result.remaining) == (len(places), 0)
        assert list(known(empty)) == [frame_id for i, frame_id in enumerate(ids) if i not in places]
        if places:
            empty.tombstones.restore("hall", result.deletion.deletion_id)


def test_a_call_that_runs_out_of_time_says_what_is_left(empty, ids):
    wanted = FrameSelection(filter=FrameListing(session=["a"]))
    result = [
        delete_selection(empty.store, "hall", wanted, empty.tombstones, seconds=0.0)
        for _ in range(4)
    ]
    assert [(item.frames, item.remaining) for item in result] == [(2, 3), (2, 1), (1, 0), (0, 0)]
    assert [item.deletion and item.deletion.frames for item in result] == [2, 2, 1, None]
    for one in result[:3]:
        empty.tombstones.restore("hall", one.deletion.deletion_id)
    assert list(known(empty)) == ids


def changed(session, robot, tags, changes):
    kept = [tag for tag in tags if tag not in changes.get("remove_tags", [])]
    return (
        changes.get("session", session), changes.get("robot", robot),
        sorted({*kept, *changes.get("add_tags", [])}),
    )  # fmt: skip


def test_an_edit_is_undone_by_its_inverse(empty, ids):
    before = known(empty)
    every = [
        {"session": "b"}, {"session": None}, {"robot": "r9", "session": "z"},
        {"add_tags": ["y", "n"]}, {"remove_tags": ["x"], "add_tags": ["n"]}, {"robot": None},
    ]  # fmt: skip
    for changes in every:
        result = edit(empty, filter={"name": "0"}, **changes)
        after = {frame_id: changed(*before[frame_id], changes) if i < 10 else before[frame_id]
                 for i, frame_id in enumerate(ids)}  # fmt: skip
        assert known(empty) == after
        assert result.frames == sum(after[frame_id] != before[frame_id] for frame_id in ids)
        assert (result.remaining, result.last_frame_id) == (0, None)
        again = edit(empty, filter={"name": "0"}, **changes)
        assert (again.frames, again.inverse) == (0, [])
        assert sum(len(one["frame_ids"]) for one in result.inverse) == result.frames
        for one in result.inverse:
            edit(empty, **one)
        assert known(empty) == before


def test_an_edit_goes_on_after_the_last_frame(empty, ids):
    first = edit(empty, 0.0, filter={"session": "a"}, session="c")
    assert (first.frames, first.remaining, first.last_frame_id) == (2, 3, ids[1])
    rest = edit(empty, filter={"session": "a"}, session="c", after=first.last_frame_id)
    assert (rest.frames, rest.remaining) == (3, 0)
    with pytest.raises(UnknownFrame):
        edit(empty, filter={"session": "a"}, session="c", after="none")


def test_too_many_tags_are_refused(empty, ids):
    with pytest.raises(InvalidRequest, match="33 tags, but a frame can have at most 32"):
        edit(empty, frame_ids=ids[:1], add_tags=[f"t{i}" for i in range(32)])
    assert known(empty)[ids[0]] == ("a", "r1", ["x"])


@pytest.mark.parametrize(
    "fields",
    [
        {}, {"frame_ids": []}, {"frame_ids": ["a"] * 1001}, {"filter": {}},
        {"filter": {"order": "desc"}}, {"filter": {"state": "deleted"}},
        {"frame_ids": ["a"], "filter": {"name": "a"}}, {"filter": {"nothing": 1}},
    ],
)  # fmt: skip
def test_what_selects_nothing_or_everything_is_refused(fields):
    with pytest.raises(ValidationError):
        FrameSelection.model_validate(fields)
    with pytest.raises(ValidationError, match="specify session, robot, add_tags or remove_tags"):
        FramesEdit.model_validate({"frame_ids": ["a"], "add_tags": []})


def frames(engine):
    return {frame.frame_id: frame for frame in engine.list_frames("hall", None, 100).items}


def test_a_session_is_deleted_with_its_frames_and_blobs(empty, of_sessions):
    before = frames(empty)
    change = delete_session(empty.store, "hall", "a", empty.tombstones, "r1")
    assert (change.session, change.robot, change.frames, change.remaining) == ("a", "r1", 5, 0)
    assert frames(empty) == {row: before[row] for row in of_sessions[5:]}
    assert empty.tombstones.purge(everything=True) == 5
    assert len(list(empty.store.blobs.digests())) == 7
    assert empty.get_map("hall").used_frames == 7
    assert delete_session(empty.store, "hall", "a", empty.tombstones).frames == 3
    assert delete_session(empty.store, "hall", "a/..", empty.tombstones).frames == 2
    assert list(frames(empty)) == of_sessions[10:]
    for name, robot in (("a", None), ("", None), ("a", "r1")):
        with pytest.raises(UnknownSession, match="has no frame of session"):
            delete_session(empty.store, "hall", name, empty.tombstones, robot)
    with pytest.raises(UnknownMap):
        delete_session(empty.store, "hall-2", "a", empty.tombstones)


def test_a_session_is_renamed_and_joins_another(empty, of_sessions):
    before = frames(empty)
    edit = SessionEdit(session="a", robot="r2")
    assert edit_session(empty.store, "hall", "a/..", edit).frames == 2
    after = frames(empty)
    for place, row in enumerate(of_sessions):
        wanted = {"session": "a", "robot": "r2"} if place in (8, 9) else {}
        free = {"etag": "", "revision": 0}
        now = after[row].model_copy(update=free)
        assert now == before[row].model_copy(update={**wanted, **free})
    assert delete_session(empty.store, "hall", "a", empty.tombstones, "r2").frames == 3 + 2


def test_tags_are_added_once_and_removed(empty, of_sessions):
    edit = SessionEdit(add_tags=["new", "old", "new"], remove_tags=["other"])
    change = edit_session(empty.store, "hall", "a", edit, "r1")
    assert (change.frames, change.session, change.robot) == (5, "a", "r1")
    tags = [frame.tags for frame in frames(empty).values()]
    assert tags == [["old", "new"]] * 5 + [["old"]] * 7
    listed = list_sessions(empty.store, "hall", None, 10).items
    assert [(row.session, row.robot, row.tags) for row in listed] == [
        (None, "r1", ["old"]), ("a", "r1", ["new", "old"]), ("a", "r2", ["old"]),
        ("a/..", "r1", ["old"]),
    ]  # fmt: skip
    edit_session(empty.store, "hall", "a", SessionEdit(remove_tags=["old"]))
    actual = empty.list_frames("hall", None, 100, wanted=FrameListing(tag=["old"])).items
    assert [item.frame_id for item in actual] == of_sessions[8:]
