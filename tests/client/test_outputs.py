"""Tests of downloads and edits of frames through the client."""

from datetime import UTC, datetime, timedelta

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest, PreconditionFailed, UnknownFrame
from sceneprint_client import meta_of

START = datetime(2026, 11, 16, 9, 30, tzinfo=UTC)


@pytest.fixture
def map_name():
    return "outputs"


@pytest.fixture(scope="module")
def ids(client, references):
    """Three frames of a map, taken a second apart."""
    map_name = "outputs"
    client.create_map(map_name, model="depth")
    results = []
    for i, reference in enumerate(references[:3]):
        meta = meta_of(reference, robot="r2", tags=["door"] if i else [])
        meta = meta.model_copy(update={"captured_at": START + timedelta(seconds=i)})
        results.append(
            client.upload(map_name, reference.path.read_bytes(), meta, wait_s=PATIENCE_S).frame_id
        )
    return results


def listed(client, map_name, **wanted):
    return [frame.frame_id for frame in client.frames(map_name, **wanted)]


def test_frames_by_their_metadata(client, map_name, ids):
    assert listed(client, map_name, order="desc") == ids[::-1]
    assert listed(client, map_name, tags="door", robot=["r1", "r2"]) == ids[1:]
    assert listed(client, map_name, captured_after=START + timedelta(seconds=1)) == ids[1:]
    assert listed(client, map_name, session="room-0/seq-01", captured_before=START) == ids[:1]
    assert listed(client, map_name, has_pose=False) == []
    for bad in ({"robot": ""}, {"captured_after": datetime(2026, 1, 1)}, {"order": "up"}):
        with pytest.raises(InvalidRequest, match="The list is not valid"):
            listed(client, map_name, **bad)


def test_a_trajectory_is_thinned(client, map_name, ids):
    thin = client.trajectory(map_name, "room-0/seq-01", most=2)
    assert (len(thin.poses), thin.posed > 2) == (2, True)


def test_edits(client, map_name, ids):
    before = client.frame(map_name, ids[0])
    after = client.edit_frame(
        map_name, ids[0], {"captured_at": START, "tags": ["é"], "robot": None}, before.etag
    )
    assert (after.tags, after.robot, after.captured_at) == (["é"], None, START)
    with pytest.raises(PreconditionFailed):
        client.edit_frame(map_name, ids[0], {"tags": []}, before.etag)
    with pytest.raises(InvalidRequest):
        client.edit_frame(map_name, ids[0], {"depth_scale": 1})
    record = client.map(map_name)
    assert client.edit_map(map_name, {"title": "Küche"}, record.etag).title == "Küche"
    with pytest.raises(PreconditionFailed):
        client.edit_map(map_name, {"title": None}, record.etag)
    client.delete_frame(map_name, ids[0])
    with pytest.raises(UnknownFrame, match="was deleted"):
        client.upload_of(map_name, ids[0])
