"""Tests of the file names and sequence numbers that the client sends with frames."""

import os

import numpy as np
import pytest

from sceneprint_client.api import FrameMeta
from sceneprint_client.frame_files import file_name, meta_of, sendable, seven_scenes_number


@pytest.mark.parametrize(
    ("name", "sent"),
    [
        ("a.png", "a.png"), ("depth/1.5.png", "depth/1.5.png"), ("/points/3.001", "points/3.001"),
        ("../../etc/./passwd", "etc/passwd"), ("a\\b\n.png", "a_b_.png"),
        ("é\U0001f600", "é\U0001f600"), (os.fsdecode(b"a\xff"), "a?"), ("x" * 300, "x" * 255),
        ("x../" + "y" * 252, "y" * 252), ("/", None), ("", None),
    ],
)  # fmt: skip
def test_whatever_a_file_is_called_it_can_be_sent(name, sent):
    assert file_name(name) == sent
    if sent is not None:
        assert FrameMeta(name=sent).name == sent


def test_the_number_of_a_file_is_its_place():
    assert seven_scenes_number("frame-000123.depth.png") == 123
    assert seven_scenes_number("frame-" + "9" * 16 + ".depth.png") is None
    assert seven_scenes_number("frame-000123.png") is None


def test_a_frame_is_sent_with_its_name_and_a_query_without(references, tmp_path):
    one = references[1]
    path, depth = one.path, np.full((4, 4), 1.5, np.float32)
    meta, camera = meta_of(one), (5.0, 5.0, 2.0, 2.0)
    assert (meta.name, meta.sequence) == ("frame-000001.depth.png", 1)

    def labels(frame, meta=None, *, with_pose=True):
        sent = sendable(frame, meta, with_pose=with_pose)[1]
        return sent.name, sent.sequence

    for frame in (one, path, str(path)):
        assert labels(frame) == ("frame-000001.depth.png", 1)
        assert labels(frame, with_pose=False) == (None, None)
        assert labels(frame, FrameMeta(intrinsics=meta.intrinsics)) == ("frame-000001.depth.png", 1)
        own = FrameMeta(intrinsics=meta.intrinsics, name="own", sequence=9)
        assert labels(frame, own) == ("own", 9)
    assert labels(depth, camera) == (None, None)
    assert labels(path.read_bytes(), meta) == (meta.name, meta.sequence)
    alone = tmp_path / "alone.npy"
    np.save(alone, depth)
    assert labels(alone, meta.intrinsics) == ("alone.npy", None)
