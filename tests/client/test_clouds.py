"""Tests of point clouds through the client."""

import json

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.dataset import find_sequences, write_pose
from sceneprint.formats.export import write_ply
from sceneprint.formats.points.cloud import decode_cloud
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.pipeline import open_signer, sign


@pytest.fixture(scope="module")
def seen(room_frames):
    """What depth images of one room see, in their optical frames."""
    found = []
    for frame in room_frames[:2]:
        k, depth = frame.intrinsics, frame.depth.astype(float)
        y, x = np.nonzero(depth)
        z = depth[y, x]
        found.append(np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1))
    return found


@pytest.fixture(scope="module")
def folder(seen, room_frames, tmp_path_factory):
    """Two scans in centimetres from a mast, with their poses."""
    place = tmp_path_factory.mktemp("scans") / "run"
    place.mkdir()
    said = {"units_per_metre": 100, "viewpoint": {"x": 0, "y": 0, "z": 1.5}}
    (place / "clouds.json").write_text(json.dumps(said))
    for i, (points, frame) in enumerate(zip(seen, room_frames, strict=False)):
        (place / f"{i}.ply").write_bytes(write_ply(100 * (points + np.array([0, 0, 1.5]))))
        assert frame.pose is not None
        write_pose(place / f"{i}.pose.txt", frame.pose)
    return place


def test_a_folder_of_scans(client, map_name, folder, seen):
    client.create_map(map_name, model="depth")
    [sequence] = find_sequences(folder)
    for reference in sequence.frames:
        assert client.upload(map_name, reference, wait_s=PATIENCE_S).state == "indexed"
    first, second = client.frames(map_name)
    assert (first.kind, first.points, first.units_per_metre) == ("cloud", len(seen[0]), 100)
    assert (first.viewpoint.z, first.base_frame) == (1.5, "cloud")
    again = client.upload(map_name, folder / "0.ply", wait_s=PATIENCE_S)
    assert again.frame_id == first.frame_id

    # asked by bytes alone: the same numbers as of the library
    data = write_ply(seen[0])
    answer = client.query(map_name, data, k=2)
    signer = open_signer("depth")
    own, two = (sign(decode_cloud(one), signer) for one in map(write_ply, seen))
    told = {match.frame_id: match for match in answer.matches}
    apart = int(distances(own.vector, two.vector[None], "l2")[0])
    assert abs(told[second.frame_id].distance - apart) < 0.02 * apart  # centimetres are rounded
    assert told[first.frame_id].validation.status == "accepted"
    assert np.allclose(told[first.frame_id].transform.matrix, np.eye(4), atol=0.02)
    # one weak match, which the map's frames confirm
    assert (answer.status, answer.location.verified_by) == ("found", "map")
    assert (answer.location.support, answer.location.pose.parent_frame) == (
        1, first.pose.parent_frame,
    )  # fmt: skip
    itself = client.similarity((map_name, first.frame_id), data)
    assert itself.distance == told[first.frame_id].distance
