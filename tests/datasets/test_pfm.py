"""Tests of depth images in PFM against the description of the format."""

import numpy as np
import pytest

from sceneprint.errors import UnreadableFrame
from sceneprint.formats.dataset import decode_frame, find_sequences
from sceneprint.formats.depth_file import size_of
from sceneprint.types import Intrinsics

#: Two rows, the lower one first in a file.
METRES = np.array([[1, 2, 0], [3.5, np.inf, np.nan]], np.float32)


def pfm(order="<", header="Pf\n3 2\n{}1.000000\n"):
    head = header.format("-" if order == "<" else "").encode()
    return head + METRES[::-1].astype(order + "f4").tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
def test_pfm(order):
    assert size_of(pfm(order)[:20]) == (3, 2)
    frame = decode_frame(pfm(order), Intrinsics(3, 2, 5.0, 5.0, 1.0, 0.5))
    np.testing.assert_array_equal(frame.depth, [[1, 2, 0], [3.5, 0, 0]])


def test_its_scale_makes_metres():
    data = pfm(header="Pf 3 2\r\n{}.5e-1\n")
    frame = decode_frame(data, Intrinsics(3, 2, 5.0, 5.0, 1.0, 0.5))
    np.testing.assert_allclose(frame.depth, [[0.05, 0.1, 0], [0.175, 0, 0]], rtol=1e-6)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (pfm()[:-1], "3 x 2 samples of 4 bytes, but 23 bytes follow"),
        (pfm() + b" ", "25 bytes follow"),
        (pfm(header="Pf\n3\n{}1\n"), "header of the PFM file"),
        (pfm(header="Pf\n3 2\n0\n"), "header of the PFM file"),
        (pfm(header="Pf\n3 2\n1e999\n"), "header of the PFM file"),
        (pfm(header="Pf\n0 2\n-1\n"), "not between 1 and 8388608"),
        (pfm(header="Pf\n99999 99999\n-1\n"), "not between 1 and 8388608"),
        (pfm(header="PF\n3 2\n-1\n"), "none of PNG"),
    ],
)
def test_lies(data, message):
    with pytest.raises(UnreadableFrame, match=message):
        decode_frame(data, Intrinsics(3, 2, 5.0, 5.0, 1.0, 0.5))


def test_a_folder_of_them_is_a_sequence(tmp_path):
    (tmp_path / "a.pfm").write_bytes(pfm())
    (tmp_path / "intrinsics.json").write_text(
        '{"width": 3, "height": 2, "fx": 5, "fy": 5, "cx": 1, "cy": 0.5}'
    )
    (sequence,) = find_sequences(tmp_path)
    assert [frame.path.name for frame in sequence.frames] == ["a.pfm"]
    assert sequence.frames[0].read().depth[1, 0] == 3.5
