"""Tests of the comparison of two sessions: a new box, lost slices, and a deleted frame."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.engine.products.session_differences import POINTS
from sceneprint.errors import InvalidRequest
from sceneprint.geometry.rigid import inverse, transform_points
from sceneprint_client.api import JobState
from sceneprint_client.api.sessions import GONE, NEW, NewDifference
from sceneprint_client.surface_encoding import decode_points

#: Of the box's front, before the cameras; and the pixels that it fills there.
BOX_M = 0.8
BOX = (slice(120, 360), slice(160, 480))


@pytest.fixture
def compared(empty, uploads, make_upload, work_off):
    """Map `hall`: three frames of a room in session a, and in session b with something before the
    camera; one frame of another room in session c. Returns the engine and the box's pose."""
    for one in uploads[:3]:
        meta = one.meta.model_copy(update={"session": "a"})
        empty.add_frame("hall", one.data, meta)
    for one in uploads[:3]:
        depth = one.frame.depth.copy()
        depth[BOX] = np.where(depth[BOX] > BOX_M, BOX_M, depth[BOX])
        frame = replace(one.frame, depth=depth, pose=one.pose)
        sent = make_upload(frame, one.room, session="b")
        empty.add_frame("hall", sent.data, sent.meta)
    other = uploads[6].meta.model_copy(update={"session": "c"})
    empty.add_frame("hall", uploads[6].data, other)
    assert set(work_off(empty)) == {JobState.SUCCEEDED}
    return empty, [one.pose for one in uploads[:3]]


def difference(engine, work_off, before, after):
    begun = engine.differences.begin("hall", NewDifference(before=before, after=after))
    assert begun.state is JobState.QUEUED
    assert work_off(engine)[-1] is JobState.SUCCEEDED
    return engine.differences.get("hall", begun.job_id)


def points_of(engine, told):
    file = engine.differences.file("hall", told.job_id, POINTS)
    return decode_points(engine.store.blobs.get(file.blob))


def test_what_came_is_new_and_what_went_is_gone(compared, work_off):
    engine, poses = compared
    told = difference(engine, work_off, "a", "b")
    result = told.result
    assert (result.frames_before, result.frames_after, result.skipped) == (3, 3, 0)
    assert result.cell_m == 0.05
    assert result.new > 80
    assert result.gone <= 0.002 * result.same
    found = points_of(engine, told)
    assert found.patches is not None
    counts = np.bincount(found.patches, minlength=5).tolist()
    assert counts == [
        result.same, result.gone, result.new, result.unseen_after, result.unseen_before,
    ]  # fmt: skip
    # what is new lies on the box of one of the frames
    new = found.points[found.patches == NEW]
    depths = np.stack([transform_points(inverse(T), new)[:, 2] for T in poses])
    assert (np.abs(depths - BOX_M).min(axis=0) < 0.05).mean() > 0.95
    back = difference(engine, work_off, "b", "a")
    assert (back.result.gone, back.result.new) == (result.new, result.gone)
    gone = points_of(engine, back)
    np.testing.assert_array_equal(gone.points[gone.patches == GONE], new)


def test_sessions_that_cannot_be_compared_are_refused(compared):
    engine, _ = compared
    for asked, why in (
        ({"before": "a", "after": "z"}, "'z' of map 'hall' has no indexed frame with a pose"),
        ({"before": "a", "after": "c"}, "share no parent frame"),
        ({"before": "a", "after": "b", "parent_frame": "x"}, "parent frame 'x'. Choose from"),
    ):
        with pytest.raises(InvalidRequest, match=why):
            engine.differences.begin("hall", NewDifference.model_validate(asked))
    with pytest.raises(ValueError, match="must differ from before"):
        NewDifference(before="a", after="a")
