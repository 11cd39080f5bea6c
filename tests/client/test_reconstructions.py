"""Tests of reconstructions through the client: files, results and errors."""

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest, NotIndexed, UnknownJob, UnknownQuery
from sceneprint.formats.dataset import find_sequences
from sceneprint_client import Client
from sceneprint_client.api.surface import Reconstruction
from tests.cli_service.conftest import write_rooms
from tests.conftest import halved

NAME = "rebuilt"


@pytest.fixture(scope="module")
def views(tmp_path_factory, room_views):
    """Eight small neighbouring views of one room: most can be validated against each other."""
    frames = map(halved, room_views(33, 1, 8).frames)
    (sequence,) = find_sequences(write_rooms(tmp_path_factory.mktemp("walk"), frames, views=8))
    return list(sequence.frames)


@pytest.fixture(scope="module")
def answered(client, views, with_open3d):
    client.create_map(NAME, model="depth")
    for view in views[1:]:
        assert client.upload(NAME, view, wait_s=PATIENCE_S).state == "indexed"
    answer = client.query(NAME, views[0], k=4)
    assert answer.status == "found"
    return answer


def files(folder):
    return {path for path in (folder / "blobs").rglob("*") if path.is_file()}


def ply(data):
    """Points, triangles and comment of a PLY file, whose size must fit its header."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if "element" in line}
    points, faces = counts["vertex"], counts.get("face", 0)
    assert len(body) == points * (6 * 4 + 3) + faces * (1 + 3 * 4)
    return points, faces, next(line for line in lines if line.startswith("comment"))


def test_a_surface_and_its_figures(client, answered):
    begun = client.reconstruct(answered, voxel_m=0.04)
    [job] = client.wait([begun.job_id], timeout_s=PATIENCE_S)
    assert (job.state, job.kind, job.map) == ("succeeded", "reconstruct", NAME), job.error
    done = client.product(Reconstruction, None, begun.job_id)
    coverage = done.result
    mesh = client.reconstruction_mesh(begun.job_id)
    points, triangles, comment = ply(mesh)
    assert (points, triangles) == (coverage.points, coverage.triangles)
    assert comment == "comment frame query.optical: x right, y down, z forward, metres"
    accepted = [m for m in answered.matches if m.validation.status == "accepted"]
    views = coverage.views
    assert [view.frame_id for view in views[1:]] == [
        match.frame_id for match in sorted(accepted, key=lambda match: match.rank)
    ]
    assert (views[0].frame_id, views[0].source) == (None, "geometry")
    assert all(view.source == "upload" for view in views[1:])
    assert sum(view.added_m2 for view in views) == pytest.approx(coverage.area_m2)
    assert 0.5 < coverage.query_explained <= 1.0
    assert coverage.left_out == []


def test_what_is_wanted_is_what_is_fused(client, answered):
    answer = answered
    first = next(match for match in answer.matches if match.validation.status == "accepted")
    done = client.reconstruct(
        answer.query_id, frames=[first.frame_id], include_query=False, voxel_m=0.05,
        output="cloud", wait_s=PATIENCE_S,
    )  # fmt: skip
    assert done.result is not None, done.error
    assert [view.frame_id for view in done.result.views] == [first.frame_id]
    assert (done.result.triangles, done.result.voxel_m) == (0, 0.05)
    assert done.result.area_m2 > 1.0  # also of a cloud: it is that of the surface
    points, triangles, _ = ply(client.reconstruction_mesh(done.job_id))
    assert (points, triangles) == (done.result.points, 0)


def test_the_surface_lies_where_the_query_saw_it(client, answered, views):
    """Matches alone, in the query's camera: their points project onto the query's depth."""
    job = client.reconstruct(answered, include_query=False, strength="strong", wait_s=PATIENCE_S)
    data = client.reconstruction_mesh(job.job_id).partition(b"end_header\n")[2]
    rows = np.frombuffer(data[: 27 * job.result.points], np.uint8).reshape(-1, 27)
    points = rows[:, :12].copy().view("<f4").astype(float)
    query = views[0].read()
    k = query.intrinsics
    points = points[points[:, 2] > 0.3]
    x = np.rint(points[:, 0] / points[:, 2] * k.fx + k.cx).astype(int)
    y = np.rint(points[:, 1] / points[:, 2] * k.fy + k.cy).astype(int)
    seen = (x >= 0) & (x < k.width) & (y >= 0) & (y < k.height)
    depth = query.depth[y[seen], x[seen]]
    behind = points[seen, 2] - depth
    visible = (depth > 0) & (behind < 0.3)  # what is farther behind is hidden from the query
    assert visible.sum() > 1250
    assert np.median(np.abs(behind[visible])) < 0.02


def test_refusals(client, answered):
    with pytest.raises(UnknownQuery, match="no answer"):
        client.reconstruct("0" * 32)
    with pytest.raises(InvalidRequest, match="'nobody' is not an accepted match"):
        client.reconstruct(answered, frames=["nobody"])
    with pytest.raises(InvalidRequest, match="voxel_m"):
        client.reconstruct(answered, voxel_m=0.0001)
    begun = client.reconstruct(answered, voxel_m=0.002)  # finer than memory allows for a room
    [job] = client.wait([begun.job_id], timeout_s=PATIENCE_S)
    assert (job.state, job.attempts) == ("failed", 1)
    assert "Request 0.005 m or more" in str(job.error)
    with pytest.raises(NotIndexed, match=r"is failed \(.*Its mesh\.ply will be"):
        client.reconstruction_mesh(begun.job_id)
    client.delete_product(Reconstruction, None, begun.job_id)
    with pytest.raises(UnknownJob):
        client.delete_product(Reconstruction, None, begun.job_id)
    unvalidated = client.query(NAME, frame_id=answered.matches[0].frame_id, stages=["retrieve"])
    with pytest.raises(InvalidRequest, match="no accepted match, so"):
        client.reconstruct(unvalidated)


@pytest.mark.usefixtures("with_open3d")
def test_a_lost_upload_is_stood_in_for_and_a_deleted_frame_left_out(views, tmp_path):
    with Client.embedded(tmp_path) as client:
        client.create_map(NAME, model="depth")
        client.wait([client.upload(NAME, view).job_id for view in views[1:]])
        answer = client.query(NAME, views[0], k=4)
        accepted = sorted(
            (m for m in answer.matches if m.validation.status == "accepted"), key=lambda m: m.rank
        )
        assert len(accepted) >= 2
        begun = client.reconstruct(answer, voxel_m=0.05)
        lost, deleted = accepted[0].frame_id, accepted[1].frame_id
        size = client.frame(NAME, lost).bytes
        next(path for path in files(tmp_path) if path.stat().st_size == size).unlink()
        client.delete_frame(NAME, deleted)
        client.put_frame(NAME, deleted, views[0])  # another frame, which nobody has matched
        [job] = client.wait([begun.job_id], timeout_s=PATIENCE_S)
        assert job.state == "succeeded", job.error
        coverage = client.product(Reconstruction, None, begun.job_id).result
        sources = {view.frame_id: view.source for view in coverage.views}
        assert sources[lost] == "geometry"
        assert [frame.frame_id for frame in coverage.left_out] == [deleted]
        assert "replaced by a new frame" in coverage.left_out[0].reason
        # what the query saw is not kept beyond the job, and all goes with it
        before = files(tmp_path)
        client.delete_product(Reconstruction, None, begun.job_id)
        assert len(before - files(tmp_path)) == 1


def test_files_are_sent_in_ranges(client, answered):
    job = client.reconstruct(answered, voxel_m=0.05, wait_s=PATIENCE_S)
    whole = client.reconstruction_mesh(job.job_id)
    url = f"/v1/reconstructions/{job.job_id}/mesh.ply"
    http = client._http
    response = http.get(url)
    tag = response.headers["ETag"]
    assert (response.content, response.headers["Content-Type"]) == (whole, "application/ply")
    for span, expected in (("0-99", whole[:100]), ("100-", whole[100:]), ("-7", whole[-7:])):
        part = http.get(url, headers={"Range": f"bytes={span}", "If-Range": tag})
        assert (part.status_code, part.content) == (206, expected)
    assert http.get(url, headers={"Range": "bytes=1-2,5-6"}).content == whole
    assert http.get(url, headers={"Range": "bytes=0-9", "If-Range": '"old"'}).content == whole
    refused = http.get(url, headers={"Range": f"bytes={len(whole)}-"})
    assert (refused.status_code, refused.json()["type"]) == (416, "/problems/range-not-satisfiable")
    assert refused.headers["Content-Range"] == f"bytes */{len(whole)}"
    assert http.get(url, headers={"If-None-Match": tag}).status_code == 304
