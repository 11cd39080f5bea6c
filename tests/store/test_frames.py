"""Tests of rows of frames and signatures, and of notifications."""

import pytest
from sqlalchemy import select, update
from sqlalchemy.exc import IntegrityError

from sceneprint.errors import UnknownFrame, UnknownMap
from sceneprint.store import frames as stored
from sceneprint.store import maps as stored_maps
from sceneprint.store import queue
from sceneprint.store import signatures as signed
from sceneprint.store.deletion import remove_map
from sceneprint.store.frame_queries import list_frames
from sceneprint.store.tables import events, signatures
from sceneprint_client.api import FrameState
from sceneprint_client.api.listing import FrameListing


@pytest.fixture
def indexed(store, hall):
    """Give a frame a signature of three bytes that tell its number."""

    def index(frame):
        signature = signed.StoredSignature(
            hall.model_id, bytes([frame.number, 2, 3]), f"{frame.number:064d}", [4], [12]
        )
        with store.database.write() as connection:
            return signed.index_frame(connection, frame, signature)

    return index


def delete(store, row, frame):
    with store.database.write() as connection:
        now = stored_maps.find_frame(connection, row, frame.id)
        return stored.delete_frame(connection, row, now)


def changes(store, row, since, limit=256):
    with store.database.read() as connection:
        return list(signed.changes_since(connection, row, since, limit))


def test_a_row_comes_back_as_it_was_given(store, hall, received):
    pose = [[0.1 + 0.2, -0.0, 1 / 3, 5e-324], [0.0, 1.0, 0.0, 1e22], [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0]]  # fmt: skip
    frame = received(
        "a", robot="R2", session="s\u00e9ance", captured_at=1763731200.123456, tags=["x", "\u2764"],
        pose_parent="p", pose=pose,
    )  # fmt: skip
    with store.database.read() as connection:
        assert stored_maps.find_frame(connection, hall, frame.id) == frame
        assert stored_maps.frames_of_content(connection, hall.number, "a")[:1] == [frame]
        assert stored_maps.frames_of_content(connection, hall.number, "b") == []
        assert stored_maps.frames_of_content(connection, hall.number + 1, "a") == []
        with pytest.raises(UnknownFrame, match="no frame 'x' in map 'hall'"):
            stored_maps.find_frame(connection, hall, "x")
        with pytest.raises(UnknownMap, match="no map 'x'"):
            stored_maps.find_map(connection, "x")
    assert frame.pose == pose
    assert (frame.state, frame.robot, frame.tags) == (FrameState.RECEIVED, "R2", ["x", "\u2764"])
    assert (frame.captured_at, frame.session) == (1763731200.123456, "s\u00e9ance")


def test_an_id_is_in_a_map_once_and_given_up_by_what_is_deleted(store, hall, received):
    first = received("a", frame_id="gate.1")
    with pytest.raises(IntegrityError):
        received("b", frame_id="gate.1")
    with store.database.write() as connection:
        other = stored_maps.add_map(connection, "other", None, hall.model_id)
    assert received("a", other, frame_id="gate.1").map_number == other.number
    second = received("a")  # the same content under an id of its own
    with store.database.read() as connection:
        assert stored_maps.frames_of_content(connection, hall.number, "a")[:1] == [first]
    delete(store, hall, first)
    again = received("b", frame_id="gate.1")
    with store.database.read() as connection:
        assert stored_maps.frames_of_content(connection, hall.number, "a")[:1] == [second]
        assert stored_maps.find_frame(connection, hall, "gate.1") == again
        gone = stored_maps.frame_of(connection, first.number)
    assert (gone.state, gone.id != "gate.1") == (FrameState.DELETED, True)
    assert again.number > second.number > first.number


def test_changes_come_in_order_whatever_the_block(store, hall, received, indexed):
    frames = [received(str(i)) for i in range(5)]
    revisions = [indexed(frames[i]) for i in (3, 0, 4, 1)]
    assert revisions == [1, 2, 3, 4]  # frame 2 is never signed
    delete(store, hall, frames[0])
    delete(store, hall, frames[2])
    wanted = [
        signed.SignatureChange(
            frames[i].number, frames[i].id, revision,
            bytes([frames[i].number, 2, 3]) if there else None, deleted=not there,
        )
        for i, revision, there in [(3, 1, 1), (4, 3, 1), (1, 4, 1), (0, 5, 0), (2, 6, 0)]
    ]  # fmt: skip
    assert changes(store, hall, 0) == [wanted]
    assert changes(store, hall, 0, 2) == [wanted[:2], wanted[2:4], wanted[4:]]
    assert changes(store, hall, 0, 5) == [wanted]
    assert changes(store, hall, 3) == [wanted[2:]]
    assert changes(store, hall, 6) == []
    with store.database.read() as connection:
        counts = [signed.count_indexed(connection, hall.number, since) for since in (0, 1, 3, 4)]
        assert counts == [3, 2, 1, 0]
        gone = [signed.deleted_since(connection, hall.number, since) for since in (0, 5, 6)]
        assert gone == [{frames[0].number, frames[2].number}, {frames[2].number}, set()]
        assert stored_maps.find_map(connection, "hall").revision == 6


def test_a_damaged_signature_is_noticed_and_deleting_its_frame_helps(
    store, hall, received, indexed
):
    good, bad = received("a"), received("b")
    indexed(good)
    indexed(bad)
    with store.database.write() as connection:
        connection.execute(
            update(signatures).where(signatures.c.frame_number == bad.number).values(vector=b"\0")
        )
    (block,) = changes(store, hall, 0)
    assert [(change.frame_id, change.vector is None, change.deleted) for change in block] == [
        (good.id, False, False), (bad.id, True, False),
    ]  # fmt: skip
    delete(store, hall, bad)
    (block,) = changes(store, hall, 0)
    assert [(change.number, change.deleted) for change in block] == [
        (good.number, False), (bad.number, True),
    ]  # fmt: skip


def test_a_deleted_frame_leaves_a_row_and_nothing_else(store, hall, received, indexed):
    frame, other = received("a", blob="11" * 32), received("b", blob="11" * 32)
    indexed(frame)
    artifact = f"{frame.number:064d}"
    assert delete(store, hall, frame) == ["11" * 32, artifact]
    with store.database.read() as connection:
        now = stored_maps.find_frame(connection, hall, frame.id)
        listings = (FrameListing(), FrameListing(state=FrameState.DELETED))
        assert (now.state, now.content_id, now.revision) == (FrameState.DELETED, None, 2)
        assert stored_maps.frames_of_content(connection, hall.number, "a") == []
        result = [list_frames(connection, hall.number, None, 9, listing) for listing in listings]
        assert result == [[other], [now]]
        numbers = [frame.number, other.number]
        assert stored_maps.frames_of(connection, numbers) == {other.number: other}
        assert signed.stored_vector(connection, frame.number, hall.model_id) is None
        assert stored_maps.geometry_blobs(connection, [frame.number], hall.model_id) == {}
        assert stored.refers_to(connection, "11" * 32)  # the other frame does
        assert not stored.refers_to(connection, artifact)
        rows = connection.execute(select(events).where(events.c.kind == "frame.deleted")).all()
        assert [(each.map, each.frame_id) for each in rows] == [("hall", frame.id)]
    with pytest.raises(UnknownFrame, match="is already deleted"):
        delete(store, hall, frame)
    with store.database.write() as connection:
        stored.set_state(connection, frame.number, FrameState.FAILED, "late")
        assert stored_maps.find_frame(connection, hall, frame.id) == now
    assert received("a").number > other.number


def test_a_removed_map_takes_all_of_its_own_and_nothing_of_others(store, hall, received, indexed):
    with store.database.write() as connection:
        other = stored_maps.add_map(connection, "other", "Other", hall.model_id)
    mine, theirs = received("a", blob="11" * 32), received("a", other, blob="11" * 32)
    indexed(mine)
    indexed(theirs)
    with store.database.write() as connection:
        job = queue.enqueue(connection, "sign", mine.number)
        kept = queue.enqueue(connection, "sign", theirs.number)
        blobs = remove_map(connection, hall)
    assert sorted(blobs) == sorted(["11" * 32, f"{mine.number:064d}"])
    with store.database.read() as connection:
        assert [row.name for row in stored_maps.list_maps(connection)] == ["other"]
        numbers = [mine.number, theirs.number]
        assert list(stored_maps.frames_of(connection, numbers)) == [theirs.number]
        assert queue.signing_jobs(connection, numbers) == {theirs.number: kept.id}
        assert job.number != kept.number
        assert stored.refers_to(connection, "11" * 32)
        assert signed.stored_vector(connection, mine.number, hall.model_id) is None
        vector = signed.stored_vector(connection, theirs.number, hall.model_id)
        assert vector == bytes([theirs.number, 2, 3])
        assert [e.kind for e in connection.execute(select(events).order_by(events.c.number))] == [
            "map.created", "map.created", "map.deleted",
        ]  # fmt: skip
    with store.database.write() as connection:  # numbers are not given out twice
        again = stored_maps.add_map(connection, "hall", None, hall.model_id)
    assert again.number > other.number
