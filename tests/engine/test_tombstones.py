"""Tests of deleted frames: hidden, restored in time, and finally removed."""

import pytest
from sqlalchemy import update

from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.maps import selections, tombstones
from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.maps.selections import delete_selection, delete_session
from sceneprint.errors import Conflict, InvalidRequest, QuotaExceeded, UnknownDeletion, UnknownFrame
from sceneprint.store.frames import set_state
from sceneprint.store.maps import MapUsage, find_frame, find_map
from sceneprint.store.tables import frames as frames_table
from sceneprint_client.api import FrameMeta, FrameState, Query
from sceneprint_client.api.listing import FrameListing, FrameSelection
from tests.engine.conftest import bytes_on_disk, used

#: What a restored frame has anew.
FRESH = {"revision", "job_id", "indexed_at", "state"}


def frames(engine):
    return {
        frame.frame_id: frame.model_dump(exclude=FRESH)
        for frame in engine.list_frames("hall", None, 100).items
    }


def delete(engine, frame_ids):
    wanted = FrameSelection(frame_ids=frame_ids)
    return delete_selection(engine.store, "hall", wanted, engine.tombstones)


def restore(engine, deletion):
    return engine.tombstones.restore("hall", deletion.deletion_id)


def end_undo(engine):
    engine.write(update(frames_table).values(ended_at=frames_table.c.ended_at - 601))


def nearest(engine, upload):
    answer = engine.ask(upload, Query(seed=5))
    return answer.matches[0].frame_id, answer.matches[0].distance


def test_a_deleted_frame_is_found_by_nothing(full, uploads):
    [first, second, *_] = frames(full)
    meta = full.get_frame("hall", first)
    assert nearest(full, uploads[0])[0] == first
    full.delete_frame("hall", first)
    assert nearest(full, uploads[0])[0] != first
    assert first not in frames(full)
    assert full.get_map("hall").frames == {"deleted": 1, "indexed": len(uploads) - 1}
    for wanted in (
        FrameListing(find=first), FrameListing(content_id=meta.content_id),
        FrameListing(parent_frame=uploads[0].room, has_pose=True),
        FrameListing(state=FrameState.DELETED, parent_frame=uploads[0].room),
    ):  # fmt: skip
        assert first not in {f.frame_id for f in full.list_frames("hall", wanted=wanted).items}
    bare = full.get_frame("hall", first)
    assert (bare.state, bare.pose, bare.content_id, bare.tags) == ("deleted", None, None, [])
    assert full.list_frames("hall", state=FrameState.DELETED).items == [bare]
    with pytest.raises(UnknownFrame):
        full.outputs.upload("hall", first)
    with pytest.raises(InvalidRequest, match="Only an indexed frame can be a query"):
        full.query_frame("hall", first, Query())
    answer = full.query_frame("hall", second, Query())
    assert first not in {match.frame_id for match in answer.matches}


def test_a_restored_frame_is_as_it_was_and_found_at_once(full, uploads):
    before, use = frames(full), used(full)
    first = next(iter(before))
    actual = nearest(full, uploads[0])
    full.delete_frame("hall", first)
    full.rebuild_index("hall")  # an index that was published without it
    assert nearest(full, uploads[0])[0] != first
    full.tombstones.restore_one("hall", first)
    assert nearest(full, uploads[0]) == actual
    assert frames(full) == before
    assert used(full) == use
    assert full.claim("w") is None
    assert full.get_frame("hall", first).state == FrameState.INDEXED
    assert full.event_kinds()[-2:] == ["frame.deleted", "frame.restored"]
    assert full.tombstones.list_all("hall", None, 9).items == []
    for name in (first, "none"):
        with pytest.raises(UnknownFrame, match="was not deleted, or can no longer be restored"):
            full.tombstones.restore_one("hall", name)


def test_a_session_is_restored_with_names_tags_and_states(empty, uploads, monkeypatch):
    for module in (selections, tombstones):
        monkeypatch.setattr(module, "AT_ONCE", 2)
    for number, upload in enumerate(uploads[:7]):
        fields = {
            "session": "a" if number < 5 else "b", "robot": "r", "tags": ["x", f"{number}"],
            "name": f"{number}.png", "sequence": number,
        }  # fmt: skip
        meta = FrameMeta.model_validate(upload.meta.model_dump() | fields)
        empty.add_frame("hall", upload.data, meta)
    before = frames(empty)
    change = delete_session(empty.store, "hall", "a", empty.tombstones)
    assert change.deletion.frames == 5
    (deletion,) = empty.tombstones.list_all("hall", None, 9).items
    assert deletion == change.deletion
    assert (deletion.until - deletion.at).total_seconds() == pytest.approx(600, abs=0.01)
    assert len(frames(empty)) == 2
    assert empty.list_frames("hall", wanted=FrameListing(tag=["0"])).items == []
    assert len(list(empty.store.blobs.digests())) == 7
    part = empty.tombstones.restore("hall", deletion.deletion_id, seconds=0.0)
    assert (part.frames, part.refused, part.remaining) == (2, [], 3)
    assert restore(empty, deletion).frames == 3
    assert frames(empty) == before
    assert {frame.state for frame in empty.list_frames("hall").items} == {FrameState.RECEIVED}
    assert len(empty.list_frames("hall", wanted=FrameListing(tag=["x"])).items) == 7
    for unknown in (deletion.deletion_id, "0", "none", "9" * 40, "²"):
        with pytest.raises(UnknownDeletion):
            empty.tombstones.restore("hall", unknown)


def test_what_has_come_again_is_not_restored(full, uploads):
    first, second, third = list(frames(full))[:3]
    deletion = delete(full, [first, second, third]).deletion
    again, new = full.add(uploads[0])
    assert new
    other = uploads[8].meta.model_copy(update={"name": "other"})
    put = Upload(uploads[8].data, other, frame_id=second)  # another frame under the second's id
    assert full.uploads.add("hall", put)[0].accepted.frame_id == second
    (left,) = full.tombstones.list_all("hall", None, 9).items
    assert left.frames == 2
    with pytest.raises(Conflict, match=f"uploaded again as frame {again.frame_id}"):
        full.tombstones.restore_one("hall", first)
    with pytest.raises(UnknownFrame):
        full.tombstones.restore_one("hall", second)
    done = restore(full, deletion)
    assert (done.frames, done.remaining) == (1, 0)
    reasons = {frame.frame_id: frame.reason for frame in done.refused}
    assert reasons == {first: f"it was uploaded again as frame {again.frame_id}"}
    assert third in frames(full)
    assert full.get_frame("hall", second).name == "other"
    assert full.tombstones.purge(everything=True) == 2
    assert used(full).frames == len(uploads)


def test_a_quota_of_frames_holds(full):
    names = list(frames(full))
    deletion = delete(full, names[:3]).deletion
    edit_map(full.store, "hall", {"quota_frames": len(names) - 1})
    with pytest.raises(QuotaExceeded, match="no room for the 3 frames"):
        restore(full, deletion)
    for name in names[:2]:
        full.tombstones.restore_one("hall", name)
    with pytest.raises(QuotaExceeded):
        full.tombstones.restore_one("hall", names[2])


def test_an_upload_beyond_the_quota_purges_the_oldest_deletions(empty, uploads):
    names = [empty.add(upload)[0].frame_id for upload in uploads[:4]]
    sizes = [len(upload.data) for upload in uploads]
    quota = sum(sizes[:4])
    edit_map(empty.store, "hall", {"quota_bytes": quota})
    for name in names[:3]:
        empty.delete_frame("hall", name)
    empty.add(uploads[4])  # as large as one, or as two
    assert names[0] not in restorable(empty, names)
    assert names[2] in restorable(empty, names)
    assert used(empty).bytes == bytes_on_disk(empty) <= quota
    batch = [Upload(upload.data, upload.meta) for upload in uploads[5:7]]
    results, _ = empty.uploads.add_all("hall", batch)
    assert [result.new for result in results] == [True, sum(sizes[3:7]) <= quota]
    assert used(empty).bytes == bytes_on_disk(empty) <= quota
    # what would not fit anyway purges nothing
    left = restorable(empty, names)
    edit_map(empty.store, "hall", {"quota_bytes": 1})
    with pytest.raises(QuotaExceeded):
        empty.add(uploads[8])
    assert restorable(empty, names) == left


def restorable(engine, names):
    """Return the names of the frames that can be restored, by restoring and deleting them."""
    results = set()
    for name in names:
        try:
            engine.tombstones.restore_one("hall", name)
        except UnknownFrame:
            continue
        engine.delete_frame("hall", name)
        results.add(name)
    return results


def test_after_its_time_a_deletion_is_for_good(full):
    names, use, on_disk = list(frames(full)), used(full), bytes_on_disk(full)
    deletion = delete(full, names[:2]).deletion
    size = sum(full.get_frame("hall", name).bytes for name in names[2:])
    assert used(full) == MapUsage(use.frames - 2, use.bytes)
    assert full.tombstones.purge() == 0
    end_undo(full)
    with pytest.raises(UnknownDeletion, match="has expired"):
        restore(full, deletion)
    with pytest.raises(UnknownFrame, match="can no longer be restored"):
        full.tombstones.restore_one("hall", names[0])
    assert full.tombstones.list_all("hall", None, 9).items == []
    assert full.tombstones.purge() == 2
    assert used(full) == MapUsage(use.frames - 2, size)  # bytes count until they are gone
    assert len(list(full.store.blobs.digests())) == 2 * len(names) - 4  # uploads and artifacts
    assert bytes_on_disk(full) < on_disk
    assert full.tombstones.purge() == 0


def test_what_could_not_be_signed_is_restored_as_it_was(empty, uploads):
    frames = []
    for upload, state in zip(uploads, (FrameState.REJECTED, FrameState.REDUNDANT), strict=False):
        name = empty.add(upload)[0].frame_id
        with empty.store.database.write() as connection:
            actual = find_frame(connection, find_map(connection, "hall"), name)
            set_state(connection, actual.number, state, "as a test says")
        frames.append(empty.get_frame("hall", name))
    use = used(empty)
    deletion = delete(empty, [frame.frame_id for frame in frames]).deletion
    assert deletion.frames == 1
    assert restore(empty, deletion).frames == 1
    now = empty.get_frame("hall", frames[0].frame_id)
    assert (now.state, now.reason) == (FrameState.REJECTED, "as a test says")
    assert empty.get_frame("hall", frames[1].frame_id).state == FrameState.DELETED
    assert used(empty) == use


def test_a_frame_of_a_map_that_has_another_model_now_is_signed_again(full, small_model):
    first = next(iter(frames(full)))
    full.delete_frame("hall", first)
    full.reencode("hall", small_model)
    full.work_off()
    full.publish_due()
    assert full.get_map("hall").model_id == small_model.id
    full.tombstones.restore_one("hall", first)
    assert full.get_frame("hall", first).state == FrameState.RECEIVED
    assert full.work_off() == ["succeeded"]
