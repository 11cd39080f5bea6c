"""Tests of point clouds in a store: decoding, answers, and mismatched models."""

import numpy as np
import pytest

from sceneprint.decoders import LocalDecoders
from sceneprint.engine.ingest.frame_decoder import content_id, read_upload
from sceneprint.errors import UnreadableCloud
from sceneprint.formats.export import write_ply
from sceneprint_client.api import FrameMeta, JobState, Query

HERE = LocalDecoders(1)


def points_of(frame):
    """What a depth image sees, in its optical frame."""
    depth, k = frame.depth[::2, ::2].astype(float), frame.intrinsics
    y, x = np.nonzero(depth)
    z = depth[y, x]
    points = np.stack([(2 * x - k.cx) / k.fx * z, (2 * y - k.cy) / k.fy * z, z], axis=1)
    return points.astype(np.float32).astype(float)


def said(**more):
    return FrameMeta.model_validate(more)


def test_what_could_not_be_read_again_is_not_let_in():
    """A format that only its caller knows is lost with him."""
    odd = write_ply(np.eye(3)[np.arange(12) % 3]).replace(b"ply\n", b"ply\t\n", 1)
    with pytest.raises(UnreadableCloud, match="does not have the magic bytes"):
        read_upload(odd, said(format="ply"), HERE)


def test_minus_nought_is_no_other_viewpoint():
    data = write_ply(np.eye(3)[np.arange(12) % 3])
    mine = read_upload(data, said(viewpoint={"x": -0.0, "y": 0, "z": -0.0}), HERE)
    assert content_id(mine) == content_id(read_upload(data, said(), HERE))


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
