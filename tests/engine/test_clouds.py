"""Tests of point clouds in a store: decoding, answers, and mismatched models."""

import io
import sys

import numpy as np
import pytest
from sqlalchemy import select

from sceneprint.decoders import LocalDecoders
from sceneprint.engine.ingest.frame_decoder import content_id, read_upload
from sceneprint.engine.products.reconstruction import JobView, fused
from sceneprint.engine.search.verification import thresholds
from sceneprint.errors import UnreadableCloud
from sceneprint.formats.export import write_ply
from sceneprint.geometry.validation.acceptance import Evidence, belief, objection
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.pipeline import open_signer, sign
from sceneprint.store.tables import frames
from sceneprint_client.api import FrameMeta, JobState, Query
from sceneprint_client.api.query import ValidationOptions
from sceneprint_client.api.surface import NewReconstruction

#: Where clouds were seen from, metres in their own coordinates.
VIEWPOINT = np.array((2.0, -1.0, 0.5))
HERE = LocalDecoders(1)


def points_of(frame):
    """What a depth image sees, in its optical frame."""
    depth, k = frame.depth[::2, ::2].astype(float), frame.intrinsics
    y, x = np.nonzero(depth)
    z = depth[y, x]
    points = np.stack([(2 * x - k.cx) / k.fx * z, (2 * y - k.cy) / k.fy * z, z], axis=1)
    return points.astype(np.float32).astype(float)


def kitti(points):
    rows = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return rows.astype("<f4").tobytes()


def said(**more):
    return FrameMeta.model_validate(more)


def vector(engine, frame_id):
    return engine.outputs.vector("hall", frame_id).make()


def lose(engine, frame_id):
    """Remove the upload of a frame from the disk."""
    with engine.store.database.read() as connection:
        asked = select(frames.c.blob).where(frames.c.id == frame_id)
        engine.store.blobs.path(connection.execute(asked).scalar_one()).unlink()


def test_what_could_not_be_read_again_is_not_let_in():
    """A format that only its caller knows is lost with him."""
    odd = write_ply(np.eye(3)[np.arange(12) % 3]).replace(b"ply\n", b"ply\t\n", 1)
    with pytest.raises(UnreadableCloud, match="does not have the magic bytes"):
        read_upload(odd, said(format="ply"), HERE)


def test_minus_nought_is_no_other_viewpoint():
    data = write_ply(np.eye(3)[np.arange(12) % 3])
    mine = read_upload(data, said(viewpoint={"x": -0.0, "y": 0, "z": -0.0}), HERE)
    assert content_id(mine) == content_id(read_upload(data, said(), HERE))


def test_a_lost_cloud_comes_again_packed_otherwise_and_is_signed_with_another_model(
    empty, uploads, work_off
):
    points = points_of(uploads[0].frame)
    place = dict(zip("xyz", VIEWPOINT, strict=True))
    sent = (1000.0 * (points + VIEWPOINT)).astype(np.float32).astype(float)
    first = write_ply(sent)
    meta = said(viewpoint=place, units_per_metre=1000)
    other, of_many = kitti(points), said(viewpoint=None, format="kitti")
    frame_id = empty.add_frame("hall", first, meta)[0].frame_id
    other_id = empty.add_frame("hall", other, of_many)[0].frame_id
    assert work_off(empty) == [JobState.SUCCEEDED] * 2
    lose(empty, frame_id)
    again = said(viewpoint=place, units_per_metre=1000, format="kitti")
    assert empty.add_frame("hall", kitti(sent), again)[0].frame_id == frame_id
    assert empty.outputs.upload("hall", frame_id).make() == kitti(sent)

    empty.reencode("hall", "paper")
    assert set(work_off(empty)) == {JobState.SUCCEEDED}
    empty.publish_due()
    assert empty.get_map("hall").model.startswith("paper-")
    signer = open_signer("paper")
    for one, data, known in ((frame_id, first, meta), (other_id, other, of_many)):
        frame = read_upload(data, known, HERE).frame
        assert vector(empty, one) == sign(frame, signer).vector.tobytes()


def test_what_a_caller_asks_of_matches_is_asked_without_free_space_too():
    blind = Evidence(0.0, 0.0, overlap=0.5, plane_overlap=0.5, violations=None, stiffness=1.0)
    usual = ValidationParameters()
    assert objection(blind, thresholds(None, usual)[0].acceptance, "full") is None
    for asked, why in (
        ({"evidence": 0.6}, "only 50% of the surfaces agree"), ({"plane_overlap": 0.6}, "plane"),
    ):  # fmt: skip
        p, mode = thresholds(ValidationOptions.model_validate(asked), usual)
        found = objection(blind, p.acceptance, mode)
        assert why in found[1]
    p, _ = thresholds(ValidationOptions(ambiguous_share=0.1), usual)
    assert belief(blind, 0.1, usual.acceptance)[0] == "accepted"
    assert belief(blind, 0.1, p.acceptance)[0] == "ambiguous"


def test_what_is_behind_a_match_without_a_viewpoint_can_be_looked_at(empty, uploads, work_off):
    points = write_ply(points_of(uploads[0].frame))
    frame_id = empty.add_frame("hall", points, said(viewpoint=None))[0].frame_id
    image_id = empty.add_frame("hall", uploads[1].data, uploads[1].meta)[0].frame_id
    assert work_off(empty) == [JobState.SUCCEEDED] * 2
    for view in ("depth", "normals", "patches"):
        assert empty.outputs.preview("hall", frame_id, view).make().startswith(b"\x89PNG")
    answer = empty.queries.upload(["hall"], points, said(viewpoint=None), Query(k=2, explain=True))
    tried = {one.frame_id: one.validation for one in answer.matches}
    assert tried[frame_id].free_space_violations is None
    assert tried[image_id].free_space_violations is not None  # the image knows of free space
    told = {one.frame_id: one.reason for one in answer.explanations or ()}
    assert "violations unknown" in told[frame_id]
    details = empty.inspection.match(answer.query_id, frame_id)
    assert details.query.violations == []
    assert len(details.query.inliers) > 100
    for colour in ("source", "normal", "residual"):
        laid = empty.inspection.overlay(answer.query_id, frame_id, colour=colour)
        assert laid.startswith(b"ply\n")
    assert empty.inspection.cloud(answer.query_id).startswith(b"ply\n")


@pytest.mark.thorough
@pytest.mark.usefixtures("with_open3d")
def test_a_cloud_that_cannot_be_unpacked_here_costs_no_reconstruction(
    empty, uploads, work_off, monkeypatch
):
    """It would not be fused anyway, so nobody needs to read it."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = [0.001] * 3
    packed = laspy.LasData(header)
    packed.x, packed.y, packed.z = points_of(uploads[0].frame).T
    out = io.BytesIO()
    packed.write(out, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    cloud_id = empty.add_frame("hall", out.getvalue(), said())[0].frame_id
    image_id = empty.add_frame("hall", uploads[0].data, uploads[0].meta)[0].frame_id
    assert work_off(empty) == [JobState.SUCCEEDED] * 2
    monkeypatch.setitem(sys.modules, "lazrs", None)
    still = np.eye(4).tolist()
    views = [
        JobView("hall", one, i + 1, "strong", still) for i, one in enumerate((cloud_id, image_id))
    ]
    model = empty.get_map("hall").model_id
    wanted = NewReconstruction()
    coverage, ply = fused(empty.store, views, None, None, wanted, model, "query.sensor", 1e12)
    assert [one.frame_id for one in coverage.views] == [image_id]
    assert "is a point cloud" in coverage.left_out[0].reason
    # nobody knows the axes of the sensor of a cloud
    assert b"comment frame query.sensor, metres\n" in ply[:500]
