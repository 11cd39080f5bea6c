"""Tests of client methods for many frames, for deletions and for kept answers."""

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest, UnknownDeletion


def test_frames_are_deleted_edited_and_restored(client, map_name, references):
    client.create_map(map_name)
    ids = [client.upload(map_name, reference).frame_id for reference in references[:3]]
    client.edit_frames(map_name, ids, session="monday", add_tags=["door"])
    before = {frame.frame_id: (frame.session, frame.tags) for frame in client.frames(map_name)}
    assert before == dict.fromkeys(ids, ("monday", ["door"]))
    assert [frame.frame_id for frame in client.frames(map_name, find=ids[1])] == ids[1:2]
    count, inverse = client.edit_frames(
        map_name, filter={"session": ["monday"]}, session=None, remove_tags=["door"]
    )
    assert count == 3
    assert [(frame.session, frame.tags) for frame in client.frames(map_name)] == [(None, [])] * 3
    for one in inverse:
        client.edit_frames(map_name, **one)
    count, (deletion,) = client.delete_frames(map_name, filter={"tag": ["door"]})
    assert (count, deletion.frames) == (3, 3)
    assert list(client.deletions(map_name)) == [deletion]
    assert list(client.frames(map_name)) == []
    assert client.restore_frame(map_name, ids[0]).tags == ["door"]
    restored = client.restore_deletion(map_name, deletion.deletion_id)
    assert (restored.frames, restored.refused) == (2, [])
    assert {f.frame_id: (f.session, f.tags) for f in client.frames(map_name)} == before
    with pytest.raises(UnknownDeletion):
        client.restore_deletion(map_name, deletion.deletion_id)
    with pytest.raises(InvalidRequest, match="`filter` has no condition"):
        client.delete_frames(map_name, filter={})


def test_an_answer_is_kept_and_released(client, map_name, references):
    client.create_map(map_name)
    added = client.upload(map_name, references[0], wait_s=PATIENCE_S)
    answer = client.query(map_name, frame_id=added.frame_id, robot="cart")
    record = client.stored_query(answer.query_id)
    assert (record.kept_at, record.title, record.model) == (None, None, answer.model)
    saved = client.keep_answer(answer.query_id, "by the door")
    assert (saved.title, saved.expires_at) == ("by the door", None)
    (listed,) = client.queries(map_name, kept=True)
    assert (listed.query_id, listed.robot, listed.title) == (answer.query_id, "cart", "by the door")
    client.release_answer(answer.query_id)
    assert list(client.queries(map_name, kept=True)) == []
