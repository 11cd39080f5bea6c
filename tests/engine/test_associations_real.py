"""Tests of an association of two parts of a recording; see docs/associations.md."""

import math
from datetime import UTC, datetime, timedelta

import numpy as np

from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint_client.api import FrameMeta
from sceneprint_client.api.sessions import NewAssociation
from sceneprint_client.frame_files import sendable

#: Frames of redkitchen: the second stretch comes back to what the first saw.
FIRST, SECOND = range(100, 180, 10), range(640, 720, 10)


def origin(metres, degrees):
    """Somewhere else, turned about an upright axis."""
    T, angle = np.eye(4), math.radians(degrees)
    T[0, 0] = T[2, 2] = math.cos(angle)
    T[0, 2], T[2, 0] = math.sin(angle), -math.sin(angle)
    T[:3, 3] = (metres, -metres / 2, 2 * metres)
    return T


def test_halves_with_unrelated_origins_are_joined(data_root, empty, work_off):
    references = find_sequences(data_root / "7scenes" / "redkitchen")[0].frames
    origins, true = {"first": origin(3.0, 130.0), "second": origin(-2.0, 40.0)}, {}
    for session, numbers in (("first", FIRST), ("second", SECOND)):
        for i in numbers:
            data, meta = sendable(references[i], None, with_pose=True)
            pose = np.array(meta.pose.matrix)
            fields = meta.model_dump(exclude={"pose"}) | {
                "session": session,
                "captured_at": datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=i / 30),
                "pose": {"parent_frame": session, "matrix": (origins[session] @ pose).tolist()},
            }
            added, _ = empty.add_frame("hall", data, FrameMeta.model_validate(fields))
            true[added.frame_id] = pose
    work_off(empty)
    asked = NewAssociation(sessions=["second", "first"])
    begun = empty.associations.begin("hall", asked)
    work_off(empty)
    told = empty.associations.get("hall", begun.job_id)
    (join,) = told.result.joins
    T, wanted = np.array(join.transform.matrix), origins["first"] @ inverse(origins["second"])
    for frame_id in (one.frame_id for one in empty.list_frames("hall").items):
        here = origins["second"] @ true[frame_id]
        metres, radians = pose_difference(T @ here, wanted @ here)
        assert metres < 0.06
        assert radians < math.radians(2.0)
    edges = empty.associations.edges("hall", told.job_id).items
    assert len(edges) >= 15
    for edge in edges:
        truth = inverse(true[edge.to_frame]) @ true[edge.from_frame]
        metres, radians = pose_difference(truth, np.array(edge.transform.matrix))
        assert metres < 0.1
        assert radians < math.radians(10.0)
