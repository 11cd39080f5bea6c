"""Tests of sessions that are renamed, tagged and deleted in blocks."""

import pytest

from sceneprint.engine.maps import selections
from sceneprint.engine.maps.map_frames import list_sessions
from sceneprint.engine.maps.selections import delete_session, edit_session
from sceneprint.errors import UnknownFrame, UnknownMap, UnknownSession
from sceneprint_client.api import FrameMeta
from sceneprint_client.api.listing import FrameListing, SessionEdit

#: Session and robot of each of twelve uploads.
TAKEN = [("a", "r1")] * 5 + [("a", "r2")] * 3 + [("a/..", "r1")] * 2 + [(None, "r1")] * 2


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch):
    monkeypatch.setattr(selections, "AT_ONCE", 2)


@pytest.fixture
def ids(empty, uploads):
    """Twelve frames that nobody signs: states do not matter."""
    made = []
    for upload, (session, robot) in zip(uploads, TAKEN, strict=True):
        known = upload.meta.model_dump() | {"session": session, "robot": robot, "tags": ["old"]}
        made.append(empty.add_frame("hall", upload.data, FrameMeta.model_validate(known))[0])
    return [one.frame_id for one in made]


def frames(engine):
    return {one.frame_id: one for one in engine.list_frames("hall", None, 100).items}


def test_a_session_is_deleted_with_its_frames_and_blobs(empty, ids):
    before = frames(empty)
    change = delete_session(empty.store, "hall", "a", empty.tombstones, "r1")
    assert (change.session, change.robot, change.frames, change.remaining) == ("a", "r1", 5, 0)
    assert frames(empty) == {one: before[one] for one in ids[5:]}
    assert empty.tombstones.purge(everything=True) == 5
    assert len(list(empty.store.blobs.digests())) == 7
    assert empty.get_map("hall").used_frames == 7
    assert delete_session(empty.store, "hall", "a", empty.tombstones).frames == 3
    assert delete_session(empty.store, "hall", "a/..", empty.tombstones).frames == 2
    assert list(frames(empty)) == ids[10:]
    for name, robot in (("a", None), ("", None), ("a", "r1")):
        with pytest.raises(UnknownSession, match="has no frame of session"):
            delete_session(empty.store, "hall", name, empty.tombstones, robot)
    with pytest.raises(UnknownMap):
        delete_session(empty.store, "hall-2", "a", empty.tombstones)


def test_a_session_is_renamed_and_joins_another(empty, ids):
    before = frames(empty)
    edit = SessionEdit(session="a", robot="r2")
    assert edit_session(empty.store, "hall", "a/..", edit).frames == 2
    after = frames(empty)
    for place, one in enumerate(ids):
        wanted = {"session": "a", "robot": "r2"} if place in (8, 9) else {}
        free = {"etag": "", "revision": 0}
        now = after[one].model_copy(update=free)
        assert now == before[one].model_copy(update={**wanted, **free})
    assert delete_session(empty.store, "hall", "a", empty.tombstones, "r2").frames == 3 + 2


def test_tags_are_added_once_and_removed(empty, ids):
    edit = SessionEdit(add_tags=["new", "old", "new"], remove_tags=["other"])
    change = edit_session(empty.store, "hall", "a", edit, "r1")
    assert (change.frames, change.session, change.robot) == (5, "a", "r1")
    tags = [one.tags for one in frames(empty).values()]
    assert tags == [["old", "new"]] * 5 + [["old"]] * 7
    listed = list_sessions(empty.store, "hall", None, 10).items
    assert [(one.session, one.robot, one.tags) for one in listed] == [
        (None, "r1", ["old"]), ("a", "r1", ["new", "old"]), ("a", "r2", ["old"]),
        ("a/..", "r1", ["old"]),
    ]  # fmt: skip
    edit_session(empty.store, "hall", "a", SessionEdit(remove_tags=["old"]))
    found = empty.list_frames("hall", None, 100, wanted=FrameListing(tag=["old"])).items
    assert [one.frame_id for one in found] == ids[8:]


def test_an_edit_goes_on_after_the_last_frame(empty, ids):
    edit, after, told = SessionEdit(add_tags=["new"]), None, []
    while not told or told[-1].remaining:
        told.append(edit_session(empty.store, "hall", "a", edit, after=after, seconds=0.0))
        after = told[-1].last_frame_id
    assert [(one.frames, one.remaining) for one in told] == [(2, 6), (2, 4), (2, 2), (2, 0)]
    assert [one.last_frame_id for one in told] == [ids[1], ids[3], ids[5], None]
    assert sum("new" in one.tags for one in frames(empty).values()) == 8
    with pytest.raises(UnknownFrame):
        edit_session(empty.store, "hall", "a", edit, after="0" * 32)
