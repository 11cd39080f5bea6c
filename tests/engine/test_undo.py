"""Deleted frames: restored as they were while that can be done, and gone for good afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import update

from sceneprint.engine import Engine
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.maps import selections as module
from sceneprint.engine.maps.selections import delete_selection, delete_session
from sceneprint.errors import (
    Conflict,
    InvalidRequest,
    QuotaExceeded,
    UnknownDeletion,
    UnknownFrame,
    UnknownMap,
)
from sceneprint.store.frames import set_state, write_map
from sceneprint.store.maps import find_frame, find_map
from sceneprint.store.tables import deletions
from sceneprint_client.api import Frame, FrameMeta, FrameState, Query
from sceneprint_client.api.listing import FrameListing, FrameSelection, RestoreOptions

#: What a restored frame has anew.
FRESH = {"revision", "job_id", "indexed_at", "state"}


def frames(engine: Engine) -> dict[str, Any]:
    return {
        one.frame_id: one.model_dump(exclude=FRESH)
        for one in engine.list_frames("hall", None, 100).items
    }


def restore(engine: Engine, **wanted: Any) -> Any:
    return engine.undo.restore("hall", RestoreOptions(**wanted))


def delete(engine: Engine, frame_ids: list[str]) -> Any:
    wanted = FrameSelection(frame_ids=frame_ids)
    return delete_selection(engine.store, "hall", wanted, engine.undo_limits)


def end_undo(engine: Engine) -> None:
    """Let the time of all deletions be over."""
    with engine.store.database.write() as connection:
        connection.execute(update(deletions).values(until=0.0))


def test_a_restored_frame_is_as_it_was_and_found_again(
    full: Engine, uploads: Any, work_off: Callable[[Engine], list[Any]]
) -> None:
    before = frames(full)
    first = next(iter(before))
    options = Query(seed=5)

    def nearest() -> tuple[str, float]:
        answer = full.queries.upload(["hall"], uploads[0].data, uploads[0].meta, options)
        return answer.matches[0].frame_id, answer.matches[0].distance

    found = nearest()
    assert found[0] == first
    use = full.get_map("hall")
    full.delete_frame("hall", first)
    assert nearest()[0] != first
    full.undo.restore_one("hall", first)
    assert frames(full) == before
    assert nearest()[0] != first  # until it is signed again
    assert len(work_off(full)) == 1
    assert nearest() == found
    now = full.get_map("hall")
    assert (now.used_frames, now.used_bytes) == (use.used_frames, use.used_bytes)
    assert full.undo.list_all("hall", None, 9).items == []
    for name in (first, "none"):
        with pytest.raises(UnknownFrame, match="was not deleted, or cannot be restored"):
            full.undo.restore_one("hall", name)


def test_a_session_is_restored_with_names_tags_and_states(
    empty: Engine, uploads: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AT_ONCE", 2)
    for number, upload in enumerate(uploads[:7]):
        known = {
            "session": "a" if number < 5 else "b", "robot": "r", "tags": ["x", f"{number}"],
            "name": f"{number}.png", "sequence": number,
        }  # fmt: skip
        meta = FrameMeta.model_validate(upload.meta.model_dump() | known)
        empty.add_frame("hall", upload.data, meta)
    before = frames(empty)
    change = delete_session(empty.store, "hall", "a", undo=empty.undo_limits)
    assert change.deletion is not None
    assert change.deletion.frames == 5
    (told,) = empty.undo.list_all("hall", None, 9).items
    assert told == change.deletion
    assert (told.until - told.at).total_seconds() == pytest.approx(600, abs=0.01)
    assert len(frames(empty)) == 2
    assert len(list(empty.store.blobs.digests())) == 7
    wanted = RestoreOptions(deletion_id=told.deletion_id)
    part = empty.undo.restore("hall", wanted, seconds=0.0)
    assert (part.frames, part.refused, part.remaining) == (2, [], 3)
    assert restore(empty, deletion_id=told.deletion_id).frames == 3
    assert frames(empty) == before
    assert len(empty.list_frames("hall", wanted=FrameListing(tag=["x"])).items) == 7
    with pytest.raises(UnknownDeletion):
        restore(empty, deletion_id=told.deletion_id)


def test_what_has_come_again_is_not_restored(full: Engine, uploads: Any) -> None:
    first, second, third = list(frames(full))[:3]
    deletion = delete(full, [first, second, third]).deletion
    (again, _) = full.add_frame("hall", uploads[0].data, uploads[0].meta)
    put = full.uploads.add("hall", module_upload(uploads[8], second))[
        0
    ].taken.frame_id  # another frame under the id of the second
    assert put == second
    done = restore(full, deletion_id=deletion.deletion_id)
    assert (done.frames, done.remaining) == (1, 0)
    reasons = {one.frame_id: one.reason for one in done.refused}
    assert reasons == {
        first: f"it was uploaded again, as frame {again.frame_id}",
        second: f"another frame has the id {second}",
    }
    with pytest.raises(Conflict, match="was uploaded again"):
        full.undo.restore_one("hall", first)
    assert third in frames(full)
    # the id is free again where the other frame was deleted as well
    other = delete(full, [second]).deletion
    assert restore(full, deletion_id=deletion.deletion_id).frames == 1
    assert full.get_frame("hall", second).name != "other"
    (refused,) = restore(full, deletion_id=other.deletion_id).refused
    assert refused.reason == f"another frame has the id {second}"


def module_upload(one: Any, frame_id: str) -> Upload:
    return Upload(one.data, one.meta.model_copy(update={"name": "other"}), frame_id=frame_id)


def test_a_quota_holds(full: Engine, uploads: Any) -> None:
    names = list(frames(full))
    deletion = delete(full, names[:3]).deletion
    with full.store.database.write() as connection:
        write_map(connection, find_map(connection, "hall"), {"quota_frames": len(names) - 1})
    with pytest.raises(QuotaExceeded, match="The deletion has 3 frames"):
        restore(full, deletion_id=deletion.deletion_id)
    assert len(frames(full)) == len(names) - 3
    assert restore(full, frame_ids=names[:2]).frames == 2
    with pytest.raises(QuotaExceeded):
        full.undo.restore_one("hall", names[2])


def test_after_its_time_a_deletion_is_for_good(full: Engine) -> None:
    names = list(frames(full))
    deletion = delete(full, names[:2]).deletion
    blobs = len(list(full.store.blobs.digests()))
    assert full.undo.purge() == 0
    end_undo(full)
    with pytest.raises(UnknownDeletion, match="its time is over"):
        restore(full, deletion_id=deletion.deletion_id)
    assert [one.reason for one in restore(full, frame_ids=names[:1]).refused] == [
        "was not deleted, or cannot be restored any more"
    ]
    assert full.undo.purge() == 2
    assert len(list(full.store.blobs.digests())) == blobs - 2
    assert full.undo.purge() == 0


def test_only_so_many_bytes_are_kept_for_it(
    full: Engine, make_engine: Callable[..., Engine]
) -> None:
    names = list(frames(full))
    sizes = [full.outputs.upload("hall", one).make() for one in names[:3]]
    engine = make_engine(undo_bytes=sum(map(len, sizes[:2])))
    told = delete(engine, names[:3])
    assert told.frames == 3
    assert told.deletion.frames == 2
    assert restore(engine, deletion_id=told.deletion.deletion_id).frames == 2
    assert names[2] not in frames(engine)
    never = make_engine(undo_s=0)
    told = delete(never, names[:1])
    assert (told.frames, told.deletion) == (1, None)
    small = make_engine(undo_bytes=1)
    assert delete(small, names[1:2]).deletion is None
    assert small.undo.purge() == 0
    assert small.undo.list_all("hall", None, 9).items == []


def test_deletions_are_listed_a_page_at_a_time(full: Engine) -> None:
    names = list(frames(full))
    made = [delete(full, [one]).deletion for one in names[:3]]
    page = full.undo.list_all("hall", None, 2)
    assert page.items == [made[2], made[1]]
    assert full.undo.list_all("hall", page.next_cursor, 2).items == [made[0]]
    with pytest.raises(InvalidRequest):
        full.undo.list_all("hall", "x", 2)
    with pytest.raises(UnknownMap):
        full.undo.list_all("attic", None, 2)
    full.delete_map("hall")
    assert list(full.store.blobs.digests()) == []


def test_what_could_not_be_signed_is_restored_as_it_was(empty: Engine, uploads: Any) -> None:
    made: list[Frame] = []
    for one, state in zip(uploads, (FrameState.REJECTED, FrameState.REDUNDANT), strict=False):
        name = empty.add_frame("hall", one.data, one.meta)[0].frame_id
        with empty.store.database.write() as connection:
            found = find_frame(connection, find_map(connection, "hall"), name)
            set_state(connection, found.number, state, "as a test says")
        made.append(empty.get_frame("hall", name))
    use = empty.get_map("hall").used_frames
    deletion = delete(empty, [one.frame_id for one in made]).deletion
    assert restore(empty, deletion_id=deletion.deletion_id).frames == 2
    for one in made:
        now = empty.get_frame("hall", one.frame_id)
        assert (now.state, now.reason) == (one.state, one.reason)
    assert empty.get_map("hall").used_frames == use
