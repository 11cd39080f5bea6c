"""Tests of downloads and edits of frames through the client."""

import base64
import io
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from PIL import Image

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest, NotIndexed, PreconditionFailed, UnknownFrame
from sceneprint_client import meta_of

START = datetime(2026, 11, 16, 9, 30, tzinfo=UTC)


@pytest.fixture
def map_name():
    """The map of all tests of this file."""
    return "outputs"


@pytest.fixture(scope="module")
def ids(client, references):
    """Three frames of a map, taken a second apart."""
    map_name = "outputs"
    client.create_map(map_name, model="depth")
    found = []
    for i, one in enumerate(references[:3]):
        meta = meta_of(one, robot="r2", tags=["door"] if i else [])
        meta = meta.model_copy(update={"captured_at": START + timedelta(seconds=i)})
        found.append(
            client.upload(map_name, one.path.read_bytes(), meta, wait_s=PATIENCE_S).frame_id
        )
    return found


def listed(client, map_name, **wanted):
    return [one.frame_id for one in client.frames(map_name, **wanted)]


def test_frames_by_their_metadata(client, map_name, ids):
    assert listed(client, map_name, order="desc") == ids[::-1]
    assert listed(client, map_name, tags="door", robot=["r1", "r2"]) == ids[1:]
    assert listed(client, map_name, captured_after=START + timedelta(seconds=1)) == ids[1:]
    assert listed(client, map_name, session="room-0/seq-01", captured_before=START) == ids[:1]
    assert listed(client, map_name, has_pose=False) == []
    for bad in ({"robot": ""}, {"captured_after": datetime(2026, 1, 1)}, {"order": "up"}):
        with pytest.raises(InvalidRequest, match="The list is not valid"):
            listed(client, map_name, **bad)


def test_what_a_frame_is_made_of(client, map_name, ids, references):
    name = ids[0]
    assert client.upload_of(map_name, name) == references[0].path.read_bytes()
    cloud, at = client.cloud(map_name, name), client.cloud(map_name, name, "parent")
    assert f"comment frame {name}.optical\n".encode() in cloud
    assert b"comment frame r2/room-0/seq-01\n" in at
    a, b = (
        np.frombuffer(one.partition(b"end_header\n")[2], "<f4").reshape(-1, 6)[:, :3]
        for one in (cloud, at)
    )
    T = references[0].pose
    np.testing.assert_allclose(b, a.astype(float) @ T[:3, :3].T + T[:3, 3], atol=1e-5)
    with Image.open(io.BytesIO(client.preview(map_name, name, "normals", 96))) as image:
        assert image.size == (96, 72)
    patches = client.patches(map_name, name)
    signature = client.signature(map_name, name)
    # the signature is made of the second level alone
    assert [len(level.mean) for level in patches.levels[1:]] == signature.n_patches
    assert len(base64.b64decode(signature.base64)) == signature.length


def test_what_is_not_signed_yet(embedded, references):
    embedded.create_map("m", model="depth")
    added = embedded.upload("m", references[0])
    with pytest.raises(NotIndexed, match="is received"):
        embedded.preview("m", added.frame_id)


def test_a_run_and_its_poses(client, map_name, ids, references):
    (session,) = client.sessions(map_name)
    assert (session.robot, session.session, session.frames) == (
        "r2", "room-0/seq-01", {"indexed": 3},
    )  # fmt: skip
    assert (session.first_captured_at, session.with_pose) == (START, 3)
    thin = client.trajectory(map_name, "room-0/seq-01", most=2)
    assert (len(thin.poses), thin.posed > 2) == (2, True)
    told = client.trajectory(map_name, "room-0/seq-01", captured_after=START + timedelta(seconds=1))
    assert told.frame_ids == ids[1:]
    for row, one in zip(told.poses, references[1:], strict=False):
        np.testing.assert_allclose(row[1:4], one.pose[:3, 3], atol=1e-12)
    text = client.trajectory_text(map_name, "room-0/seq-01", robot="r2")
    rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
    assert [[float(word) for word in row] for row in rows[1:]] == told.poses
    with pytest.raises(InvalidRequest):
        client.trajectory(map_name, "")


def test_edits(client, map_name, ids):
    before = client.frame(map_name, ids[0])
    after = client.edit_frame(
        map_name, ids[0], {"captured_at": START, "tags": ["é"], "robot": None}, before.etag
    )
    assert (after.tags, after.robot, after.captured_at) == (["é"], None, START)
    assert after == client.frame(map_name, ids[0])
    with pytest.raises(PreconditionFailed):
        client.edit_frame(map_name, ids[0], {"tags": []}, before.etag)
    with pytest.raises(InvalidRequest):
        client.edit_frame(map_name, ids[0], {"depth_scale": 1})
    assert listed(client, map_name, tags="é") == ids[:1]
    told = client.map(map_name)
    assert client.edit_map(map_name, {"title": "Küche"}, told.etag).title == "Küche"
    with pytest.raises(PreconditionFailed):
        client.edit_map(map_name, {"title": None}, told.etag)
    client.delete_frame(map_name, ids[0])
    with pytest.raises(UnknownFrame, match="was deleted"):
        client.upload_of(map_name, ids[0])
