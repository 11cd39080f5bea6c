"""Tests of original names of frames, and of their order in a session."""

from datetime import UTC, datetime

import pytest

from sceneprint.engine.maps.map_frames import list_frames, trajectory, trajectory_file
from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.errors import InvalidRequest, PreconditionFailed
from sceneprint_client.api import FrameMeta, FrameState
from sceneprint_client.api.listing import FrameListing, Run


def listed(engine, map_name="hall", **wanted):
    """Names of the frames of a list, page by page."""
    names, cursor = [], None
    while True:
        asked = FrameListing.model_validate(wanted)
        page = list_frames(engine.store, map_name, asked, cursor, 3)
        names += [one.name for one in page.items]
        cursor = page.next_cursor
        if cursor is None:
            return names


def send(engine, upload, **more):
    known = upload.meta.model_dump() | more
    added, new = engine.add_frame("hall", upload.data, FrameMeta.model_validate(known))
    return added.frame_id, new


def test_names_are_labels_and_tell_no_uploads_apart(empty, uploads):
    frame, new = send(empty, uploads[0], session="s", name="a.png", sequence=3)
    assert new
    assert send(empty, uploads[0], session="s", name="b.png", sequence=4) == (frame, False)
    told = empty.get_frame("hall", frame)
    assert (told.name, told.sequence) == ("a.png", 3)
    tag = told.etag
    now = edit_frame(empty.store, "hall", frame, {"name": "c/d.png", "sequence": 0}, [str(tag)])
    assert (now.name, now.sequence) == ("c/d.png", 0)
    with pytest.raises(PreconditionFailed):
        edit_frame(empty.store, "hall", frame, {"name": "e"}, [str(tag)])
    edit_frame(empty.store, "hall", frame, {"name": None, "sequence": None})
    told = empty.get_frame("hall", frame)
    assert (told.name, told.sequence) == (None, None)
    for bad in ("", "/etc/passwd", "a/../b", "a//b", "a\\b", "a\nb", "x" * 256):
        with pytest.raises(InvalidRequest, match="name"):
            edit_frame(empty.store, "hall", frame, {"name": bad})
    for worse in (-1, 2**53, 1.5):
        with pytest.raises(InvalidRequest, match="sequence"):
            edit_frame(empty.store, "hall", frame, {"sequence": worse})


def test_what_is_deleted_is_forgotten_and_pages_go_on_after_it(empty, uploads):
    order = (4, 1, None, 3, 0, None)
    for i, (upload, place) in enumerate(zip(uploads, order, strict=False)):
        at = datetime.fromtimestamp(1.7e9 - i, UTC) if i < 2 else None
        send(empty, upload, session="s", name=f"{i}", sequence=place, captured_at=at)
    # by time; then by place; then as they came
    taken = ["1", "0", "4", "3", "2", "5"]
    assert listed(empty, session="s", order="taken") == taken
    wanted = FrameListing(session=["s"], order="taken")
    page = list_frames(empty.store, "hall", wanted, None, 2)
    empty.delete_frame("hall", page.items[-1].frame_id)
    gone = empty.list_frames("hall", state=FrameState.DELETED).items[0]
    assert (gone.name, gone.sequence, gone.captured_at) == (None, None, None)
    rest = list_frames(empty.store, "hall", wanted, page.next_cursor, 9)
    assert [one.name for one in rest.items] == taken[2:]
    cursor = str(page.next_cursor)
    sealed = cursor.partition("~")[0]
    for bad in (sealed, f"{sealed}~", f"{sealed}~x", f"{sealed}~W251bGwsIC0xXQ", cursor[1:]):
        with pytest.raises(InvalidRequest, match="is not valid"):
            list_frames(empty.store, "hall", wanted, bad, 9)


def test_an_empty_trajectory_says_why(empty, uploads):
    def told(**run):
        found = trajectory(empty.store, "hall", Run.model_validate({"session": "s"} | run))
        assert (found.stamps is None) == (found.poses == [])
        assert (f"# empty: {found.reason}" in trajectory_file(found)) == (not found.poses)
        return len(found.poses), found.reason

    assert told() == (0, "the map has no frame of session 's'")
    send(empty, uploads[0], session="s", pose=None)
    assert told() == (0, "none of its 1 frames has a pose; send `pose` with uploads, or edit them")
    after = datetime(2026, 1, 1, tzinfo=UTC)
    assert told(captured_after=after) == (0, "the map has no frame of session 's' in this period")
    send(empty, uploads[1], session="s")
    assert told() == (
        0,
        f"none of its 2 frames has a pose in {uploads[1].room!r} with `captured_at` or `sequence`; "
        "`clock=received` orders them by upload",
    )
    assert told(clock="received") == (1, None)
    # where some have times, places would be stamps of another kind
    send(empty, uploads[2], session="s", sequence=7)
    send(empty, uploads[3], session="s", sequence=8, captured_at=after)
    assert (told(), told(clock="sequence")) == ((1, None), (2, None))
